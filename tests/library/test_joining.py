"""Joining rules in the library: the gate at the near starts, batches that keep a rule, older versions, and storage."""

from itertools import pairwise
from math import nan

import numpy as np
import pytest

from skills.db.packed import seal, unpack_as
from skills.errors import Conflict
from skills.gridworld.grid import PAPER_GRID, GridPath
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import Coverage, NearLimits, NearStarts, certify, coverage
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import CellQLearning, PhaseQLearning
from skills.library.operation.integrity import covered, learnt
from skills.library.policies.gate import GateLimits, refusals
from skills.library.policies.retraining import request_retraining
from skills.library.policies.training import request_training
from skills.schemas.training import RetrainingIn, TrainingIn
from skills.settings import Settings
from tests.library import cases
from tests.library.styles import ask_retraining, finish, styles_of

HALF = PhaseQLearning(join_share=0.5)
# A loop that ends in the cell beside its start, so that the starts on the other side of its end join there.
LOOP_MM = np.array([[-20, 60, -120], [-20, 40, -120], [0, 40, -120], [0, 60, -120], [-15, 60, -120]], dtype=float)


def loop() -> bytes:
    legs = [np.linspace(a, b, 40) for a, b in pairwise(LOOP_MM)]
    return cases.table(np.concatenate(legs))


def test_a_loop_that_ends_beside_its_start_is_refused_with_the_remedy(database):
    version = cases.trained(database, loop())
    certificate = version.manifest.grid_certificate
    assert certificate.near == NearStarts(radius_mm=3.0, least_share=0.4, starts=7, share=0.0)
    (refused,) = certificate.refused_because
    reason = refused.text
    assert reason.startswith("of 7 starts within 3 mm of the demonstrated one, one follows only 0% of the demonstr")
    assert "train with a joining rule such as --join 0.5" in reason
    with pytest.raises(Conflict, match=r"--join 0\.5"):
        cases.release(database, version)
    mended = cases.train(database, learner=HALF)
    assert mended.manifest.grid_certificate.refused_because == ()
    assert mended.manifest.grid_certificate.near.share >= 0.5
    cases.release(database, mended)


@pytest.mark.parametrize(("share", "refused"), [(0.4, False), (0.39, True), (nan, True)])
def test_the_gate_refuses_a_near_start_below_its_limit_and_nan(share, refused):
    path = GridPath(PAPER_GRID, np.array([0, 1, 2]))
    near = NearStarts(radius_mm=3.0, least_share=0.4, starts=7, share=share)
    policy = learn_tabular(sparse_reward(path), PhaseQLearning())
    assert bool(refusals(policy, certify(policy)[0], near)) == refused


def test_the_gates_limit_is_a_setting_and_part_of_a_trainings_identity(database):
    refused = cases.trained(database, loop())
    with database.writing() as session:
        asked = TrainingIn(surgeon="kestrel", suture=cases.SUTURE)
        job = request_training(session, asked, "test", GateLimits(NearLimits(3.0, 0.0))).job
        same = request_training(session, asked, "test", GateLimits.of(Settings())).job
    assert job.row != same.row, "an equal training under another limit is another job"
    result = cases.work(database, job).result
    assert (result["policy_version"], result["releasable"]) == (refused.version + 1, True)


def test_a_batch_of_stale_styles_takes_those_checked_by_other_near_limits(database):
    cases.trained(database, loop())
    asked = RetrainingIn(surgeon="kestrel", only_stale=True)
    for near, stale in ((NearLimits(), []), (NearLimits(3.0, 0.0), [["other limits at the near starts"]])):
        job = request_retraining(database, asked, "test", GateLimits(near))[0]
        assert [style.stale for style in styles_of(database, job)] == stale


def test_the_default_of_the_settings_is_that_of_the_gate():
    assert GateLimits.of(Settings()).near == NearLimits()


def test_a_manifest_states_shares_and_by_another_rule_a_table(database):
    cases.add_demo(database)
    nearest, half = cases.train(database), cases.train(database, learner=HALF)
    for version in (nearest, half):
        with database.reading() as session:
            stored = session.merge(version)
            share, said = coverage(learnt(stored)).share, stored.manifest.coverage
            assert covered(stored).share.tolist() == share.tolist()
        assert (said.mean_share, said.median_share) == (share.mean(), np.median(share))
        assert said.starts_goal_alone == (share == 0).sum()
    assert nearest.manifest.joining is None
    assert nearest.manifest.settings["join_share"] == 0
    waypoints = half.manifest.waypoints
    joined = half.manifest.joining
    first = waypoints[: len(waypoints) // 2]  # ten states, nine moves: five of them with at least half left
    assert joined.join_share == half.manifest.settings["join_share"] == 0.5
    assert {*zip(joined.states, joined.phases, strict=True)} == {(s, first.index(s) + 1) for s in first}


def test_a_batch_keeps_the_rule_of_each_style_unless_it_names_a_learner(database):
    cases.add_surgeon(database, "osprey")
    cases.add_demo(database)
    cases.add_demo(database, cases.hand_off((5.0, 0.0, 0.0)), "osprey")
    half = cases.train(database, learner=HALF, release=True)
    cases.train(database, "osprey", release=True)
    assert [style.stale for style in styles_of(database, ask_retraining(database, only_stale=True))] == []
    job = ask_retraining(database)
    finish(database, job)
    kept = {style.demonstration.surgeon.slug: style.policy for style in styles_of(database, job)}
    assert kept["kestrel"].sha256 == half.sha256, "the same version, by its rule"
    assert kept["osprey"].manifest.settings["join_share"] == 0
    named = ask_retraining(database, learner=PhaseQLearning(), release=True)
    finish(database, named)
    (style,) = [one for one in styles_of(database, named) if one.demonstration.surgeon.slug == "kestrel"]
    assert style.policy.manifest.settings["join_share"] == 0
    assert any("of the demonstration on average" in why for why in style.comparison.worse_because)
    assert not style.comparison.now_released


@pytest.mark.parametrize("learner", [PhaseQLearning(), CellQLearning()])
def test_a_coverage_and_a_policy_by_a_rule_are_read_back(learner):
    policy = learn_tabular(sparse_reward(GridPath(PAPER_GRID, np.array([0, 1, 2]))), learner)
    new = coverage(policy)
    assert unpack_as(Coverage, seal(new).packed).share.tolist() == new.share.tolist()
    by_rule = learn_tabular(sparse_reward(policy.path), HALF)
    assert unpack_as(Policy, seal(by_rule).packed).learner == HALF
