"""Timelines: columns against the arms that made them, by hand and by other ways, and what is not known is NaN."""

from dataclasses import replace
from functools import cache

import numpy as np
import orjson
import pytest
from pydantic import TypeAdapter

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Motion, Recording, Signal
from skills.dynamics import Servo, predict
from skills.fields import as_json
from skills.kinematics import JOINTS, forward, matrix_of
from skills.learning.pose_style import PosePath
from skills.planning.passes import PassPath
from skills.planning.trajectory import Trajectory, time_parametrise
from skills.verification.bodies import names_of, parts_of, radii_of
from skills.verification.timeline import (
    MOST_ROWS,
    Timeline,
    timeline_of_demo,
    timeline_of_path,
    timeline_of_plan,
    timeline_of_recording,
)
from tests.verification.timelines import NAME, START_NS, base_of, joints_at, two_arms

FORM = TypeAdapter(Timeline)


@cache
def short() -> Recording:
    return two_arms(6.0)


def test_the_columns_are_those_of_the_arms_that_moved():
    timeline = timeline_of_recording(short())
    assert (timeline.rate_hz, timeline.rows, timeline.in_one_frame, timeline.start_s) == (200.0, 1200, True, 0.0)
    for track in timeline.arms:
        base, place = base_of(track.arm)
        tip_mm, rotation = forward(joints_at(track.arm, timeline.seconds()), NAME)
        assert np.abs(track.tip_mm - (tip_mm @ base.T + place)).max() < 1e-4
        assert np.abs(matrix_of(track.rotation_xyzw.astype(float)) - base @ rotation).max() < 1e-5
        assert np.abs(track.joints - joints_at(track.arm, timeline.seconds())).max() < 1e-4
        way = np.linalg.norm(np.diff(tip_mm, axis=0), axis=1) * 200.0
        assert np.abs(track.speed_mm_s[200:-200] - way[200:-199]).max() < 0.05 * way.max()


def test_the_outer_bodies_stand_where_joints_and_base_put_them():
    timeline = timeline_of_recording(short())
    at_s = timeline.seconds()[:: timeline.every]
    apart = timeline.traces[0]
    assert (apart.name, apart.limit) == ("Outer bodies apart", 2.0)
    for track in timeline.arms:
        base, place = base_of(track.arm)
        parts = parts_of(joints_at(track.arm, at_s), NAME).seen_from(base, place)
        assert track.bodies == names_of(NAME)[:-1] and track.radii_mm == tuple(radii_of(NAME)[:-1])
        # The base is fitted to the poses, which were rounded to nothing here.
        assert np.abs(track.bodies_mm[:, :, :3] - parts.begin_mm[:, :-1]).max() < 0.05
        assert np.abs(track.bodies_mm[:, :, 3:] - parts.end_mm[:, :-1]).max() < 0.05


def test_where_a_base_moved_or_turned_no_bodies_are_placed(monkeypatch):
    for spread in ({"spread_mm": 10.0}, {"spread_rad": 0.2}):
        monkeypatch.setattr(Recording, "bases", tuple(replace(one, **spread) for one in two_arms(6.0).bases))
        assert all(one.bodies_mm is None for one in timeline_of_recording(two_arms(6.0)).arms)
        monkeypatch.undo()


def test_a_demonstration_is_in_its_own_frame_with_its_recordings_times():
    recording = short()
    demo = cut_demo(recording, arm="PSM1", start_s=1.0, end_s=5.0)
    timeline = timeline_of_demo(recording, demo)
    track = timeline.arms[0]
    assert (timeline.kind, track.frame, timeline.start_s) == ("demonstration", demo.frame, demo.start_s)
    assert np.abs(track.tip_mm - demo.tip_mm).max() < 1e-4
    assert [stage.name for stage in timeline.stages] == ["grasping", "driving", "hand-off"]
    assert track.bodies_mm is not None, "its joints show where its base stands"


def test_arms_without_a_common_frame_are_each_in_their_own():
    recording = short()
    apart = [replace(one, topic=f"/{one.arm}/local/measured_cp", frame=f"{one.arm}_base") for one in recording.motions]
    timeline = timeline_of_recording(replace(recording, motions=tuple(apart), joints=()))
    assert not timeline.in_one_frame
    assert [(one.arm, one.frame, one.bodies) for one in timeline.arms] == [
        ("PSM1", "PSM1_base", ()),
        ("PSM2", "PSM2_base", ()),
    ]
    assert timeline.traces == ()


def test_where_an_arm_was_not_recorded_there_is_no_number():
    first, second = short().motions
    late = Motion("PSM2", second.topic, "ECM", second.stamps_ns[600:900], second.tip_mm[600:900], None)
    timeline = timeline_of_recording(Recording("mcap", "full", (first, late)))
    known = ~np.isnan(timeline.arms[1].tip_mm[:, 0])
    assert known[600:900].all() and not known[:590].any() and not known[910:].any()
    assert np.isnan(timeline.arms[1].speed_mm_s[:590]).all() and timeline.arms[1].rotation_xyzw is None
    assert np.isfinite(timeline.way).all() and timeline.way[-1] == 1


def test_a_long_recording_gets_a_lower_rate():
    stamps_ns = START_NS + np.arange(60_000) * 20_000_000  # twenty minutes at 50 Hz
    tip_mm = np.column_stack([np.sin(np.arange(60_000) / 300), np.zeros(60_000), np.zeros(60_000)])
    timeline = timeline_of_recording(Recording("mcap", "full", (Motion("PSM1", "t", "base", stamps_ns, tip_mm),)))
    assert MOST_ROWS - 2 <= timeline.rows <= MOST_ROWS
    assert timeline.seconds()[-1] == pytest.approx(1199.98, abs=0.1)


def test_a_pressed_clutch_lasts_to_the_end_if_it_never_goes_up():
    clutch = Signal(START_NS + np.array([0, 2, 3, 5]) * 1_000_000_000, np.array([0.0, 1.0, 0.0, 1.0]), "clutch")
    timeline = timeline_of_recording(replace(short(), clutch=clutch))
    assert timeline.clutch_s == ((2.0, 3.0), (5.0, pytest.approx(5.995)))


def test_the_columns_come_back_from_json_to_the_bit():
    timeline = timeline_of_recording(short())
    back = FORM.validate_python(orjson.loads(orjson.dumps(as_json(timeline))))
    assert orjson.dumps(as_json(back)) == orjson.dumps(as_json(timeline))
    assert np.array_equal(back.arms[1].bodies_mm, timeline.arms[1].bodies_mm)
    assert back.arms[0].tip_mm.shape == (timeline.rows, 3)


def test_a_learnt_path_has_the_tempo_of_its_style():
    elapsed_s = np.array([0.0, 1.0, 4.0])
    tips = np.array([[0.0, 0, 0], [10.0, 0, 0], [10.0, 30.0, 0]])
    still = np.tile([0.0, 0, 0, 1.0], (3, 1))
    path = PosePath(tips, still, elapsed_s, np.array([0.2, 0.2, 0.8]), np.zeros(3), np.zeros(3))
    timeline = timeline_of_path(path, arm="PSM2", frame="PSM2_base")
    assert timeline.rows == 801
    assert timeline.arms[0].tip_mm[[100, 200, 500]].tolist() == [[5, 0, 0], [10, 0, 0], [10, 15, 0]]
    assert timeline.way[[100, 200, 500]] == pytest.approx([5 / 40, 10 / 40, 25 / 40], abs=1e-5)
    assert timeline.arms[0].jaw_rad[500] == pytest.approx(0.5)


def planned() -> Trajectory:
    down = matrix_of(np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0]]))[0]
    passes = [PassPath(np.array([[x, 30.0, -130.0], [x + 5, 50.0, -115.0]]), down) for x in (-20.0, 0.0)]
    return time_parametrise(passes)


def test_an_executed_plan_has_one_more_arm_a_tube_and_efforts():
    t, servo = planned(), Servo(velocities=False)
    timeline = timeline_of_plan(t, arm="PSM2", frame="PSM2_base", servo=servo)
    found, (asked, executed) = predict(t.joints, t.stamps_s, servo, t.instrument), timeline.arms
    tip_mm = forward(found.executed.joints, t.instrument)[0]
    at_s = timeline.seconds()
    for wanted, got in ((tip_mm, executed.tip_mm), (found.off_mm[2][:, None], asked.off_mm[:, None])):
        seen = np.stack([np.interp(at_s, t.stamps_s, one) for one in wanted.T], axis=1)
        assert np.abs(got - seen).max() < 1e-4
    assert executed.arm == "PSM_A as executed" and executed.off_mm is None and asked.off_mm.max() > 0.5
    assert [one.name for one in timeline.traces] == [f"Effort of {joint}" for joint in JOINTS]
    most = max(float(one.values.max()) for one in timeline.traces)
    assert most == pytest.approx(100 * found.effort.max(), rel=0.02)


def test_a_plan_names_its_phases_and_a_pass_its_probability():
    t = planned()
    timeline = timeline_of_plan(t, arm="PSM2", frame="PSM2_base", odds={0: 0.25, 1: 0.75})
    first, last = timeline.stages[0], timeline.stages[-1]
    assert first.name.startswith("pass 0: ") and last.name == "pass 1: A1"
    assert last.end_s == t.stamps_s[-1]
    (odds,) = timeline.traces
    at = [
        np.searchsorted(timeline.seconds(), second)
        for second in (0.5, t.stamps_s[t.last_samples[0]] + 0.5, t.stamps_s[-1] - 0.5)
    ]
    assert odds.values[at[0]] == 0.25 and np.isnan(odds.values[at[1]]) and odds.values[at[2]] == 0.75
    tip_mm = np.stack([np.interp(timeline.seconds(), t.stamps_s, one) for one in t.tip_mm.T], axis=1)
    assert np.abs(timeline.arms[0].tip_mm - tip_mm).max() < 1e-4
