from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import FAINT, certify, coverage, least_gamma, mdp_of
from skills.learning.dynamic_programming import ValueIteration, exact_values
from skills.learning.policy import learn_tabular, rollout_from
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from tests.by_day import examples, some
from tests.gridworld.paths import WALKS, follow, joins_nearest, learnt, named_path

STAY = 13
both_states = pytest.mark.parametrize("phased", [True, False], ids=["phase", "cell"])
every_walk = pytest.mark.parametrize("name", WALKS)


def values_everywhere(
    path, gamma, *, phased, joinable=None, goal_pays=10.0, visited_pays=1.0, off_grid_pays=-1.0, kind=float
):
    """Iterate values over all phases and all cells, without a domain: (phases, n_states, 27), and their maximum.

    A second method, from the interface's rules: it shares nothing with the certificate but the numbering of states.
    With `joinable` only so many waypoints, the first ones, may be joined, and an unjoined pass does not finish.
    """
    n, (_, ny, nz), waypoints = path.grid.n_states, path.grid.shape, path.states.tolist()
    phases = len(waypoints) if phased else 1
    cells = np.stack(np.unravel_index(np.arange(n), path.grid.shape), axis=-1)[:, None] + MOVES
    on_grid = ((cells >= 0) & (cells < path.grid.shape)).all(axis=-1)
    to = np.where(on_grid, cells @ (ny * nz, nz, 1), np.arange(n)[:, None])
    pays = np.where(on_grid, 0.0, off_grid_pays) * np.ones((phases, 1, 1), kind)
    after = np.arange(phases)[:, None, None] * np.ones((1, n, 27), int)
    ends = np.zeros((phases, n, 27), bool)
    ends_at = path.goal if joinable is None else None
    for k, waypoint in reversed([*enumerate(waypoints)][:joinable]):  # in phase 0; backwards: the first visit wins
        pays[0][on_grid & (to == waypoint)] = goal_pays if waypoint == ends_at else visited_pays
        after[0][on_grid & (to == waypoint)] = k + 1 if phased and waypoint != ends_at else 0
    ends[0] = on_grid & (to == ends_at)
    for phase in range(1, phases):
        enters, last = on_grid & (to == waypoints[phase]), phase == phases - 1
        pays[phase][enters] = goal_pays if last else visited_pays
        after[phase][enters] = phase if last else phase + 1
        ends[phase] = enters & last
    values = np.zeros((phases, n), kind)
    finished = np.zeros((phases, n), bool)
    finished[[0, -1] if joinable is None else [-1], path.goal] = True
    while True:
        q = pays + gamma * np.where(ends, 0.0, values[after, to])
        better = np.where(finished, 0.0, q.max(axis=-1))
        if np.array_equal(better, values):
            return q, values
        values = better


@every_walk
@both_states
@pytest.mark.parametrize("gamma", [0.1, 0.5, 0.85])
def test_exact_values_equal_value_iteration_over_all_phases_and_cells(name, phased, gamma):
    policy = learnt(name, phased=phased)
    policy = replace(policy, learner=replace(policy.learner, gamma=gamma))
    domain = policy.domain
    _, values = values_everywhere(policy.path, gamma, phased=phased)
    inside = domain.certified
    expected = values[domain.phase_of[inside], domain.state_of[inside]]
    assert exact_values(mdp_of(policy))[inside] == pytest.approx(expected, rel=1e-12, abs=0)


@every_walk
@both_states
def test_what_was_learnt_is_worth_what_dynamic_programming_says(name, phased):
    policy = learnt(name, phased=phased)
    live = policy.domain.certified & ~policy.domain.terminal
    q, _ = values_everywhere(policy.path, policy.learner.gamma, phased=phased)
    expected = q[policy.domain.phase_of[live], policy.domain.state_of[live]].max(axis=1)
    assert policy.q[live].max(axis=1) == pytest.approx(expected, rel=1e-9, abs=0)


@pytest.mark.parametrize("name", some(WALKS, 3))
def test_with_phases_every_q_value_is_exact_and_leaving_the_domain_pays_0(name):
    policy, path = learnt(name), named_path(name)
    q, _ = values_everywhere(path, policy.learner.gamma, phased=True)
    domain = policy.domain
    places = {*zip(domain.phase_of[domain.certified].tolist(), domain.state_of[domain.certified].tolist(), strict=True)}
    for row in np.flatnonzero(domain.certified & ~domain.terminal):
        phase, state = int(domain.phase_of[row]), int(domain.state_of[row])
        cells = path.grid.cells_of(state) + MOVES
        there = np.where(path.grid.holds(cells)[:, None], cells, path.grid.cells_of(state))
        leaves = [phase > 0 and (phase, to) not in places for to in path.grid.states_of(there).tolist()]
        expected = np.where(leaves, 0.0, q[phase, state])
        assert policy.q[row] == pytest.approx(expected, rel=1e-9, abs=1e-15)


@every_walk
def test_the_certificate_of_a_learnt_phase_policy_is_clean(name):
    certificate, covered = certify(learnt(name))
    states = named_path(name).grid.n_states
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert (certificate.starts, certificate.starts_reaching, certificate.starts_joining_nearest) == (states,) * 3
    assert covered.reaches.all()
    assert covered.joins_nearest.all()
    live = learnt(name).domain.certified & ~learnt(name).domain.terminal
    assert certificate.checked == live.sum()


@every_walk
@both_states
def test_coverage_agrees_with_rolling_out_from_every_single_start(name, phased):
    policy, path = learnt(name, phased=phased), named_path(name)
    check_coverage(policy, path)


@examples(40)
@given(st.sampled_from([*WALKS]), st.booleans(), st.integers(0, 2**32), st.floats(0.02, 0.5))
def test_coverage_agrees_with_rollouts_also_where_the_policy_is_bad(name, phased, seed, share):
    policy = learnt(name, phased=phased)
    rng, q = np.random.default_rng(seed), policy.q.copy()
    spoilt = rng.random(len(q)) < share
    q[spoilt, rng.integers(27, size=spoilt.sum())] = q.max() + 1
    check_coverage(replace(policy, q=q), named_path(name))


def check_coverage(policy, path):
    covered, actions, waypoints = coverage(policy), policy.table(), path.states.tolist()
    for start in range(path.grid.n_states):
        one = rollout_from(policy, start)
        states, finished = follow(actions, path.grid.shape, waypoints, start)  # by the interface's text alone
        assert covered.reaches[start] == one.finished == finished
        assert covered.joins_nearest[start] == joins_nearest(path, one.states.tolist())
        if finished:
            assert one.states.tolist() == states


@examples(60)
@given(st.sampled_from([*WALKS]), st.booleans(), st.integers(0, 2**32), st.integers(0, 26))
def test_one_worse_action_is_found_and_an_equally_good_one_is_accepted(name, phased, place, action):
    policy = learnt(name, phased=phased)
    q, values = values_everywhere(policy.path, policy.learner.gamma, phased=phased)
    live = np.flatnonzero(policy.domain.certified & ~policy.domain.terminal)
    row = live[place % len(live)]
    phase, state = policy.domain.phase_of[row], policy.domain.state_of[row]
    spoilt = policy.q.copy()
    spoilt[row, action] = spoilt.max() + 1
    before, _ = certify(policy)
    after, _ = certify(replace(policy, q=spoilt))
    assert before.suboptimal == 0
    assert after.suboptimal == (q[phase, state, action] < values[phase, state] * (1 - 1e-9))
    assert after.every_action_optimal == (after.suboptimal == 0)


def test_a_policy_that_stands_still_at_its_start_does_not_reach_the_goal():
    policy, path = learnt("an angle"), named_path("an angle")
    q = policy.q.copy()
    q[policy.row(1, path.start), STAY] = 100
    certificate, covered = certify(replace(policy, q=q))
    assert certificate.suboptimal == 1
    assert not certificate.demonstration_reproduced
    assert not covered.reaches[path.start]
    assert not covered.joins_nearest[path.start]
    assert certificate.starts_reaching == covered.reaches.sum() < certificate.starts
    assert certificate.starts_joining_nearest == covered.joins_nearest.sum() < certificate.starts


def test_a_policy_that_paces_between_two_cells_reaches_from_neither():
    policy, grid = learnt("an angle"), named_path("an angle").grid
    here, there = int(grid.states_of([5, 0, 0])), int(grid.states_of([5, 0, 1]))
    q = policy.q.copy()
    q[policy.row(0, here), 14] = q[policy.row(0, there), 12] = 100
    _, covered = certify(replace(policy, q=q))
    assert not covered.reaches[[here, there]].any()


def test_rewards_that_never_settle_are_said_so():
    policy = learnt("two cells", phased=False)
    endless = replace(policy, learner=replace(CellQLearning(), gamma=1.0))
    with pytest.raises(BadSettings, match="a cycle has a positive reward"):
        exact_values(mdp_of(endless))


# ---- values too small for floating-point numbers

TINY = np.longdouble(2.0) ** -400  # as gamma: a value is faint from three moves on, and a `longdouble` holds 40 moves


def spoilt_at_random(policy, seed):
    """Return the policy with other actions in half of its rows."""
    rng, q = np.random.default_rng(seed), policy.q.copy()
    rows = np.flatnonzero(rng.random(len(q)) < 0.5)
    q[rows, rng.integers(27, size=len(rows))] = q.max() + 1
    return replace(policy, q=q)


@pytest.mark.skipif(np.finfo(np.longdouble).maxexp < 16000, reason="`longdouble` has no larger exponents here")
@every_walk
@both_states
@pytest.mark.parametrize("seed", range(3))
def test_faint_values_are_compared_as_wider_numbers_compare_them(name, phased, seed):
    policy = learnt(name, phased=phased)
    policy = spoilt_at_random(replace(policy, learner=replace(policy.learner, gamma=float(TINY))), seed)
    domain = policy.domain
    live = np.flatnonzero(domain.certified & ~domain.terminal)
    q, values = values_everywhere(policy.path, TINY, phased=phased, kind=np.longdouble)
    phases, states = domain.phase_of[live], domain.state_of[live]
    worse = q[phases, states, policy.greedy[live]] < values[phases, states] * (1 - np.longdouble(1e-9))
    certificate, _ = certify(policy)
    assert certificate.suboptimal == worse.sum() > 0
    assert certificate.faint == (values[phases, states] < np.longdouble(1e-300)).sum()


def long_path():
    """Return a path of two cells at the end of a grid of 450 cells."""
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (450, 3, 3))
    return GridPath(grid, grid.states_of([[448, 1, 1], [449, 1, 1]]))


@pytest.mark.parametrize("learner", [PhaseQLearning(), ValueIteration()], ids=lambda learner: learner.kind)
def test_on_a_long_grid_an_action_is_optimal_where_it_comes_nearer(learner):
    """At gamma 0.1 and 445 cells from the path a value is 10^-444; every action was equally good there."""
    path = long_path()
    ruled = learn_tabular(sparse_reward(path), learner)  # where all values are 0 the shortest way is the nearest here
    for policy, optimal in ((ruled, True), (replace(ruled, ties=None), False)):
        before, after = (path.grid.cells_of(one)[:, 0] for one in (np.arange(4050), policy.moves.state[:4050]))
        further = np.count_nonzero((after <= before)[before < 447])
        certificate, _ = certify(policy)
        assert certificate.faint > 100 * 9
        assert certificate.suboptimal == further
        assert (further == 0) == certificate.every_action_optimal == optimal


def test_the_advised_gamma_is_the_least_that_keeps_the_furthest_value():
    """The furthest cell is 448 moves away; each multiplies a value by gamma, and by 0.8 where a fifth of them slips."""
    policy = learn_tabular(sparse_reward(long_path()), PhaseQLearning())
    for slip in (0.0, 0.2):
        gamma = least_gamma(replace(policy, learner=ValueIteration(slip=slip)))
        kept, faint = (policy.levels.visited * (one * (1 - slip)) ** 448 for one in (gamma, gamma - 0.01))
        assert kept >= FAINT > faint
    alone_at_1 = 1 - (1.05 * FAINT / policy.levels.visited) ** (1 / 448)  # and a gamma of 1 discounts nothing
    for slip in (0.9, alone_at_1):
        assert least_gamma(replace(policy, learner=ValueIteration(slip=slip))) is None
    alone = GridWorld((0.0, 0.0, 0.0), 1.0, (2, 1, 1))  # every cell is on the path
    beside = learn_tabular(sparse_reward(GridPath(alone, np.arange(2))), PhaseQLearning())
    assert least_gamma(beside) == 0.01


@pytest.mark.nightly  # by day shorter grids
def test_on_a_long_grid_a_gamma_nearer_1_is_certified():
    path = long_path()
    for learner in (PhaseQLearning(gamma=0.22), ValueIteration(gamma=0.22), ValueIteration(gamma=0.4, slip=0.2)):
        certificate, covered = certify(learn_tabular(sparse_reward(path), learner))
        assert certificate.every_action_optimal
        assert covered.reaches.all()


@pytest.mark.parametrize("seed", range(3))
def test_faint_values_of_a_world_that_slips_are_compared_too(seed):
    """Actions that are best at gamma 0.4, and others, judged at gamma 10^-60 by value iteration in wider numbers."""
    grid, slip, gamma = GridWorld((0.0, 0.0, 0.0), 1.0, (12, 4, 3)), 0.3, 1e-60
    path = GridPath(grid, grid.states_of([[9, 1, 1], [10, 1, 1], [10, 2, 1]]))
    policy = spoilt_at_random(learn_tabular(sparse_reward(path), ValueIteration(gamma=0.4, slip=slip)), seed)
    policy = replace(policy, learner=ValueIteration(gamma=gamma, slip=slip))
    domain, rows = policy.domain, np.arange(policy.domain.n_rows)
    live = domain.certified & ~domain.terminal
    each = [domain.move(rows, np.full(len(rows), action)) for action in range(27)]
    rewards = sparse_reward(path).rewards
    pays = [np.where(domain.phase_of == 0, rewards[m.state], m.advances + 10.0 * m.finishes) for m in each]
    pays = [np.where(m.off_grid, -1.0, p) for p, m in zip(pays, each, strict=True)]
    values = np.zeros(len(rows) + 1, np.longdouble)
    for _ in range(60):
        made = np.stack([p + np.longdouble(gamma) * values[m.row] for p, m in zip(pays, each, strict=True)])
        off = np.stack([m.off_grid for m in each])
        anywhere = np.where(off, made[STAY], made).mean(axis=0)
        q = (1 - np.longdouble(slip)) * made + slip * anywhere
        values[:-1] = np.where(live, q.max(axis=0), 0)
    worse = q[policy.greedy[live], np.flatnonzero(live)] < values[:-1][live] * (1 - np.longdouble(1e-9))
    certificate, _ = certify(policy)
    assert certificate.faint == (values[:-1][live] < np.longdouble(1e-300)).sum() > 20
    assert certificate.suboptimal == worse.sum() > 20
