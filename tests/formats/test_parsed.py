"""The summary of a recording for clients: complete, in plain JSON, and of bounded size."""

import json
from dataclasses import replace

import numpy as np
import pytest

from skills.demonstration.recording import Joints, Label, Recording, Signal
from skills.formats.parsed import MOST, parse
from skills.schemas import recordings as described
from skills.schemas.recordings import Following, JointStates, Pedal, Scale
from tests.demonstration import sessions
from tests.demonstration.sessions import Kind, session

NS = 10**9


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """Return two arms with every signal that a dVRK may record."""
    value, _ = session(Kind(seed=6, passes=2))
    origin_ns = value.origin_ns
    stamps_ns = origin_ns + np.array([0, 2, 5]) * NS
    return replace(
        value,
        joints=(Joints("PSM2", "/PSM2/measured_js", stamps_ns, np.zeros((3, 6))),),
        pedals=(("/footpedals/coag", Signal(stamps_ns, np.array([0.0, 1.0, 0.0]))),),
        following=(("MTMR_PSM2", Signal(stamps_ns[:1], np.array([1.0]))),),
        scales=(("MTMR_PSM2", Signal(stamps_ns[:2], np.array([0.2, 0.3]))),),
        tools=(("PSM2", "LARGE_NEEDLE_DRIVER:400006"),),
        labels=(Label("insertion", "stage", origin_ns + NS, origin_ns + 3 * NS),),
        notes=(("surgeon", "somebody"),),
    )


def test_all_that_a_recording_has_is_told(recorded):
    about = parse(recorded).about
    assert about.joints == [JointStates("PSM2", "/PSM2/measured_js", 6)]
    assert about.pedals == [Pedal("/footpedals/coag", 1, 3.0)]
    assert about.following == [Following("MTMR_PSM2", pytest.approx(recorded.duration_s))]
    assert about.scales == [Scale("MTMR_PSM2", 0.2, 0.3)]
    assert about.tools == {"PSM2": "LARGE_NEEDLE_DRIVER:400006"}
    assert about.labels == [described.Label("insertion", "stage", 1.0, 3.0)]
    assert {one.arm for one in about.quality} == {"PSM1", "PSM2"}
    assert [one.found_by for one in about.segments if one.arm == "PSM2"] == ["transfer", "transfer"]


def test_where_an_arms_base_stands_in_the_camera_is_told(recorded):
    about = parse(recorded).about
    assert {(one.arm, one.frame) for one in about.base_frames} == {("PSM1", "ECM"), ("PSM2", "ECM")}


def test_it_is_plain_json(recorded):
    about = parse(recorded).about.model_dump(mode="json")
    assert json.loads(json.dumps(about, allow_nan=False)) == about


def test_a_jump_is_named_before_anything_is_cut(recorded):
    moved = recorded.motions[0]
    tip_mm = moved.tip_mm.copy()
    tip_mm[len(tip_mm) // 2 :] += 40.0
    notes = parse(replace(recorded, motions=(replace(moved, tip_mm=tip_mm), *recorded.motions[1:]))).about.notes
    assert list(notes) == ["surgeon", f"jump of {moved.topic}"]
    assert "the tip jumps by 69.2 mm within" in notes[f"jump of {moved.topic}"]
    assert list(parse(recorded).about.notes) == ["surgeon"]


def test_a_recording_with_little_in_it_has_little_told():
    value, _ = session(Kind(seed=6, passes=1, jaw=False, clutch=False, both_arms=False, wrist=False))
    about = parse(value).about
    for name in ("joints", "masters", "pedals", "following", "scales", "labels"):
        assert getattr(about, name) == []
    empty = Signal(np.empty(0, np.int64), np.empty(0))
    silent = parse(replace(value, following=(("MTMR_PSM2", empty),), scales=(("MTMR_PSM2", empty),))).about
    assert silent.following == [Following("MTMR_PSM2", 0.0)]
    assert silent.scales == []


def test_what_a_recording_may_make_as_long_as_it_likes_is_cut_and_counted(recorded):
    origin_ns = recorded.origin_ns
    marks = tuple(Label("knot", "stage", origin_ns + k, origin_ns + k + 1) for k in range(3 * MOST))
    about = parse(replace(recorded, labels=marks)).about
    assert (len(about.labels), about.counts.labels) == (MOST, 3 * MOST)
    assert about.counts.segments == len(about.segments)
    assert sessions.A in {one.arm for one in about.segments}
