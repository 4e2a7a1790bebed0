"""Policies learnt in a scene, in the library: stored, certified, gated, kept by batches, and refused before a job."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest
from sqlalchemy import func, select

from skills.db.models import PolicyVersion
from skills.db.packed import digest, seal, unpack_as
from skills.db.service_tables import Job
from skills.errors import BadInput, BadSettings, Conflict, Corrupt
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.hazards import Surroundings, hazards_of
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.gridworld.slip import slip_model
from skills.learning.certificate import Coverage, NearLimits, NearOdds, OddsLimits, certify, near_starts
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.in_scene import learn_in_scene
from skills.learning.policy import Policy
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.learning.slip_runs import FollowPolicy, follows, walk
from skills.library.operation.integrity import covered, learnt, scene_digest
from skills.library.policies import gate, releases
from skills.library.policies.answers import roll_out
from skills.library.policies.gate import refusals
from skills.library.policies.retraining import request_retraining
from skills.schemas.training import RetrainingIn
from skills.settings import Settings
from tests.library import cases
from tests.library.styles import ask_retraining, finish, styles_of

SCENE = Scene(
    "PSM_base",
    boxes=(Box((-23.0, 30.0, -123.0), (-17.0, 50.0, -117.0)),),
    capsules=(Capsule((18.0, 70.0, -100.0), (18.0, 70.0, -150.0), 2.0),),
    tissue=Tissue((-30.0, 25.0, -143.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 25.0, ((0.0, 1.0), (0.0, 2.0))),
    margin_mm=0.5,
)
SLIPPING = ValueIteration(gamma=0.95, slip=0.1)


def trained(database, *, scene=SCENE, learner=SLIPPING, **asked):
    return cases.train(database, scene=scene.as_json(), learner=learner, **asked)


def test_a_style_is_learnt_in_a_scene_stored_and_served_with_its_odds(database):
    cases.add_demo(database)
    version = trained(database, release=True, scene_costs={"touch": 60.0})
    said = version.manifest.scene
    assert said.sha256 == scene_digest(SCENE)
    assert (said.scene, said.costs.touch, said.costs.close) == (SCENE, 60.0, 0.1)
    assert version.manifest.grid_certificate.refused_because == ()
    assert version.manifest.grid_certificate.suboptimal_actions == said.certificate.suboptimal == 0
    with database.reading() as session:
        stored = session.merge(version)
        policy, odds = learnt(stored), covered(stored)
        rollout = roll_out(stored, version.manifest.start_mm)
        served = releases.served(session, stored.surgeon, stored.suture)
        assert served.policy_row == stored.row
    assert policy.surroundings.scene == SCENE
    start, forbidden = policy.path.start, policy.hazards.forbidden
    assert said.near.finishing <= odds.finishing[start] == rollout.finishing < 1
    assert said.near.touching >= odds.touching[start] == rollout.touching > 0
    assert said.certificate.starts == np.count_nonzero(~forbidden) < policy.path.grid.n_states
    assert (policy.table()[:, forbidden] == -2).all(), "a client that knows no scenes stops there"


@pytest.mark.nightly  # by day: tests/learning/test_in_scene.py, without the store
def test_the_stored_odds_are_those_of_many_walks_that_slip(database):
    cases.add_demo(database)
    version = trained(database, learner=replace(SLIPPING, slip=0.3))
    with database.reading() as session:
        policy, odds = learnt(session.merge(version)), covered(session.merge(version))
    for start in (policy.path.start, int(policy.path.grid.states_of([4, 1, 4]))):
        slips = slip_model(0.3).draw(runs=3000, moves=400, seed=3)
        walks = walk(FollowPolicy(policy), policy.path, start, slips, policy.hazards.touches)
        assert follows(walks).mean() == pytest.approx(odds.finishing[start], abs=0.037)  # four standard deviations
        assert walks.touched.mean() == pytest.approx(odds.touching[start], abs=0.037)


def test_no_action_that_touches_is_ever_served():
    """Three cells in a row: the path leads from the second to the third, the first is forbidden."""
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 1, 1)), np.array([1, 2]))
    scene = Scene("base", (Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),))
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.9), hazards_of(scene, path, "base"))
    assert policy.table().tolist() == [[-2, 22, -1], [-2, 22, -1]]
    q = policy.q.copy()
    q[:, 4] = q.max() + 1  # a step back, of a policy that was learnt badly
    worse = replace(policy, q=q)
    assert worse.table().tolist() == [[-2, -2, -1], [-2, -2, -1]]
    assert not certify(worse)[1].reaches[:2].any()


@pytest.mark.parametrize(
    ("finishing", "touching", "refused"),
    [(0.9, 0.05, False), (0.89, 0.05, True), (0.9, 0.051, True), (nan, 0.0, True), (1.0, nan, True)],
)
def test_the_gate_asks_for_finishing_and_touching_and_refuses_nan(finishing, touching, refused):
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 1, 1)), np.array([1, 2]))
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.9), hazards_of(Scene("base"), path, "base"))
    certificate, coverage = certify(policy)
    odds = NearOdds(starts=2, finishing=finishing, touching=touching, least_finishing=0.9, most_touching=0.05)
    reasons = refusals(policy, certificate, near_starts(policy, coverage.share, NearLimits(radius_mm=0.1)), odds)
    assert bool(reasons) == refused
    for reason in reasons:
        assert "touches the scene with" in reason.text
        assert "value-iteration" in gate.remedy([reason])


def test_a_policy_that_slips_too_often_is_stored_and_not_released(database):
    cases.add_demo(database)
    job = cases.work(
        database, cases.ask_training(database, scene=SCENE.as_json(), learner=replace(SLIPPING, slip=0.6), release=True)
    )
    assert (job.result["releasable"], job.result["released"]) == (False, False)
    assert "the gate requires at least 90% and at most 5%" in job.result["not_released_because"]
    with database.writing() as session, pytest.raises(Conflict, match="touches the scene with"):
        releases.release(session, session.query(PolicyVersion).one(), "test")


def test_the_default_of_the_settings_is_that_of_the_gate_in_a_scene():
    assert gate.GateLimits.of(Settings()).odds == OddsLimits()
    with pytest.raises(BadSettings, match="must be in"):
        OddsLimits(least_finishing=nan)


@pytest.mark.parametrize(
    ("asked", "error", "why"),
    [
        (
            {"scene": replace(SCENE, frame="PSM2_base").as_json()},
            BadSettings,
            "'PSM2_base', the demonstration in 'PSM_",
        ),
        ({"scene": replace(SCENE, margin_mm=9.0).as_json()}, BadSettings, "The demonstration itself touches the scene"),
        ({"scene": SCENE.as_json(), "learner": CellQLearning()}, BadSettings, "does not learn in a scene"),
        ({"scene_costs": {"touch": 10.0}}, BadInput, "give the scene too"),
    ],
)
def test_a_scene_that_cannot_be_used_is_refused_before_a_job(database, asked, error, why):
    cases.add_demo(database)
    with pytest.raises(error, match=why):
        cases.ask_training(database, **{"learner": SLIPPING} | asked)
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(Job)) == 0


def test_another_scene_or_cost_is_another_training_and_an_equal_one_is_not(database):
    cases.add_demo(database)
    given = [
        {"scene": SCENE.as_json()},
        {"scene": SCENE.as_json(), "scene_costs": {"close": 0.1}},  # the default
        {"scene": SCENE.as_json(), "scene_costs": {"close": 0.2}},
        {"scene": replace(SCENE, margin_mm=0.25).as_json()},
        {},
    ]
    first, same, *others = [cases.ask_training(database, learner=SLIPPING, **one).row for one in given]
    assert first == same
    assert len({first, *others}) == 4


@pytest.mark.nightly  # by day a batch keeps joining rules
def test_a_batch_keeps_the_scene_of_a_style_and_its_learner(database):
    cases.add_demo(database)
    version = trained(database, release=True)
    assert [style.stale for style in styles_of(database, ask_retraining(database, only_stale=True))] == []
    other = request_retraining(
        database, RetrainingIn(only_stale=True), "test", gate.GateLimits(odds=OddsLimits(0.5, 0.5))
    ).job
    assert [style.stale for style in styles_of(database, other)] == [["other limits at the near starts"]]
    job = ask_retraining(database)
    finish(database, job)
    (style,) = styles_of(database, job)
    assert style.policy.sha256 == version.sha256
    trained(database, scene_costs={"close": 0.2})  # newer, and not released
    (style,) = styles_of(database, ask_retraining(database, only_stale=True))
    assert style.stale == ["another scene"]
    named = ask_retraining(database, learner=PhaseQLearning(gamma=0.95))
    finish(database, named)
    (style,) = styles_of(database, named)
    assert style.policy.manifest.scene.scene == SCENE
    assert style.policy.manifest.learner == "phase-q-learning"


def test_a_policy_in_a_scene_has_a_digest_of_its_own_and_is_read_back():
    path = GridPath(GridWorld((0.0, 0.0, 0.0), 5.0, (3, 1, 1)), np.array([1, 2]))
    policy = learn_in_scene(sparse_reward(path), ValueIteration(gamma=0.9), hazards_of(Scene("base"), path, "base"))
    bare = replace(policy, surroundings=None)
    again = unpack_as(Policy, seal(policy).packed)
    assert again.surroundings == Surroundings(Scene("base"))
    assert unpack_as(Policy, seal(bare).packed).surroundings is None
    assert digest(policy) != digest(bare)
    coverage = Coverage(np.ones(3, bool), np.ones(3, bool), np.ones(3), np.ones(3), np.zeros(3))
    assert unpack_as(Coverage, seal(coverage).packed).finishing.tolist() == [1, 1, 1]


def test_a_scene_changed_in_the_database_is_noticed(database):
    cases.add_demo(database)
    version = trained(database)
    moved = version.manifest.model_copy(update={"scene": replace(version.manifest.scene, sha256="0" * 64)})
    with database.reading() as session:
        stored = session.merge(version)
        stored.manifest = moved
        with session.no_autoflush, pytest.raises(Corrupt):
            learnt(stored)
        session.rollback()
