"""Clearances between surfaces and their bounds, the needle, and its catch, against second methods and by hand."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from importlib.resources import files
from math import erf, nan, radians, sqrt
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from skills import kinematics
from skills.planning.handoff import HELD_MM, HOLDING_RAD, NEEDLE_RADIUS_MM, hand_off, realign
from skills.planning.trajectory import TRANSFER, PassPath, time_parametrise
from skills.simulation import simulator
from skills.verification.arm_errors import MEAN_LENGTH
from skills.verification.clearance import (
    ASIDE_MM,
    FINGER_MM,
    FINGER_RADIUS_MM,
    FINGERS,
    GRASPS,
    LINKS,
    NEEDLE_FREE_RAD,
    NEEDLE_THICK_MM,
    RADII_MM,
    WRIST_RADIUS_MM,
    Bounds,
    Crossing,
    HandOff,
    Links,
    caught,
    clearance_between,
    clearance_to_pad,
    crossing,
    links_of,
    needle_poses,
    needle_to_pad_mm,
    travel_mm,
)
from skills.verification.error_draws import Drawn, draw
from skills.verification.playback import link_pairs
from tests.bench.playing import stacked
from tests.needs import need
from tests.planning.motions import small_trajectory

STRAIGHT = np.array([[0.0, 0.0, 150.0, 0.0, 0.0, 0.0]])
BESIDE_MM = np.array([20.0, 0.0, 0.0])
BASE_MM = np.array([160.0, 20.0, 20.0])
BASE = kinematics.matrix_of([[0.0, np.sin(np.radians(35) / 2), 0.0, np.cos(np.radians(35) / 2)]])[0]


def joints_anywhere(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    joints = rng.uniform(kinematics.CLASSIC.lower, kinematics.CLASSIC.upper, (count, 6))
    joints[:, 2] = rng.uniform(kinematics.CANNULA_MM, kinematics.CLASSIC.upper[2], count)
    return joints


def two_arms(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return joints that bring both arms to one place, where some are in each other's way."""
    rng = np.random.default_rng(5)
    tip = rng.uniform([-30, 25, -140], [20, 75, -90], (40 * count, 3))
    turned, turned_m = (
        kinematics.matrix_of(rng.normal(size=(40 * count, 4))),
        kinematics.matrix_of(rng.normal(size=(40 * count, 4))),
    )
    tip_m = (tip + rng.normal(size=tip.shape) * 15.0 - BASE_MM) @ BASE
    both = np.flatnonzero(kinematics.reachable(tip, turned) & kinematics.reachable(tip_m, turned_m))[:count]
    assert len(both) == count
    return kinematics.inverse(tip[both], turned[both]), kinematics.inverse(tip_m[both], turned_m[both])


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
    tip, rotation = kinematics.forward(joints, instrument)
    arm = links_of(joints, instrument, opening_rad=0.2)
    np.testing.assert_allclose(arm.end_mm[:, 1], tip, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(arm.end_mm[:, 1] - arm.begin_mm[:, 1], axis=1), kinematics.WRIST_MM)
    np.testing.assert_allclose(
        np.cross(arm.begin_mm[:, 0], arm.end_mm[:, 0]), 0, atol=1e-9
    )  # through the remote centre
    length = np.linalg.norm(arm.end_mm[:, 0] - arm.begin_mm[:, 0], axis=1)
    np.testing.assert_allclose(length, kinematics.instrument_of(instrument).shaft_mm)
    in_jaw = np.einsum("tji,tkj->tki", rotation, arm.end_mm[:, FINGERS] - tip[:, None])
    sine, cosine = np.sin(0.2), np.cos(0.2)
    y, z = ASIDE_MM * cosine + FINGER_MM * sine, FINGER_MM * cosine - ASIDE_MM * sine
    np.testing.assert_allclose(in_jaw, np.broadcast_to([[0, y, z], [0, -y, z]], (100, 2, 3)), atol=1e-9)


def test_the_capsules_are_those_of_the_urdf():
    """Each is a cylinder, and a sphere of the same radius at either end."""
    root = ElementTree.parse(files("skills") / "urdf" / "psm.urdf").getroot()
    found = {
        link.get("name"): link.findall("collision") for link in root.iter("link") if link.find("collision") is not None
    }
    assert tuple(found) == LINKS
    lengths = (kinematics.instrument_of("400006").shaft_mm, kinematics.WRIST_MM, FINGER_MM, FINGER_MM)
    for name, radius, length in zip(LINKS, RADII_MM, lengths, strict=True):
        cylinder, *ends = found[name]
        size = cylinder.find("geometry/cylinder").attrib
        assert float(size["radius"]) * 1e3 == pytest.approx(radius)
        assert float(size["length"]) * 1e3 == pytest.approx(length)
        assert [float(one.find("geometry/sphere").get("radius")) * 1e3 for one in ends] == pytest.approx([radius] * 2)
        first, last = (np.array(one.find("origin").get("xyz").split(), float) * 1e3 for one in ends)
        centre = np.array(cylinder.find("origin").get("xyz").split(), float) * 1e3
        np.testing.assert_allclose((first + last) / 2, centre, atol=1e-9)
        assert np.linalg.norm(last - first) == pytest.approx(length)
    finger = [float(x) * 1e3 for x in found["finger_1"][0].find("origin").get("xyz").split()]
    np.testing.assert_allclose(finger, [0, ASIDE_MM, FINGER_MM / 2], atol=1e-9)
    assert pytest.approx(kinematics.JAW_TIP_MM) == FINGER_MM + RADII_MM[2]


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
        with TemporaryDirectory() as folder:
            path = Path(folder) / "psm.urdf"
            path.write_text(simulator.arm_in_capsules((files("skills") / "urdf" / "psm.urdf").read_text(), 15.6))
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


APPROACH = (-0.94, 0.10, -0.33)
OPENING_RAD = radians(30)


def drawn_errors(seed: int, count: int, needle_rad: float) -> tuple[Drawn, np.ndarray]:
    """Return draws, and offsets between the arms of the mean length of one arm's at a tip error of 1 mm."""
    drawn = draw(seed, 0, count, 1, suture_point_mm=5.0, needle_rad=needle_rad)
    return drawn, drawn.tip_bias[0] / MEAN_LENGTH


def planned_hand_off() -> HandOff:
    jaw = realign(kinematics.POINTING_DOWN, APPROACH).rotation
    tip = np.array([5.0, 55.0, -125.0])
    (tip_m,), (jaw_m,) = hand_off(tip[None], jaw[None], APPROACH)
    return HandOff(tip, jaw, tip_m, jaw_m)


PLANNED = planned_hand_off()


def catch(
    planned: HandOff, turned: np.ndarray, apart_mm: np.ndarray, opening_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the needle is caught between fingers, and its angle to their hinge."""
    at = crossing(planned, turned, apart_mm)
    return caught(opening_rad).takes(at), at.askew_rad


UNTURNED = np.eye(3)[None]


def test_as_planned_the_needle_lies_along_the_hinge_between_the_fingers():
    between, askew = catch(PLANNED, UNTURNED, np.zeros((1, 3)), OPENING_RAD)
    assert between.tolist() == [True]
    assert askew[0] < 1e-7


def test_jaws_that_are_turned_over_catch_the_same():
    drawn, offset = drawn_errors(0, 300, radians(10))
    over = replace(PLANNED, jaw_m=PLANNED.jaw_m @ np.diag([-1.0, -1.0, 1.0]))
    for one, other in zip(*(catch(at, drawn.turned, offset, OPENING_RAD) for at in (PLANNED, over)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize(
    ("aside_mm", "out_mm", "edge"),
    [
        # PSM_M holds the needle, 0.66 mm thick, 7 mm from its hinge. Along its approach it may sink in until the wrist,
        # 3.6 mm from the hinge, and come out until the tips, 10.2 mm from it.
        (0.0, 1.0, 10.2 - 7.0 - 0.33),
        (0.0, -1.0, 7.0 - 3.6 - 0.33),
        # Sideways, and half inwards, as far as the open finger allows: y cos 30 + 0.33 = z sin 30.
        (1.0, 0.0, (3.5 - 0.33) / sqrt(0.75)),
        (-1.0, 0.0, (3.5 - 0.33) / sqrt(0.75)),
        (0.5, -sqrt(0.75), (3.5 - 0.33) / sqrt(0.75)),
        (-0.5, -sqrt(0.75), (3.5 - 0.33) / sqrt(0.75)),
        # Half outwards it is within the tips' path when they close, 9.87^2 = (7 + d cos 30)^2 + (d sin 30)^2.
        (0.5, sqrt(0.75), sqrt(9.87**2 - 7.0**2 / 4) - 7.0 * sqrt(0.75)),
        (-0.5, sqrt(0.75), sqrt(9.87**2 - 7.0**2 / 4) - 7.0 * sqrt(0.75)),
    ],
)
def test_the_edges_of_what_the_fingers_sweep_are_worked_by_hand(aside_mm, out_mm, edge):
    direction = PLANNED.jaw_m @ np.array([0.0, aside_mm, out_mm])
    within, beyond = ((edge + by) * direction for by in (-1e-6, 1e-6))
    between, _ = catch(PLANNED, np.repeat(UNTURNED, 2, axis=0), np.array([within, beyond]), OPENING_RAD)
    assert between.tolist() == [True, False]


def test_along_the_hinge_the_needle_slides_through_until_it_ends():
    # Moved by d along the hinge, another place of the arc is between the fingers, where cos phi = -d / r.
    n = PLANNED.jaw_m[:, 0]
    shifts = np.array([1.0, -1.0, 3.0, -4.0, 4.0, 9.0])
    between, askew = catch(PLANNED, np.repeat(UNTURNED, 6, axis=0), -shifts[:, None] * n, OPENING_RAD)
    np.testing.assert_allclose(askew[:5], np.arcsin(np.abs(shifts[:5]) / NEEDLE_RADIUS_MM), atol=1e-9)
    # Its free end is 120 degrees from PSM_A's grip: at 4 mm, 119 degrees, it is only half across the fingers.
    assert between.tolist()[:5] == [True, True, True, True, False]
    assert not between[5] and np.isnan(askew[5])  # the offset exceeds the radius: the needle does not pass at all


@pytest.mark.parametrize(
    ("beside_mm", "deep_mm", "along_deg", "askew_deg", "held", "straight"),
    [
        (0.0, 7.0, 90.0, 0.0, True, True),  # as planned
        (0.0, 7.0, 90.0, 30.0, True, False),  # askew: how it is held, and not whether
        (0.0, 7.0, 90.0, 60.0, False, False),
        (0.0, 12.0, 90.0, 0.0, False, False),  # 5 mm short: beyond the tips
        (8.0, 7.0, 90.0, 0.0, False, False),  # beside the fingers
        (0.0, 1.0, 90.0, 0.0, True, True),  # against the wrist
        (0.0, 7.0, 126.0, 0.0, True, True),  # its end is beside the fingers' middle, and they are 2.2 mm wide
        (0.0, 7.0, 129.0, 0.0, False, False),
        (nan, nan, nan, nan, False, False),
    ],
)
def test_grasps_by_friction_are_worked_by_hand(beside_mm, deep_mm, along_deg, askew_deg, held, straight):
    at = Crossing(*(np.array([one]) for one in (beside_mm, deep_mm, radians(along_deg), radians(askew_deg))))
    assert [GRASPS[name].takes(at).tolist() for name in ("held", "straight")] == [[held], [straight]]


@given(some.arrays(np.float64, (4, 20), elements=st.floats(-15, 15)))
def test_what_is_held_straight_is_held(numbers):
    at = Crossing(*numbers)
    assert not (GRASPS["straight"].takes(at) & ~GRASPS["held"].takes(at)).any()


def test_a_sampled_arc_crosses_the_jaws_at_the_same_place_and_angle():
    drawn, offset = drawn_errors(3, 400, radians(25))
    apart = 2.0 * offset
    between, askew = catch(PLANNED, drawn.turned, apart, OPENING_RAD)
    n, a, a_m = PLANNED.jaw_a[:, 0], PLANNED.jaw_a[:, 2], PLANNED.jaw_m[:, 2]
    free = -n * np.sign(n @ a_m)
    phi = np.linspace(0, NEEDLE_FREE_RAD, 24001)[:, None]
    arc = NEEDLE_RADIUS_MM * ((1 - np.cos(phi)) * np.cross(a, free) + np.sin(phi) * free)
    for k in range(400):
        points = (PLANNED.tip_a + HELD_MM * a + apart[k] + arc @ drawn.turned[k].T - PLANNED.tip_m) @ PLANNED.jaw_m
        # Of the two crossings a half circle may have, the one on its far side.
        crossing = np.flatnonzero(np.diff(np.sign(points[:, 0])) > 0)
        if not len(crossing):
            assert not between[k]
            continue
        at = crossing[-1]
        along = points[at + 1] - points[at]
        cosine = np.clip(along[0] / np.linalg.norm(along), -1, 1)
        assert askew[k] == pytest.approx(np.arccos(cosine), abs=2e-4)
        y, z = abs(points[at, 1]), points[at, 2]
        beside = NEEDLE_RADIUS_MM * min(phi[at, 0], NEEDLE_FREE_RAD - phi[at, 0]) - FINGER_RADIUS_MM
        depth, half = np.hypot(y, z), NEEDLE_THICK_MM / 2
        room = z * np.sin(OPENING_RAD) - y * np.cos(OPENING_RAD) - half
        spare = min(beside, depth - WRIST_RADIUS_MM - half, kinematics.JAW_TIP_MM - half - depth, room)
        if abs(spare) > 0.01:
            assert between[k] == (spare > 0)


def test_the_angle_alone_fails_as_often_as_the_error_function_says():
    # Without any turn, the tangent is off by asin(d / r) for an offset d along the hinge, a normal number.
    drawn, offset = drawn_errors(1, 200_000, 0.0)
    apart = 3.0 * (drawn.tip_bias[0] - drawn.tip_bias[1]) / MEAN_LENGTH
    _, askew = catch(PLANNED, drawn.turned, apart, OPENING_RAD)
    sigma = 3.0 / sqrt(8 / np.pi) * sqrt(2)  # the mean length of an offset is 3 mm, and there are two
    share = np.count_nonzero(askew <= radians(15)) / 200_000
    assert share == pytest.approx(erf(NEEDLE_RADIUS_MM * np.sin(radians(15)) / sigma / sqrt(2)), abs=0.004)
    assert np.linalg.norm(3.0 * offset, axis=1).mean() == pytest.approx(3.0, abs=0.01)


PAD_MM = np.array([0.0, 55.0, -150.0])
LEVEL = time_parametrise([PassPath([[0, 55, -135], [0, 55, -130]], kinematics.POINTING_DOWN)], rate_hz=60.0)


def test_a_downward_needle_lies_level_9_mm_below_the_hinge():
    found = needle_to_pad_mm(LEVEL, np.array([0, len(LEVEL) - 1]), PAD_MM)
    np.testing.assert_allclose(found, [15.0 - 9.0 - 0.33, 20.0 - 9.0 - 0.33], atol=1e-9)


@pytest.mark.parametrize(("centre", "lowest_mm"), [(1.0, 0.0), (-1.0, 1.5 * NEEDLE_RADIUS_MM)])
def test_on_its_edge_it_reaches_down_as_far_as_its_arc_does(centre, lowest_mm):
    """Held along x, the approach along -y, the arc's centre above or below; two thirds of it are on one side."""
    upright = np.array([[centre, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, centre, 0.0]])
    edge = replace(LEVEL, rotation_xyzw=np.tile(kinematics.quaternion_of(upright[None]), (len(LEVEL), 1)))
    [found] = needle_to_pad_mm(edge, np.array([0]), PAD_MM)
    assert found == pytest.approx(15.0 - lowest_mm - 0.33, abs=1e-9)


def test_inside_the_pad_it_is_negative():
    level = time_parametrise([PassPath([[0, 55, -145], [0, 55, -140]], kinematics.POINTING_DOWN)], rate_hz=60.0)
    assert needle_to_pad_mm(level, np.array([0]), PAD_MM)[0] == pytest.approx(-4.0 - 0.33, abs=1e-9)


def test_after_the_hand_off_the_needle_follows_psm_m_to_the_next_pass():
    trajectory = stacked(passes=2, rate_hz=60.0)
    end = int(trajectory.last_samples[0])
    place, rotation = needle_poses(trajectory, np.arange(len(trajectory)))
    away = np.flatnonzero((trajectory.phase == TRANSFER) & (trajectory.pass_index == 1))
    np.testing.assert_allclose(place[end + 1], place[end], atol=1e-6)  # the arms stand still there
    alone = needle_poses(replace(trajectory, psm_m=None), away)[0]
    assert np.linalg.norm(place[away] - alone, axis=1).max() > 10.0  # mm: PSM_M holds it
    turned = rotation @ np.swapaxes(rotation, 1, 2)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-9)


def finger_ends(joints: np.ndarray) -> np.ndarray:
    """Return points all over both fingers' caps, shape (T, K, 3)."""
    tip, rotation = kinematics.forward(joints)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    opened = [np.array([0.0, side * (0.6 + 9.1 * np.sin(0.06)), 9.1 * np.cos(0.06)]) for side in (1, -1)]
    around = 1.1 * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    around = np.append(around, [[0.0, 0.0, 1.1]], axis=0)
    points = np.concatenate([end + around for end in opened])
    return tip[:, None] + np.einsum("tij,kj->tki", rotation, points)


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 0.3))
def test_no_point_of_a_finger_moves_further_than_the_bound(seed, step):
    rng = np.random.default_rng(seed)
    joints = rng.uniform(kinematics.CLASSIC.lower, kinematics.CLASSIC.upper, (1, 6))
    joints[:, 2] = rng.uniform(40.0, 240.0)
    joints = np.concatenate([joints, joints + rng.uniform(-step, step, 6) * [1, 1, 50, 1, 1, 1]])
    moved = np.linalg.norm(np.diff(finger_ends(joints), axis=0), axis=2).max()
    assert moved <= travel_mm(joints, "400006")[0, 2] + 1e-9


def test_the_bound_is_worked_by_hand_where_one_joint_moves():
    joints = np.zeros((2, 6))
    joints[:, 2] = 115.6  # the wrist 100 mm beyond the remote centre
    for joint, turned, expected in (
        (0, 0.01, [3.202, 1.127, 1.194, 1.194]),  # the shaft's far end, 316.2 mm behind; the finger tip, 119.4 mm ahead
        (2, 0.5, [0.5, 0.5, 0.5, 0.5]),
        (3, 0.1, [0.0, 1.27, 1.94, 1.94]),
        (5, 0.1, [0.0, 0.0, 1.03, 1.03]),
    ):
        moved = joints.copy()
        moved[1, joint] += turned
        if joint == 2:
            np.testing.assert_allclose(travel_mm(moved, "400006")[0], expected, atol=1e-9)
        else:
            np.testing.assert_allclose(travel_mm(moved, "400006")[0], expected, atol=1e-3)


def bounded(seen: list[float], looked_at: list[int], way: np.ndarray) -> np.ndarray:
    """Bound one pair, the shaft and the pad, for a given travel of the shaft."""
    pair = link_pairs(False)[:1]
    return Bounds(pair, np.array(looked_at), np.array(seen)[:, None], {"PSM_A": np.tile(way[:, None], 4)}).at_least_mm(
        0
    )


def test_between_looks_the_distance_is_bounded_by_the_closing_motion():
    np.testing.assert_allclose(bounded([5.0, 4.0], [0, 4], np.arange(5.0)), [5.0, 4.0, 3.0, 3.0, 4.0])


def test_a_nan_spoils_everything_up_to_its_neighbours():
    found = bounded([5.0, np.nan, 5.0], [0, 3, 6], np.arange(7) * 0.1)
    assert np.isnan(found).tolist() == [False, True, True, True, True, True, False]


@given(some.arrays(np.float64, 40, elements=st.floats(-5.0, 5.0)))
def test_a_distance_is_never_bounded_above_itself(steps):
    apart = 10.0 + np.cumsum(steps)
    looked_at = [*range(0, 39, 7), 39]
    found = bounded(apart[looked_at], looked_at, np.append(0.0, np.cumsum(np.abs(np.diff(apart)))))
    assert (found <= apart + 1e-9).all()
    np.testing.assert_array_equal(found[looked_at], apart[looked_at])


def test_both_arms_may_have_closed_in():
    joints = small_trajectory(1, rate_hz=60.0).joints
    pairs = link_pairs(True)
    looked_at, seen = np.array([0, len(joints) - 1]), np.full((2, len(pairs)), 20.0)
    motion, rest = (joints, "400006"), (np.tile(joints[:1], (len(joints), 1)), "400006")
    one = Bounds.of({"PSM_A": motion, "PSM_M": rest}, pairs, looked_at, seen)
    two = Bounds.of({"PSM_A": motion, "PSM_M": motion}, pairs, looked_at, seen)
    column = [str(pair) for pair in pairs].index("PSM_A finger_1 to PSM_M finger_1")
    np.testing.assert_allclose(20.0 - two.at_least_mm(column), 2 * (20.0 - one.at_least_mm(column)), atol=1e-9)
    assert two.moved_mm() == pytest.approx(2 * one.moved_mm())


def test_four_samples_of_a_plan_are_bounded_by_about_a_millimetre():
    trajectory = small_trajectory(1, rate_hz=240.0)
    fingers = travel_mm(trajectory.joints, "400006")[:, 2]
    along = np.linalg.norm(np.diff(finger_ends(trajectory.joints), axis=0), axis=2).max(axis=1)
    assert (along <= fingers + 1e-9).all()
    assert 4 * fingers.max() < 1.5
