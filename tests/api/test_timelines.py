"""Timelines over HTTP: columns of each kind of resource, the file for viewers, and who may have them."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from sqlalchemy import select

from skills.db.models import Plan, PolicyVersion
from skills.schemas.timelines import MotionTimeline
from skills.verification.timeline import Timeline
from tests.api.keyed import copy_of_told
from tests.api.service import Service, assert_problem, serving

MCAP = {"Accept": "application/vnd.mcap"}


def digests(service: Service) -> dict[str, str]:
    """Return a resource of kestrel of each kind."""
    demo = service.client.demos(surgeon="kestrel")[0]
    with service.database.reading() as session:
        policy, plan = session.scalars(select(PolicyVersion.sha256)).first(), session.scalars(select(Plan.sha256)).one()
    return {"recordings": demo["recording"], "demos": demo["id"], "policy-versions": str(policy), "plans": plan}


def timeline_of(service: Service, source: str, sha256: str) -> Timeline:
    return MotionTimeline.model_validate(service.http.get(f"/timelines/{source}/{sha256}").json()).timeline


def test_a_demonstration_is_its_path_as_recorded(told: Service):
    demo = digests(told)["demos"]
    timeline, path = timeline_of(told, "demos", demo), told.client.demo_path(demo)
    at_s = timeline.start_s + np.array(path["stamps_s"]) - path["stamps_s"][0]
    seen = np.stack([np.interp(at_s, timeline.seconds(), one) for one in timeline.arms[0].tip_mm.T], axis=1)
    assert np.abs(seen - path["recorded_mm"]).max() < 0.2, "between two rows"
    assert timeline.arms[0].frame == path["frame"]


def test_a_plan_is_its_trajectory_with_the_verdict_beside_it(told: Service):
    plan = digests(told)["plans"]
    timeline, motion = timeline_of(told, "plans", plan), told.client.trajectory(plan)
    rows = np.array(motion["rows"])
    assert np.abs(timeline.arms[0].tip_mm[0] - rows[0, 3:6]).max() < 1e-4
    assert np.abs(timeline.arms[0].joints[-1] - rows[-1, 10:16]).max() < 0.1
    names = [trace.name for trace in timeline.traces]
    assert names == ["Tools above the pad", "The pass stays within reach and clear, the errors of an uncalibrated arm"]
    assert (timeline.traces[1].values[:5] <= 1).all()


@pytest.mark.parametrize("source", ["recordings", "demos", "policy-versions", "plans"])
def test_every_kind_has_columns_a_file_and_a_page(told: Service, source: str):
    sha256 = digests(told)[source]
    if source == "policy-versions" and told.http.get(f"/timelines/{source}/{sha256}").status_code == 404:
        assert "orientation" in assert_problem(told.http.get(f"/timelines/{source}/{sha256}"), 404)["detail"]
        return
    answer = told.http.get(f"/timelines/{source}/{sha256}")
    assert answer.json()["sha256"] == sha256 and answer.json()["timeline"]["rows"] > 10
    tag = {"If-None-Match": answer.headers["etag"]}
    assert told.http.get(f"/timelines/{source}/{sha256}", headers=tag).status_code == 304
    file = told.client.timeline_mcap(source, sha256)
    (notes,) = make_reader(io.BytesIO(file)).iter_metadata()
    assert notes.metadata["use"] == "to look at; not for execution"
    page = told.http.get(f"/pages/player/{source}/{sha256}", headers={"Accept": "text/html"})
    assert page.status_code == 200 and "The motion is being read" in page.text


def test_an_unknown_motion_is_not_found_also_beside_another(told: Service):
    recording = digests(told)["recordings"]
    for source in ("recordings", "demos", "policy-versions", "plans"):
        assert_problem(told.http.get(f"/timelines/{source}/{'0' * 64}"), 404)
        assert told.http.get(f"/pages/player/{source}/{'0' * 64}").status_code == 404
    assert told.http.get(f"/timelines/surgeons/{recording}").status_code == 422
    assert told.http.get(f"/pages/player/recordings/{recording}?beside=demos/{'0' * 64}").status_code == 404
    assert_problem(told.http.get(f"/timelines/recordings/{recording}", headers={"Accept": "text/csv"}), 415)


def test_every_motion_can_be_played_beside_another_however_many_there_are(told: Service, monkeypatch):
    monkeypatch.setattr("skills.library.recordings.timelines.MOST_CHOICES", 1)
    every = digests(told)
    demos = [one["id"] for one in told.client.demos()]
    assert len(demos) == 2
    others = [f"demos/{one}" for one in demos] + [f"{source}/{digest}" for source, digest in every.items()]
    for source, digest in every.items():
        for other in others:
            page = told.http.get(f"/pages/player/{source}/{digest}?beside={other}", headers={"Accept": "text/html"})
            assert page.status_code == 200, (source, other)
            assert page.text.count(f'<option value="{other}" selected>') == 1
    for other in ("surgeons/kestrel", "x"):
        assert told.http.get(f"/pages/player/demos/{every['demos']}?beside={other}").status_code == 404


def test_a_file_needs_consent_to_export_and_a_plan_consent_to_train(tmp_path):
    with serving(copy_of_told(tmp_path)) as service:
        every = digests(service)
        service.client.put_surgeon("kestrel", consent={"uses": ["training"], "until": None})
        for source in ("recordings", "demos"):
            assert service.http.get(f"/timelines/{source}/{every[source]}").status_code == 200
            assert_problem(service.http.get(f"/timelines/{source}/{every[source]}", headers=MCAP), 409)
        assert service.http.get(f"/timelines/plans/{every['plans']}", headers=MCAP).status_code == 200
        service.client.put_surgeon("kestrel", consent={"uses": ["export"], "until": None})
        assert_problem(service.http.get(f"/timelines/plans/{every['plans']}"), 409)
        assert service.http.get(f"/timelines/demos/{every['demos']}", headers=MCAP).status_code == 200
