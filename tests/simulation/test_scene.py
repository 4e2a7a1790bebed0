"""Our URDF in PyBullet compared with the closed form: two ways to the same frames."""

import hashlib
from importlib.resources import files

import numpy as np
import pytest

from skills.kinematics import INSTRUMENTS, angle_between, forward, instrument_of, inverse, matrix_of
from skills.simulation import simulator
from skills.verification.playback import LINKS, PAD_SIZE_MM

pytestmark = pytest.mark.needs("simulator")


@pytest.fixture(scope="module")
def opened():
    with simulator.opened("400006") as one:
        yield one


def joints_anywhere(count: int, instrument: str = "400006") -> np.ndarray:
    rng = np.random.default_rng(11)
    tool = instrument_of(instrument)
    joints = rng.uniform(tool.lower, tool.upper, (count, 6))
    joints[:, 2] = rng.uniform(max(0.0, tool.cannula_mm), tool.upper[2], count)
    return joints


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_the_urdf_has_the_tip_where_the_closed_form_has_it(instrument):
    joints = joints_anywhere(1000, instrument)
    tip_mm, rotation = forward(joints, instrument)
    seen_mm, seen, read = np.empty((1000, 3)), np.empty((1000, 4)), np.empty((1000, 6))
    with simulator.opened(instrument) as one:
        for k in range(1000):
            one.pose(joints[k])
            seen_mm[k], seen[k] = one.read_tip()
            read[k] = [state[0] for state in one.joint_states()]
    np.testing.assert_allclose(read, simulator.in_metres(joints), atol=1e-12)
    assert np.abs(seen_mm - tip_mm).max() < 1e-4  # mm
    assert np.degrees(angle_between(matrix_of(seen), rotation)).max() < 1e-3


def test_six_joints_put_at_once_are_where_six_calls_put_them(opened):
    for joints in joints_anywhere(20):
        opened.pose(joints)
        together = opened.frame_of(opened.arm, opened.arm.tool)
        for index, value in zip(opened.arm.joints, simulator.in_metres(joints).tolist(), strict=True):
            opened.bullet.resetJointState(opened.arm.number, index, value)
        assert opened.frame_of(opened.arm, opened.arm.tool) == together


def test_pybullets_inverse_kinematics_agrees_once_its_damping_is_removed(opened):
    joints = 0.4 * joints_anywhere(10)
    joints[:, 2] += 90.0
    tip_mm, rotation = forward(joints)
    ours = inverse(tip_mm, rotation)
    for k in range(10):
        opened.pose(joints[k])
        _, quaternion = opened.read_tip()
        opened.pose(joints[k] + [0.02, -0.02, 1.0, 0.02, 0.02, -0.02])
        found = opened.bullet.calculateInverseKinematics(
            opened.arm.number,
            opened.arm.tool,
            (tip_mm[k] / 1000).tolist(),
            quaternion.tolist(),
            jointDamping=[1e-6] * 8,
            maxNumIterations=100,
            residualThreshold=1e-9,
        )
        theirs = np.array(found[:6]) * [1, 1, 1000, 1, 1, 1]
        assert np.abs(theirs - ours[k]).max() < 1e-3  # rad and mm


def test_the_files_limits_are_the_closed_forms(opened):
    for joint, index in enumerate(opened.arm.joints):
        info = opened.bullet.getJointInfo(opened.arm.number, index)
        scale = 1000.0 if joint == 2 else 1.0
        assert info[8] * scale == pytest.approx(instrument_of("400006").lower[joint], abs=1e-6)
        assert info[9] * scale == pytest.approx(instrument_of("400006").upper[joint], abs=1e-6)
        assert info[10] == pytest.approx(instrument_of("400006").arm.effort[joint])


def test_the_shaft_passes_through_the_remote_centre(opened):
    roll = opened.arm.joints[3]
    for joints in joints_anywhere(20):
        opened.pose(joints)
        state = opened.bullet.getLinkState(opened.arm.number, roll, computeForwardKinematics=1)
        along = np.array(opened.bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 2]
        assert np.linalg.norm(np.cross(state[4], along)) * 1000 < 1e-4  # mm off the line


def test_the_finger_tips_are_a_centimetre_beyond_the_tip(opened):
    opened.pose(np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0]))
    by_link = {
        opened.bullet.getJointInfo(opened.arm.number, k)[12].decode(): k
        for k in range(opened.bullet.getNumJoints(opened.arm.number))
    }
    state = opened.bullet.getLinkState(opened.arm.number, by_link["jaw_tip"], computeForwardKinematics=1)
    tip_mm, _ = opened.read_tip()
    np.testing.assert_allclose(np.array(state[4]) * 1000 - tip_mm, [0, 0, -10.2], atol=1e-4)


# ---- surfaces --------------------------------------------------------------------------------------------------

CAPSULES = {  # ends, mm in the link's frame, and radius, as in psm.urdf
    "roll_link": ((0.0, 0.0, -416.2), (0.0, 0.0, 0.0), 4.0),
    "wrist_pitch_link": ((0.0, 0.0, 0.0), (9.1, 0.0, 0.0), 3.6),
    "finger_1": ((0.0, 0.6, 0.0), (0.0, 0.6, 9.1), 1.1),
    "finger_2": ((0.0, -0.6, 0.0), (0.0, -0.6, 9.1), 1.1),
}


def test_distances_to_the_pad_are_those_of_the_capsules_lowest_points():
    """Boxes of this size would be wrong by 0.7 mm: the simulator rounds their edges by its margin."""
    with simulator.opened("400006") as one:
        one.place_pad(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), -190.0)
        rng = np.random.default_rng(5)
        for _ in range(100):
            one.pose(np.array([*rng.uniform(-0.15, 0.15, 2), 150.0, *rng.uniform(-1.2, 1.2, 3)]))
            seen = {point[3]: point[8] * 1000 for point in one.closest(one.arm.number, one.pad)}
            for index, name in zip(one.arm.surfaces, LINKS, strict=True):
                ends, radius = placed(one, index, name)
                assert seen.get(index, 50.0) == pytest.approx(min(50.0, ends[:, 2].min() - radius + 190.0), abs=1e-4)


def test_distances_between_arms_are_those_of_the_capsules_axes():
    with simulator.opened("400006") as one:
        one.place_psm_m(np.array([50.0, 10.0, 0.0]), np.array([0.0, 0.17, 0.0, 0.985444]), instrument_of("400006"))
        assert one.psm_m is not None
        rng = np.random.default_rng(6)
        for _ in range(40):
            for body in (one.arm, one.psm_m):
                joints = rng.uniform(-0.4, 0.4, 6)
                one.pose(joints * [1, 1, 1, 2, 2, 2] + [0, 0, 150.0, 0, 0, 0], body)
            seen = {point[3:5]: point[8] * 1000 for point in one.closest(one.arm.number, one.psm_m.number)}
            for (a, b), found in seen.items():
                one_axis, one_radius = placed(one, a, LINKS[one.arm.surfaces.index(a)])
                axis, radius = placed(one, b, LINKS[one.psm_m.surfaces.index(b)], one.psm_m)
                apart = between_segments(one_axis, axis) - one_radius - radius
                assert found == pytest.approx(apart, abs=1e-3 if apart > 0 else 0.02)


def placed(one, index, name, body=None):
    """Return a capsule's ends at its link's pose, mm, shape (2, 3), and its radius."""
    place, quaternion = one.frame_of(body or one.arm, index)
    *ends, radius = CAPSULES[name]
    return np.array(place) * 1000 + np.array(ends) @ matrix_of(np.array([quaternion]))[0].T, radius


def between_segments(one: np.ndarray, other: np.ndarray) -> float:
    """Return the distance of two segments: between the closest points of their lines, else from an end of one."""
    p, u, q, v = one[0], one[1] - one[0], other[0], other[1] - other[0]
    found = [off_segment(end, q, v) for end in one] + [off_segment(end, p, u) for end in other]
    s, t = np.linalg.lstsq(np.stack([u, -v], axis=1), q - p, rcond=None)[0]
    if 0 <= s <= 1 and 0 <= t <= 1:
        found.append(float(np.linalg.norm(p + s * u - q - t * v)))
    return min(found)


def off_segment(point: np.ndarray, begin: np.ndarray, along: np.ndarray) -> float:
    part = np.clip((point - begin) @ along / (along @ along), 0.0, 1.0)
    return float(np.linalg.norm(begin + part * along - point))


def test_the_pad_is_as_large_as_the_needles_closed_form_takes_it():
    with simulator.opened("400006") as one:
        for width, scale in ((10.0, 1.0), (200.0, 2.0)):
            one.place_pad(np.array([[0.0, 0.0, 0.0], [0.0, width, 0.0]]), -150.0)
            [shape] = one.bullet.getCollisionShapeData(one.pad, -1)
            np.testing.assert_allclose(np.array(shape[3]) * 1000, np.array(PAD_SIZE_MM) * scale, atol=1e-6)


def test_the_files_of_the_scene_are_known_by_their_digests(opened):
    [digest] = opened.files.values()
    assert digest == hashlib.sha256((files("skills") / "urdf" / "psm.urdf").read_bytes()).hexdigest()
