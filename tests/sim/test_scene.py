"""Our URDF in PyBullet against the closed form: two ways to the same frames."""

import numpy as np
import pytest

from skills.style.kinematics import CANNULA_MM, CLASSIC, angle_between, forward, inverse, matrix_of

pybullet = pytest.importorskip(
    "pybullet", reason="PYBULLET IS NOT INSTALLED: the URDF is not compared with the closed form here"
)

from skills.sim import scene  # noqa: E402 - after the skip


@pytest.fixture(scope="module")
def opened():
    with scene.opened("400006", 240.0) as one:
        yield one


def joints_anywhere(count: int) -> np.ndarray:
    rng = np.random.default_rng(11)
    joints = rng.uniform(CLASSIC.lower, CLASSIC.upper, (count, 6))
    joints[:, 2] = rng.uniform(CANNULA_MM, CLASSIC.upper[2], count)
    return joints


def test_the_urdf_has_the_tip_where_the_closed_form_has_it(opened):
    joints = joints_anywhere(200)
    tip_mm, rotation = forward(joints)
    seen_mm, seen = np.empty((200, 3)), np.empty((200, 4))
    for k in range(200):
        opened.pose(joints[k])
        seen_mm[k], seen[k] = opened.read_tip()
        np.testing.assert_allclose(opened.read_joints(), joints[k], atol=1e-12)
    assert np.abs(seen_mm - tip_mm).max() < 1e-4  # mm
    assert np.degrees(angle_between(matrix_of(seen), rotation)).max() < 1e-3


def test_pybullets_own_inverse_kinematics_agrees_when_its_damping_is_taken_away(opened):
    joints = 0.4 * joints_anywhere(10)
    joints[:, 2] += 90.0
    tip_mm, rotation = forward(joints)
    ours = inverse(tip_mm, rotation)
    for k in range(10):
        opened.pose(joints[k])
        _, quaternion = opened.read_tip()
        opened.pose(joints[k] + [0.02, -0.02, 1.0, 0.02, 0.02, -0.02])
        found = pybullet.calculateInverseKinematics(
            opened.arm.number,
            opened.arm.tool,
            (tip_mm[k] / 1000).tolist(),
            quaternion.tolist(),
            jointDamping=[1e-6] * 8,
            maxNumIterations=100,
            residualThreshold=1e-9,
            physicsClientId=opened.client,
        )
        theirs = np.array(found[:6]) * [1, 1, 1000, 1, 1, 1]
        assert np.abs(theirs - ours[k]).max() < 1e-3  # rad and mm


def test_the_files_limits_are_the_closed_forms(opened):
    for joint, index in enumerate(opened.arm.joints):
        info = pybullet.getJointInfo(opened.arm.number, index, physicsClientId=opened.client)
        scale = 1000.0 if joint == 2 else 1.0
        assert info[8] * scale == pytest.approx(CLASSIC.lower[joint], abs=1e-6)
        assert info[9] * scale == pytest.approx(CLASSIC.upper[joint], abs=1e-6)
        assert info[10] == pytest.approx(CLASSIC.effort[joint])


def test_the_shaft_passes_through_the_remote_centre(opened):
    roll = opened.arm.joints[3]
    for joints in joints_anywhere(20):
        opened.pose(joints)
        state = pybullet.getLinkState(
            opened.arm.number, roll, computeForwardKinematics=1, physicsClientId=opened.client
        )
        along = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 2]
        assert np.linalg.norm(np.cross(state[4], along)) * 1000 < 1e-4  # mm off the line


def test_the_finger_tips_are_a_centimetre_beyond_the_tip(opened):
    opened.pose(np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0]))
    by_link = {
        pybullet.getJointInfo(opened.arm.number, k, physicsClientId=opened.client)[12].decode(): k
        for k in range(pybullet.getNumJoints(opened.arm.number, physicsClientId=opened.client))
    }
    state = pybullet.getLinkState(
        opened.arm.number, by_link["jaw_tip"], computeForwardKinematics=1, physicsClientId=opened.client
    )
    tip_mm, _ = opened.read_tip()
    np.testing.assert_allclose(np.array(state[4]) * 1000 - tip_mm, [0, 0, -10.2], atol=1e-4)
