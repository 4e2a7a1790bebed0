import numpy as np
import pytest

from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.movement import Pause
from skills.demonstration.quality import describe
from skills.demonstration.recording import Signal
from skills.gridworld.grid import PAPER_GRID, describe_path, discretize, fit_grid
from tests.demonstration.strokes import RATE, along_x, line, motion, recording

# ---- the motion -------------------------------------------------------------------------------------------------


def test_a_straight_stroke_is_described_in_plain_numbers():
    report = describe(cut_demo(recording(motion(line(4, 20)), jaw=np.zeros(401))))
    assert (report.duration_s, report.samples) == (4.0, 401)
    assert report.rate_hz == pytest.approx(100.0)
    assert report.path_length_mm == pytest.approx(80.0)
    assert report.extent_mm == pytest.approx((80.0, 0.0, 0.0))
    assert report.speed_median_mm_s == pytest.approx(20.0)
    assert report.speed_peak_mm_s == pytest.approx(20.0)
    assert report.idle_share == 0.0
    assert report.orientation_change_rad is None


def test_tremor_is_not_taken_for_motion():
    seconds = np.arange(401) / RATE
    tip_mm = along_x((3, 0), (1, 20))
    tip_mm[:, 1] = 0.3 * np.sin(2 * np.pi * 8 * seconds)
    assert describe(cut_demo(recording(motion(tip_mm)))).idle_share == pytest.approx(0.75, abs=0.06)


def test_a_quarter_turn_is_measured_for_either_sign_of_the_quaternion():
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (101, 1))
    turn[50:] = [-np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]
    report = describe(cut_demo(recording(motion(line(1, 20), rotation=turn))))
    assert report.orientation_change_rad == pytest.approx(np.pi / 2)
    assert "turns by 90 degrees" in report.advice[-2] and "A plan turns it as you did" in report.advice[-2]


def test_advice_names_rest_clutch_gap_and_what_is_missing():
    tip_mm = along_x((3, 0), (2, 20), (1, 0))
    stamps_s = np.arange(len(tip_mm)) / RATE
    stamps_s[400:] += 2.0
    demo = Demo("PSM2", "/t", "f", 0.0, 8.0, stamps_s, tip_mm, clutch_presses=2)
    said = " ".join(describe(demo).advice)
    for word in ("rests", "twice", "lost 2.01 s", "wrist", "jaw"):
        assert word in said


def test_a_good_demonstration_needs_no_advice():
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (401, 1))
    assert describe(cut_demo(recording(motion(line(4, 20), rotation=turn), jaw=np.zeros(401)))).advice == ()


def test_samples_nanoseconds_apart_need_no_gigabytes():
    demo = Demo("PSM2", "/t", "f", 0.0, 1e-9, np.array([0.0, 1e-9]), np.array([[0.0, 0, 0], [5, 0, 0]]))
    assert describe(demo).samples == 2


def minimum_jerk(duration_s=4.0, length_mm=60.0, rest_s=1.0, strokes=1):
    """Return strokes along x, each after a rest and before one."""
    share = np.clip((np.arange(int((duration_s + rest_s) * RATE)) / RATE - rest_s) / duration_s, 0, 1)
    one = share**3 * (10 - 15 * share + 6 * share**2)
    x = length_mm / strokes * np.concatenate([k + one for k in range(strokes)] + [np.full(int(rest_s * RATE), strokes)])
    return np.stack([x, 0 * x, 0 * x], axis=1)


def test_one_minimum_jerk_stroke_has_the_smoothness_that_is_known_of_it():
    """-ln(720 / 1.875^2) = -5.32 of the stroke alone; half a second of rest costs 0.35, and smoothing adds 0.19."""
    rest_s = 0.25
    report = describe(cut_demo(recording(motion(minimum_jerk(rest_s=rest_s)))))
    known = -np.log(720 / 1.875**2)
    assert report.log_dimensionless_jerk == pytest.approx(known - 3 * np.log(4.5 / 4.0), abs=0.2)
    assert report.jerk_rms_mm_s3 == pytest.approx(np.sqrt(720) * 60 / 4**3, rel=0.1)


def test_every_hesitation_costs_smoothness():
    found = [describe(cut_demo(recording(motion(minimum_jerk(strokes=n))))).log_dimensionless_jerk for n in (1, 2, 4)]
    assert found[0] > found[1] > found[2]
    said = " ".join(describe(cut_demo(recording(motion(minimum_jerk(strokes=6))))).advice)
    assert "starts and stops" in said


def test_smoothness_does_not_depend_on_how_far_the_hand_goes():
    near, far = (describe(cut_demo(recording(motion(minimum_jerk(length_mm=mm))))) for mm in (20.0, 80.0))
    assert near.log_dimensionless_jerk == pytest.approx(far.log_dimensionless_jerk, abs=1e-9)


def turning(at_s, angle_rad):
    """Rest 1 s, move 2 s along x, rest 2 s; with a rotation about z that takes 1 s."""
    tip_mm = along_x((1, 0), (2, 20), (2, 0))
    angle = angle_rad * np.clip(np.arange(len(tip_mm)) / RATE - at_s, 0, 1)
    turn = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    return describe(cut_demo(recording(motion(tip_mm, rotation=turn))))


def test_a_turn_after_the_tip_has_come_to_rest_is_a2():
    report = turning(at_s=3.6, angle_rad=1.0)
    assert report.a1_s == pytest.approx(3.0, abs=0.3)
    assert report.a1_orientation_change_rad == pytest.approx(0.0, abs=0.01)
    assert report.a1_turn_negligible
    assert report.orientation_change_rad == pytest.approx(1.0)
    assert "turns by" not in " ".join(report.advice)


def test_a_turn_on_the_way_is_not_what_the_paper_found():
    report = turning(at_s=1.5, angle_rad=1.0)
    assert report.a1_orientation_change_rad == pytest.approx(1.0)
    assert report.a1_turn_negligible is False
    assert "turns by 57 degrees before the tip arrives" in " ".join(report.advice)


def test_a_needle_that_turns_in_place_does_not_rest():
    assert turning(at_s=3.1, angle_rad=1.0).idle_share < turning(at_s=3.1, angle_rad=0.05).idle_share - 0.15


# ---- pauses -----------------------------------------------------------------------------------------------------


def test_a_pause_counts_neither_as_a_gap_nor_as_idle_nor_as_a_way():
    tip_mm = along_x((2, 20), (2, 1.5), (2, 20))  # pushed by 3 mm while the clutch is down
    clutch = Signal(np.array([0, 1_990_000_000, 4_010_000_000]), np.array([0.0, 1, 0]))
    report = describe(cut_demo(recording(motion(tip_mm), clutch=clutch)))
    assert (report.clutch_presses, report.clutched_s, report.undriven_s) == (
        1,
        pytest.approx(2.02),
        pytest.approx(2.02),
    )
    assert report.longest_gap_s == pytest.approx(0.01)
    assert report.path_length_mm == pytest.approx(80.0, abs=1.0)
    assert report.idle_share == 0.0
    assert report.rate_hz == pytest.approx(100.0)
    assert "lost" not in " ".join(report.advice)


def test_time_without_teleoperation_is_told_from_the_clutch():
    demo = Demo("PSM2", "/t", "f", 0.0, 4.0, np.arange(401) / RATE, line(4, 20), pauses=(Pause(1, 2, "not following"),))
    report = describe(demo)
    assert (report.clutched_s, report.undriven_s) == (0.0, 1.0)
    assert "Teleoperation did not follow for 1.0 s" in " ".join(report.advice)


# ---- the path in its grid ---------------------------------------------------------------------------------------


def described(tip_mm, grid=None, hysteresis=0.0):
    demo = cut_demo(recording(motion(tip_mm)))
    return describe_path(demo, discretize(demo.tip_mm, grid or fit_grid(demo.tip_mm), hysteresis))


def test_a_tremor_across_a_face_is_counted_and_hysteresis_advised():
    tip_mm = np.add(line(2, 20), [0.0, 2.5, 0.0])
    tip_mm[:, 1] += 0.3 * np.sin(2 * np.pi * 9 * np.arange(201) / RATE)
    report = described(tip_mm)
    assert report.returns > 10
    assert report.advised_hysteresis == 0.25
    assert "Request hysteresis 0.25" in " ".join(report.advice)
    calm = described(tip_mm, hysteresis=0.25)
    assert (calm.returns, calm.advised_hysteresis, calm.advice[:0]) == (0, None, ())
    assert f"{calm.path_states} states instead of {report.path_states}" in " ".join(report.advice)


def test_what_the_grid_loses_is_said_along_each_axis_and_in_all():
    report = described(np.add(line(2, 20), [0.0, 1.0, 2.0]))
    assert report.discretisation_rmse_mm[1:] == pytest.approx((1.0, 2.0))
    assert report.discretisation_rmse_3d_mm == pytest.approx(np.linalg.norm(report.discretisation_rmse_mm))


def test_what_lies_outside_the_papers_grid_is_said():
    inside = np.array([-30.0, 50.0, -120.0]) + line(2, 20)
    assert described(inside, PAPER_GRID).outside_paper_grid_share == 0.0
    half = np.add(inside, [32.5, 0.0, 0.0])
    report = described(half)
    assert report.outside_paper_grid_share == pytest.approx(0.5, abs=0.01)
    assert "outside the paper's grid" in " ".join(report.advice)
