"""Equal trainings requested at the same moment become one job: real requests to the real service."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx2 as httpx
import pytest
from sqlalchemy import select

from skills.db.models import PolicyVersion
from skills.db.service_tables import Event, Job
from tests.backends import BACKENDS
from tests.jobs.house import add_demonstration, site
from tests.library import cases
from tests.waiting import END_S, until

AT_ONCE = 8
PATIENCE_S = END_S


@pytest.mark.nightly  # by day eight equal requests of a batch (`test_batches`)
@pytest.mark.parametrize("rounds", [5, 50])
@pytest.mark.parametrize("backend", BACKENDS)
def test_eight_equal_requests_at_once_are_one_job_in_each_round(backend: str, rounds: int, tmp_path: Path):
    with site(backend, tmp_path, workers=1) as place:
        add_demonstration(place.service.url)
        start = threading.Barrier(AT_ONCE)
        connections = [httpx.Client(base_url=place.service.url, timeout=PATIENCE_S) for _ in range(AT_ONCE)]

        def ask(http: httpx.Client) -> list[str]:
            jobs = []
            for seed in range(rounds):
                start.wait(PATIENCE_S)
                answer = http.post("/trainings", json={"surgeon": "kestrel", "suture": cases.SUTURE, "seed": seed})
                assert answer.status_code in (200, 202), answer.text
                jobs.append(answer.json()["id"])
            return jobs

        with ThreadPoolExecutor(AT_ONCE) as pool:
            told = list(pool.map(ask, connections))
        for http in connections:
            http.close()
        assert all(jobs == told[0] for jobs in told)
        until(lambda: place.jobs("succeeded") == rounds, PATIENCE_S)
        with place.database.reading() as session:
            asked = session.scalars(select(Event.object_id).where(Event.action == "ask")).all()
            finished = session.scalars(select(Event.object_id).where(Event.action == "finish")).all()
        assert sorted(asked) == sorted(finished) == sorted(told[0])
        assert (len(set(told[0])), place.count(Job), place.count(PolicyVersion)) == (rounds, rounds, rounds)
