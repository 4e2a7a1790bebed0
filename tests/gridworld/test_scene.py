"""Scenes: distances and touching worked by hand and by a dense second method, and the moves of a grid that touch."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.hazards import STAY, SceneCosts, hazards_of
from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.packing import canonical, sha256
from tests.by_day import examples

BOX = Box((0.0, 0.0, 0.0), (10.0, 10.0, 1.0))
ARM = Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 10.0), 2.0)
FLAT = Tissue.plane((0.0, 0.0, -5.0), (0.0, 0.0, 2.0))
RIDGE = Tissue((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 2.0, ((0.0, 0.0), (4.0, 0.0), (0.0, 0.0)))
FULL = Scene("PSM2_base", (BOX,), (ARM,), RIDGE, 0.5)
numbers = st.integers(-15000, 15000).map(lambda n: n / 1000)
points = st.tuples(numbers, numbers, numbers)


def test_the_clearance_of_each_part_is_the_one_worked_by_hand():
    points_mm = [[5, 5, 3], [13, 14, 0.5], [5, 5, 0.5]]
    assert Scene("base", boxes=(BOX,)).clearance_mm(points_mm) == pytest.approx([2, 5, 0])
    assert Scene("base", capsules=(ARM,)).clearance_mm([[5, 0, 5], [0, 3, 14], [1, 0, 5]]) == pytest.approx([3, 3, 0])
    assert Scene("base", tissue=FLAT).clearance_mm([[99, -7, 0], [0, 0, -6]]) == pytest.approx([5, 0])
    assert Scene("base").clearance_mm([[0, 0, 0]]) == np.inf
    assert Scene("base", boxes=(BOX,), margin_mm=1.5).clearance_mm([[5, 5, 3]]) == pytest.approx([0.5])


def test_a_height_map_is_bilinear_and_goes_on_beyond_its_edges():
    at = [[0, 0, 0], [2, 0, 0], [1, 0, 0], [2, 1, 0], [2, 2, 0], [2, -5, 0], [99, 99, 0]]
    assert RIDGE.above_mm(at) == pytest.approx([0, -4, -2, -2, 0, -4, 0])
    turned = replace(RIDGE, along=(0.0, 3.0, 0.0))  # rows along y, columns along normal x along: -x
    assert turned.above_mm([[0, 2, 0], [-1, 2, 0], [-2, 2, 0]]) == pytest.approx([-4, -2, 0])


def test_no_line_passes_through_a_thin_box():
    scene = Scene("base", boxes=(Box((0.0, 0.0, 0.0), (10.0, 10.0, 1e-6)),))
    assert scene.touches([5, 5, 3], [5, 5, -3])
    assert scene.touches([-1, 5, 3], [11, 5, -3])
    assert not scene.touches([5, 5, 3], [5, 5, 1])
    assert not scene.touches([11, 5, 3], [11, 5, -3])
    assert scene.clearance_mm([[5, 5, 3], [5, 5, -3]]).min() > 2.9


def test_a_line_touches_also_when_it_is_compared_together_with_longer_ones():
    """A policy asks for its own moves, and its odds for each action of all cells: both must be told the same."""
    heights = np.random.default_rng(2).normal(0.0, 2.0, (9, 9))
    scene = Scene("base", tissue=replace(RIDGE, heights_mm=tuple(map(tuple, heights))))
    ends = np.random.default_rng(3).uniform((0, 0, -1), (16, 16, 5), (300, 2, 3))
    together = scene.touches(ends[:, 0], ends[:, 1])
    assert together.tolist() == [bool(scene.touches(a, b)) for a, b in ends]
    assert 0.2 < together.mean() < 0.8
    assert scene.touches([np.nan, 1, 9], [1, 1, 9])
    assert Scene("base", capsules=(ARM,)).touches([np.nan, 1, 9], [1, 1, 9])
    assert Scene("base", boxes=(BOX,)).touches([np.nan, 1, 9], [1, 1, 9])


@examples(150)
@given(points, points)
def test_touching_agrees_with_points_along_the_line(a, b):
    """Points in steps of 1/2000 never enter what is not touched, and come near to what is."""
    for scene in (Scene("base", (BOX,)), Scene("base", capsules=(ARM,)), Scene("base", tissue=FLAT), FULL):
        along = np.array(a) + np.linspace(0, 1, 2001)[:, None] * (np.array(b) - a)
        nearest = scene.clearance_mm(along).min()
        # The map is compared at points, between which its surface rises by less than 1 mm; edges of boxes stay sharp.
        if scene.touches(a, b):
            assert nearest <= 0.03 + (np.sqrt(3) - 1) * scene.margin_mm
        else:
            assert nearest > 0 or (scene is FULL and scene.tissue.above_mm(along).min() > scene.margin_mm - 1)


def test_a_cell_is_forbidden_by_its_centre_and_a_move_by_its_line():
    """Five cells in a row, a wall between the second and the third, and a box around the last one's centre."""
    grid = GridWorld((0.0, 0.0, 0.0), 5.0, (5, 1, 1))
    wall, end = Box((7.0, -1.0, -1.0), (7.1, 1.0, 1.0)), Box((19.0, -1.0, -1.0), (30.0, 1.0, 1.0))
    hazards = hazards_of(Scene("base", (wall, end)), GridPath(grid, np.array([0, 1])), "base")
    assert hazards.forbidden.tolist() == [False] * 4 + [True]
    forward = int(np.flatnonzero((MOVES == [1, 0, 0]).all(axis=1))[0])
    assert hazards.touches[:, forward].tolist() == [False, True, False, True, True]
    assert hazards.touches[:, 26 - forward].tolist() == [False, False, True, False, True]
    off_grid = int(np.flatnonzero((MOVES == [0, 1, 0]).all(axis=1))[0])
    assert np.array_equal(hazards.touches[:, off_grid], hazards.touches[:, STAY])


def test_entering_a_cell_costs_by_clearance_and_by_depth_below_the_path():
    grid = GridWorld((0.0, 0.0, 0.0), 2.0, (1, 1, 6))
    path = GridPath(grid, np.array([5, 4]))
    costs = SceneCosts(touch=50.0, close=1.0, close_mm=4.0, deeper_per_mm=0.1)
    hazards = hazards_of(Scene("base", tissue=Tissue.plane((0.0, 0.0, -1.0), (0.0, 0.0, 1.0))), path, "base", costs)
    assert hazards.cost == pytest.approx([0.75 + 0.8, 0.25 + 0.6, 0.4, 0.2, 0, 0])
    assert hazards.touch == 50


def test_a_demonstration_that_touches_the_scene_is_refused_with_the_place():
    grid = GridWorld((0.0, 0.0, 0.0), 5.0, (5, 1, 1))
    scene = Scene("base", (Box((7.0, -1.0, -1.0), (7.1, 1.0, 1.0)),))
    with pytest.raises(BadSettings, match=r"in 1 of 2 moves, first from \(5.0, 0.0, 0.0\) mm; check the scene's frame"):
        hazards_of(scene, GridPath(grid, np.array([0, 1, 2])), "base")


def test_a_scene_in_another_frame_than_the_path_is_refused():
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (5, 1, 1)), np.array([0, 1]))
    with pytest.raises(BadSettings, match="in the frame 'camera', the demonstration in 'PSM2_base'"):
        hazards_of(Scene("camera"), path, "PSM2_base")


def test_a_scene_survives_json_and_its_digest_covers_every_number():
    assert Scene.of_json(json.loads(json.dumps(FULL.as_json()))) == FULL
    others = [replace(FULL, margin_mm=0.6), replace(FULL, frame="PSM1_base"), replace(FULL, tissue=FLAT)]
    assert len({sha256(canonical(scene.as_json())) for scene in (FULL, *others)}) == 4


@pytest.mark.parametrize(
    "wrong",
    [
        {"boxes": [{"low_mm": [0, 0, 0], "high_mm": [1, 1, 0]}]},
        {"boxes": [{"low_mm": [0, 0, float("nan")], "high_mm": [1, 1, 1]}]},
        {"capsules": [{"a_mm": [0, 0, 0], "b_mm": [1, 1, 1], "radius_mm": 0}]},
        {"tissue": {"at_mm": [0, 0, 0], "normal": [0, 0, 1], "along": [0, 0, 1]}},
        {"tissue": {"at_mm": [0, 0, 0], "normal": [0, 0, 1], "along": [1, 0, 0], "heights_mm": [[0], [0, 1]]}},
        {"tissue": {"at_mm": [0, 0, 0], "normal": [0, 0, 1], "along": [1, 0, 0], "heights_mm": []}},
        {"tissue": {"at_mm": [0, 0, 0], "normal": [0, 0, 1], "along": [1, 0, 0], "step_mm": 0}},
        {"margin_mm": float("nan")},
        {"margin_mm": -1},
        {"mesh": "tissue.stl"},
        {"boxes": 3},
        {"frame": ""},
    ],
    ids=lambda wrong: json.dumps(wrong)[:40],
)
def test_what_is_no_scene_is_refused(wrong):
    with pytest.raises(BadSettings):
        Scene.of_json({"frame": "base"} | wrong)


@pytest.mark.parametrize(
    "wrong", [{"touch": 0}, {"close": -1}, {"close_mm": 0}, {"deeper_per_mm": float("nan")}], ids=str
)
def test_impossible_costs_are_refused(wrong):
    with pytest.raises(BadSettings):
        SceneCosts(**wrong)


@examples(100)
@given(points, points)
def test_distances_of_lines_are_the_least_of_points_along_them(a, b):
    """Points in steps of 1/2000 are at most 0.03 mm from any point of the line."""
    a, b = np.array(a), np.array(b)
    along = a + np.linspace(0, 1, 2001)[:, None] * (b - a)
    box = Scene("base", boxes=(BOX,)).clearance_mm(along).min()
    assert box - 0.03 <= BOX.from_lines_mm(a[None], b[None])[0] <= box + 1e-9
    arm = Scene("base", capsules=(ARM,)).clearance_mm(along).min()
    assert arm - 0.03 <= max(ARM.from_lines_mm(a[None], b[None])[0], 0) <= arm + 1e-9
    assert FLAT.from_lines_mm(a, b, 50.0) == pytest.approx(FLAT.above_mm(along).min())


SURFACE = np.stack(np.meshgrid(np.linspace(-20, 20, 81), np.linspace(-20, 20, 81), [0.0]), axis=-1).reshape(-1, 3)
SURFACE[:, 2] = -RIDGE.above_mm(SURFACE)


@examples(40)
@given(points, points)
def test_the_distance_from_a_height_map_is_a_lower_bound(a, b):
    a, b = np.array(a), np.array(b)
    along = a + np.linspace(0, 1, 21)[:, None] * (b - a)
    bound = float(RIDGE.from_lines_mm(a[None], b[None], 8.0)[0])
    if RIDGE.above_mm(along).min() > 0:
        assert bound <= np.linalg.norm(along[:, None] - SURFACE, axis=2).min() + 1e-9
    else:
        assert bound <= 0
    # a surface with slopes of 2 along both axes is at most three times as near as it is below
    assert (
        bound >= min(RIDGE.above_mm(a + np.linspace(0, 1, 2001)[:, None] * (b - a)).min() / 3, 8.0) - 0.2 or bound < 0
    )


def test_distances_of_lines_worked_by_hand_and_nan():
    assert BOX.from_lines_mm(
        np.array([[5, 5, 4], [13, 5, 0.5], [-5, 5, 3.0]]), np.array([[5, 5, 3], [13, 14, 0.5], [15, 5, 3]])
    ) == pytest.approx([2, 3, 2])
    assert RIDGE.from_lines_mm(np.array([[20.0, 20.0, 6.0]]), np.array([[20.0, 20.0, 300.0]]), 50.0) == pytest.approx(
        [2.0], abs=0.13
    )
    lost = np.array([[np.nan, 0.0, 3.0]])
    for apart in (BOX.from_lines_mm(lost, lost + 1), ARM.from_lines_mm(lost, lost + 1)):
        assert np.isnan(apart).all()
    for tissue in (FLAT, RIDGE):
        assert np.isnan(tissue.from_lines_mm(np.full((1, 3), np.nan), np.zeros((1, 3)), 50.0)).all()
        assert np.isnan(tissue.from_lines_mm(np.zeros((1, 3)), np.array([[0.0, 0.0, np.nan]]), 50.0)).all()
