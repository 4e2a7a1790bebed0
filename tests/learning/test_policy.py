"""Policies: greedy actions, rollouts and next steps, on demonstrations of any shape."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skills.errors import BadInput, OutsideGrid
from skills.gridworld.domain import FINISHED, OUTSIDE
from skills.gridworld.grid import PAPER_GRID, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw
from skills.learning.policy import GUIDED_MM, Policy, learn_tabular, next_step, rollout, rollout_from
from skills.learning.q_learning import PhaseQLearning
from tests.by_day import some
from tests.demonstration.synthetic import crossing_path, crossings, edge_path, winding_path
from tests.gridworld.paths import WALKS, follow, joins_nearest, learnt, named_path

STAY = 13
both_states = pytest.mark.parametrize("phased", [True, False], ids=["phase", "cell"])
every_walk = pytest.mark.parametrize("name", WALKS)


def with_action(policy, phase, state, action):
    """Return the same policy with another greedy action in one place."""
    q = policy.q.copy()
    q[policy.row(phase, state), action] = q.max() + 1
    return replace(policy, q=q)


# ---- the table for clients --------------------------------------------------------------------------------------


@every_walk
def test_the_table_is_outside_beyond_2_cells_and_finished_at_the_goal(name):
    policy, path = learnt(name), named_path(name)
    table = policy.table()
    assert table.shape == (len(path.states), path.grid.n_states)
    cells = path.grid.cells_of(np.arange(path.grid.n_states))
    for phase in range(len(path.states)):
        near = np.min([np.abs(cells - path.cells[w]).max(axis=1) for w in (phase - 1, phase)], axis=0) <= 2
        assert ((table[phase] == OUTSIDE) == ((phase > 0) & ~near)).all()
        finished = [path.goal] if phase in (0, len(path.states) - 1) else []
        assert np.flatnonzero(table[phase] == FINISHED).tolist() == finished
        assert table[phase].max() < 27


def test_a_cell_policy_has_one_phase_and_finishes_at_its_goal_alone():
    table = learnt("a figure of eight", phased=False).table()
    path = named_path("a figure of eight")
    assert table.shape == (1, path.grid.n_states)
    assert np.flatnonzero(table[0] < 0).tolist() == [path.goal]


def test_without_a_rule_the_greedy_action_is_the_first_of_the_best():
    policy = replace(learnt("an angle"), ties=None)
    q = np.zeros_like(policy.q)
    q[:, [7, 20]] = 0.25
    live = policy.domain.certified & ~policy.domain.terminal
    assert set(replace(policy, q=q).greedy[live]) == {7}


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_q_values_that_are_not_numbers_are_refused(wrong):
    policy = learnt("an angle")
    q = policy.q.copy()
    q[3, 5] = wrong
    with pytest.raises(BadInput, match="NaN or infinity"):
        replace(policy, q=q)


def test_q_values_of_another_domain_are_refused():
    with pytest.raises(BadInput, match="shape"):
        replace(learnt("an angle"), q=learnt("closed").q)


def test_confidence_is_how_far_the_best_action_stands_out():
    policy = learnt("an angle")
    q = policy.q.copy()
    q[0], q[1], q[2], q[3] = 0, 0, -1, 0
    q[0, [3, 9]] = 4, 3
    q[1, [3, 9]] = 2, 2
    q[3, 0] = 1
    confidence = replace(policy, q=q).confidence
    assert confidence[:4].tolist() == [0.25, 0, 0, 1]
    assert ((confidence >= 0) & (confidence <= 1)).all()


# ---- rolling it out ---------------------------------------------------------------------------------------------


@every_walk
@both_states
def test_a_rollout_is_what_a_client_sees_who_follows_the_served_actions(name, phased):
    policy, path = learnt(name, phased=phased), named_path(name)
    table = policy.table()
    for start in range(path.grid.n_states):
        one = rollout_from(policy, start)
        assert (one.states.tolist(), one.finished) == follow(table, path.grid.shape, path.states.tolist(), start)


@every_walk
def test_with_phases_a_rollout_from_the_demos_start_is_the_demo(name):
    path = named_path(name)
    one = rollout(learnt(name), path.tip_mm[0])
    assert one.states.tolist() == path.states.tolist()
    assert one.finished
    assert np.array_equal(one.tip_mm, path.tip_mm)
    assert one.phases.tolist() == [*range(1, len(path.states)), len(path.states) - 1]


def test_a_policy_that_stands_still_ends_unfinished():
    path = named_path("an angle")
    one = rollout_from(with_action(learnt("an angle"), 1, path.start, STAY), path.start)
    assert not one.finished
    assert one.states.tolist() == [path.start] * 2


def test_a_policy_that_runs_against_the_edge_ends_unfinished():
    policy = with_action(learnt("an angle"), 0, 0, 0)
    one = rollout_from(policy, 0)
    assert not one.finished
    assert one.states.tolist() == [0, 0]


def test_a_policy_that_leaves_its_domain_ends_unfinished():
    policy, path = learnt("an angle"), named_path("an angle")  # 6 x 6 x 3 cells
    for phase, state in ((1, path.start), (1, path.grid.states_of([1, 2, 1])), (1, path.grid.states_of([1, 3, 1]))):
        policy = with_action(policy, phase, int(state), 16)  # along y, away from the path
    one = rollout_from(policy, path.start)
    assert not one.finished
    assert path.grid.cells_of(one.states).tolist() == [[1, 1, 1], [1, 2, 1], [1, 3, 1], [1, 4, 1]]


@pytest.mark.parametrize("start_mm", [(1000, 0, 0), (np.nan, 0, 0), (0, 0), [(0, 0, 0)]])
def test_a_start_outside_the_grid_or_that_is_no_place_is_refused(start_mm):
    with pytest.raises(OutsideGrid):
        rollout(learnt("an angle"), start_mm)


# ---- one step at a time -----------------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.sampled_from([*WALKS]), st.booleans(), st.integers(0, 1000), st.booleans())
def test_step_by_step_is_the_rollout(name, phased, start, counts_the_next_position_itself):
    policy, grid = learnt(name, phased=phased), named_path(name).grid
    whole = rollout_from(policy, start % grid.n_states)
    position_mm, phase, states = grid.centres_mm(start % grid.n_states), None, []
    while True:
        step = next_step(policy, position_mm, phase)
        states.append(int(grid.states_at(position_mm)))
        if step.action is None or len(states) > policy.domain.n_rows:
            break
        position_mm = step.next_position_mm
        phase = step.next_phase if counts_the_next_position_itself else step.phase
    assert (step.done, states) == (whole.finished, whole.states.tolist())


def test_on_the_path_a_step_needs_no_correction():
    policy, path = learnt("an angle"), named_path("an angle")
    step = next_step(policy, path.tip_mm[2], 2)
    assert (step.phase, step.next_phase, step.done, step.correction_mm) == (3, 4, False, None)
    assert step.next_position_mm == tuple(path.tip_mm[3])
    row = policy.row(3, int(path.states[2]))
    assert step.action == policy.greedy[row] == 22
    assert step.confidence == policy.confidence[row]


def test_off_the_path_a_step_points_back_to_the_last_waypoint():
    policy, path = learnt("an angle"), named_path("an angle")
    step = next_step(policy, path.tip_mm[2] + [0, 10, 1.0], 3)
    assert step.correction_mm == pytest.approx((0, -10, -1.0), abs=1e-9)  # mm
    assert step.phase == 3
    assert step.action is not None


def test_before_joining_a_step_points_to_the_nearest_waypoint():
    policy, path = learnt("an angle"), named_path("an angle")
    step = next_step(policy, path.tip_mm[0] + [0, -5, 0], None)
    assert step.phase == 0
    assert step.next_phase > 0  # the next move joins
    assert step.correction_mm == pytest.approx((0, 5, 0), abs=1e-9)  # mm


def test_three_cells_off_its_path_nothing_is_promised_and_a_client_stops():
    policy, path = learnt("an angle"), named_path("an angle")
    step = next_step(policy, path.tip_mm[0] + [0, 15, 0], 1)
    assert (step.action, step.next_position_mm, step.next_phase, step.done, step.confidence) == (None,) * 3 + (False, 0)
    assert step.correction_mm == pytest.approx((0, -15, 0), abs=1e-9)  # mm


def test_the_goal_is_the_end_only_where_it_is_due():
    policy, path = learnt("through its goal"), named_path("through its goal")
    early = path.states.tolist().index(path.goal)
    goal_mm = path.tip_mm[-1]
    assert next_step(policy, goal_mm, len(path.states) - 1).done
    assert next_step(policy, goal_mm, 0).done
    assert not next_step(policy, goal_mm, early).done
    assert not next_step(policy, goal_mm, None).done


@pytest.mark.parametrize("phase", [-1, 7])
def test_a_phase_that_the_policy_does_not_have_is_refused(phase):
    with pytest.raises(OutsideGrid, match="phases 0 to 6"):
        next_step(learnt("an angle"), named_path("an angle").tip_mm[0], phase)


@pytest.mark.parametrize(("phase", "after", "waypoint"), [(None, 0, 0), (0, 0, 0), (1, 1, 0), (3, 3, 2), (6, 6, 5)])
def test_outside_the_grid_nothing_is_promised_but_the_way_back(phase, after, waypoint):
    policy, path = learnt("an angle"), named_path("an angle")
    here = path.tip_mm[0] + [-40.0, -20.0, 0.5]  # the grid ends 7.5 mm from there
    step = next_step(policy, here, phase)
    assert (step.phase, step.action, step.next_position_mm, step.next_phase) == (after, None, None, None)
    assert (step.done, step.confidence) == (False, 0.0)
    np.testing.assert_allclose(here + step.correction_mm, path.tip_mm[waypoint], rtol=0, atol=1e-12)  # mm


@settings(deadline=None)
@given(
    name=st.sampled_from([*WALKS]),
    phased=st.booleans(),
    data=st.data(),
)
def test_a_correction_and_then_actions_lead_from_anywhere_to_the_goal(name, phased, data):
    policy, path = learnt(name, phased=phased), named_path(name)
    offset = st.tuples(*3 * [st.floats(-GUIDED_MM / 2, GUIDED_MM / 2)])
    here = path.tip_mm[data.draw(st.integers(0, len(path.states) - 1))] + data.draw(offset)
    step = next_step(policy, here, data.draw(st.none() | st.integers(0, policy.domain.phases - 1)))
    phase = step.phase
    if step.correction_mm is not None:
        assert not step.done
        here = here + step.correction_mm
        step = next_step(policy, here, phase)
        assert step.correction_mm is None  # it is on the path now, and needs no further correction
    for _ in range(policy.domain.n_rows):
        if step.done:
            break
        assert step.action is not None
        here, phase = step.next_position_mm, step.phase
        step = next_step(policy, here, phase)
        assert step.correction_mm is None
    assert step.done
    assert path.grid.states_at(here) == path.goal


@settings(deadline=None)
@given(
    name=st.sampled_from([*WALKS]),
    state=st.integers(0, 10_000),
    phase=st.none() | st.integers(0, 5),
)
def test_a_correction_is_given_exactly_while_the_hand_is_off_its_path(name, state, phase):
    policy, path = learnt(name), named_path(name)
    here = path.grid.centres_mm(state % path.grid.n_states)
    step = next_step(policy, here, None if phase is None else phase % policy.domain.phases)
    meant = path.states if step.phase == 0 else path.states[step.phase - 1]
    assert (step.correction_mm is None) == (step.done or path.grid.states_at(here) in np.atleast_1d(meant))


def test_a_position_in_metres_is_refused_instead_of_corrected():
    path = GridPath(PAPER_GRID, [551, 430, 442])
    policy = learn_tabular(sparse_reward(path), PhaseQLearning())
    with pytest.raises(OutsideGrid, match=r"outside the grid.*millimetres"):
        next_step(policy, path.tip_mm[0] / 1000, 1)
    assert next_step(policy, path.tip_mm[0] + [0, 0, -50], 1).correction_mm == pytest.approx((0, 0, 50), abs=1e-9)


@pytest.mark.parametrize("here", [(500, 0, 0), (1e300, 0, 0), (0, -1e300, 1e300)])
def test_a_place_that_no_hand_can_be_at_is_refused(here):
    with pytest.raises(OutsideGrid):
        next_step(learnt("an angle"), here, 1)


@pytest.mark.parametrize("here", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0), [(0, 0, 0)]])
def test_what_is_no_place_is_refused(here):
    with pytest.raises(BadInput):
        next_step(learnt("an angle"), here, 1)


SEEDS = range(5)
FINE = GridWorld((0.0, 0.0, 0.0), 2.5, (21, 21, 21))
FINEST = GridWorld((-20.0, 0.0, -150.0), 1.0, (51, 51, 51))
OBLONG = GridWorld((-30.0, 25.0, -140.0), 5.0, (7, 23, 11))
FLAT = GridWorld((0.0, 0.0, 0.0), 5.0, (23, 19, 1))
THIN = GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 12))
SHAPES = {
    "5 states": partial(winding_path, 0, PAPER_GRID, 5),
    "400 states": partial(winding_path, 1, PAPER_GRID, 400),
    "2.5 mm": partial(crossing_path, 2, 5, FINE),
    "7 x 23 x 11": partial(crossing_path, 3, 5, OBLONG),
    "one cell thick": partial(crossing_path, 4, 5, FLAT),
    "one cell wide": partial(winding_path, 5, THIN, 60),
    "along the edges": partial(edge_path, PAPER_GRID),
    "along the edges of 7 x 23 x 11": partial(edge_path, OBLONG),
    "in a fitted grid of 5 mm": partial(crossing_path, 6, 5, fit_mm=5.0),
    "in a fitted grid of 2.5 mm": partial(crossing_path, 7, 3, fit_mm=2.5),
}
LARGE = {
    "1 mm": partial(crossing_path, 8, 5, FINEST),
    "400 states of 1 mm": partial(winding_path, 9, FINEST, 400),
    "in a fitted grid of 1 mm": partial(crossing_path, 10, 2, fit_mm=1.0),
}


@cache
def demonstration(number: int) -> GridPath:
    """Draw a demonstration in the paper's grid, with 0 to 5 crossings in turn."""
    return crossing_path(number, number % 6)


def check(path: GridPath, seed: int) -> Policy:
    """Learn, and check: the demonstration exactly, every action optimal, every start to the goal by the nearest way."""
    policy = learn_tabular(sparse_reward(path), PhaseQLearning(), seed)
    assert policy.training.settled
    followed = rollout_from(policy, path.start)
    assert followed.finished
    assert followed.states.tolist() == path.states.tolist()
    assert dtw(followed.tip_mm, path.tip_mm).total_mm == 0
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert certificate.starts == path.grid.n_states
    assert certificate.starts_reaching == certificate.starts_joining_nearest == certificate.starts
    return policy


def check_as_a_client(policy: Policy, starts: np.ndarray) -> None:
    """Follow the served actions from the demonstrated start and others, by the interface's text alone."""
    path = policy.path
    followed = partial(follow, policy.table(), path.grid.shape, path.states.tolist())
    assert followed(path.start) == (path.states.tolist(), True)
    for start in starts.tolist():
        states, finished = followed(start)
        assert finished
        assert joins_nearest(path, states)


# ---- the demonstrations themselves


@pytest.mark.parametrize("n_crossings", some(range(6), 3))
def test_a_synthetic_demonstration_crosses_itself_as_often_as_was_asked(n_crossings):
    paths = [crossing_path(seed, n_crossings) for seed in range(4)]
    for path in paths:
        assert crossings(path) == n_crossings <= path.revisits
        assert path.bridged == 0
    assert len({path.states.tobytes() for path in paths}) == len(paths)
    assert crossing_path(3, n_crossings).states.tolist() == paths[3].states.tolist()


def test_crossings_are_counted_by_hand():
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (3, 3, 1))
    around = [0, 1, 4, 3]
    assert crossings(GridPath(grid, np.array(around))) == 0
    assert crossings(GridPath(grid, np.array([*around, 0]))) == 1
    assert crossings(GridPath(grid, np.array([*around, 0, 1, 2]))) == 1  # two cells shared in a row
    assert crossings(GridPath(grid, np.array([*around, 0, 1, 2, 4]))) == 2


@pytest.mark.nightly  # of the test's own generator
def test_they_are_of_all_lengths():
    lengths = [len(demonstration(number).states) for number in range(30)]
    assert min(lengths) < 20
    assert max(lengths) > 80
    assert len(winding_path(0, PAPER_GRID, 5).states) == 5
    assert len(SHAPES["400 states"]().states) == len(LARGE["400 states of 1 mm"]().states) == 400
    assert crossings(SHAPES["400 states"]()) > 40


def test_a_path_along_the_edges_touches_every_corner_and_leaves_no_margin():
    path = SHAPES["along the edges"]()
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * 10
    assert set(PAPER_GRID.states_of(corners)) <= set(path.states)
    assert ((path.cells == 0) | (path.cells == 10)).sum(axis=1).mean() > 1.8


# ---- learning from them


@pytest.mark.parametrize("number", some(range(200), 67))
def test_demos_on_5_seeds_are_exact_from_all_starts(number):
    for seed in SEEDS:
        check(demonstration(number), seed)


@pytest.mark.parametrize("number", some(range(0, 40, 13), 2))
def test_a_client_that_knows_the_text_alone_says_so_too(number):
    policy = check(demonstration(number), seed=0)
    check_as_a_client(policy, np.arange(PAPER_GRID.n_states))


@pytest.mark.parametrize("name", some(SHAPES, 2))
def test_a_demonstration_and_a_grid_of_any_shape_are_learnt_exactly(name):
    path = SHAPES[name]()
    policy = check(path, seed=0)
    check_as_a_client(policy, np.random.default_rng(0).permutation(path.grid.n_states)[:100])


@pytest.mark.parametrize("name", some(LARGE, 3))
def test_a_demonstration_in_cells_of_1_mm_is_learnt_exactly(name):
    check(LARGE[name](), seed=0)
