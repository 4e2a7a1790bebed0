"""Repeated release requests: a job reports the version served now, and a request for an ended release renews it."""

from typing import Any

import httpx2 as httpx
import pytest

from skills.client.blocking.client import Client
from skills.client.problems import NotReached
from skills.client.retrying import Retrying
from skills.library.policies import releases
from skills.library.policies.versions import list_versions
from tests.api.service import CSV, KESTREL, POLICY, Service, assert_problem
from tests.library import cases
from tests.library.styles import add_styles

ASK = KESTREL | {"release": True}


def ask(service: Service, **more: Any) -> dict[str, Any]:
    """Request training and release of kestrel's style, as in every earlier request."""
    return service.http.post("/trainings", json=ASK | more).json()


def served(service: Service) -> int | None:
    answer = service.http.get(POLICY)
    return answer.json()["version"] if answer.status_code == 200 else None


def told(job: dict[str, Any]) -> tuple[bool, int | None]:
    """Return a job's statement on its own version and on the version served."""
    return job["result"]["released"], job["served"] and job["served"]["version"]


def test_asked_again_for_what_is_served_nothing_is_done_and_that_is_said(trained: Service):
    events = trained.counts()["events"]
    again = ask(trained)
    assert again["did"] == "Nothing: the style serves version 1 already."
    assert told(again) == (True, 1)
    assert trained.counts()["events"] == events


def test_one_version_of_a_style_serves_or_none_does(trained: Service):
    def serving() -> list[bool]:
        with trained.database.reading() as session:
            return [releases.serves(session, one) for one in list_versions(session, **KESTREL, limit=9)]

    assert serving() == [True]
    trained.train(seed=7, release=True)
    assert serving() == [True, False]
    trained.client.withdraw(**KESTREL)
    assert serving() == [False, False]


def test_a_withdrawn_release_is_reported_and_a_new_request_releases_it(trained: Service):
    first = ask(trained)["id"]
    assert trained.http.delete(f"{POLICY}/release").status_code == 204
    for job in (trained.client.job(first), trained.http.get("/jobs?kind=training").json()["items"][0]):
        assert told(job) == (False, None)
        assert (job["result"]["was_released"], job["did"]) == (True, None)
        assert job["result"]["not_released_because"] == "It was released, and since then it was withdrawn."
        assert "Request the release again" in job["result"]["remedy"]
    assert "serves now" not in trained.http.get(f"/pages/jobs/{first}").text
    again = ask(trained)
    assert (again["id"], again["did"], told(again)) == (first, "Version 1 was released.", (True, 1))
    assert served(trained) == 1
    assert again["result"]["not_released_because"] is None


def test_a_superseded_release_is_reported_and_a_new_request_serves_it(trained: Service):
    first = ask(trained)["id"]
    trained.train(seed=7, release=True)
    job = trained.client.job(first)
    assert told(job) == (False, 2)
    assert job["result"]["not_released_because"] == "It was released, and since then version 2 was released."
    assert told(ask(trained)) == (True, 1)
    assert served(trained) == 1


def test_a_job_reports_that_its_version_was_released_by_hand(trained: Service):
    job = trained.train(seed=7)
    assert told(job) == (False, 1)
    assert (job["result"]["not_released_because"], job["result"]["remedy"]) == (None, None)
    assert trained.http.post(f"{POLICY}/versions/2/release").status_code == 200
    assert told(trained.client.job(job["id"])) == (True, 2)


def test_without_consent_or_the_demonstration_nothing_is_released_again(trained: Service):
    first = ask(trained)["id"]
    demo = trained.client.demos("kestrel")[0]["id"]
    trained.client.put_surgeon("kestrel", consent={"uses": ["export"], "until": None})
    refused = assert_problem(trained.http.post("/trainings", json=ASK), 409)
    assert "does not cover training" in refused["detail"]
    assert "does not cover training" in trained.client.job(first)["result"]["not_released_because"]
    trained.client.put_surgeon("kestrel", consent=None)
    assert "it was withdrawn" in trained.client.job(first)["result"]["not_released_because"]
    trained.client.withdraw_demo(demo)
    assert_problem(trained.http.post("/trainings", json=ASK | {"demos": [demo]}), 409)
    assert_problem(trained.http.post("/trainings", json=ASK), 409)
    assert told(trained.client.job(first)) == (False, None)
    assert served(trained) is None
    trained.client.withdraw_demo(demo, erase=True)
    assert_problem(trained.http.post("/trainings", json=ASK | {"demos": [demo]}), 404)
    assert_problem(trained.http.get(f"/jobs/{first}"), 404)


def test_a_refused_release_reports_reason_and_remedy_at_every_request(service: Service):
    service.client.put_surgeon("kestrel")
    service.client.put_suture_type(cases.SUTURE, name="Simple running", family="running", description="")
    service.client.add_demo(cases.hand_off((0.0, 0.0, -400.0)), media_type=CSV, **KESTREL)  # far below the arm's reach
    service.client.train(**KESTREL, release=True)
    service.work()
    again = ask(service)
    assert told(again) == (False, None)
    assert "joint limits" in again["result"]["not_released_because"]
    assert again["did"] == f"Nothing: {again['result']['not_released_because']}"
    assert "further inside the arm's reach" in again["result"]["remedy"]


def test_a_training_that_waits_says_so(trained: Service):
    first, second = ask(trained, seed=9), ask(trained, seed=9)
    assert (first["did"], second["did"]) == ("A new job is queued.", "Nothing: an equal job is queued already.")
    assert (second["result"], second["served"]["version"]) == (None, 1)


# ---- batches


def batch(service: Service) -> dict[str, Any]:
    """Request training and release of all styles, and carry it out."""
    asked = service.http.post("/retrainings", json={"release": True, "learner": {"kind": "value-iteration"}}).json()
    service.work()
    return asked


def test_a_repeated_batch_trains_only_styles_whose_release_was_withdrawn(trained: Service):
    add_styles(trained.database, 3)
    first = batch(trained)
    assert first["did"] == "A new job is queued, of 4 styles."
    again = batch(trained)
    assert (again["id"], again["did"]) == (
        first["id"],
        "Nothing: an equal batch trained 4 styles, and 4 of them serve its version, as when it ended.",
    )
    assert trained.http.delete(f"{POLICY}/release").status_code == 204
    mine = next(one for one in trained.client.retrained(first["id"]) if one["surgeon"] == "kestrel")
    assert (mine["comparison"]["now_released"], mine["comparison"]["was_released"], mine["served"]) == (
        False,
        True,
        None,
    )
    assert mine["comparison"]["not_released_because"] == "It was released, and since then it was withdrawn."
    released = batch(trained)
    assert released["id"] != first["id"]
    assert (released["request"]["styles"], released["request"]["after"]) == (1, first["id"])
    assert served(trained) == 2
    assert (
        next(one for one in trained.client.retrained(first["id"]) if one["surgeon"] == "kestrel")["served"]["version"]
        == 2
    )
    assert batch(trained)["id"] == first["id"]


def test_a_batch_is_repeated_as_often_as_its_release_does_not_stand(trained: Service):
    ids = set()
    for _ in range(3):
        ids.add(batch(trained)["id"])
        assert served(trained) == 2
        assert trained.http.delete(f"{POLICY}/release").status_code == 204
    assert len(ids) == 3


def test_a_batch_asked_for_twice_while_it_waits_is_one(trained: Service):
    batch(trained)
    assert trained.http.delete(f"{POLICY}/release").status_code == 204
    asked = {"release": True, "learner": {"kind": "value-iteration"}}
    first, second = (trained.http.post("/retrainings", json=asked).json() for _ in range(2))
    assert first["id"] == second["id"]
    assert second["did"] == "Nothing: an equal job is queued already."


# ---- the client


@pytest.mark.parametrize("call", ["train", "retrain"])
def test_the_client_repeats_no_training_with_a_release_by_itself(call: str):
    sent = []

    def lose(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        raise httpx.ReadTimeout("lost", request=request)

    http = httpx.Client(transport=httpx.MockTransport(lose), base_url="http://127.0.0.1")
    client = Client(http, retrying=Retrying(attempts=3, first_s=0.0))
    for release, times in ((True, 1), (False, 3)):
        sent.clear()
        with pytest.raises(NotReached):
            getattr(client, call)(**KESTREL, release=release)
        assert len(sent) == times
