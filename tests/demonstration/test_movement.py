"""Movement: pauses of the drive, and the smoothness of a speed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.movement import Pause, spectral_arc_length
from skills.demonstration.recording import Signal
from skills.errors import BadSegment
from skills.gridworld.grid import discretize, fit_grid
from skills.planning.path_fit import trace
from tests.by_day import some
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


STEP_S = 0.01


def stroke(duration_s: float, step_s: float = STEP_S) -> np.ndarray:
    """Return the speed of a minimum-jerk stroke of length 1."""
    u = np.arange(round(duration_s / step_s) + 1) * step_s / duration_s
    return 30 * u**2 * (1 - u) ** 2 / duration_s


def strokes(*at_s: float, lasting_s: float = 1.0, in_all_s: float = 6.0) -> np.ndarray:
    speed = np.zeros(round(in_all_s / STEP_S) + 1)
    for start_s in at_s:
        one = stroke(lasting_s)
        first = round(start_s / STEP_S)
        speed[first : first + len(one)] += one
    return speed


def by_integration(speed: np.ndarray, step_s: float) -> float:
    """Compute the definition with the Fourier integral summed at each of 20,000 frequencies, without our code."""
    seconds, hertz = np.arange(len(speed)) * step_s, np.linspace(0.0, 10.0, 20_001)
    spectrum = np.abs([np.sum(speed * np.exp(-2j * np.pi * f * seconds)) for f in hertz])
    spectrum /= spectrum[0]
    cut = np.flatnonzero(spectrum >= 0.05).max()
    along = np.diff(hertz[: cut + 1]) / hertz[cut]
    return -float(np.sqrt(along**2 + np.diff(spectrum[: cut + 1]) ** 2).sum())


@pytest.mark.parametrize(
    "speed", some([strokes(0.5, 2.0), stroke(1.0), strokes(0.0, 0.7, 3.0)], 3), ids=["2", "1", "3"]
)
def test_it_is_what_integrating_its_definition_gives(speed: np.ndarray) -> None:
    assert spectral_arc_length(speed, STEP_S) == pytest.approx(by_integration(speed, STEP_S), rel=0.01)


def test_a_speed_whose_spectrum_is_known_by_hand() -> None:
    """The spectrum of a Gaussian of 0.1 s falls without a ripple from 1 to 0.05, at 0.39 Hz by 0.1 s."""
    seconds = np.arange(-200, 201) * STEP_S
    speed = np.exp(-(seconds**2) / (2 * 0.1**2))
    cut_hz = np.sqrt(-2 * np.log(0.05)) / (2 * np.pi * 0.1)
    f = np.linspace(0.0, cut_hz, 100_001)
    shape = np.exp(-0.5 * (2 * np.pi * f * 0.1) ** 2)
    by_hand = -np.hypot(np.diff(f) / cut_hz, np.diff(shape)).sum()
    assert spectral_arc_length(speed, STEP_S) == pytest.approx(by_hand, abs=0.01)


@given(st.floats(1e-3, 1e3))
def test_it_does_not_depend_on_how_far_the_hand_goes(times: float) -> None:
    speed = strokes(0.5, 2.0)
    assert spectral_arc_length(times * speed, STEP_S) == pytest.approx(spectral_arc_length(speed, STEP_S), rel=1e-9)


@given(st.floats(0.5, 6.0))
def test_it_does_not_depend_on_how_fast(duration_s: float) -> None:
    assert spectral_arc_length(stroke(duration_s), STEP_S) == pytest.approx(-1.406, abs=0.02)


def test_nor_on_how_often_it_is_sampled() -> None:
    fine, coarse = (spectral_arc_length(stroke(2.0, step_s), step_s) for step_s in (0.001, 0.02))
    assert fine == pytest.approx(coarse, abs=0.01)


def test_every_stop_on_the_way_costs_smoothness_and_longer_ones_cost_more() -> None:
    one, near, far = (
        spectral_arc_length(speed, STEP_S) for speed in (strokes(0.5), strokes(0.5, 1.6), strokes(0.5, 3.5))
    )
    assert one > near > far


def test_where_nothing_moves_there_is_none() -> None:
    for speed, step_s in (
        (np.zeros(100), 0.01),
        (np.ones(1), 0.01),
        (np.ones(10), 0.0),
        (np.full(10, np.nan), 0.01),
        (np.ones(10), np.nan),
    ):
        assert spectral_arc_length(speed, step_s) is None
