"""Q-learning in both states: by hand, beside exact values, and its loops compiled and plain."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.hazards import SceneCosts, hazards_of
from skills.gridworld.reward import RewardLevels, sparse_reward
from skills.gridworld.scene import Box, Scene
from skills.gridworld.slip import slip_model
from skills.learning import q_learning
from skills.learning.certificate import certify
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.in_scene import learn_in_scene
from skills.learning.policy import MAX_SEED, learn_tabular, rollout_from
from skills.learning.q_learning import (
    OFF_GRID,
    UNKNOWN,
    CellQLearning,
    PhaseQLearning,
    Sweeper,
    any_action,
    explore,
    next_random,
    run_episodes,
)
from tests.by_day import some
from tests.gridworld.paths import follow, joins_nearest, named_path, random_path
from tests.learning.loops import run_both

REWARD = sparse_reward(named_path("a figure of eight"))
STAY, OFF_GRID_PAYS = 13, -1.0
both_learners = pytest.mark.parametrize("learner", [CellQLearning(), PhaseQLearning()], ids=["cell", "phase"])


# ---- arbitrary paths --------------------------------------------------------------------------------------------


def test_the_random_paths_close_oscillate_and_cross_their_goal_early():
    paths = [random_path(seed) for seed in range(50)]
    goal_visits = [int((path.states == path.goal).sum()) for path in paths]
    assert all(path.revisits > 0 for path in paths)
    assert sum(path.start == path.goal for path in paths) >= 20
    assert sum(path.start != path.goal and n > 1 for path, n in zip(paths, goal_visits, strict=True)) >= 10
    assert sum(path.start == path.goal and n > 2 for path, n in zip(paths, goal_visits, strict=True)) >= 10
    oscillate = [
        any(s[i : i + 2] * 3 == s[i : i + 6] for i in range(len(s))) for s in (p.states.tolist() for p in paths)
    ]
    assert sum(oscillate) >= 10
    assert len({path.grid.shape for path in paths}) > 25


def check_path(path, seeds):
    """Check that the demonstration is exact, every start joins by the nearest way, and every action is optimal."""
    for seed in seeds:
        policy = learn_tabular(sparse_reward(path), PhaseQLearning(), seed)
        assert policy.training.settled
        assert rollout_from(policy, path.start).states.tolist() == path.states.tolist()
        certificate, _ = certify(policy)
        assert certificate.every_action_optimal
        assert certificate.demonstration_reproduced
        assert certificate.starts_reaching == certificate.starts_joining_nearest == path.grid.n_states
        assert certificate.finishing == certificate.checked  # from every certified state
        actions, waypoints = policy.table(), path.states.tolist()
        for start in range(path.grid.n_states):  # confirmed by a client that knows the interface's text alone
            states, finished = follow(actions, path.grid.shape, waypoints, start)
            assert finished
            assert joins_nearest(path, states)


@pytest.mark.parametrize("number", some(range(50), 5))
def test_on_each_of_50_self_crossing_paths_every_state_and_every_start(number):
    check_path(random_path(number), seeds=(number, number + 100))


@pytest.mark.nightly
@pytest.mark.parametrize("number", range(200))
def test_200_self_crossing_paths_are_learnt_exactly_on_20_seeds(number):
    check_path(random_path(1_000_000 + number), seeds=range(20))


@pytest.mark.parametrize("settings", [{"max_steps": 100}, {"max_steps": 7}], ids=str)
def test_longer_episodes_learn_the_same_policy(settings):
    short = learn_tabular(REWARD, PhaseQLearning())
    long = learn_tabular(REWARD, PhaseQLearning(**settings))
    assert long.training.steps > long.training.episodes
    assert long.training.settled
    assert long.q.max(axis=1) == pytest.approx(short.q.max(axis=1), rel=1e-9, abs=0)
    assert vars(certify(long)[0]) == vars(certify(short)[0])


def test_a_sweep_cap_that_is_too_low_is_told():
    assert not learn_tabular(REWARD, PhaseQLearning(max_sweeps=1)).training.settled


def test_a_learner_tells_how_it_is_called():
    assert (CellQLearning.kind, PhaseQLearning.kind) == ("cell-q-learning", "phase-q-learning")
    published = CellQLearning.published()
    assert (published.alpha, published.gamma, published.epsilon_falls_over) == (0.1, 0.01, 0.5)
    assert (published.epsilon_start, published.epsilon_end, published.episodes) == (1.0, 0.0, 5000)


# ---- slipping moves ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def slipping():
    """Return the exact policy of a world in which one move in ten slips, and the rows that have a move to choose."""
    policy = learn_tabular(REWARD, ValueIteration(slip=0.1))
    return policy, policy.domain.certified & ~policy.domain.terminal


def outcomes(policy):
    """Return each action's target and reward from each row without a slip, both (rows, 27); -1: no target."""
    domain, rewards = policy.domain, REWARD.rewards
    after, pays = np.zeros((domain.n_rows, 27), int), np.zeros((domain.n_rows, 27))
    for row in range(domain.n_rows):
        phase, here = int(domain.phase_of[row]), domain.cell_of[row]
        for action, step in enumerate(MOVES):
            cell = here + step
            if not policy.path.grid.holds(cell):
                after[row, action], pays[row, action] = row, OFF_GRID_PAYS
                continue
            state = int(policy.path.grid.states_of(cell))
            then, ends = domain.enter(phase, state)
            place = None if ends else policy.row(then, state)
            after[row, action] = -1 if place is None else place
            pays[row, action] = rewards[state] if phase == 0 else 10.0 if ends else float(then > phase)
    return after, pays


def learn_slipping(alpha, sweeps, seed=0):
    return learn_tabular(REWARD, PhaseQLearning(alpha=alpha, slip=0.1, max_sweeps=sweeps), seed)


def test_exact_values_of_a_world_that_slips_are_those_of_a_second_method(slipping):
    """The values of its greedy policy solve a system of linear equations."""
    exact, live = slipping
    domain, slip, gamma = exact.domain, 0.1, exact.learner.gamma
    after, pays = outcomes(exact)
    n, greedy = domain.n_rows, exact.greedy.astype(int).clip(0)
    anywhere_pays, chances = np.zeros(n), np.zeros((n, n + 1))
    for action in range(27):
        off = pays[:, action] == OFF_GRID_PAYS
        np.add.at(chances, (np.arange(n), np.where(off, after[:, STAY], after[:, action])), slip / 27)
        anywhere_pays += np.where(off, pays[:, STAY], pays[:, action]) / 27
    made = after[np.arange(n), greedy]
    np.add.at(chances, (np.arange(n), made), 1 - slip)
    reward = (1 - slip) * pays[np.arange(n), greedy] + slip * anywhere_pays
    chances[~live], reward[~live] = 0.0, 0.0
    values = np.linalg.solve(np.eye(n) - gamma * chances[:, :n], reward)
    assert exact.q.max(axis=1)[live] == pytest.approx(values[live], rel=1e-9, abs=0)


@pytest.mark.nightly  # by day one rate below 1 and 1 are compared (the next test)
def test_learning_rates_below_1_approach_the_exact_values_and_1_does_not(slipping):
    exact, live = slipping
    best = exact.q[live].max(axis=1)
    apart = {
        alpha: float(np.median(np.abs(learn_slipping(alpha, sweeps).q[live].max(axis=1) / best - 1)))
        for alpha, sweeps in ((1.0, 100), (0.3, 100), (0.1, 200), (0.02, 1000))
    }
    assert apart[1.0] > 0.15
    assert apart[1.0] > apart[0.3] > apart[0.1] > apart[0.02]
    assert apart[0.02] < 0.05


@pytest.mark.parametrize("seed", some(range(3), 3))
def test_what_is_learnt_while_moves_slip_follows_from_everywhere(seed):
    certificate, _ = certify(learn_slipping(0.02, 1000, seed))
    assert certificate.demonstration_reproduced
    assert certificate.finishing == certificate.checked
    assert certificate.starts_reaching == certificate.starts_joining_nearest == certificate.starts
    assert certify(learn_slipping(1.0, 100, seed))[0].starts_joining_nearest < certificate.starts


@pytest.mark.nightly  # a statement about the learner's choice, not a guard
def test_slip_makes_near_ties_so_only_the_exact_policy_passes(slipping):
    exact, live = slipping
    assert certify(exact)[0].every_action_optimal
    learnt = learn_slipping(0.02, 1000)
    certificate, _ = certify(learnt)
    assert 0 < certificate.suboptimal < certificate.checked
    rows = np.flatnonzero(live)
    lost = 1 - exact.q[rows, learnt.greedy[rows].astype(int)] / exact.q[rows].max(axis=1)
    assert lost.max() < 0.15


# ---- repeatability ----------------------------------------------------------------------------------------------


@both_learners
def test_the_same_seed_learns_the_same_bytes(learner):
    first, second = (learn_tabular(REWARD, learner, seed=3) for _ in range(2))
    assert first.q.tobytes() == second.q.tobytes()
    assert first.training == second.training


@both_learners
def test_two_threads_learn_the_same_bytes_as_one(learner):
    alone = [learn_tabular(REWARD, learner, seed).q.tobytes() for seed in range(6)]
    with ThreadPoolExecutor(2) as threads:
        together = threads.map(lambda seed: learn_tabular(REWARD, learner, seed).q.tobytes(), range(6))
        assert list(together) == alone


def test_another_seed_learns_other_bytes():
    learner = CellQLearning(episodes=50)
    assert len({learn_tabular(REWARD, learner, seed).q.tobytes() for seed in (0, 1, 2, MAX_SEED)}) == 4


# ---- refused ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [True, False, 1.0, -1, MAX_SEED + 1, "1", None, np.float64(1)], ids=repr)
def test_a_seed_that_is_no_whole_number_from_0_is_refused(seed):
    with pytest.raises(BadSettings, match="seed must be an integer"):
        learn_tabular(REWARD, CellQLearning(), seed)


@pytest.mark.parametrize("learner", [CellQLearning, PhaseQLearning])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("gamma", [0.0, 1.5, -0.1, np.nan, np.inf]),
        ("alpha", [0.0, 1.01, -1.0, np.nan]),
        ("max_steps", [0, -5, 1_000_001, np.nan]),
        ("max_episode_s", [0.0, 0.2, np.nan, np.inf]),
        ("step_s", [0.0, -1.0, np.nan, np.inf]),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(learner, name, values):
    for value in values:
        with pytest.raises(BadSettings, match=name):
            learner(**{name: value})


@pytest.mark.parametrize(
    "name",
    ["epsilon_start", "epsilon_end", "epsilon_falls_over"],
)
def test_an_epsilon_that_is_no_share_is_refused(name):
    for value in (-0.1, 1.1, np.nan):
        with pytest.raises(BadSettings, match="epsilon"):
            CellQLearning(**{name: value})


@pytest.mark.parametrize("learner", [PhaseQLearning, ValueIteration])
@pytest.mark.parametrize("slip", [-0.1, 1.0, np.nan])
def test_a_slip_that_is_no_chance_is_refused(learner, slip):
    with pytest.raises(BadSettings, match="slip"):
        learner(slip=slip)


def test_numbers_of_episodes_and_sweeps_are_bounded():
    for episodes in (0, 10_000_001):
        with pytest.raises(BadSettings, match="episodes"):
            CellQLearning(episodes=episodes)
    for sweeps in (0, 100_001):
        with pytest.raises(BadSettings, match="max_sweeps"):
            PhaseQLearning(max_sweeps=sweeps)


@pytest.mark.parametrize(
    ("learner", "gib"), [(PhaseQLearning(), "6.8"), (CellQLearning(), "6.8"), (ValueIteration(slip=0.1), "27.2")]
)
def test_a_grid_too_large_for_memory_is_refused_before_allocation(learner, gib):
    grid = GridWorld((0.0, 0.0, 0.0), 1.0, (230, 230, 230))
    reward = sparse_reward(GridPath(grid, np.array([0, 1, 2])))
    with pytest.raises(BadSettings, match=f"12167000 cells needs about {gib} GiB .* at most 4 GiB"):
        learn_tabular(reward, learner)


def test_a_loop_that_pays_more_than_arriving_is_refused_with_what_it_pays():
    with pytest.raises(BadSettings, match=r"is worth 20 in the long run, arriving only 10: .* gamma below 0\.9"):
        learn_tabular(REWARD, CellQLearning(gamma=0.95))
    with pytest.raises(BadSettings, match="is worth 10 in the long run, arriving only 10"):
        learn_tabular(REWARD, CellQLearning(gamma=0.9))
    with pytest.raises(BadSettings, match=r"is worth inf in the long run, .* gamma below 0\.9"):
        learn_tabular(REWARD, CellQLearning(gamma=1.0))


def test_in_the_phase_state_no_loop_pays_so_any_gamma_below_1_is_learnt():
    policy = learn_tabular(REWARD, PhaseQLearning(gamma=0.95))
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert certificate.starts_reaching == certificate.starts


@pytest.mark.parametrize("levels", [RewardLevels(0, -1, -2, -2), RewardLevels(10, -1, -1.5, -2)], ids=str)
def test_if_every_move_costs_arriving_pays_even_without_discount(levels):
    reward = sparse_reward(named_path("an angle"), levels)
    policy = learn_tabular(reward, CellQLearning(gamma=1.0))
    certificate, _ = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.starts_reaching == certificate.starts


def test_in_the_phase_state_moves_that_advance_nothing_must_pay_nothing():
    reward = sparse_reward(named_path("an angle"), RewardLevels(other=-0.5))
    with pytest.raises(BadSettings, match="`other` must be 0"):
        learn_tabular(reward, PhaseQLearning())


def test_a_huge_episode_time_leaves_the_step_limit_as_the_only_one():
    learner = CellQLearning(episodes=20, max_episode_s=1e300, step_s=1e-300)
    training = learn_tabular(REWARD, learner).training
    assert training == learn_tabular(REWARD, CellQLearning(episodes=20)).training


def test_a_time_of_one_step_ends_every_episode_after_it():
    learner = replace(CellQLearning(episodes=40), max_episode_s=0.25)
    training = learn_tabular(REWARD, learner).training
    assert (training.steps, training.finished + training.out_of_time, training.out_of_steps) == (40, 40, 0)


GOAL, VISITED, OTHER, OFF = (10.0, 1.0, 0.0, -1.0)  # rewards
STAYS, UP = 13, 14
NOTHING = np.zeros((0, 27), bool)  # touches
ANYWHERE = slip_model(0.0).cumulated
TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (1, 1, 2)), np.array([0, 1]))
LEARNERS = [
    CellQLearning(alpha=0.3, epsilon_start=0.9, epsilon_end=0.2, episodes=60, max_steps=30),
    PhaseQLearning(alpha=0.5, max_steps=3, max_sweeps=2),
    PhaseQLearning(alpha=0.5, max_steps=2, max_sweeps=3, slip=0.4),
]


@pytest.mark.parametrize("learner", LEARNERS, ids=["cell", "phase", "phase, slipping"])
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_loops_and_the_plain_ones_agree_to_the_last_bit(monkeypatch, learner, name):
    agreed = run_both(monkeypatch, q_learning, "run_episodes", "explore", "sweep")
    policy = learn_tabular(sparse_reward(named_path(name)), learner, seed=5)
    assert set(agreed) == ({"run_episodes"} if isinstance(learner, CellQLearning) else {"explore", "sweep"})
    assert policy.q.any()
    assert policy.training.steps > policy.training.episodes // 2


def test_compiled_and_plain_loops_agree_in_a_scene_too(monkeypatch):
    agreed = run_both(monkeypatch, q_learning, "explore", "sweep")
    path = named_path("to and fro")
    wall = Box((1.0, 0.0, -200.0), (2.0, 100.0, 0.0))  # between the path and the last row of cells
    hazards = hazards_of(Scene("base", (wall,)), path, "base", SceneCosts(close=0.3))
    assert 0 < hazards.touches.sum() < hazards.touches.size
    learn_in_scene(sparse_reward(path), LEARNERS[2], hazards, seed=5)
    assert set(agreed) == {"explore", "sweep"}


def episodes(starts, *, first, alpha=0.5, gamma=0.5, max_steps=1, epsilon=0.0):
    """Run episodes in the paper's state on two cells, of which the second is the goal; `first` is best at first."""
    q, value, best = np.zeros(2 * 27), np.zeros(2), np.zeros(2, np.int8)
    q[first], value[0], best[0] = 1e-9, 1e-9, first
    tally, rng = np.zeros(3, int), np.ones(1, np.uint64)
    run_episodes(
        q,
        value,
        best,
        sparse_reward(TWO_CELLS).rewards,
        np.array(TWO_CELLS.grid.shape, np.uint64),
        np.array(starts, np.uint64),
        np.full(len(starts), epsilon),
        OFF,
        alpha,
        gamma,
        max_steps,
        np.uint64(TWO_CELLS.goal),
        rng,
        tally,
    )
    assert value.tolist() == q.reshape(2, 27).max(axis=1).tolist()
    assert best.tolist() == q.reshape(2, 27).argmax(axis=1).tolist()
    return q.reshape(2, 27), tally.tolist()


def test_equation_1_by_hand_in_the_papers_state():
    q, tally = episodes([0, 0], first=UP)
    assert q[0, UP] == pytest.approx(5 + 0.5 * (GOAL - 5), abs=1e-8)
    assert tally == [2, 2, 0]
    q, tally = episodes([0], first=STAYS)
    assert q[0, STAYS] == pytest.approx(0.5 * VISITED, abs=1e-8)
    assert tally == [1, 0, 1]
    q, _ = episodes([0], first=0)
    assert q[0, 0] == pytest.approx(0.5 * OFF, abs=1e-8)
    assert not q[1].any()


def test_an_episode_goes_on_to_the_goal_and_ends_there():
    q, tally = episodes([0] * 3, first=STAYS, max_steps=2000, epsilon=0.5)
    assert tally[1:] == [3, 0]
    assert q[0, UP] > 5


def swept(rows, *, model, phases=(1,), alpha=0.5, gamma=0.5):
    """Sweep once over some phases of two cells, in turn; return the Q values of some (phase, cell)."""
    sweeper = Sweeper(sparse_reward(TWO_CELLS), PhaseQLearning(alpha=alpha, gamma=gamma))
    for phase in phases:
        sweeper.sweep(phase, model, (0,))
    return sweeper.q[sweeper.domain.rows_of([p for p, _ in rows], [[0, 0, z] for _, z in rows])]


def explored(max_steps=1, first=0, slip=0.0):
    """Try every action in both cells."""
    model, tally = np.full((2, 27), UNKNOWN, np.int32), np.zeros(3, int)
    shape, rng = np.array(TWO_CELLS.grid.shape), np.ones(1, np.uint64)
    explore(model, shape, first, slip, ANYWHERE, max_steps, TWO_CELLS.goal, rng, tally, NOTHING)
    return model, tally.tolist()


def test_a_model_says_where_every_action_led():
    model, tally = explored()
    assert model[0, [STAYS, UP]].tolist() == [0, 1]
    assert model[1, [STAYS, UP - 2]].tolist() == [1, 0]
    assert np.count_nonzero(model == OFF_GRID) == 54 - 4
    assert tally == [54, 2, 52]


def test_exploring_ends_at_the_goal_or_after_its_steps():
    _, (steps, finished, out_of_steps) = explored(max_steps=50)
    assert finished + out_of_steps == 54
    assert 54 < steps < 54 * 50


def test_equation_1_by_hand_in_the_phase_state():
    model, _ = explored()
    joined, not_joined = swept([(1, 0), (0, 0)], model=model, phases=(1, 0))
    assert joined[UP] == 0.5 * GOAL
    assert joined[STAYS] == OTHER  # it has passed waypoint 0: standing there pays nothing and adds no future value
    assert joined[0] == 0.5 * OFF
    assert not_joined[STAYS] == 0.5 * (VISITED + 0.5 * 5)  # joins, and continues with the value of phase 1
    assert not_joined[UP] == 0.5 * GOAL


def test_what_was_never_tried_is_not_learnt():
    model, _ = explored()
    model[0, UP] = UNKNOWN
    (joined,) = swept([(1, 0)], model=model)
    assert joined[UP] == 0
    assert joined[0] == 0.5 * OFF


def test_the_random_numbers_are_those_of_xorshift64():
    # Marsaglia 2003, (13, 7, 17), from the state 1: by hand in whole numbers
    bits, x = np.uint64(1), 1
    for _ in range(1000):
        x ^= x << 13 & 0xFFFFFFFFFFFFFFFF
        x ^= x >> 7
        x ^= x << 17 & 0xFFFFFFFFFFFFFFFF
        bits = next_random(bits)
        assert int(bits) == x


def drawn(count):
    """Draw random bits, one after the other."""
    bits = np.uint64(1)
    for _ in range(count):
        bits = next_random(bits)
        yield bits


def test_exploration_takes_every_action_about_equally_often():
    taken = np.bincount([int(any_action(bits)) for bits in drawn(27_000)], minlength=27)
    assert len(taken) == 27
    assert taken == pytest.approx(1000, abs=160)  # five standard deviations


def test_where_one_starts_to_explore_makes_no_difference_to_what_is_found():
    assert all(np.array_equal(explored(first=first)[0], explored()[0]) for first in range(54))


def test_a_move_slips_at_its_rate_and_a_slip_off_the_grid_stays():
    """In the middle of 3 x 3 x 3 cells a slip is another move 26 times of 27; at a corner 19 of 27 slips stay."""
    grid, rounds, slip = GridWorld((0.0, 0.0, 0.0), 5.0, (3, 3, 3)), 400, 0.3
    rng, tally, moved, stayed = np.ones(1, np.uint64), np.zeros(3, int), 0, 0
    model = np.full((27, 27), UNKNOWN, np.int32)
    for _ in range(rounds):
        explore(model, np.array(grid.shape), 0, slip, ANYWHERE, 1, 26, rng, tally, NOTHING)
        moved += np.count_nonzero(model[13] != np.arange(27))  # from the middle, an action leads to its own number
        stayed += np.count_nonzero(
            model[0][np.arange(27) // 9 == 0] == 0
        )  # nine that lead off the grid unless they slip
    assert moved / (27 * rounds) == pytest.approx(slip * 26 / 27, abs=0.02)
    assert stayed / (9 * rounds) == pytest.approx(slip * (27 - 7) / 27, abs=0.035)
