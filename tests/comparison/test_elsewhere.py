"""A demonstration at another wound line: its shape is unchanged."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skills.comparison.combining import axes, moved
from skills.comparison.distances import placed
from skills.errors import BadInput, BadPath
from skills.kinematics import matrix_of
from tests.bench.geometry import METHODS, measured
from tests.comparison.cohort import demo_of

HUMPS_MM = np.array([[3.0, 8.0], [-2.0, 1.0], [1.0, 1.0]])
PLACES = st.tuples(*[st.floats(-80, 80)] * 3).map(np.array)


def demo():
    one = demo_of(HUMPS_MM, 0.4, np.array([5.0, 40.0, -120.0]), 3.0)
    turning = Rotation.from_euler("xyz", np.outer(one.stamps_s + 1.0, [0.1, 0.2, 0.3]))
    return replace(one, rotation_xyzw=turning.as_quat())


def test_a_path_of_40_mm_along_x_is_turned_and_doubled_onto_80_mm_along_y():
    along_x = np.array([[0.0, 0.0, 0.0], [20.0, 3.0, 5.0], [40.0, 0.0, 0.0]])
    one = replace(demo(), stamps_s=np.arange(3.0), tip_mm=along_x, rotation_xyzw=None)
    there = moved(one, [1.0, 2.0, 3.0], [1.0, 82.0, 3.0])
    np.testing.assert_allclose(there.tip_mm, [[1.0, 2.0, 3.0], [-5.0, 42.0, 13.0], [1.0, 82.0, 3.0]], atol=1e-12)


@given(PLACES, PLACES)
def test_it_begins_and_ends_where_it_should_and_its_shape_stays(start, goal):
    one = demo()
    scale = np.linalg.norm(goal - start) / np.linalg.norm(one.tip_mm[-1] - one.tip_mm[0])
    if not 0.25 <= scale <= 4.0:
        with pytest.raises(BadPath):
            moved(one, start, goal)
        return
    there = moved(one, start, goal)
    np.testing.assert_allclose(there.tip_mm[[0, -1]], [start, goal], atol=1e-9)
    np.testing.assert_allclose(placed(there.tip_mm, scaled=True), placed(one.tip_mm, scaled=True), atol=1e-9)


@given(PLACES, PLACES)
def test_the_tool_turns_with_the_way(start, goal):
    one = demo()
    try:
        there = moved(one, start, goal)
    except BadPath:
        return
    before, after = (axes(d.tip_mm[0], d.tip_mm[-1]) @ matrix_of(d.rotation_xyzw) for d in (one, there))
    np.testing.assert_allclose(before, after, atol=1e-9)


def test_moved_to_where_it_is_it_stays_and_there_and_back_is_where_it_was():
    one = demo()
    start, goal = one.tip_mm[0], one.tip_mm[-1]
    np.testing.assert_allclose(moved(one, start, goal).tip_mm, one.tip_mm, atol=1e-9)
    there = moved(one, [0.0, 0.0, -100.0], [30.0, -20.0, -90.0])
    np.testing.assert_allclose(moved(there, start, goal).tip_mm, one.tip_mm, atol=1e-9)


@given(PLACES, PLACES)
def test_axes_are_a_right_handed_frame_along_the_way_with_its_upside_up(start, goal):
    if np.linalg.norm(goal - start) < 1.0:
        return
    x, y, z = axes(start, goal)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    np.testing.assert_allclose(x, (goal - start) / np.linalg.norm(goal - start), atol=1e-12)
    assert z[2] >= 0 or abs(x[2]) >= 0.99


@pytest.mark.parametrize("goal", [[0.0, 0.0, 0.5], [5.0, 0.0, 0.0], [300.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
def test_a_way_of_no_length_or_of_quite_another_is_refused(goal):
    with pytest.raises(BadInput, match=r"times as long|NaN"):
        moved(demo(), np.zeros(3), goal)


def test_where_the_other_arm_would_be_is_not_made_up():
    assert moved(demo(), np.zeros(3), [30.0, 0.0, 0.0]).partner is None


def test_at_other_lines_ours_keeps_the_shape_and_a_primitive_loses_it():
    kept, lost = (
        [shape for shape, *_ in islice(measured(METHODS[name], 1), 2)] for name in ("ours", "dynamic primitive")
    )
    assert max(kept) < 1e-9
    assert lost[0] < 1.0 < lost[1]  # mm at a state: at its own line, and at another
