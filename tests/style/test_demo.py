import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.errors import BadInput, BadSegment, NotFinite, NotMetres, NoUsableTopic
from skills.style.demo import Demo, Motion, Recording, Signal, cut_demo, describe, propose_segments, recorded_motion

RATE = 100


def motion(tip_mm, *, arm="PSM2", topic=None, rotation=None, start_ns=0):
    stamps_ns = start_ns + np.arange(len(tip_mm)) * (10**9 // RATE)
    return Motion(arm, topic or f"/{arm}/local/measured_cp", f"{arm}_base", stamps_ns, np.asarray(tip_mm), rotation)


def recording(*motions, jaw=None, clutch=None):
    jaws = () if jaw is None else ((motions[0].arm, Signal(motions[0].stamps_ns, jaw)),)
    return Recording(format="mcap", integrity="full", motions=motions, jaws=jaws, clutch=clutch)


def line(seconds, speed_mm_s):
    """The tip along x at one speed."""
    t = np.arange(int(seconds * RATE) + 1) / RATE
    return np.stack([speed_mm_s * t, 0 * t, 0 * t], axis=1)


def along_x(*parts):
    """Rests and strokes one after the other: (seconds, mm/s)."""
    speeds = np.concatenate([np.full(int(seconds * RATE), float(speed)) for seconds, speed in parts])
    x = np.concatenate(([0.0], np.cumsum(speeds / RATE)))
    return np.stack([x, 0 * x, 0 * x], axis=1)


# ---- values -----------------------------------------------------------------------------------------------------


def test_the_arrays_of_a_value_cannot_be_changed():
    demo = cut_demo(recording(motion(line(1, 20))))
    for array in (demo.tip_mm, demo.stamps_s):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_motion_of_another_shape_is_refused():
    with pytest.raises(BadInput, match="shape"):
        Motion("PSM2", "/t", "f", np.arange(3), np.zeros((3, 2)))
    with pytest.raises(BadInput, match="shape"):
        Signal(np.arange(3), np.zeros(2))


def test_nothing_wrong_hides_in_a_sample_that_is_dropped():
    tip_mm = np.array([[0.0, 0, 0], [np.nan, 0, 0], [1, 0, 0]])
    with pytest.raises(NotFinite):
        recorded_motion(
            arm="PSM2", topic="/t", frame="f", stamps_ns=np.array([0, 0, 1]), tip_mm=tip_mm, rotation_xyzw=None
        )


# ---- cutting ----------------------------------------------------------------------------------------------------


def test_a_cut_counts_its_own_seconds_from_its_first_sample():
    demo = cut_demo(recording(motion(line(4, 20), start_ns=10**18)), start_s=1.0, end_s=3.0)
    assert (demo.start_s, demo.end_s) == (1.0, 3.0)
    assert (demo.stamps_s[0], demo.stamps_s[-1], len(demo.stamps_s)) == (0.0, 2.0, 201)
    assert demo.tip_mm[0, 0] == pytest.approx(20.0)
    assert demo.instrument == "400006"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 300), st.integers(10, 100))
def test_cutting_a_cut_at_its_own_times_gives_the_same_demonstration(first, length):
    whole = recording(motion(line(4, 50), start_ns=1_760_000_000_000_000_000))
    once = cut_demo(whole, start_s=first / RATE, end_s=(first + length) / RATE)
    again = cut_demo(whole, start_s=once.start_s, end_s=once.end_s)
    np.testing.assert_array_equal(once.tip_mm, again.tip_mm)
    assert len(once.stamps_s) == length + 1


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [(-0.1, 2.0), (1.0, 4.1), (2.0, 2.0), (3.0, 2.0), (float("nan"), 2.0), (1.0, float("inf")), (9.0, None)],
)
def test_a_segment_that_is_not_in_the_recording_is_refused(start_s, end_s):
    with pytest.raises(BadSegment):
        cut_demo(recording(motion(line(4, 20))), start_s=start_s, end_s=end_s)


def test_a_segment_between_two_samples_is_refused():
    with pytest.raises(BadSegment, match="1 samples"):
        cut_demo(recording(motion(line(4, 20))), start_s=1.0, end_s=1.005)


@pytest.mark.parametrize("speed_mm_s", [0.0, 0.01, 200.0])
def test_a_path_too_small_or_too_wide_for_a_hand_off_is_refused(speed_mm_s):
    with pytest.raises(NotMetres, match="wide"):
        cut_demo(recording(motion(line(4, speed_mm_s))))


def test_several_arms_need_a_name():
    both = recording(motion(line(1, 20)), motion(line(1, 40), arm="PSM1"))
    with pytest.raises(NoUsableTopic, match="PSM1, PSM2"):
        cut_demo(both)
    assert cut_demo(both, arm="PSM1").arm == "PSM1"
    assert cut_demo(both, topic="/PSM1/local/measured_cp").arm == "PSM1"
    with pytest.raises(NoUsableTopic, match="PSM3"):
        cut_demo(both, arm="PSM3")


def test_the_local_pose_comes_before_the_one_in_the_camera_and_that_before_any_other():
    poses = [motion(line(1, 20), topic=topic) for topic in ("/PSM2/a_cp", "/PSM2/measured_cp")]
    assert cut_demo(recording(*poses)).topic == "/PSM2/measured_cp"
    assert cut_demo(recording(*poses, motion(line(1, 20)))).topic == "/PSM2/local/measured_cp"
    assert cut_demo(recording(poses[0])).topic == "/PSM2/a_cp"


def test_the_jaw_is_interpolated_and_held_at_its_ends():
    jaw = Signal(np.array([1, 3]) * 10**9, np.array([0.8, 0.0]))
    value = Recording(format="mcap", integrity="full", motions=(motion(line(4, 20)),), jaws=(("PSM2", jaw),))
    demo = cut_demo(value)
    assert demo.jaw_rad[[0, 100, 200, 300, 400]] == pytest.approx([0.8, 0.8, 0.4, 0.0, 0.0])


def test_a_press_counts_where_the_pedal_goes_down():
    events = Signal(np.array([0, 1, 2, 3, 4]) * 5 * 10**8, np.array([1.0, 0, 1, 2, 0]))
    value = recording(motion(line(4, 20)), clutch=events)
    assert cut_demo(value).clutch_presses == 2
    assert cut_demo(value, start_s=0.2).clutch_presses == 1
    assert cut_demo(value, start_s=1.2).clutch_presses == 0


# ---- the report -------------------------------------------------------------------------------------------------


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


def test_a_quarter_turn_is_a_quarter_turn_whichever_sign_its_quaternion_has():
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (101, 1))
    turn[50:] = [-np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]
    report = describe(cut_demo(recording(motion(line(1, 20), rotation=turn))))
    assert report.orientation_change_rad == pytest.approx(np.pi / 2)


def test_advice_names_rest_clutch_gap_and_what_is_missing():
    tip_mm = along_x((3, 0), (2, 20), (1, 0))
    stamps_s = np.arange(len(tip_mm)) / RATE
    stamps_s[400:] += 2.0
    demo = Demo("PSM2", "/t", "f", 0.0, 8.0, stamps_s, tip_mm, clutch_presses=2)
    said = " ".join(describe(demo).advice)
    for word in ("rests", "2 times", "lost 2.01 s", "wrist", "jaw"):
        assert word in said


def test_a_good_demonstration_needs_no_advice():
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (401, 1))
    assert describe(cut_demo(recording(motion(line(4, 20), rotation=turn), jaw=np.zeros(401)))).advice == ()


def test_samples_nanoseconds_apart_need_no_gigabytes():
    demo = Demo("PSM2", "/t", "f", 0.0, 1e-9, np.array([0.0, 1e-9]), np.array([[0.0, 0, 0], [5, 0, 0]]))
    assert describe(demo).samples == 2


# ---- proposing segments -----------------------------------------------------------------------------------------


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


def test_a_stamp_years_away_costs_no_memory():
    value = Motion("PSM2", "/t", "f", np.array([0, 10**7, 10**18]), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    propose_segments(Recording(format="csv", integrity="none", motions=(value,)), "PSM2")
