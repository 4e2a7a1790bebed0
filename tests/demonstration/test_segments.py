from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration import segments
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Label, Motion, Recording, Signal
from skills.demonstration.segments import propose_segments
from skills.errors import BadSegment, NotMetres
from tests.by_day import examples, some
from tests.demonstration import sessions
from tests.demonstration.sessions import Kind, kinds, session
from tests.demonstration.strokes import RATE, along_x, line, motion, recording

WITHIN_S = 0.3


def assert_found(kind: Kind) -> None:
    """Assert that the proposals match the true hand-offs in number and time."""
    value, truths = session(kind)
    proposed = propose_segments(value, sessions.A)
    assert len(proposed) == len(truths), kind
    for segment, truth in zip(proposed, truths, strict=True):
        assert segment.start_s == pytest.approx(truth.start_s, abs=WITHIN_S), kind
        assert segment.end_s == pytest.approx(truth.end_s, abs=WITHIN_S), kind


# ---- long recordings whose hand-offs are known ------------------------------------------------------------------


@pytest.mark.parametrize("kind", some(kinds(range(200, 201)), 4), ids=str)
def test_twelve_hand_offs_are_found_within_three_tenths_of_a_second(kind):
    assert_found(kind)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(50))
def test_they_are_found_on_fifty_seeds_however_they_were_recorded(seed):
    for kind in kinds(range(seed, seed + 1)):
        assert_found(kind)


def test_a1_gives_way_to_a2_where_the_tip_comes_to_rest():
    value, truths = session(Kind(seed=3))
    for segment, truth in zip(propose_segments(value, sessions.A), truths, strict=True):
        assert segment.handover_s == pytest.approx(truth.handover_s, abs=WITHIN_S)


def test_a_proposal_says_why():
    value, _ = session(Kind(seed=1))
    first = propose_segments(value, sessions.A)[0]
    assert first.found_by == "transfer"
    assert first.confidence is not None and first.confidence > 0.99
    for words in ("jaw closed 0.8 s before", "turns by 60 degrees in place", "PSM1's jaw closes", "jaw opens"):
        assert words in first.reason
    assert "PSM1 takes the needle: both jaws are closed for" in first.reason
    assert len(first.reasons) >= 5


def test_an_arm_that_both_see_in_one_frame_is_said_to_be_near():
    value, _ = session(Kind(seed=1, passes=2))
    in_camera = tuple(m for m in value.motions if "/local/" not in m.topic)
    first = propose_segments(replace(value, motions=in_camera), sessions.A)[0]
    assert "16 mm from this tip" in first.reason, "16 by construction"


def test_without_jaw_the_turn_in_place_tells_a_hand_off_from_the_way_back():
    value, truths = session(Kind(seed=2, jaw=False, passes=3))
    assert [s.found_by for s in propose_segments(value, sessions.A)] == ["motion"] * 3
    blind = tuple(replace(m, rotation_xyzw=None) for m in value.motions)
    assert len(propose_segments(replace(value, motions=blind), sessions.A)) > len(truths), "nothing tells them apart"


# ---- segments named by the user ---------------------------------------------------------------------------------

S = 10**9


def named(*labels, value=None):
    value = value or recording(motion(along_x((3, 0), (2, 20), (4, 0), (2, -20), (1, 0))))
    marks = tuple(Label(name, kind, round(start * S), round(end * S)) for name, kind, start, end in labels)
    return propose_segments(replace(value, labels=marks), "PSM2")


@pytest.mark.parametrize("name", ["hand-off", "Hand Off 3", "needle_handover", "A1+A2", "a1_a2"])
def test_a_stage_that_is_named_after_the_hand_off_is_one(name):
    (segment,) = named(("needle insertion", "stage", 0, 2.5), (name, "stage", 2.8, 6.0))
    assert (segment.start_s, segment.end_s, segment.found_by) == (2.8, 6.0, "stage")
    assert segment.handover_s == pytest.approx(5.0, abs=0.3)
    assert name in segment.reason


def test_the_stages_a1_and_a2_are_one_hand_off():
    (segment,) = named(("A1 pull", "stage", 2.8, 5.1), ("A2", "stage", 5.5, 6.5))
    assert (segment.start_s, segment.handover_s, segment.end_s) == (2.8, 5.1, 6.5)
    (alone,) = named(("A1", "stage", 2.8, 5.1), ("knot", "stage", 5.5, 6.5))
    assert (alone.handover_s, alone.end_s) == (5.1, 5.1)


@pytest.mark.parametrize(
    ("gestures", "until"), [("G6 G4", 2), ("G6 G8 G4", 3), ("G6 G8", 2), ("G6 G4 G8", 2), ("G3 G6 G4 G2", 3)]
)
def test_a_pull_and_what_passes_the_needle_on_are_one_hand_off(gestures, until):
    marks = [(name, "gesture", 2.5 + k, 3.5 + k) for k, name in enumerate(gestures.split())]
    (segment,) = named(*marks)
    pull = gestures.split().index("G6")
    assert (segment.start_s, segment.handover_s) == (2.5 + pull, 3.5 + pull)
    assert segment.end_s == 2.5 + until
    assert segment.found_by == "gesture"


def test_a_pull_that_passes_nothing_on_is_no_hand_off():
    assert [s.found_by for s in named(("G6", "gesture", 3, 5), ("G9", "gesture", 5, 6))] == ["motion"] * 2


def test_labels_of_other_things_leave_it_to_the_motion():
    assert [s.found_by for s in named(("knot tying", "stage", 0, 4))] == ["motion"] * 2


def test_a_label_names_no_arm_so_the_one_that_moves_is_taken():
    still = motion(along_x((12, 0)), arm="PSM1")
    value = recording(motion(along_x((3, 0), (2, 20), (7, 0))), still)
    label = (Label("hand-off", "stage", 2 * S, 6 * S),)
    value = replace(value, labels=label)
    assert [s.found_by for s in propose_segments(value, "PSM2")] == ["stage"]
    assert propose_segments(value, "PSM1") == ()


def test_a_label_outside_the_recording_is_passed_over():
    assert [s.found_by for s in named(("hand-off", "stage", 100, 200))] == ["motion"] * 2


# ---- cases worked by hand ---------------------------------------------------------------------------------------


def spans(value):
    return [(segment.start_s, segment.end_s) for segment in propose_segments(value, "PSM2")]


def test_idle_start_and_end_are_left_out():
    ((start_s, end_s),) = spans(recording(motion(along_x((3, 0), (2, 20), (4, 0)))))
    assert start_s == pytest.approx(3.0, abs=0.6)
    assert end_s == pytest.approx(5.0, abs=0.6)


def test_a_short_pause_is_bridged_and_a_long_one_separates():
    assert len(spans(recording(motion(along_x((2, 20), (1, 0), (2, 20)))))) == 1
    assert len(spans(recording(motion(along_x((2, 20), (4, 0), (2, 20)))))) == 2


def test_a_long_pause_with_the_clutch_pressed_is_bridged():
    clutch = Signal(np.array([3, 5]) * 10**9, np.array([1.0, 0.0]))
    value = recording(motion(along_x((2, 20), (4, 0), (2, 20))), clutch=clutch)
    assert len(spans(value)) == 1
    assert "pause" in propose_segments(value, "PSM2")[0].reason


def test_the_jaw_that_opens_between_two_passes_separates_them():
    tip_mm = along_x((2, 20), (1, -40), (2, 20))
    seconds = np.arange(len(tip_mm)) / RATE
    jaw = np.where((seconds > 2) & (seconds < 3), 0.9, 0.1)
    first, second = spans(recording(motion(tip_mm), jaw=jaw))
    assert first == pytest.approx((0.0, 2.0), abs=0.02)
    assert second == pytest.approx((3.0, 5.0), abs=0.02)


def test_a_jaw_that_never_moves_is_no_witness():
    assert len(spans(recording(motion(line(4, 20)), jaw=np.full(401, 0.1)))) == 1


def test_an_arm_at_rest_gives_no_segment():
    assert spans(recording(motion(line(4, 0)))) == []


def test_a_movement_begins_before_any_threshold_sees_it():
    share = np.clip(np.arange(-200, 801) / 600, 0, 1)  # 2 s of rest, a minimum-jerk movement of 6 s, 2 s of rest
    x = 60 * share**3 * (10 - 15 * share + 6 * share**2)
    ((start_s, end_s),) = spans(recording(motion(np.stack([x, 0 * x, 0 * x], axis=1))))
    assert start_s == pytest.approx(2.0, abs=0.3)
    assert end_s == pytest.approx(8.0, abs=0.3)


def test_a_tug_at_the_needle_is_not_yet_the_hand_off():
    tip_mm = along_x((2, 0), (0.2, 6), (0.2, -6), (0.8, 0), (2, 20), (2, 0))
    seconds = np.arange(len(tip_mm)) / RATE
    ((start_s, _),) = spans(recording(motion(tip_mm), jaw=np.where((seconds > 1) & (seconds < 6), 0.1, 0.9)))
    assert start_s == pytest.approx(3.2, abs=0.3)


def test_a_last_turn_counts_by_its_angle_and_not_by_a_rate(monkeypatch):
    """A wrist that turns by 6 degrees in 2 s ends no hand-off, even where so slow a turn is seen as one."""
    monkeypatch.setattr(segments, "TURNING_RAD_S", 0.01)
    tip_mm = along_x((2, 0), (2, 20), (1, 0), (2, 0), (2, 0))
    seconds = np.arange(len(tip_mm)) / RATE
    half = np.clip((seconds - 5) / 2, 0, 1) * 0.1 / 2
    turn = np.stack([np.sin(half), 0 * half, 0 * half, np.cos(half)], axis=1)
    jaw = np.where((seconds > 1) & (seconds < 8.5), 0.1, 0.9)
    ((_, end_s),) = spans(recording(motion(tip_mm, rotation=turn), jaw=jaw))
    assert end_s == pytest.approx(4.0, abs=0.3)


def test_what_is_small_beside_the_others_is_hand_work():
    tip_mm = along_x((2, 0), (0.5, 10), (4, 0), (2, 20), (4, 0), (2, 20), (2, 0))
    assert len(spans(recording(motion(tip_mm)))) == 2


def test_a_touch_of_the_threshold_is_no_movement():
    """A single smoothed sample of the session is above the threshold."""
    assert_found(Kind(seed=204, jaw=False, noisy=True))


@examples(60)
@given(st.integers(0, 2**32), st.booleans(), st.booleans(), st.booleans())
def test_any_motion_gives_ordered_proposals_that_can_be_cut(seed, jaw, pedal, turn):
    rng = np.random.default_rng(seed)
    parts = [(rng.uniform(0.02, 2.0), rng.choice([0, 0, 1, 2, 3, 20, -20])) for _ in range(rng.integers(1, 12))]
    tip_mm = along_x(*parts)
    if len(tip_mm) < 2:
        return
    times = np.sort(rng.uniform(0, len(tip_mm) / RATE, 6))
    clutch = Signal((times * S).astype(np.int64), rng.choice([0.0, 1.0, 2.0], 6)) if pedal else None
    angle = np.cumsum(rng.normal(0, 0.02, len(tip_mm)))
    rotation = np.stack([0 * angle, 0 * angle, np.sin(angle), np.cos(angle)], axis=1) if turn else None
    shut = np.repeat(rng.choice([0.0, 0.9], len(tip_mm) // 30 + 1), 30)[: len(tip_mm)] if jaw else None
    value = recording(motion(tip_mm, rotation=rotation), jaw=shut, clutch=clutch)
    before = -1.0
    for segment in propose_segments(value, "PSM2"):
        assert before <= segment.start_s <= segment.handover_s <= segment.end_s <= value.duration_s + 0.01
        before = segment.start_s
        with suppress(BadSegment, NotMetres):  # too little of it was driven
            cut_demo(value, start_s=max(0.0, segment.start_s), end_s=min(value.duration_s, segment.end_s))


def test_a_stamp_years_away_costs_no_memory():
    value = Motion(
        "PSM2", "/t", "f", 10**16 + np.array([0, 10**7, 10**18]), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    )
    propose_segments(Recording(format="csv", integrity="none", motions=(value,)), "PSM2")
