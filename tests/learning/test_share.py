"""The share of the demonstration that a start follows, and the joining rules, which set the least of it."""

from dataclasses import asdict, replace
from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadInput, BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.gridworld.slip import slip_model
from skills.learning.certificate import (
    Coverage,
    NearLimits,
    NearStarts,
    OddsLimits,
    certify,
    coverage,
    finishes,
    mdp_of,
    near_starts,
    shares_of,
)
from skills.learning.dynamic_programming import ValueIteration, exact_values
from skills.learning.policy import describe_learner, learn_tabular, learner_of, next_step, rollout_from
from skills.learning.q_learning import PhaseQLearning
from skills.learning.slip_runs import odds
from tests.by_day import examples, some
from tests.gridworld.paths import WALKS, follow, joins_nearest, learnt, named_path, random_path, share_of
from tests.learning.test_certificate import values_everywhere

every_walk = pytest.mark.parametrize("name", some(WALKS, 4))
RULES = (0.0, 0.3, 0.5, 0.8, 1.0)
every_rule = pytest.mark.parametrize("join_share", RULES)
# Five waypoints in a row, with a cell of room before the first and one after the last.
ROW = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (7, 1, 1)), np.array([1, 2, 3, 4, 5]))


def share_in(path, **settings):
    policy = learn_tabular(sparse_reward(path), PhaseQLearning(**settings))
    return shares_of(policy, finishes(policy)).tolist()


@pytest.mark.parametrize(
    ("join_share", "by_hand"),
    [
        (0.0, [1, 1, 0.75, 0.5, 0.25, 0, 0]),  # nearest: from beyond the goal it moves onto the goal alone
        (0.25, [1, 1, 0.75, 0.5, 0.25, 0.25, 0.25]),
        (0.5, [1, 1, 0.75, 0.5, 0.5, 0.5, 0.5]),
        (0.6, [1, 1, 0.75, 0.75, 0.75, 0.75, 0.75]),
        (1.0, [1, 1, 1, 1, 1, 1, 1]),  # start
    ],
)
def test_the_shares_of_five_waypoints_in_a_row_by_hand(join_share, by_hand):
    assert share_in(ROW, join_share=join_share) == by_hand


def test_by_the_rule_start_a_pass_beyond_the_goal_goes_back_to_the_start():
    policy = learn_tabular(sparse_reward(ROW), PhaseQLearning(join_share=1.0))
    followed = rollout_from(policy, 6)
    assert followed.states.tolist() == [6, 5, 4, 3, 2, 1, 2, 3, 4, 5]
    assert followed.phases.tolist() == [0, 0, 0, 0, 0, 1, 2, 3, 4, 4]
    assert followed.finished


def test_a_share_of_seven_tenths_is_met_where_seven_of_ten_moves_are_left():
    row = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (11, 1, 1)), np.arange(11))
    for tenths in range(11):
        assert Domain(row, phased=True, join_share=tenths / 10).may_join.sum() == 11 - tenths


@every_walk
@pytest.mark.parametrize("phased", [True, False], ids=["phase", "cell"])
def test_shares_agree_with_rolling_out_from_every_start(name, phased):
    check_shares(learnt(name, phased=phased))


@every_walk
@every_rule
def test_by_every_rule_shares_and_coverage_agree_with_rollouts(name, join_share):
    policy = learnt(name, join_share=join_share)
    check_shares(policy)
    assert coverage(policy).reaches.all()
    assert coverage(policy).joins_nearest.all()


@examples(10)
@given(st.sampled_from([*WALKS]), st.sampled_from(RULES), st.integers(0, 2**32), st.floats(0.02, 0.5))
def test_shares_agree_with_rollouts_also_where_the_policy_is_bad(name, join_share, seed, spoilt):
    policy = learnt(name, join_share=join_share)
    rng, q = np.random.default_rng(seed), policy.q.copy()
    rows = rng.random(len(q)) < spoilt
    q[rows, rng.integers(27, size=rows.sum())] = q.max() + 1
    check_shares(replace(policy, q=q))


def check_shares(policy):
    path, covered, actions = policy.path, coverage(policy), policy.table()
    joins, rule = policy.domain.joins, policy.domain.join_share
    table = {int(state): int(joins[state]) for state in np.flatnonzero(joins)} if rule else None
    for start in range(path.grid.n_states):
        one = rollout_from(policy, start)
        states, finished = follow(actions, path.grid.shape, path.states.tolist(), start, table)  # by the text alone
        assert covered.reaches[start] == one.finished == finished
        assert covered.joins_nearest[start] == joins_nearest(path, one.states.tolist(), rule)
        assert covered.share[start] == share_of(path, one.states.tolist(), finished=one.finished)
        if finished:
            assert states == one.states.tolist()


@examples(30)
@given(st.integers(0, 2**20), st.floats(0, 1), st.floats(0, 1))
def test_a_stricter_rule_takes_no_start_less_of_the_demonstration(seed, one, other):
    path = random_path(seed)
    looser, stricter = (np.array(share_in(path, join_share=share)) for share in sorted((one, other)))
    assert (stricter >= looser).all()
    assert (stricter >= max(one, other)).all()
    assert stricter[path.start] == 1


@every_walk
def test_the_rule_start_shows_the_whole_demonstration_from_everywhere(name):
    certificate, covered = certify(learnt(name, join_share=1.0))
    assert (covered.share == 1).all()
    assert (certificate.mean_share, certificate.median_share, certificate.starts_goal_alone) == (1, 1, 0)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced


@every_walk
@every_rule
@pytest.mark.parametrize("learner", [PhaseQLearning(), ValueIteration()], ids=["q", "vi"])
def test_by_every_rule_both_phase_learners_are_certified(name, join_share, learner):
    policy = learn_tabular(sparse_reward(named_path(name)), replace(learner, join_share=join_share))
    certificate, covered = certify(policy)
    assert certificate.every_action_optimal
    assert certificate.demonstration_reproduced
    assert certificate.starts_reaching == certificate.starts_joining_nearest == certificate.starts
    assert certificate.mean_share == covered.share.mean()
    assert certificate.finishing == certificate.checked


@every_walk
@pytest.mark.parametrize("join_share", RULES[1:])
def test_by_another_rule_exact_values_equal_value_iteration_everywhere(name, join_share):
    policy = learnt(name, join_share=join_share)
    domain = policy.domain
    joinable = int(domain.may_join.sum())
    _, values = values_everywhere(policy.path, policy.learner.gamma, phased=True, joinable=joinable)
    inside = domain.certified
    expected = values[domain.phase_of[inside], domain.state_of[inside]]
    assert exact_values(mdp_of(policy))[inside] == pytest.approx(expected, rel=1e-12, abs=0)
    slow = replace(
        mdp_of(policy), slip=slip_model(1e-13)
    )  # as the world that slips computes them, over the whole domain at once
    assert exact_values(slow)[inside] == pytest.approx(expected, rel=1e-9, abs=0)


@pytest.mark.parametrize("name", some(WALKS, 4))
def test_with_slips_a_joining_rule_is_certified_and_finishes(name):
    learner = ValueIteration(slip=0.1, join_share=0.5)
    policy = learn_tabular(sparse_reward(named_path(name)), learner)
    certificate, covered = certify(policy)
    assert certificate.every_action_optimal
    assert covered.share.min() >= 0.5
    chances = [odds(policy, slip_model(0.0), start, 1000).finishes for start in range(policy.path.grid.n_states)]
    assert chances == [1.0] * len(chances)


def started(domain, state):
    """Return the interface's rule for one start: its phase, and whether it is finished there."""
    visits, last = np.flatnonzero(domain.path.states == state), domain.phases - 1
    if len(visits) == 0 or (last - visits[0]) / last < domain.join_share:
        return 0, False
    return (last, True) if visits[0] == last else (visits[0] + 1, False)


@every_walk
@every_rule
def test_a_pass_starts_as_the_interface_says(name, join_share):
    domain = Domain(named_path(name), phased=True, join_share=join_share)
    states = np.arange(domain.path.grid.n_states)
    assert [*zip(*domain.start(states), strict=True)] == [started(domain, state) for state in states]


@pytest.mark.parametrize("name", some(WALKS, 4))
@pytest.mark.parametrize("join_share", [0.5, 1.0])
def test_next_step_leads_along_the_same_walk_and_back_to_where_it_may_join(name, join_share):
    policy = learnt(name, join_share=join_share)
    path, first = policy.path, int(policy.domain.may_join.sum())
    for start in range(path.grid.n_states):
        expected = rollout_from(policy, start).states.tolist()
        state, phase, states = start, None, []
        while True:
            step = next_step(policy, path.grid.centres_mm(state), phase)
            states.append(state)
            if step.phase == 0:
                waypoint = path.grid.states_at(path.grid.centres_mm(state) + step.correction_mm)
                assert waypoint in path.states[:first]
            if step.done:
                break
            state, phase = int(path.grid.states_at(np.array(step.next_position_mm))), step.phase
        assert states == expected


# ---- planted defects -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("join_share", [0.5, 1.0])
def test_a_policy_of_the_rule_nearest_does_not_pass_for_one_of_another(join_share):
    policy = learnt("an angle")
    mislabelled = replace(policy, learner=replace(policy.learner, join_share=join_share))
    certificate, _ = certify(mislabelled)
    assert certificate.suboptimal > 0
    assert certificate.starts_joining_nearest < certificate.starts


def test_a_policy_of_another_rule_does_not_pass_for_one_of_the_nearest():
    policy = learnt("an angle", join_share=1.0)
    certificate, _ = certify(replace(policy, learner=replace(policy.learner, join_share=0.0)))
    assert certificate.suboptimal > 0
    assert certificate.starts_joining_nearest < certificate.starts


def test_a_table_that_joins_one_waypoint_too_late_is_found():
    """The joining table is shifted while learning, and right in the certificate."""
    exact = learnt("an angle", join_share=0.5)
    late = learnt("an angle", join_share=0.3)
    assert late.domain.may_join.sum() == exact.domain.may_join.sum() + 1
    certificate, _ = certify(replace(late, learner=exact.learner))
    assert certificate.suboptimal > 0


@pytest.mark.parametrize("share", [-0.1, 1.1, nan])
@pytest.mark.parametrize("learner", [PhaseQLearning, ValueIteration])
def test_a_rule_that_is_no_share_is_refused(learner, share):
    with pytest.raises(BadSettings, match=r"join_share must lie in \[0, 1\]"):
        learner(join_share=share)


@pytest.mark.parametrize("kind", ["cell-q-learning", "max-ent-irl", "dqn", "ddpg", "trpo"])
def test_learners_without_phases_have_the_rule_nearest_alone(kind):
    assert learner_of({"kind": kind}).join_share == 0
    with pytest.raises(BadSettings, match=f"{kind} has no setting join_share"):
        learner_of({"kind": kind, "join_share": 0.5})


# ---- the starts near the demonstrated one --------------------------------------------------------------------------


def test_the_near_starts_of_a_row_by_hand():
    policy = learn_tabular(sparse_reward(ROW), PhaseQLearning())
    share = np.array(share_in(ROW))
    # The demonstrated start is the centre of cell 1; the faces of cells 0 and 2 are 2.5 mm away, of cell 3 7.5 mm.
    assert near_starts(policy, share, NearLimits(2.4, 0.5)) == NearStarts(
        radius_mm=2.4, least_share=0.5, starts=1, share=1.0
    )
    assert near_starts(policy, share, NearLimits(3.0, 0.5)).share == 0.75
    assert near_starts(policy, share, NearLimits(7.5, 0.5)).starts == 4


def test_a_near_start_below_the_limit_or_without_a_share_fails():
    near = NearStarts(radius_mm=3.0, least_share=0.4, starts=7, share=0.4)
    assert near.within
    assert not replace(near, share=0.39).within
    assert not replace(near, share=nan).within


@pytest.mark.parametrize("limits", [(0.0, 0.4), (nan, 0.4), (np.inf, 0.4), (3.0, -0.1), (3.0, 1.1), (3.0, nan)])
def test_limits_that_mean_nothing_are_refused(limits):
    with pytest.raises(BadSettings, match="radius_mm must be positive"):
        NearLimits(*limits)


@pytest.mark.parametrize("odds", [(-0.1, 0.05), (1.1, 0.05), (0.9, -0.1), (0.9, 1.1), (nan, 0.05), (0.9, nan)])
def test_odds_that_mean_nothing_are_refused(odds):
    with pytest.raises(BadSettings, match="least_finishing and most_touching"):
        OddsLimits(*odds)


def test_the_limits_of_a_release_are_the_stated_ones_or_all_or_nothing():
    assert asdict(NearLimits()) == {"radius_mm": 3.0, "least_share": 0.4}
    assert asdict(OddsLimits()) == {"least_finishing": 0.9, "most_touching": 0.05}
    for extreme in (0.0, 1.0):
        assert NearLimits(1e-9, extreme).least_share == extreme
        assert OddsLimits(extreme, 1.0 - extreme).least_finishing == extreme


def test_a_path_that_ends_beside_its_start_fails_and_the_remedy_mends_it():
    for join_share, within in ((0.0, False), (0.5, True)):
        policy = learnt("closed", join_share=join_share)
        assert near_starts(policy, coverage(policy).share, NearLimits()).within == within


# ---- storage -------------------------------------------------------------------------------------------------------


def test_the_json_of_a_learner_states_its_joining_rule():
    assert describe_learner(PhaseQLearning())["join_share"] == describe_learner(ValueIteration())["join_share"] == 0
    described = describe_learner(ValueIteration(join_share=0.5))
    assert described["join_share"] == 0.5
    assert learner_of(described) == ValueIteration(join_share=0.5)


def test_a_coverage_refuses_shares_of_other_starts_and_nan():
    flags = np.ones(3, bool)
    with pytest.raises(BadInput):
        Coverage(flags, flags, np.ones(2))
    with pytest.raises(BadInput):
        Coverage(flags, flags, np.array([1, nan, 0]))
