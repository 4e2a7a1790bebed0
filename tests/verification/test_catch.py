"""Catching the needle: compared with cases worked by hand, sampled points and the error function."""

from dataclasses import replace
from math import erf, radians, sqrt

import numpy as np
import pytest

from skills.kinematics import JAW_TIP_MM, POINTING_DOWN
from skills.planning.handoff import HELD_MM, NEEDLE_RADIUS_MM, hand_off, realign
from skills.verification.arm_errors import MEAN_LENGTH
from skills.verification.clearance import (
    FINGER_RADIUS_MM,
    NEEDLE_FREE_RAD,
    NEEDLE_THICK_MM,
    WRIST_RADIUS_MM,
    HandOff,
    catch,
)
from skills.verification.error_draws import Drawn, draw

APPROACH = (-0.94, 0.10, -0.33)
OPENING_RAD = radians(30)


def drawn_errors(seed: int, count: int, needle_rad: float) -> tuple[Drawn, np.ndarray]:
    """Return draws, and offsets between the arms of the mean length of one arm's at a tip error of 1 mm."""
    drawn = draw(seed, 0, count, 1, suture_point_mm=5.0, needle_rad=needle_rad)
    return drawn, drawn.tip_bias[0] / MEAN_LENGTH


def planned_hand_off() -> HandOff:
    jaw = realign(POINTING_DOWN, APPROACH).rotation
    tip = np.array([5.0, 55.0, -125.0])
    (tip_m,), (jaw_m,) = hand_off(tip[None], jaw[None], APPROACH)
    return HandOff(tip, jaw, tip_m, jaw_m)


PLANNED = planned_hand_off()
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
        spare = min(beside, depth - WRIST_RADIUS_MM - half, JAW_TIP_MM - half - depth, room)
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
