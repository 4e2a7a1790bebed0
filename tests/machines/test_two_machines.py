"""Two machines on one PostgreSQL: trained here, played there, exported and verified here, and the reverse."""

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select

from skills.db.models import Plan, PolicyVersion, StoredPlayback
from skills.db.session import Database
from skills.formats.reader_process import read_told
from skills.formats.verify import check_bag
from skills.library.inspection import inspect_installation
from skills.library.playbacks import request_playback
from skills.library.replay import replay_bag
from skills.settings import Settings
from skills.verification.arm_errors import UNCALIBRATED
from tests import backends
from tests.library import cases
from tests.machines.test_machines import OLDEST


def train(database: Database) -> str:
    return cases.train(database, release=True).sha256


def plan(database: Database) -> str:
    return cases.add_plan(database, tissue_mm=-160.0).sha256


def play(database: Database) -> str:
    with database.writing() as session:
        sha256 = session.scalars(select(Plan.sha256)).one()
        job = request_playback(session, sha256, "test", Settings())[0]
    ended = cases.work(database, job)
    assert ended.state == "succeeded", ended.error
    return str((ended.result or {})["playback"])


def export(database: Database) -> str:
    with database.reading() as session:
        sha256 = session.scalars(select(Plan.sha256)).one()
    bag = replay_bag(database, sha256, errors=UNCALIBRATED, lower_bound=0.0, handoff="none")
    check_bag(io.BytesIO(bag))
    return "a bag"


def verify(database: Database) -> list[Any]:
    return [one for part in inspect_installation(database, read_told, relearn=Settings()) for one in part.wrong]


STEPS = {step.__name__: step for step in (train, plan, play, export, verify)}


def take(step: str, url: str) -> Any:
    with closing(Database(url)) as database:
        return STEPS[step](database)


def there(step: str, url: str) -> Any:
    """Take a step as another machine does."""
    command = [sys.executable, "-m", "tests.machines.test_two_machines", step, url]
    ended = subprocess.run(command, env=os.environ | OLDEST, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    here = backends.fresh("postgresql", tmp_path)
    with closing(Database(here)) as database:
        cases.add_surgeon(database)
        cases.add_demo(database)
    yield here
    backends.drop(here)


@pytest.mark.needs("simulator")
@pytest.mark.parametrize(
    "machines", [(take, there), pytest.param((there, take), marks=pytest.mark.nightly)], ids=["here", "there"]
)
def test_what_one_machine_trains_another_plays_and_the_first_exports(machines: Any, url: str):
    one, other = machines
    trained = one("train", url)
    one("plan", url)
    played = other("play", url)
    assert one("export", url) == other("export", url) == "a bag"
    assert one("play", url) == played  # an equal job has succeeded, so nothing is played again
    assert one("verify", url) == other("verify", url) == []
    with closing(Database(url)) as database, database.reading() as session:
        assert session.scalars(select(PolicyVersion.sha256)).all() == [trained]
        assert session.scalar(select(func.count()).select_from(StoredPlayback)) == 1


if __name__ == "__main__":
    print(json.dumps(take(*sys.argv[1:])))
