"""Entry and Exit marks of a simulator, transformed to an arm's base."""

import io
import tempfile

import numpy as np
import pytest

from skills.errors import MixedFrames, NotAQuaternion, NotMetres, NoUsableTopic, UnreadableRecording
from skills.formats import bag_writer
from skills.formats.bag_writer import write_messages
from skills.formats.reader_process import ConfinedReader
from skills.formats.suture_points import READ, SuturePoints, read_scene, suture_points
from skills.kinematics import matrix_of, quaternion_of

START_NS = 1_760_000_000_000_000_000
HALF = np.sqrt(0.5)
QUARTER = (0.0, 0.0, HALF, HALF)  # a quarter turn about z
BASE_M, BASE_XYZW = (0.16, 0.02, 0.3), QUARTER
MARKS = {  # in PSM2's base: metres, and the rotation
    "Entry1": ((0.000, 0.055, -0.125), (0.0, 0.0, 0.0, 1.0)),
    "Exit1": ((0.005, 0.055, -0.125), (0.0, 0.0, 0.0, 1.0)),
    "Entry2": ((0.000, 0.061, -0.125), QUARTER),
    "Exit2": ((0.005, 0.061, -0.125), QUARTER),
}


def in_world(place_m, turn):
    base = matrix_of([BASE_XYZW])[0]
    return base @ place_m + BASE_M, quaternion_of((base @ matrix_of([turn])[0])[None])[0]


def scene(poses, count: int = 5) -> bytes:
    """Publish (topic, place in m, rotation, frame), or a function of the message number that returns them, in turn."""
    said = []
    for k in range(count):
        for one in poses:
            topic, place_m, turn, frame = one(k) if callable(one) else one
            said.append(bag_writer.pose(topic, START_NS + k * 10_000_000, frame, tuple(place_m), tuple(turn)))
    file = io.BytesIO()
    write_messages(said, file)
    return file.getvalue()


def world(*, base: str | None = "psm2", marks=MARKS):
    poses = [(f"/CRTK/{name}/measured_cp", *in_world(*pose), "world") for name, pose in marks.items()]
    return [*poses, *([] if base is None else [(f"/CRTK/{base}/T_b_w", BASE_M, BASE_XYZW, "world")])]


def found(poses, **how) -> SuturePoints:
    return suture_points(read_scene(io.BytesIO(scene(poses))), **how)


def test_marks_in_the_world_are_brought_to_the_arms_base_in_mm():
    points = found(world())
    assert (points.arm, points.frame) == ("psm2", "psm2_base")
    assert [one.name for one in points.points] == ["Entry1", "Exit1", "Entry2", "Exit2"]
    for one in points.points:
        place_m, turn = MARKS[one.name]
        assert one.position_mm == pytest.approx(1000 * np.array(place_m), abs=1e-9)
        np.testing.assert_allclose(matrix_of([one.rotation_xyzw]), matrix_of([turn]), atol=1e-12)


def test_the_exit_point_is_proposed_as_the_goal():
    points = found(world()).points
    assert [(one.kind, one.is_goal) for one in points] == [("entry", False), ("exit", True)] * 2


def test_a_turn_is_told_from_the_first_mark_of_its_kind():
    first, second = (one for one in found(world()).points if one.is_goal)
    assert first.turn_xyzw == pytest.approx((0.0, 0.0, 0.0, 1.0))
    assert second.turn_xyzw == pytest.approx(QUARTER)


def test_a_base_turned_by_hand_gives_the_place_worked_by_hand():
    # The base stands 10 mm along x, rotated a quarter about z: 20 mm along the world's y is 20 mm along its x.
    poses = [("/Exit1/measured_cp", (0.010, 0.020, -0.1), (0, 0, 0, 1), "world")]
    poses.append(("/psm1/T_b_w", (0.010, 0.0, 0.0), QUARTER, "world"))
    (one,) = found(poses).points
    assert one.position_mm == pytest.approx((20.0, 0.0, -100.0))
    assert one.rotation_xyzw == pytest.approx((0.0, 0.0, -HALF, HALF)) or one.rotation_xyzw == pytest.approx(
        (0.0, 0.0, HALF, -HALF)
    )


def test_of_several_arms_one_is_named():
    both = [*world(), ("/CRTK/psm1/T_b_w", (-0.16, 0.02, 0.3), BASE_XYZW, "world")]
    with pytest.raises(NoUsableTopic, match="psm1, psm2; name the arm"):
        found(both)
    assert found(both, arm="PSM2", frame="PSM2_base").points == found(world()).points


def test_an_arm_that_is_not_in_the_scene_is_refused_also_with_a_frame():
    with pytest.raises(NoUsableTopic, match="bases of psm2, not of psm9"):
        found(world(), arm="psm9", frame="psm9_base")


def test_without_a_base_the_marks_frame_must_be_said_to_be_the_arms():
    with pytest.raises(NoUsableTopic, match=r"frame 'world'.*T_b_w"):
        found(world(base=None))
    with pytest.raises(NoUsableTopic, match="T_b_w"):
        found(world(), arm="PSM3")
    local = [(f"/CRTK/{name}/measured_cp", *pose, "psm2/baselink") for name, pose in MARKS.items()]
    points = found(local, arm="PSM2", frame="psm2/baselink")
    assert points.frame == "psm2/baselink"
    assert points.points[0].position_mm == pytest.approx((0.0, 55.0, -125.0))


def test_a_trembling_mark_is_put_at_its_middle_and_a_moving_one_is_refused():
    def trembling(mm):
        def one(k):
            return "/Exit1/measured_cp", (0.001 * mm * (k - 2), 0.055, -0.125), (0, 0, 0, 1), "b"

        return one

    (one,) = found([trembling(0.3)], frame="b").points
    assert one.position_mm == pytest.approx((0.0, 55.0, -125.0))
    with pytest.raises(MixedFrames, match=r"moved by 1\.2 mm"):
        found([trembling(0.6)], frame="b")

    def turning(k):
        return "/Exit1/measured_cp", (0, 0.055, -0.125), (0, 0, np.sin(0.05 * k), np.cos(0.05 * k)), "b"

    with pytest.raises(MixedFrames, match="degrees"):
        found([turning], frame="b")


def test_a_quaternion_and_its_negative_are_the_same_turn():
    def flipping(k):
        return "/Exit1/measured_cp", (0, 0.055, -0.125), (0, 0, HALF * (-1) ** k, HALF * (-1) ** k), "b"

    (one,) = found([flipping], frame="b").points
    assert matrix_of([one.rotation_xyzw])[0] == pytest.approx(matrix_of([QUARTER])[0])


@pytest.mark.parametrize(
    ("poses", "error", "words"),
    [
        ([("/CRTK/Needle/measured_cp", (0, 0, 0), (0, 0, 0, 1), "world")], NoUsableTopic, "Entry or Exit"),
        ([("/CRTK/psm2/T_b_w", (0, 0, 0), (0, 0, 0, 1), "world")], NoUsableTopic, "Entry or Exit"),
        ([("/Exit1/measured_cp", (0.0, 0.55, -0.9), (0, 0, 0, 1), "b")], NotMetres, "1055 mm"),
        ([("/Exit1/measured_cp", (0.0, 5.5, -12.5), (0, 0, 0, 1), "b")], NotMetres, "12.5 m"),
        ([("/Exit1/measured_cp", (0.0, 0.05, -0.1), (0, 0, 0, 2), "b")], NotAQuaternion, "length 2"),
        ([*world(), ("/CRTK/Exit3/measured_cp", (0, 0, 0), (0, 0, 0, 1), "camera")], MixedFrames, "camera"),
    ],
)
def test_what_no_plan_can_be_made_of_is_refused(poses, error, words):
    with pytest.raises(error, match=words):
        found(poses, frame="b")


def test_two_frames_on_one_topic_are_refused():
    def either(k):
        return "/Exit1/measured_cp", (0, 0.05, -0.1), (0, 0, 0, 1), "b" if k else "c"

    with pytest.raises(MixedFrames, match="2 frames"):
        found([either], frame="b")


def test_a_message_of_another_type_is_refused():
    file = io.BytesIO()
    write_messages([bag_writer.boolean("/Exit1/measured_cp", START_NS, True)], file)
    with pytest.raises(UnreadableRecording, match="PoseStamped"):
        read_scene(io.BytesIO(file.getvalue()))


def test_a_file_that_is_cut_off_is_refused_at_every_length():
    whole = scene(world(), count=2)
    for size in range(0, len(whole) - 1, 37):
        with pytest.raises(UnreadableRecording):
            read_scene(io.BytesIO(whole[:size]))


def test_it_is_read_in_a_process_of_its_own_and_refusals_come_back(reader: ConfinedReader):
    with tempfile.TemporaryFile() as file:
        file.write(scene(world()))
        assert suture_points(reader(file, target=READ)) == found(world())
        file.truncate(200)
        with pytest.raises(UnreadableRecording, match="truncated"):
            reader(file, target=READ)
