"""The segment of a recording that becomes a demonstration: the proposed one, the named one, or none."""

import numpy as np
import pytest

from skills.seeds.recordings import sample_recordings
from tests.api.service import MCAP, Service, assert_problem
from tests.library import cases

KESTREL = {"surgeon": "kestrel", "suture": "simple-interrupted"}
SAMPLES = {(sample.surgeon, sample.suture): sample for sample in sample_recordings()}
ONE, FIVE = SAMPLES["wren", "simple-running"], SAMPLES["kestrel", "simple-interrupted"]


def send(service: Service, data: bytes, kind: str = MCAP, **asked: object):
    return service.http.post("/demos", params=KESTREL | asked, content=data, headers={"Content-Type": kind})


@pytest.fixture
def here(service: Service) -> Service:
    service.http.put("/surgeons/kestrel", json={})
    return service


def test_the_only_proposal_is_taken_and_said(here: Service):
    (proposed,) = here.client.add_recording(ONE.data)["segments"]
    demo = send(here, ONE.data).json()
    assert demo["segment"]["taken"] == "proposal 1 of 1"
    assert demo["segment"]["because"] == f"it is the only one: {proposed['reason']}"
    assert demo["start_s"] == demo["segment"]["start_s"] == pytest.approx(proposed["start_s"], abs=0.02)
    assert demo["end_s"] == demo["segment"]["end_s"] == pytest.approx(proposed["end_s"], abs=0.02)
    assert (
        demo["end_s"] - demo["start_s"] < 0.9 * here.http.get(f"/recordings/{demo['recording']}").json()["duration_s"]
    )
    assert here.http.get(f"/demos/{demo['id']}").json() == demo
    cut = here.http.post(f"/recordings/{demo['recording']}/demos", json=KESTREL)
    assert (cut.status_code, cut.json()) == (200, demo)


@pytest.mark.parametrize("stored", [False, True])
def test_of_several_proposals_one_must_be_named(here: Service, stored: bool):
    def ask(**asked: object):
        if not stored:
            return send(here, FIVE.data, **asked)
        recording = here.client.add_recording(FIVE.data)["id"]
        return here.http.post(f"/recordings/{recording}/demos", json=KESTREL | asked)

    problem = assert_problem(ask(), 422, "segment-not-named")
    listed = problem["numbers"]["segments"]
    assert [one["segment"] for one in listed] == [1, 2, 3, 4, 5]
    assert "segment=N" in problem["detail"]
    assert "segment=whole" in problem["detail"]
    assert here.http.get("/demos").json()["items"] == []
    second = ask(segment=2).json()
    assert second["segment"]["taken"] == "proposal 2 of 5"
    assert second["start_s"] == pytest.approx(listed[1]["start_s"], abs=0.02)
    given = ask(start_s=listed[1]["start_s"], end_s=listed[1]["end_s"]).json()
    assert given["id"] == second["id"]
    assert given["segment"]["taken"] == "the given times"
    whole = ask(segment="whole").json()
    assert whole["segment"]["taken"] == "the whole recording"
    assert whole["end_s"] > listed[-1]["end_s"]
    assert "5 hand-offs are proposed" in assert_problem(ask(segment=6), 422, "bad-segment")["detail"]
    assert_problem(ask(segment=1, end_s=5.0), 422, "bad-segment")
    for nonsense in (0, -1, "all", 1.5):
        assert_problem(ask(segment=nonsense), 422)


def test_where_no_hand_off_is_proposed_the_whole_is_taken_with_a_warning(here: Service):
    """A cut of one hand-off need not begin and end with a rest, so it is accepted completely; the response warns."""
    creeping = np.linspace([0.0, 50.0, -120.0], [4.0, 50.0, -120.0], 400)  # half a millimetre per second
    demo = send(here, cases.bag(tip=creeping), grid="fit", cell_mm=1.0).json()
    assert here.http.get(f"/recordings/{demo['recording']}").json()["segments"] == []
    assert demo["segment"]["taken"] == "the whole recording"
    assert "no hand-off is proposed" in demo["segment"]["because"]


def test_an_arm_that_is_named_has_proposals_of_its_own(here: Service):
    both = cases.bag("PSM1", "PSM2")
    listed = assert_problem(send(here, both), 422, "segment-not-named")["numbers"]["segments"]
    assert [one["arm"] for one in listed] == ["PSM1", "PSM2"]
    assert send(here, both, segment=2).json()["arm"] == "PSM2"
    assert send(here, both, arm="PSM2").json()["segment"]["taken"] == "proposal 1 of 1"
