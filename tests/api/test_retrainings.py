"""Batches over HTTP: one job, its styles one by one, and the refusals."""

import pytest

from skills.client import Problem
from tests.api.service import KESTREL, Service, assert_problem
from tests.library import cases
from tests.library.styles import add_styles

EXACT = {"kind": "value-iteration"}


def test_a_batch_is_asked_for_once_and_says_what_it_will_do(trained: Service):
    first = trained.http.post("/retrainings", json={"learner": EXACT, "release": True})
    job = first.json()
    assert (first.status_code, job["kind"], job["state"]) == (202, "retraining", "queued")
    assert first.headers["Location"] == f"/jobs/{job['id']}"
    asked = job["request"]
    assert (asked["only_stale"], asked["release"], asked.keys() & {"surgeon", "suture"}) == (False, True, set())
    assert (asked["styles"], asked["seed"], asked["learner"]["kind"]) == (1, 0, "value-iteration")
    assert trained.http.post("/retrainings", json={"learner": EXACT, "release": True}).json()["id"] == job["id"]
    trained.work()
    again = trained.http.post("/retrainings", json={"learner": EXACT, "release": True})
    assert (again.status_code, again.json()["state"], again.json()["progress"]) == (200, "succeeded", 1.0)


def test_every_style_tells_what_became_of_it(trained: Service):
    job = trained.client.retrain(learner=EXACT, release=True)
    (waiting,) = trained.client.retrained(job["id"])
    assert (waiting["state"], waiting["policy_version"], waiting["ended_at"]) == ("queued", None, None)
    trained.work()
    batch = trained.client.retraining(job["id"])
    assert (batch["id"], batch["kind"], batch["state"]) == (job["id"], "retraining", "succeeded")
    assert batch["styles"] == {"queued": 0, "done": 1, "failed": 0, "cancelled": 0} == batch["result"]
    (style,) = trained.client.retrained(job["id"])
    assert {name: style[name] for name in KESTREL} == KESTREL
    assert (style["state"], style["reason"], style["policy_version"]) == ("done", None, 2)
    assert style["stale_because"] == ["other settings"]
    assert style["comparison"]["released"]["version"] == 1
    assert style["comparison"]["worse_because"] == []
    assert style["sha256"] == trained.client.policy(**KESTREL)["sha256"] == style["comparison"]["trained"]["sha256"]


def test_failures_are_named_by_their_state_and_pages_follow_one_another(trained: Service):
    add_styles(trained.database, 7)
    with trained.database.writing() as session:
        cases.agree(session, {"uses": [], "until": None}, "surgeon-0")
    job = trained.client.retrain(only_stale=True)
    trained.work()
    failed = trained.client.retrained(job["id"], "failed")
    assert {style["surgeon"] for style in failed} == {"surgeon-0"}
    assert len(failed) == 7 and all("consent" in style["reason"] for style in failed)
    assert trained.client.retrained(job["id"], "done") == []
    batch = trained.client.retraining(job["id"])
    assert (batch["state"], batch["error"].split(";")[0]) == ("failed", "7 of 7 styles failed")
    first = trained.http.get(f"/retrainings/{job['id']}?limit=4").json()
    second = trained.http.get(f"/retrainings/{job['id']}?limit=4&cursor={first['next']}").json()
    assert (len(first["items"]), len(second["items"]), second["next"]) == (4, 3, None)
    assert first["items"] + second["items"] == failed


def test_a_batch_is_cancelled_whole_and_its_parts_are_nobodys_business(trained: Service):
    add_styles(trained.database, 3)
    job = trained.client.retrain(only_stale=True)
    assert [one["id"] for one in trained.http.get("/jobs?state=queued").json()["items"]] == [job["id"]]
    assert trained.client.cancel(job["id"])["state"] == "cancelled"
    assert trained.work() == []
    assert trained.client.retraining(job["id"])["styles"]["cancelled"] == 3
    assert trained.client.retrain(only_stale=True)["id"] != job["id"]


def test_nothing_stale_is_done_at_once(trained: Service):
    job = trained.client.retrain(only_stale=True)
    assert (job["state"], job["request"]["styles"], job["result"]["done"]) == ("succeeded", 0, 0)
    assert trained.client.retrained(job["id"]) == []


def test_what_cannot_be_meant_is_refused(trained: Service):
    ask = trained.http.post
    assert_problem(ask("/retrainings", json={"surgeon": "nobody"}), 404, "not-found")
    assert_problem(ask("/retrainings", json={"suture": "no-such"}), 404, "not-found")
    assert_problem(ask("/retrainings", json={"seed": 1}), 422)
    assert_problem(ask("/retrainings", json={"only_stale": 1}), 422)
    trained.client.put_surgeon("heron")
    with pytest.raises(Problem, match="no active demonstration"):
        trained.client.retrain(surgeon="heron")
    training = trained.client.train(**KESTREL, seed=5)
    assert_problem(trained.http.get(f"/retrainings/{training['id']}"), 404, "not-found")
    assert_problem(trained.http.get(f"/retrainings/{'0' * 16}"), 404, "not-found")
    assert_problem(trained.http.get(f"/retrainings/{training['id']}?state=stale"), 422)
