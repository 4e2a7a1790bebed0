"""Undriven samples are not part of a demonstration: the clutch, and teleoperation that does not follow."""

from dataclasses import replace

import numpy as np
import pytest

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.movement import Pause
from skills.demonstration.recording import Signal
from skills.errors import BadSegment
from skills.gridworld.grid import discretize, fit_grid
from skills.planning.path_fit import trace
from tests.demonstration.strokes import along_x, line, motion, recording

NS = 10**9


def signal(*events, topic="/console/clutch"):
    """Return a signal of (seconds, value) events."""
    return Signal(np.array([round(t * NS) for t, _ in events]), np.array([float(v) for _, v in events]), topic)


# The tip moves 40 mm, is pushed aside by 12 mm and back while the clutch is down, and moves 40 mm more.
PUSHED = along_x((2, 20), (3, 0), (2, 20))
PUSHED[210:490, 1] = 12 * np.sin(np.linspace(0, np.pi, 280))
PRESSED = signal((0, 0), (2.005, 1), (4.995, 0))


def test_a_push_while_the_clutch_is_down_does_not_enter_the_path():
    with_it = cut_demo(recording(motion(PUSHED)))
    without = cut_demo(recording(motion(PUSHED), clutch=PRESSED))
    assert np.ptp(with_it.tip_mm[:, 1]) == pytest.approx(12.0, abs=0.01)
    assert np.ptp(without.tip_mm[:, 1]) == 0.0
    grid = fit_grid(with_it.tip_mm)
    straight = discretize(without.tip_mm, grid)
    assert len(set(grid.cells_of(straight.states)[:, 1].tolist())) == 1
    assert len(discretize(with_it.tip_mm, grid).states) > len(straight.states)


def test_the_stamps_stay_those_of_the_recording_and_the_pause_is_told():
    demo = cut_demo(recording(motion(PUSHED), clutch=PRESSED))
    assert demo.stamps_s[-1] == 7.0
    assert np.diff(demo.stamps_s).max() == pytest.approx(3.0)
    assert demo.pauses == (Pause(2.005, 4.995, "clutch"),)
    assert demo.clutch_presses == 1
    assert len(demo.stamps_s) == len(PUSHED) - 299


def test_where_the_arm_was_driven_all_the_time_nothing_is_left_out():
    for clutch in (None, signal((0, 0)), signal((0, 0), (3, 2))):  # a quick tap is a command to the console
        demo = cut_demo(recording(motion(PUSHED), clutch=clutch))
        assert (len(demo.stamps_s), demo.pauses, demo.clutch_presses) == (len(PUSHED), (), 0)


def test_the_path_without_tremor_still_goes_through_its_waypoints():
    demo = cut_demo(recording(motion(PUSHED), clutch=PRESSED))
    path = discretize(demo.tip_mm, fit_grid(demo.tip_mm))
    traced = trace(demo, path)
    assert set(traced.waypoints.tolist()) == set(range(len(path.states)))
    assert np.abs(traced.tip_mm[:, 1:]).max() < 1e-9


def test_a_place_reached_while_clutched_is_bridged_by_a_straight_line():
    tip_mm = along_x((2, 20), (1, 0), (2, 20))
    tip_mm[250:, 2] += 15.0
    clutch = signal((0, 0), (2.1, 1), (2.9, 0))
    demo = cut_demo(recording(motion(tip_mm), clutch=clutch))
    path = discretize(demo.tip_mm, fit_grid(demo.tip_mm))
    assert path.bridged == 2
    trace(demo, path)


def test_a_press_at_an_end_is_cut_off_with_it():
    demo = cut_demo(recording(motion(line(4, 20)), clutch=signal((0, 1), (1, 0), (3, 1))))
    assert (demo.start_s, demo.end_s) == (1.01, 2.99)
    assert (demo.pauses, demo.clutch_presses) == ((), 2)


def test_a_segment_in_which_the_clutch_was_down_is_refused():
    with pytest.raises(BadSegment, match="not driven"):
        cut_demo(recording(motion(line(4, 20)), clutch=signal((0, 1))))


# ---- teleoperation ----------------------------------------------------------------------------------------------


def followed(*following):
    return replace(recording(motion(line(4, 20))), following=following)


def test_what_teleoperation_did_not_drive_is_left_out():
    demo = cut_demo(followed(("MTMR_PSM2", signal((0, 1), (1.005, 0), (1.995, 1)))))
    assert demo.pauses == (Pause(1.005, 1.995, "not following"),)
    assert len(demo.stamps_s) == 401 - 99


def test_another_arms_teleoperation_says_nothing_of_this_one():
    assert cut_demo(followed(("MTML_PSM1", signal((0, 1), (1, 0))))).pauses == ()


def test_one_of_two_masters_is_enough():
    demo = cut_demo(followed(("MTML_PSM2", signal((0, 1), (1, 0))), ("MTMR_PSM2", signal((0, 0), (2, 1)))))
    assert demo.pauses == (Pause(1.0, 2.0, "not following"),)


def test_an_arm_never_driven_by_teleoperation_has_no_pauses():
    assert cut_demo(followed(("MTMR_PSM2", signal((0, 0), (1, 0))))).pauses == ()


def test_a_press_that_stops_teleoperation_is_one_pause_and_the_clutchs():
    value = replace(
        followed(("MTMR_PSM2", signal((0, 1), (1.1, 0), (2.1, 1)))), clutch=signal((0, 0), (1.0, 1), (2.0, 0))
    )
    assert cut_demo(value).pauses == (Pause(1.0, 2.1, "clutch"),)
