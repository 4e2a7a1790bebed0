import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Motion, Recording, Signal, recorded_motion
from skills.errors import BadInput, BadSegment, NotFinite, NotMetres, NoUsableTopic
from tests.by_day import examples
from tests.demonstration.strokes import RATE, line, motion, recording

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


@examples(30)
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


def test_the_local_pose_is_preferred_then_the_camera_pose_then_any_other():
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
