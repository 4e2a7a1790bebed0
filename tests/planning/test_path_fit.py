"""The fitted path: near the recording, in the rollout's cells in their order, smooth, from every start.

With hysteresis a point may be outside of its cell by as much, as the recording may, but not outside of the grid.

Distance of a path from a recording: both resampled in steps of 0.5 mm, the recording without rests and without motion
back and forth within 0.5 mm; aligned by our DTW; the root mean square of the pairs' 3-D distances. The ends count as
well.
"""

from dataclasses import replace
from functools import cache
from io import BytesIO
from math import dist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.segments import propose_segments
from skills.errors import BadPlan
from skills.formats import read_recording
from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld, discretisation_rmse, discretize
from skills.gridworld.reward import sparse_reward
from skills.kinematics import POINTING_DOWN
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy, Rollout, learn_tabular, rollout
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.planning import path_fit
from skills.planning.path_fit import FittedPath, fit_to_demo, hand_along, trace
from skills.planning.trajectory import PassPath, time_parametrise
from skills.seeds.recordings import sample_recordings
from tests.by_day import examples
from tests.learning.loops import run_both

HAND_OFFS = [(s.name, k) for s in sample_recordings() for k in range(len(s.segments))]
STEP_MM = 0.5
GRID = GridWorld((0.0, 0.0, 0.0), 5.0, (9, 9, 9))


@cache
def shipped(name: str, number: int, hysteresis: float = 0.0) -> tuple[Demo, Policy]:
    """Return a shipped sample's hand-off as the service proposes it, and the policy learnt from it in 5 mm cells."""
    (sample,) = (s for s in sample_recordings() if s.name == name)
    recording = read_recording(BytesIO(sample.data))
    part = propose_segments(recording)[number]
    demo = cut_demo(recording, start_s=part.start_s, end_s=part.end_s)
    return demo, learn_tabular(sparse_reward(discretize(demo.tip_mm, PAPER_GRID, hysteresis)), PhaseQLearning(), seed=0)


def fitted(demo: Demo, policy: Policy, start_mm: np.ndarray | None = None) -> tuple[Rollout, FittedPath]:
    followed = rollout(policy, policy.path.tip_mm[0] if start_mm is None else start_mm)
    return followed, fit_to_demo(followed, trace(demo, policy.path), start_mm)


def recorded(tip_mm: np.ndarray, rate_hz: float = 100.0) -> Demo:
    """Return a demonstration of positions alone."""
    stamps = np.arange(len(tip_mm)) / rate_hz
    return Demo("PSM2", "/t", "PSM2_base", 0.0, float(stamps[-1]), stamps, tip_mm)


def along_itself(path: GridPath) -> Rollout:
    """Return the rollout from the demonstrated start, without learning it."""
    count = len(path.states)
    return Rollout(path, path.states, np.arange(1, count + 1).clip(max=count - 1), True)


def walked(tip_mm: np.ndarray, step_mm: float = STEP_MM) -> np.ndarray:
    """Return the same path in even steps."""
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)))
    even = np.linspace(0, way[-1], round(way[-1] / step_mm) + 1)
    return np.stack([np.interp(even, way, axis) for axis in tip_mm.T], axis=1)


def without_rests(tip_mm: np.ndarray) -> np.ndarray:
    kept = [tip_mm[0]]
    for tip in tip_mm:
        if dist(tip, kept[-1]) >= STEP_MM:
            kept.append(tip)
    return np.array(kept)


def rmse_mm(path_mm: np.ndarray, recorded_mm: np.ndarray) -> float:
    apart = dtw(walked(path_mm), walked(without_rests(recorded_mm))).differences_mm
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def turns_deg(tip_mm: np.ndarray) -> np.ndarray:
    moves = np.diff(tip_mm, axis=0)
    moves /= np.linalg.norm(moves, axis=1)[:, None]
    return np.degrees(np.arccos((moves[1:] * moves[:-1]).sum(axis=1).clip(-1, 1)))


def assert_through_its_cells(followed: Rollout, fit: FittedPath) -> None:
    """Assert that every point is in the cell of its visit, visits are in order, and neighbours' cells touch.

    With hysteresis a point may be as far outside of the cell as the recording may, along each axis.
    """
    grid, hysteresis = followed.path.grid, followed.path.hysteresis
    nearest = grid.states_at(fit.tip_mm)  # refuses points outside of the grid
    if hysteresis == 0:
        assert nearest.tolist() == followed.states[fit.visits].tolist()
    else:
        assert outside_cells(followed, fit).max() < hysteresis
    assert (fit.visits[0], fit.visits[-1]) == (0, len(followed.states) - 1)
    assert (np.diff(fit.visits) >= 0).all()
    assert np.abs(np.diff(grid.cells_of(followed.states[fit.visits]), axis=0)).max(initial=0) <= 1


def outside_cells(followed: Rollout, fit: FittedPath) -> np.ndarray:
    """Return how far each point is outside of the cell of its visit, along the worst axis, in cells."""
    centres = followed.path.grid.centres_mm(followed.states[fit.visits])
    return np.maximum(np.abs(fit.tip_mm - centres).max(axis=1) / followed.path.grid.cell_mm - 0.5, 0.0)


# ---- the shipped samples ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "number"), HAND_OFFS)
def test_a_shipped_hand_off_is_followed_far_below_the_grids_floor(name, number):
    demo, policy = shipped(name, number)
    _, fit = fitted(demo, policy)
    floor_mm = float(np.linalg.norm(discretisation_rmse(demo.tip_mm, policy.path.grid)))
    assert floor_mm == pytest.approx(2.4, abs=0.2)  # half a cell
    assert rmse_mm(policy.path.tip_mm, demo.tip_mm) > 1.8
    assert rmse_mm(fit.tip_mm, demo.tip_mm) <= 0.8


@pytest.mark.parametrize(("name", "number"), HAND_OFFS)
def test_away_from_its_ends_the_fit_follows_a_hand_off_within_its_tremor(name, number):
    demo, policy = shipped(name, number)
    _, fit = fitted(demo, policy)
    to_ends = np.linalg.norm(fit.tip_mm[:, None] - policy.path.tip_mm[[0, -1]], axis=2).min(axis=1)
    away = np.linalg.norm(fit.tip_mm[:, None] - demo.tip_mm, axis=2).min(axis=1)
    assert away[to_ends > 7.5].max() < 0.8


@pytest.mark.parametrize(("name", "number"), HAND_OFFS)
def test_fitted_points_lie_in_the_policys_cells_and_few_cells_are_missed(name, number):
    demo, policy = shipped(name, number)
    followed, fit = fitted(demo, policy)
    assert_through_its_cells(followed, fit)
    passed_by = set(range(len(followed.states))) - set(fit.visits.tolist())
    assert len(passed_by) <= (1 if "plover" not in name else 8)  # tremor crosses faces back and forth
    cells = policy.path.grid.cells_at(demo.tip_mm)
    visit = np.append(0, np.cumsum((np.diff(cells, axis=0) != 0).any(axis=1)))  # no cell is bridged here
    for number in passed_by:
        assert np.ptp(demo.tip_mm[visit == number], axis=0).max() < 1.0  # mm


@pytest.mark.parametrize(("name", "number"), HAND_OFFS)
def test_it_has_no_corners(name, number):
    demo, policy = shipped(name, number)
    _, fit = fitted(demo, policy)
    steps = np.linalg.norm(np.diff(fit.tip_mm, axis=0), axis=1)
    assert steps.min() > 0.1
    assert steps.max() < 0.7
    # From centre to centre: 90 and more. A trembling hand turns back, and its path with it.
    assert turns_deg(fit.tip_mm).max() < (10 if "plover" not in name else 70)
    assert turns_deg(fit.tip_mm).sum() < turns_deg(policy.path.tip_mm).sum() / (4 if "plover" not in name else 3)


@pytest.mark.parametrize("name", [s.name for s in sample_recordings()])
def test_the_arm_follows_it_sooner_and_closer_than_the_cells(name):
    demo, policy = shipped(name, 0)
    _, fit = fitted(demo, policy)
    through_cells, along_fit = (
        time_parametrise([PassPath(tip_mm, POINTING_DOWN)]) for tip_mm in (policy.path.tip_mm, fit.tip_mm)
    )
    assert along_fit.duration_s < 0.95 * through_cells.duration_s
    assert along_fit.acceleration_ratio <= 1
    assert along_fit.deviation_mm < 0.1
    assert through_cells.deviation_mm > 0.2
    assert rmse_mm(along_fit.tip_mm, demo.tip_mm) <= 0.8  # and so is the arm's motion


# ---- other starts -----------------------------------------------------------------------------------------------


@examples(60)
@given(
    st.sampled_from(["wren-simple-running", "plover-simple-running"]),
    st.integers(0, 1330),
    st.tuples(*[st.floats(-2.49, 2.49)] * 3),
)
def test_from_any_start_it_goes_through_the_rollouts_cells_and_blends_in(name, start, off_mm):
    demo, policy = shipped(name, 0)
    start_mm = policy.path.grid.centres_mm(start) + off_mm
    followed, fit = fitted(demo, policy, start_mm)
    assert_through_its_cells(followed, fit)
    assert (fit.tip_mm[0] == start_mm).all()
    assert fit.tip_mm[-1] == pytest.approx(demo.tip_mm[-1], abs=1e-6)
    joined = next(i for i, phase in enumerate(followed.phases) if phase > 0 or i == len(followed.phases) - 1)
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(fit.tip_mm, axis=0), axis=1)))
    there = (way > way[fit.visits >= joined][0] + 11) & (way < way[-1] - 8)  # mm
    away = np.linalg.norm(fit.tip_mm[there][:, None] - demo.tip_mm, axis=2).min(axis=1)
    assert away.max(initial=0) < 1.0


@examples(30)
@given(st.sampled_from([0.25, 0.5]), st.integers(0, 1330), st.tuples(*[st.floats(-2.49, 2.49)] * 3))
def test_with_hysteresis_it_goes_through_the_cells_from_any_start_as_well(hysteresis, start, off_mm):
    demo, policy = shipped("plover-simple-running", 0, hysteresis)
    start_mm = policy.path.grid.centres_mm(start) + off_mm
    followed, fit = fitted(demo, policy, start_mm)
    assert_through_its_cells(followed, fit)
    assert (fit.tip_mm[0] == start_mm).all()


def test_a_start_in_the_goals_cell_goes_straight_to_the_goal():
    demo, policy = shipped("heron-simple-running", 0)
    goal_mm = demo.tip_mm[-1].round(6)
    _, fit = fitted(demo, policy, policy.path.tip_mm[-1] + np.array([2, 1, -2]))
    assert turns_deg(fit.tip_mm).max() < 1e-3
    beside_mm = goal_mm + np.array([0.1, 0, 0])
    _, fit = fitted(demo, policy, beside_mm)
    assert fit.tip_mm.tolist() == [beside_mm.tolist(), goal_mm.tolist()]
    _, fit = fitted(demo, policy, goal_mm)
    assert fit.tip_mm.tolist() == [goal_mm.tolist()]


# ---- special recordings -----------------------------------------------------------------------------------------


def test_where_a_path_crosses_itself_each_branch_is_followed_on_its_own():
    corners = [
        [8.5, 20, 20],
        [38, 20, 20],
        [38, 38, 20],
        [21.5, 38, 20],
        [21.5, 8, 20],
    ]  # crosses in the cell at 20, 20
    demo = recorded(walked(np.array(corners, float), 0.2))
    path = discretize(demo.tip_mm, GRID)
    fit = fit_to_demo(along_itself(path), trace(demo, path))
    crossing = np.flatnonzero(path.states == GRID.states_at([20, 20, 20]))
    first, second = (fit.tip_mm[fit.visits == visit] for visit in crossing)
    assert np.abs(first[:, 1] - 20).max() < 0.1  # along x
    assert np.abs(second[:, 0] - 21.5).max() < 0.1  # along y
    assert np.ptp(first[:, 0]) > 2.5
    assert np.ptp(second[:, 1]) > 2.5


def test_tremor_and_rests_are_not_in_the_path():
    seconds = np.arange(0, 8, 0.01)
    way = np.interp(seconds, [0, 3, 5, 8], [0, 1, 1, 2])  # rests from 3 s to 5 s, on no face
    clean = np.stack([8 + 14 * way, 22 + 12 * np.sin(1.5 * way), 20 + 4 * way], axis=1)
    tremor = 0.4 * np.sin(2 * np.pi * np.array([8.3, 10.0, 11.7]) * seconds[:, None])
    demo = recorded(clean + tremor)
    path = discretize(demo.tip_mm, GRID)
    fit = fit_to_demo(along_itself(path), trace(demo, path))
    length, meant, shaken = (
        np.linalg.norm(np.diff(tip, axis=0), axis=1).sum() for tip in (fit.tip_mm, clean, demo.tip_mm)
    )
    assert shaken > 3 * meant
    assert length == pytest.approx(meant, rel=0.1)
    middle = np.linalg.norm(fit.tip_mm[8:-8, None] - clean, axis=2).min(axis=1)
    assert np.sqrt((middle**2).mean()) < 0.25  # mm; the tremor's is 0.49


def test_a_slow_hand_is_not_taken_for_a_resting_one():
    seconds = np.arange(0, 60, 0.1)
    demo = recorded(np.stack([10 + 0.3 * seconds, 21 + 0 * seconds, 19 + 0 * seconds], axis=1), rate_hz=10.0)
    path = discretize(demo.tip_mm, GRID)
    fit = fit_to_demo(along_itself(path), trace(demo, path))
    between = fit.tip_mm[(fit.tip_mm[:, 0] > 16) & (fit.tip_mm[:, 0] < 22)]
    assert len(between) >= 4
    assert np.abs(between[:, 1:] - [21, 19]).max() < 0.1


def test_cells_that_no_sample_lies_in_are_crossed_in_a_straight_line():
    tip_mm = np.concatenate((np.linspace([8, 21, 20], [11, 21, 20], 40), np.linspace([29, 30, 20], [38, 30, 20], 40)))
    demo = recorded(tip_mm, rate_hz=5.0)
    path = discretize(tip_mm, GRID)
    assert path.bridged == 3
    followed = along_itself(path)
    fit = fit_to_demo(followed, trace(demo, path))
    assert_through_its_cells(followed, fit)
    assert set(fit.visits.tolist()) == set(range(len(path.states)))
    between = fit.tip_mm[(fit.tip_mm[:, 0] > 15) & (fit.tip_mm[:, 0] < 25)]
    assert len(between) >= 6
    assert between[:, 1] == pytest.approx(21 + (between[:, 0] - 11) / 2, abs=0.8)  # mm; the line leaves a cell's corner


@examples(60)
@given(st.integers(0, 10**6), st.sampled_from([1.0, 5.0, 40.0]), st.sampled_from([0.0, 0.25, 0.5]))
def test_any_recording_whatever_is_followed_through_its_cells(seed, pace_mm, hysteresis):
    rng = np.random.default_rng(seed)
    tip_mm = 20 + np.cumsum(rng.normal(0, pace_mm / 5, (int(rng.integers(4, 120)), 3)), axis=0)
    tip_mm = np.concatenate((tip_mm.clip(-2.4, 42.4), [[1.0, 2.0, 3.0], [9.0, 2.0, 3.0]]))
    path = discretize(tip_mm, GRID, hysteresis)
    followed = along_itself(path)
    fit = fit_to_demo(followed, trace(recorded(tip_mm), path))
    assert_through_its_cells(followed, fit)


@pytest.mark.parametrize(("name", "number"), HAND_OFFS)
def test_hysteresis_shortens_the_path_and_follows_the_recording_as_well(name, number):
    demo, policy = shipped(name, number)
    path = discretize(demo.tip_mm, PAPER_GRID, 0.25)
    assert len(path.states) < 0.8 * len(policy.path.states)
    followed = along_itself(path)
    fit = fit_to_demo(followed, trace(demo, path))
    assert_through_its_cells(followed, fit)
    assert outside_cells(followed, fit).max() > 0.1  # the hand had left them, and is not pressed on their faces
    assert rmse_mm(fit.tip_mm, demo.tip_mm) <= 0.3
    assert turns_deg(fit.tip_mm).max() < (10 if "plover" not in name else 30)


@pytest.mark.parametrize("hysteresis", [0.0, 0.25, 0.5])
def test_a_point_farther_out_than_hysteresis_is_not_through_its_cells(hysteresis):
    demo, _ = shipped("heron-simple-running", 0)
    path = discretize(demo.tip_mm, PAPER_GRID, hysteresis)
    followed = along_itself(path)
    fit = fit_to_demo(followed, trace(demo, path))
    middle = len(fit.tip_mm) // 2
    for axis, side in [(axis, side) for axis in range(3) for side in (-1, 1)]:
        for beyond, sound in ((-0.01, True), (0.01, False)):
            tip_mm = fit.tip_mm.copy()
            tip_mm[middle] = path.tip_mm[fit.visits[middle]]
            tip_mm[middle, axis] += side * path.grid.cell_mm * (0.5 + hysteresis + beyond)
            if sound:
                assert_through_its_cells(followed, replace(fit, tip_mm=tip_mm))
            else:
                with pytest.raises(AssertionError):
                    assert_through_its_cells(followed, replace(fit, tip_mm=tip_mm))


@pytest.mark.parametrize("hysteresis", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("rate_hz", [5.0, 100.0])
def test_a_bend_at_the_face_of_the_grid_stays_in_the_grid(rate_hz, hysteresis):
    corners = np.array([[20, 20, 20], [42.495, 20, 20], [42.495, 35, 20], [20, 35, 20]])
    demo = recorded(walked(corners, 0.2), rate_hz)
    for tip_mm in (demo.tip_mm, 40 - demo.tip_mm):  # the faces are at 42.5 and -2.5 mm
        mirrored = replace(demo, tip_mm=tip_mm)
        path = discretize(tip_mm, GRID, hysteresis)
        followed = along_itself(path)
        assert_through_its_cells(followed, fit_to_demo(followed, trace(mirrored, path)))


def test_a_trembling_hand_crosses_its_path_19_times_or_0_with_hysteresis():
    demo, policy = shipped("plover-simple-running", 0)
    assert (len(policy.path.states), policy.path.revisits) == (44, 19)
    path = discretize(demo.tip_mm, PAPER_GRID, 0.25)
    assert (len(path.states), path.revisits) == (18, 0)


def test_a_path_made_with_another_hysteresis_is_refused():
    demo, policy = shipped("plover-simple-running", 0)
    with pytest.raises(BadPlan, match="not learnt from this demonstration"):
        trace(demo, replace(policy.path, hysteresis=0.25))


def test_the_papers_own_state_is_followed_as_far_as_it_follows():
    demo, policy = shipped("kestrel-simple-running", 0)
    cell = learn_tabular(sparse_reward(policy.path), CellQLearning(), seed=0)
    followed, fit = fitted(demo, cell)
    assert_through_its_cells(followed, fit)
    if followed.states.tolist() == policy.path.states.tolist():
        assert rmse_mm(fit.tip_mm, demo.tip_mm) <= 0.8


def test_another_demonstration_is_refused():
    demo, _ = shipped("heron-simple-running", 0)
    with pytest.raises(BadPlan, match="not learnt from this demonstration"):
        trace(demo, shipped("wren-simple-running", 0)[1].path)


def test_the_same_demonstration_gives_the_same_bytes():
    demo, policy = shipped("wren-simple-running", 0)
    one, other = (fitted(demo, policy)[1].tip_mm.tobytes() for _ in range(2))
    assert one == other


def test_compiled_loops_agree_with_plain_ones_to_the_last_bit(monkeypatch: pytest.MonkeyPatch):
    demo, policy = shipped(*HAND_OFFS[0])
    agreed = run_both(monkeypatch, path_fit, "_descend", "_furthest_mm2")
    _, fit = fitted(demo, policy)
    hand = hand_along(demo, fit, turning=False)
    assert agreed == ["_descend", "_furthest_mm2"]
    # the same distances, to the whole path
    moves, off = np.diff(fit.tip_mm, axis=0), hand.tip_mm[:, None] - fit.tip_mm[:-1]
    part = ((off * moves).sum(axis=2) / (moves**2).sum(axis=1)).clip(0, 1)
    apart = np.linalg.norm(off - part[..., None] * moves, axis=2).min(axis=1)
    assert hand.deviation_mm == pytest.approx(apart.max(), abs=1e-9)
