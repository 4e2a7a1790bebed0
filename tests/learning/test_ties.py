"""The rule among equally good actions, compared with a second method that shares no code with it."""

from dataclasses import replace
from decimal import Decimal
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning import policy as policy_module
from skills.learning import ties
from skills.learning.certificate import certify, mdp_of
from skills.learning.dynamic_programming import ValueIteration, exact_q
from skills.learning.policy import Policy, learn_tabular, rollout_from
from skills.learning.q_learning import PhaseQLearning
from skills.learning.ties import OPTIMAL, REMOTE_CENTRE, TIE, ShortestApproach, rule_in
from tests.by_day import examples, some
from tests.gridworld.paths import WALKS, learnt, named_path, random_path
from tests.learning.loops import run_both

STEPS = [Decimal(n).sqrt() for n in range(4)]
DOWN = ShortestApproach(depth_along=(0.0, -1.0, -2.0))
FLAT = ShortestApproach()
every_walk = pytest.mark.parametrize("name", some(WALKS, 4))


def by_the_rule(policy, way=lambda length, depth, joined, action: (length, depth, joined, action)):
    """Return each row's action by the rule, in plain Python, with the order of `way`.

    Best actions come from all Q values of the exact problem, and their results from the interface's text. Rows are
    taken in the order of their values, since a best action leads to a larger one.
    """
    path, grid, domain = policy.path, policy.path.grid, policy.domain
    q, waypoints = exact_q(mdp_of(policy)), path.states.tolist()
    cells = grid.centres_mm(np.arange(grid.n_states))
    rule = policy.ties
    depths = np.zeros(grid.n_states)
    if rule.depth_from_mm is not None:
        depths = np.linalg.norm(cells - rule.depth_from_mm, axis=1)
    elif rule.depth_along is not None:
        depths = cells @ rule.depth_along / np.linalg.norm(rule.depth_along)
    depths = depths.round(6)
    ways, chosen = {}, np.full(domain.n_rows, -1)
    for row in np.argsort(-q.max(axis=1), kind="stable"):
        phase, state = int(domain.phase_of[row]), int(domain.state_of[row])
        if not domain.certified[row] or domain.terminal[row]:
            continue
        found = []
        for action in np.flatnonzero(q[row] >= q[row].max() * (1 - 1e-9)):
            cell = grid.cells_of(state) + MOVES[action]
            if not grid.holds(cell):
                continue
            to, step = int(grid.states_of(cell)), STEPS[int(np.abs(MOVES[action]).sum())]
            if phase == 0 and to in waypoints:
                joined = len(waypoints) - 1 if to == path.goal else waypoints.index(to)
                found.append((step, depths[to], joined, int(action)))
            elif phase > 0 and to == waypoints[phase]:
                found.append((step, depths[to], phase, int(action)))
            elif (phase, to) in ways:
                length, depth, joined = ways[phase, to]
                found.append((step + length, max(depths[to], depth), joined, int(action)))
        best = min(found, key=lambda one: way(*one))
        ways[phase, state], chosen[row] = best[:3], best[3]
    return chosen


def with_ties(path, rule, learner=None):
    return learn_tabular(sparse_reward(path), learner or PhaseQLearning(), ties=rule)


def hairpin():
    """Return a path along one side and back along the other, so that a start in between is as far from both."""
    there = [(x, 0, 0) for x in range(25)]
    back = [(24, 1, 0), (24, 2, 0), (24, 3, 0), *((x, 4, 0) for x in range(24, -1, -1))]
    return straight((25, 5, 1), there + back)


BROKEN = {
    "longest": lambda length, depth, joined, action: (-length, depth, joined, action),
    "deepest": lambda length, depth, joined, action: (length, -depth, joined, action),
    "latest": lambda length, depth, joined, action: (length, depth, -joined, action),
    "last": lambda length, depth, joined, action: (length, depth, joined, -action),
}


@every_walk
@pytest.mark.parametrize("rule", [REMOTE_CENTRE, DOWN, FLAT], ids=["remote centre", "along", "none"])
def test_every_action_is_the_one_of_a_second_method(name, rule):
    policy = with_ties(named_path(name), rule)
    live = policy.domain.certified & ~policy.domain.terminal
    assert policy.greedy[live].tolist() == by_the_rule(policy)[live].tolist()
    certificate, _ = certify(policy)
    assert (certificate.off_rule, certificate.suboptimal) == (0, 0)
    assert certificate.starts_joining_nearest == certificate.starts
    assert certificate.demonstration_reproduced


@examples(12)
@given(st.integers(0, 10_000), st.sampled_from([0.1, 0.4, 0.9]), st.sampled_from([0.0, 0.2]))
def test_it_is_the_one_of_a_second_method_on_random_paths(seed, gamma, slip):
    policy = with_ties(random_path(seed), DOWN, ValueIteration(gamma=gamma, slip=slip))
    live = policy.domain.certified & ~policy.domain.terminal
    assert policy.greedy[live].tolist() == by_the_rule(policy)[live].tolist()
    assert certify(policy)[0].off_rule == 0


def straight(shape, cells, origin_mm=(0.0, 0.0, -60.0)):
    grid = GridWorld(origin_mm, 5.0, shape)
    return GridPath(grid, grid.states_of(np.array(cells)))


def approach(policy, cell):
    """Return the cells from a start to the joining point."""
    one = rollout_from(policy, int(policy.path.grid.states_of(np.array(cell))))
    joined = next(i for i, state in enumerate(one.states) if state in policy.path.states)
    return policy.path.grid.cells_of(one.states[: joined + 1])


def test_by_hand_the_shortest_of_equally_good_ways_goes_straight():
    policy = with_ties(straight((9, 9, 1), [(0, 4, 0), (1, 4, 0)]), FLAT)
    # Eight moves in any order of diagonals come as soon, up to 24 mm longer.
    assert approach(policy, (8, 4, 0)).tolist() == [[x, 4, 0] for x in range(8, 0, -1)]


def test_by_hand_the_shallower_of_equally_short_ways_is_taken():
    path = straight((8, 1, 4), [(0, 0, 3), (1, 0, 3)])
    up, down = (with_ties(path, ShortestApproach(depth_along=(0.0, 0.0, sign))) for sign in (-1.0, 1.0))
    # Two of five moves from (6, 0, 1) rise: at once where a low cell is deep, at the end where a high one is.
    assert approach(up, (6, 0, 1))[:, 2].tolist() == [1, 2, 3, 3, 3, 3]
    assert approach(down, (6, 0, 1))[-1].tolist() == [1, 0, 3]
    assert certify(up)[0].off_rule == certify(down)[0].off_rule == 0
    assert certify(replace(up, ties=down.ties))[0].off_rule == 0  # a policy follows the rule that it states


def test_by_hand_the_earlier_of_two_joining_points_is_taken():
    policy = with_ties(hairpin(), FLAT)
    assert approach(policy, (12, 2, 0)).tolist() == [[12, 2, 0], [12, 1, 0], [12, 0, 0]]


@pytest.mark.parametrize("order", BROKEN)
def test_a_rule_that_is_broken_fails_the_certificate(order, monkeypatch):
    policy = with_ties(hairpin(), FLAT) if order == "latest" else learnt("a figure of eight")
    actions = by_the_rule(policy, BROKEN[order])
    live = policy.domain.certified & ~policy.domain.terminal
    different = int(np.count_nonzero(policy.greedy[live] != actions[live]))
    monkeypatch.setattr(policy_module, "choose", lambda *_: actions.copy())
    certificate, _ = certify(replace(policy))
    assert different > 0
    assert certificate.off_rule > 0
    assert certificate.suboptimal == 0
    assert certificate.every_action_optimal


@examples(25)
@given(st.integers(0, 2**32))
def test_one_action_off_the_rule_is_found(place):
    policy = learnt("an angle")
    live = np.flatnonzero(policy.domain.certified & ~policy.domain.terminal)
    row = int(live[place % len(live)])
    best = np.flatnonzero(policy.q[row] >= policy.q[row].max() * (1 - 1e-9))
    actions = policy.greedy.copy()
    actions[row] = best[place % len(best)]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(policy_module, "choose", lambda *_: actions.astype(np.int64))
        certificate, _ = certify(replace(policy))
    assert (certificate.off_rule > 0) == (actions[row] != policy.greedy[row])


def test_without_ways_the_lowest_index_counts_and_nothing_loops():
    policy = learnt("an angle")
    live = policy.domain.certified & ~policy.domain.terminal
    q = np.zeros_like(policy.q)
    q[:, 13] = 1.0  # to stay is best everywhere
    stands = replace(policy, q=q)
    assert set(stands.greedy[live]) == {13}
    certificate, _ = certify(stands)
    domain, waypoints = policy.domain, policy.path.states
    enters = np.where(
        domain.phase_of > 0, domain.state_of == waypoints[domain.phase_of], np.isin(domain.state_of, waypoints)
    )  # by staying
    assert certificate.off_rule == np.count_nonzero(live & ~enters)


def test_equal_values_everywhere_still_lead_the_shortest_way():
    policy = learnt("an angle")
    level = replace(policy, q=np.ones_like(policy.q))
    assert certify(level)[0].starts_reaching == certify(level)[0].starts
    off_path = set(range(policy.path.grid.n_states)) - set(policy.path.states.tolist())
    cells = policy.path.grid.cells_of([*off_path])
    for cell in cells:
        assert length(approach(level, cell)) <= length(approach(policy, cell)) + 1e-9


def length(cells):
    return sum(float(np.linalg.norm(b - a)) for a, b in pairwise(cells))


def test_in_the_papers_state_the_lowest_index_counts():
    policy = learnt("an angle", phased=False)
    assert policy.ties is None
    assert certify(policy)[0].off_rule is None
    with pytest.raises(BadSettings, match="phase state"):
        replace(policy, ties=REMOTE_CENTRE)


def test_the_frame_decides_how_depth_is_measured():
    assert rule_in("PSM1_base") == rule_in("PSM2_base", [0, 0, 1]) == REMOTE_CENTRE
    assert rule_in("camera") == FLAT
    assert rule_in("camera", [0, 0, 2]) == ShortestApproach(depth_along=(0.0, 0.0, 2.0))
    for wrong in ([0, 0], [0, 0, 1, 5]):
        with pytest.raises(BadSettings, match="three finite numbers"):
            rule_in("camera", wrong)


@pytest.mark.parametrize(
    ("given_to", "says"),
    [
        ({"depth_along": (0.0, 0.0, 0.0)}, "must not be"),
        ({"depth_along": (0.0, np.nan, 1.0)}, "finite"),
        ({"depth_from_mm": (np.inf, 0.0, 0.0)}, "finite"),
        ({"depth_along": (0.0, 1.0)}, "three"),
        ({"depth_along": (0.0, 0.0, 1.0), "depth_from_mm": (0.0, 0.0, 0.0)}, "not both"),
    ],
)
def test_a_depth_that_cannot_be_measured_is_refused(given_to, says):
    with pytest.raises(BadSettings, match=says):
        ShortestApproach(**given_to)


def test_depths_are_those_of_the_centres():
    grid = named_path("an angle").grid
    centres = grid.centres_mm(np.arange(grid.n_states))
    assert REMOTE_CENTRE.depths_nm(grid) == pytest.approx(1e6 * np.linalg.norm(centres, axis=1), abs=0.51)
    assert DOWN.depths_nm(grid) == pytest.approx(1e6 * centres @ (0, -1, -2) / np.sqrt(5), abs=0.51)
    assert not FLAT.depths_nm(grid).any()


def test_a_policy_made_without_the_rule_takes_the_first_action():
    policy = replace(learnt("an angle"), ties=None)
    live = policy.domain.certified & ~policy.domain.terminal
    assert policy.greedy[live].tolist() == policy.q.argmax(axis=1)[live].tolist()
    certificate, _ = certify(policy)
    assert certificate.off_rule is None
    assert certificate.every_action_optimal
    assert isinstance(policy, Policy)


SAMPLED = PhaseQLearning(alpha=0.5, max_steps=2, max_sweeps=3, slip=0.4)


@pytest.mark.parametrize("learner", [PhaseQLearning(), SAMPLED], ids=["settled", "sampled"])
@pytest.mark.parametrize("name", ["two cells", "to and fro"])
def test_the_compiled_rule_and_the_plain_one_agree(monkeypatch, learner, name):
    agreed = run_both(monkeypatch, ties, "find_equal", "choose_approaches", "count_off_rule")
    certify(learn_tabular(sparse_reward(named_path(name)), learner, seed=5))
    assert agreed == ["find_equal", "choose_approaches", "count_off_rule"]


def test_the_words_for_an_optimal_action_state_the_resolution():
    assert f"optimal to {TIE:.0e} of their value".replace("e-09", "e-9") == OPTIMAL
