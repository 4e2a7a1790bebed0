"""What consent has to cover before anything leaves or is learnt from, whoever asks."""

import time
from pathlib import Path

from skills.api.gate import REMEMBERED_S
from tests import backends
from tests.api.keyed import As, copy_of_told, key
from tests.api.service import CSV, KESTREL, assert_problem, serving
from tests.library import cases


def test_what_leaves_for_elsewhere_needs_consent_to_an_export_and_what_is_learnt_consent_to_training(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        client, http = service.client, service.http
        demo = client.demos("kestrel")[0]["id"]
        plan = next(job for job in client.get_json("/jobs")["items"] if job["kind"] == "playback")["result"]["playback"]
        bag = f"/plans/{client.playback(plan)['plan']}/trajectory"
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
        assert (
            "does not cover training"
            in assert_problem(http.post("/trainings", json=KESTREL | {"seed": 6}), 409)["detail"]
        )
        client.put_surgeon("kestrel", consent={"uses": ["export", "training"], "until": "2020-01-01"})
        for answer in (http.get(f"/demos/{demo}/recording"), http.get(bag, headers=as_bag)):
            assert "ran out on 2020-01-01" in assert_problem(answer, 409)["detail"]


def test_a_recording_of_two_surgeons_leaves_only_with_both_consents_and_without_a_name(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        service.client.add_demo(cases.hand_off(), media_type=CSV, surgeon="heron", suture=cases.SUTURE)
        service.client.put_surgeon("kestrel", consent={"uses": ["training"], "until": None})
        recording = service.client.demos("kestrel")[0]["recording"]
        shared = next(one["id"] for one in service.client.demos("heron") if one["recording"] == recording)
        other = next(one["id"] for one in service.client.demos("heron") if one["recording"] != recording)
        heron = As(service, key(service, "of heron", "reader", surgeons=["heron"]))
        said = assert_problem(heron("GET", f"/demos/{shared}/recording"), 409)["detail"]
        assert "Another surgeon" in said
        assert "kestrel" not in said
        assert heron("GET", f"/demos/{other}/recording").status_code == 200


def test_whoever_was_let_in_learns_what_is_wrong_when_the_database_goes_away_and_nobody_else_does(tmp_path: Path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        anna, stranger = As(service, key(service, "anna", "reader")), As(service, f"skills_0badc0de_{'x' * 43}")
        assert anna("GET", "/surgeons").status_code == 200
        file = tmp_path / "away.sqlite"
        service.database.engine.dispose()
        service.app.state.access.close()
        Path(service.url.removeprefix("sqlite:///")).rename(file)
        Path(service.url.removeprefix("sqlite:///")).mkdir()  # no file can be opened there
        time.sleep(REMEMBERED_S)  # what is known has to be asked for again
        assert_problem(anna("GET", "/surgeons"), 503, "busy")
        assert_problem(anna("GET", "/readyz"), 503, "not-ready")
        assert "skills_database_up 0.0" in anna("GET", "/metrics").text
        assert_problem(stranger("GET", "/metrics"), 503, "busy")
