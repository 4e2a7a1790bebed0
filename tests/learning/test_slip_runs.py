"""Arms that slip: laws, a case worked by hand, and the Markov chain as a second method for the sampling."""

from dataclasses import replace

import numpy as np
import pytest

from skills.arithmetic import wilson
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.gridworld.slip import STEADY, slip_model
from skills.learning.certificate import certify
from skills.learning.policy import learn_tabular, rollout_from
from skills.learning.q_learning import PhaseQLearning
from skills.learning.slip_runs import (
    FollowPolicy,
    ReplayMoves,
    ReplayPositions,
    StartAnew,
    Walks,
    arrives,
    budget,
    dtw_totals_mm,
    farthest_mm,
    follows,
    judge,
    left_out,
    odds,
    replay,
    shortest_way,
    walk,
)
from tests.gridworld.paths import WALKS, learnt, named_path, random_path
from tests.learning.two_line_rule import TwoLineRule

# A row of three cells, walked from the first to the last; the row has no neighbours.
ROW = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 1, 1)), np.array([0, 1, 2]))
BACK, STAY, AHEAD = (MOVES.tolist().index([step, 0, 0]) for step in (-1, 0, 1))


def steady(moves: int, runs: int = 1) -> np.ndarray:
    return np.full((moves, runs), STEADY, np.int8)


def controllers(name: str):
    """Return the controllers that should follow a path without slip."""
    path, policy = named_path(name), learnt(name)
    return {
        "policy": FollowPolicy(policy),
        "anew": StartAnew(FollowPolicy(policy)),
        "moves": ReplayMoves(path.grid, path.states),
        "positions": ReplayPositions(path.grid, path.states),
    }


@pytest.mark.parametrize("name", WALKS)
@pytest.mark.parametrize("by", ["policy", "anew", "moves", "positions"])
def test_without_slips_all_follow_exactly(name, by):
    path = named_path(name)
    walks = walk(controllers(name)[by], path, path.start, slip_model(0.0).draw(runs=3, moves=budget(path), seed=1))
    assert all(walks.of(run).tolist() == path.states.tolist() for run in range(3))
    outcome = judge(walks)
    assert (outcome.arrived, outcome.followed, outcome.left_out, outcome.extra_moves) == (3, 3, 0, 0)
    assert (outcome.dtw_total_mm, outcome.farthest_mm) == (0, 0)


@pytest.mark.parametrize("name", WALKS)
def test_the_paper_s_state_is_followed_as_its_rollout_is(name):
    policy = learnt(name, phased=False)
    path = policy.path
    walks = walk(FollowPolicy(policy), path, path.start, steady(budget(path)))
    followed = rollout_from(policy, path.start)
    assert arrives(walks)[0] == followed.finished
    if followed.finished:
        assert walks.of(0).tolist() == followed.states.tolist()


def test_a_slip_in_the_first_move_worked_by_hand():
    # The arm should go 0, 1, 2 and its first move slips: it stays in 0.
    slips = steady(9)
    slips[0] = STAY
    moves = walk(ReplayMoves(ROW.grid, ROW.states), ROW, 0, slips)
    assert (moves.states[:, 0].tolist(), moves.moves.tolist()) == ([0, 0, 1], [2])
    assert (arrives(moves)[0], follows(moves)[0], left_out(moves)[0]) == (False, False, 1)
    assert (dtw_totals_mm(moves)[0], farthest_mm(moves)[0]) == (5, 0)  # 2 is paired with 1: 5 mm
    positions = walk(ReplayPositions(ROW.grid, ROW.states), ROW, 0, slips)
    assert (positions.states[:, 0].tolist(), positions.moves.tolist()) == ([0, 0, 1, 2], [3])
    outcome = judge(positions)
    assert (outcome.arrived, outcome.followed, outcome.extra_moves, outcome.dtw_total_mm) == (1, 1, 1, 0)


def test_the_clock_runs_past_a_missed_corner_and_the_policy_returns_to_it():
    path = named_path("an angle")  # three cells along x, then three along y
    slips = steady(budget(path))
    slips[2] = STAY  # instead of the move into the corner
    cut = walk(ReplayPositions(path.grid, path.states), path, path.start, slips)
    assert (arrives(cut)[0], follows(cut)[0], left_out(cut)[0], cut.moves[0]) == (True, False, 1, 6)
    ours = walk(FollowPolicy(learnt("an angle")), path, path.start, slips)
    assert (follows(ours)[0], left_out(ours)[0], ours.moves[0]) == (True, 0, 7)


def test_an_arm_at_the_edge_stays_where_a_slip_would_push_it_off():
    slips = steady(9)
    slips[:2, 0] = BACK, 0  # off the row along x, and along all three axes
    walks = walk(ReplayPositions(ROW.grid, ROW.states), ROW, 0, slips)
    assert walks.states[:, 0].tolist() == [0, 0, 0, 1, 2]


def test_the_chain_of_a_row_worked_by_hand():
    # Of the 27 moves one goes ahead and one back; all others leave the row, and so stay, or stay anyway. With a slip of
    # 0.54 the next waypoint is entered with probability 0.46 + 0.54 / 27 = 0.48, and 0.02 go back.
    policy = learn_tabular(sparse_reward(ROW), PhaseQLearning(), seed=0)
    exact = odds(policy, slip_model(0.54), 0, 2)
    assert exact.finishes == pytest.approx(0.48**2, abs=1e-12)
    assert exact.moves == pytest.approx(2, abs=1e-12)
    assert odds(policy, slip_model(0.54), 0, 1).finishes == 0
    assert odds(policy, slip_model(0.54), 0, 1).moves is None
    # With a third move, one may be lost: at the start 0.52, since back stays there too; in the middle 0.50.
    assert odds(policy, slip_model(0.54), 0, 3).finishes == pytest.approx(0.48**2 * (1 + 0.52 + 0.50), abs=1e-12)


@pytest.mark.parametrize("phased", [True, False])
@pytest.mark.parametrize("slip", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("name", ["an angle", "a figure of eight", "through its goal"])
def test_what_is_sampled_lies_within_what_the_chain_says(name, slip, phased):
    policy, runs = learnt(name, phased=phased), 4000
    path = policy.path
    walks = walk(FollowPolicy(policy), path, path.start, slip_model(slip).draw(runs=runs, moves=budget(path), seed=3))
    exact = odds(policy, slip_model(slip), path.start, budget(path))
    finished = follows(walks) if phased else arrives(walks)
    low, high = wilson(int(finished.sum()), runs)
    assert exact.finishes == pytest.approx((low + high) / 2, abs=high - low)  # twice as wide: there are 18 draws
    if finished.sum() > 10:  # of fewer, the deviation is no estimate
        taken = walks.moves[finished]
        assert taken.mean() == pytest.approx(exact.moves, abs=4 * taken.std() / np.sqrt(len(taken)) + 1e-9)


def test_without_slips_the_chain_finishes_for_certain_in_the_fewest_moves():
    policy, steady_world = learnt("closed"), slip_model(0.0)
    exact = odds(policy, steady_world, policy.path.start, 8)
    assert odds(policy, steady_world, policy.path.start, budget(policy.path)) == exact
    assert exact.moves == 8
    ended = learnt("an angle")
    over = odds(ended, slip_model(0.5), ended.path.goal, 9)
    assert (over.finishes, over.moves) == (1, 0)


def test_starting_anew_never_stops_short_and_follows_at_least_as_often():
    policy = learnt("a figure of eight")
    path = policy.path
    slips = slip_model(0.5).draw(runs=400, moves=budget(path), seed=0)
    once, anew = (walk(one, path, path.start, slips) for one in (FollowPolicy(policy), StartAnew(FollowPolicy(policy))))
    assert (follows(anew) | ~follows(once)).all()
    assert follows(anew).sum() > follows(once).sum()
    assert (arrives(anew) | (anew.moves == budget(path))).all()


@pytest.mark.parametrize("seed", range(12))
def test_the_shortest_plan_joins_the_first_nearest_waypoint_and_arrives(seed):
    path = random_path(seed)
    for start in range(0, path.grid.n_states, 7):
        apart = np.abs(path.cells - path.grid.cells_of(start)).max(axis=1)
        plan, nearest = shortest_way(path, start), int(apart.argmin())
        assert (plan[0], plan[-1]) == (start, path.goal)
        assert plan[apart.min() :].tolist() == path.states[nearest:].tolist()
        assert (np.abs(np.diff(path.grid.cells_of(plan), axis=0)).max(axis=1, initial=0) == 1).all()
        assert (replay(path, start).states.tolist(), replay(path, start).finished) == (plan.tolist(), True)
        for controller in (ReplayMoves(path.grid, plan), ReplayPositions(path.grid, plan)):
            walks = walk(controller, path, start, steady(budget(path)))
            assert walks.states[:, 0].tolist() == plan.tolist()


def test_a_run_that_enters_the_waypoints_in_another_order_does_not_follow():
    path = named_path("an angle")
    turned = np.array([path.states[[0, 2, 1, 3, 4, 5, 6]], path.states]).T
    walks = Walks(path, turned, np.array([6, 6]))
    assert follows(walks).tolist() == [False, True]
    assert (arrives(walks).tolist(), left_out(walks).tolist()) == ([True, True], [0, 0])


@pytest.mark.parametrize("name", ["an angle", "closed", "two cells"])
def test_on_a_simple_path_every_move_of_the_two_line_rule_is_optimal(name):
    policy = learnt(name)
    domain = policy.domain
    actions, phases = TwoLineRule(named_path(name)).decide(1, domain.state_of, domain.phase_of)
    live = domain.certified & ~domain.terminal & (phases == domain.phase_of)  # others are in the next phase already
    q = policy.q.copy()
    q[live] = np.eye(27)[actions[live]]
    assert certify(replace(policy, q=q))[0].every_action_optimal


@pytest.mark.parametrize("name", WALKS)
def test_without_slips_the_two_line_rule_follows_from_every_start(name):
    path = named_path(name)
    for start in range(path.grid.n_states):
        assert follows(walk(TwoLineRule(path), path, start, steady(60))).all()
