"""Distances of capsules in closed form: against cases worked by hand, sampled points, the URDF and the simulator."""

import xml.etree.ElementTree as ElementTree
from importlib.resources import as_file, files

import numpy as np
import pytest

from skills.kinematics import (
    CANNULA_MM,
    CLASSIC,
    JAW_TIP_MM,
    WRIST_MM,
    forward,
    instrument_of,
    inverse,
    matrix_of,
    reachable,
)
from skills.planning.handoff import HOLDING_RAD
from skills.verification.clearance import (
    ASIDE_MM,
    FINGER_MM,
    FINGERS,
    LINKS,
    RADII_MM,
    Links,
    clearance_between,
    clearance_to_pad,
    links_of,
)
from tests.needs import need

STRAIGHT = np.array([[0.0, 0.0, 150.0, 0.0, 0.0, 0.0]])
BESIDE_MM = np.array([20.0, 0.0, 0.0])
BASE_MM = np.array([160.0, 20.0, 20.0])
BASE = matrix_of([[0.0, np.sin(np.radians(35) / 2), 0.0, np.cos(np.radians(35) / 2)]])[0]


def joints_anywhere(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    joints = rng.uniform(CLASSIC.lower, CLASSIC.upper, (count, 6))
    joints[:, 2] = rng.uniform(CANNULA_MM, CLASSIC.upper[2], count)
    return joints


def two_arms(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return joints that bring both arms to one place, where some are in each other's way."""
    rng = np.random.default_rng(5)
    tip = rng.uniform([-30, 25, -140], [20, 75, -90], (40 * count, 3))
    turned, turned_m = matrix_of(rng.normal(size=(40 * count, 4))), matrix_of(rng.normal(size=(40 * count, 4)))
    tip_m = (tip + rng.normal(size=tip.shape) * 15.0 - BASE_MM) @ BASE
    both = np.flatnonzero(reachable(tip, turned) & reachable(tip_m, turned_m))[:count]
    assert len(both) == count
    return inverse(tip[both], turned[both]), inverse(tip_m[both], turned_m[both])


def test_an_arm_that_hangs_straight_down_is_measured_by_hand():
    closed = links_of(STRAIGHT, opening_rad=0.0)
    above = clearance_to_pad(closed, -160.0)[0]
    # The hinge is 143.5 mm down; round ends are there, at the wrist 9.1 mm above it, and 10.2 mm below at the tips.
    np.testing.assert_allclose(above, [16.5 + 9.1 - 4.0, 16.5 - 3.6, 16.5 - 10.2, 16.5 - 10.2], atol=1e-12)
    beside = Links(closed.begin_mm + BESIDE_MM, closed.end_mm + BESIDE_MM)
    np.testing.assert_allclose(clearance_between(closed, beside)[0].diagonal(), 20.0 - 2 * RADII_MM, atol=1e-9)
    # Fingers meet along o, which is +x here: finger_1 of the one is nearer to finger_2 of the other.
    assert clearance_between(closed, beside)[0, 2, 3] == pytest.approx(20.0 - 2 * ASIDE_MM - 2.2)


def test_each_pose_may_have_a_pad_of_its_own():
    arm = links_of(np.repeat(STRAIGHT, 2, axis=0))
    above = clearance_to_pad(arm, [-160.0, -161.5])
    np.testing.assert_allclose(above[1] - above[0], 1.5)


@pytest.mark.parametrize("instrument", ["400006", "420006"])
def test_the_links_are_where_the_forward_kinematics_has_the_tip(instrument):
    joints = joints_anywhere(100, seed=1)
    tip, rotation = forward(joints, instrument)
    arm = links_of(joints, instrument, opening_rad=0.2)
    np.testing.assert_allclose(arm.end_mm[:, 1], tip, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(arm.end_mm[:, 1] - arm.begin_mm[:, 1], axis=1), WRIST_MM)
    np.testing.assert_allclose(
        np.cross(arm.begin_mm[:, 0], arm.end_mm[:, 0]), 0, atol=1e-9
    )  # through the remote centre
    length = np.linalg.norm(arm.end_mm[:, 0] - arm.begin_mm[:, 0], axis=1)
    np.testing.assert_allclose(length, instrument_of(instrument).shaft_mm)
    in_jaw = np.einsum("tji,tkj->tki", rotation, arm.end_mm[:, FINGERS] - tip[:, None])
    sine, cosine = np.sin(0.2), np.cos(0.2)
    y, z = ASIDE_MM * cosine + FINGER_MM * sine, FINGER_MM * cosine - ASIDE_MM * sine
    np.testing.assert_allclose(in_jaw, np.broadcast_to([[0, y, z], [0, -y, z]], (100, 2, 3)), atol=1e-9)


def test_the_capsules_are_those_of_the_urdf():
    root = ElementTree.parse(files("skills") / "urdf" / "psm.urdf").getroot()
    found = {
        link.get("name"): link.find("collision") for link in root.iter("link") if link.find("collision") is not None
    }
    assert tuple(found) == LINKS
    sizes = {name: one.find("geometry/capsule").attrib for name, one in found.items()}
    lengths = (instrument_of("400006").shaft_mm, WRIST_MM, FINGER_MM, FINGER_MM)
    for name, radius, length in zip(LINKS, RADII_MM, lengths, strict=True):
        assert float(sizes[name]["radius"]) * 1e3 == pytest.approx(radius)
        assert float(sizes[name]["length"]) * 1e3 == pytest.approx(length)
    finger = [float(x) * 1e3 for x in found["finger_1"].find("origin").get("xyz").split()]
    np.testing.assert_allclose(finger, [0, ASIDE_MM, FINGER_MM / 2], atol=1e-9)
    assert pytest.approx(JAW_TIP_MM) == FINGER_MM + RADII_MM[2]


@pytest.mark.parametrize("kind", ["anywhere", "parallel", "end to end", "crossing", "in one line"])
def test_segments_are_as_far_apart_as_their_nearest_sampled_points(kind):
    rng = np.random.default_rng(3)
    begin, end, other, far = rng.uniform(-30, 30, (4, 12, 4, 3))
    if kind == "parallel":
        far = other + 0.7 * (end - begin)
    elif kind == "end to end":
        other = end.copy()
    elif kind == "crossing":
        other, far = (begin + end) / 2 - far, (begin + end) / 2 + far
    elif kind == "in one line":
        other, far = begin + 1.5 * (end - begin), begin + 2.5 * (end - begin)
    ours = clearance_between(Links(begin, end), Links(other, far)) + (RADII_MM[:, None] + RADII_MM)
    u = np.linspace(0, 1, 101)
    one, two = (b[:, :, None] + u[:, None] * (e - b)[:, :, None] for b, e in ((begin, end), (other, far)))
    for k in range(12):
        for i in range(4):
            for j in range(4):
                apart = np.sqrt(((one[k, i][:, None] - two[k, j]) ** 2).sum(axis=2).min())
                step = (np.linalg.norm(end[k, i] - begin[k, i]) + np.linalg.norm(far[k, j] - other[k, j])) / 200
                assert -1e-5 <= apart - ours[k, i, j] <= step


def test_distances_do_not_depend_on_the_frame_or_the_order_of_arms():
    one, other = (links_of(q) for q in two_arms(50))
    other = other.seen_from(BASE, BASE_MM)
    between = clearance_between(one, other)
    np.testing.assert_allclose(clearance_between(other, one), np.swapaxes(between, 1, 2), atol=1e-6)
    moved = [arm.seen_from(BASE, BASE_MM) for arm in (one, other)]
    np.testing.assert_allclose(clearance_between(*moved), between, atol=1e-6)
    shift = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(clearance_between(one.moved(shift), other.moved(shift)), between, atol=1e-6)


def test_a_pose_that_is_not_a_number_has_no_distance():
    joints = np.repeat(STRAIGHT, 2, axis=0)
    joints[1, 0] = np.nan
    arm = links_of(joints)
    assert np.isfinite(clearance_to_pad(arm, -160.0)[0]).all() and np.isnan(clearance_to_pad(arm, -160.0)[1]).all()
    still = links_of(np.repeat(STRAIGHT, 2, axis=0))
    assert np.isnan(clearance_between(arm, still)[1]).all()


# ---- comparison with the simulator -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bullet():
    need("simulator")
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    yield pybullet, client
    pybullet.disconnect(client)


class Arm:
    """An arm of the URDF in PyBullet, with the methods that this test needs."""

    def __init__(self, bullet, base_mm=(0.0, 0.0, 0.0), base_xyzw=(0.0, 0.0, 0.0, 1.0)):
        self.bullet, self.client = bullet
        with as_file(files("skills") / "urdf" / "psm.urdf") as path:
            self.number = self.bullet.loadURDF(
                str(path),
                [x / 1e3 for x in base_mm],
                base_xyzw,
                useFixedBase=1,
                flags=self.bullet.URDF_USE_IMPLICIT_CYLINDER,
                physicsClientId=self.client,
            )
        joints = range(self.bullet.getNumJoints(self.number, physicsClientId=self.client))
        infos = [self.bullet.getJointInfo(self.number, k, physicsClientId=self.client) for k in joints]
        self.joints = [info[0] for info in infos if info[1].startswith(b"outer")]
        self.fingers = [info[0] for info in infos if info[1].endswith(b"_hinge")]
        self.links = {info[12].decode(): info[0] for info in infos}

    def pose(self, joints, opening_rad=HOLDING_RAD):
        in_metres = [value / 1e3 if k == 2 else value for k, value in enumerate(joints)]
        for index, value in zip(self.joints + self.fingers, [*in_metres, opening_rad, opening_rad], strict=True):
            self.bullet.resetJointState(self.number, index, value, physicsClientId=self.client)

    def apart_mm(self, other, link, other_link):
        points = self.bullet.getClosestPoints(
            self.number, other, 1.0, self.links[link], other_link, physicsClientId=self.client
        )
        return min(point[8] for point in points) * 1e3


def test_the_pad_is_as_far_as_the_simulator_says(bullet):
    pybullet, client = bullet
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    pad = pybullet.createMultiBody(0, shape, basePosition=[0, 0, -0.15], physicsClientId=client)
    arm = Arm(bullet)
    joints = joints_anywhere(300, seed=2)
    ours = clearance_to_pad(links_of(joints), -150.0)
    for k, q in enumerate(joints):
        arm.pose(q)
        theirs = [arm.apart_mm(pad, link, -1) for link in LINKS]
        np.testing.assert_allclose(ours[k], theirs, atol=1e-6)  # mm, above and below it


def test_two_arms_are_as_far_apart_as_the_simulator_says(bullet):
    xyzw = [0.0, np.sin(np.radians(35) / 2), 0.0, np.cos(np.radians(35) / 2)]
    a, m = Arm(bullet), Arm(bullet, BASE_MM, xyzw)
    joints, joints_m = two_arms(200)
    ours = clearance_between(links_of(joints), links_of(joints_m, opening_rad=0.5).seen_from(BASE, BASE_MM))
    assert 20 < np.count_nonzero(ours.min(axis=(1, 2)) < 0) < 180  # some of them overlap
    for k in range(200):
        a.pose(joints[k])
        m.pose(joints_m[k], opening_rad=0.5)
        theirs = [[a.apart_mm(m.number, link, m.links[other]) for other in LINKS] for link in LINKS]
        np.testing.assert_allclose(ours[k], theirs, atol=1e-6)  # mm
