"""Consent over HTTP: it must cover an export before data leave, and training before anything is learnt."""

import time
from collections.abc import Callable
from datetime import date, timedelta
from pathlib import Path

import httpx2 as httpx
import pytest

from skills.api.authentication import REMEMBERED_S
from skills.api.encoded_policies import NPZ
from skills.library.people import consent
from tests import backends
from tests.api.keyed import As, copy_of_told, key
from tests.api.service import CSV, GOAL_MM, KESTREL, POLICY, Service, assert_problem, serving
from tests.library import cases


def test_exports_need_export_consent_and_training_needs_training_consent(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        client, http = service.client, service.http
        demo = client.demos("kestrel")[0]["id"]
        plan = next(job for job in client.get_json("/jobs")["items"] if job["kind"] == "playback")["result"]["playback"]
        bag = f"/plans/{client.playback(plan)['plan']}/trajectory?handoff=none"
        as_bag = {"Accept": "application/zip"}
        assert http.get(f"/demos/{demo}/recording").status_code == 200
        assert http.get(bag, headers=as_bag).status_code == 200
        client.put_surgeon("kestrel", consent={"uses": ["training"], "until": None})
        assert "does not cover export" in assert_problem(http.get(f"/demos/{demo}/recording"), 409)["detail"]
        assert "does not cover export" in assert_problem(http.get(bag, headers=as_bag), 409)["detail"]
        assert http.get(f"/demos/{demo}/path").status_code == 200
        assert http.post("/trainings", json=KESTREL | {"seed": 5}).status_code == 202
        client.put_surgeon("kestrel", consent={"uses": ["export"], "until": None})
        assert http.get(f"/demos/{demo}/recording").status_code == 200
        assert "does not cover training" in assert_problem(http.get(bag, headers=as_bag), 409)["detail"]
        assert (
            "does not cover training"
            in assert_problem(http.post("/trainings", json=KESTREL | {"seed": 6}), 409)["detail"]
        )
        client.put_surgeon("kestrel", consent={"uses": ["export", "training"], "until": "2020-01-01"})
        for answer in (http.get(f"/demos/{demo}/recording"), http.get(bag, headers=as_bag)):
            assert "expired on 2020-01-01" in assert_problem(answer, 409)["detail"]


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_expired_consent_stops_serving_without_a_database_change(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    url, last = backends.fresh(backend, tmp_path), date(2031, 3, 31)
    monkeypatch.setattr(consent, "today", lambda: last)  # the test may go on past midnight
    with serving(url) as service:
        client, http = service.client, service.http
        client.put_surgeon("kestrel", consent={"uses": ["training", "export"], "until": last.isoformat()})
        client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
        digest = service.train(release=True)["result"]["sha256"]
        plan = client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")["sha256"]
        start = {"start_mm": [-10, 55, -135]}
        tag = http.get(POLICY).headers["etag"]
        given: dict[str, Callable[[], httpx.Response]] = {
            "JSON": lambda: http.get(POLICY),
            "arrays": lambda: http.get(POLICY, headers={"Accept": NPZ}),
            "not changed": lambda: http.get(POLICY, headers={"If-None-Match": tag}),
            "rollout": lambda: http.post(f"{POLICY}/rollouts", json=start),
            "next": lambda: http.post(f"{POLICY}/next", json={"position_mm": start["start_mm"]}),
            "version": lambda: http.get(f"{POLICY}/versions/1"),
            "rollout of a version": lambda: http.post(f"{POLICY}/rollouts", json=start | {"version": 1}),
            "digest": lambda: http.get(f"/policy-versions/{digest}", headers={"Accept": NPZ}),
            "motion": lambda: http.get(f"/plans/{plan}/trajectory"),
            "table": lambda: http.get(f"/plans/{plan}/trajectory", headers={"Accept": "text/csv"}),
        }
        for ask in given.values():
            for _ in range(2):  # the second response comes from the cache
                assert ask().status_code in (200, 304)
        assert "is served to clients" in http.get(f"/pages/styles/kestrel/{cases.SUTURE}").text
        assert [one["version"] for one in client.policies()] == [1]
        monkeypatch.setattr(consent, "today", lambda: last + timedelta(days=1))
        refused = {name: ask() for name, ask in given.items()}
        assert {name: answer.status_code for name, answer in refused.items()} == dict.fromkeys(
            given, 409
        ) | dict.fromkeys(("JSON", "arrays", "not changed", "rollout", "next"), 404)
        assert all(f"expired on {last}" in answer.json()["detail"] for answer in refused.values())
        assert client.policies() == []
        card = http.get(f"{POLICY}/versions/1/card", headers={"Accept": "application/json"}).json()
        assert (card["status"]["released_now"], card["status"]["served_now"]) == (False, None)
        assert "consent no longer covers training" in card["status"]["in_words"]
        assert not card["status"]["releases"][0]["serving"]
        assert "is served to clients" not in http.get(f"/pages/styles/kestrel/{cases.SUTURE}").text
    backends.drop(url)


def test_consent_withdrawn_in_one_request_is_not_served_in_the_next(trained: Service):
    assert trained.http.get(POLICY).status_code == 200
    trained.client.put_surgeon("kestrel", consent={"uses": ["export"], "until": None})
    assert "does not cover training" in assert_problem(trained.http.get(POLICY), 404)["detail"]
    trained.client.put_surgeon("kestrel", consent=None)
    assert "is released" in assert_problem(trained.http.get(POLICY), 404)["detail"]


def test_a_shared_recording_needs_both_consents_and_refusals_name_nobody(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        service.client.add_demo(cases.hand_off(), media_type=CSV, surgeon="heron", suture=cases.SUTURE)
        service.client.put_surgeon("kestrel", consent={"uses": ["training"], "until": None})
        recording = service.client.demos("kestrel")[0]["recording"]
        shared = next(one["id"] for one in service.client.demos("heron") if one["recording"] == recording)
        other = next(one["id"] for one in service.client.demos("heron") if one["recording"] != recording)
        heron = As(service, key(service, "of heron", "reader", surgeons=["heron"]))
        said = assert_problem(heron("GET", f"/demos/{shared}/recording"), 409)["detail"]
        assert "another surgeon" in said
        assert "kestrel" not in said
        assert heron("GET", f"/demos/{other}/recording").status_code == 200


def test_only_known_keys_get_status_details_while_the_database_is_away(tmp_path: Path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        anna, stranger = As(service, key(service, "anna", "reader")), As(service, f"skills_0badc0de_{'x' * 43}")
        assert anna("GET", "/surgeons").status_code == 200
        file = tmp_path / "away.sqlite"
        service.database.engine.dispose()
        service.app.state.access.close()
        Path(service.url.removeprefix("sqlite:///")).rename(file)
        Path(service.url.removeprefix("sqlite:///")).mkdir()  # no file can be opened there
        time.sleep(REMEMBERED_S)  # cached keys expire, and have to be looked up again
        assert_problem(anna("GET", "/surgeons"), 503, "busy")
        assert_problem(anna("GET", "/readyz"), 503, "not-ready")
        assert "skills_database_up 0.0" in anna("GET", "/metrics").text
        assert_problem(stranger("GET", "/metrics"), 503, "busy")
