"""Plans of a recorded hand: what they state, what is stored, and the gates on a jaw that is held."""

from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from sqlalchemy import select

from skills.db.models import Release
from skills.db.session import Database
from skills.demonstration.recording import Motion, Recording
from skills.errors import BadPlan, Conflict
from skills.formats import write_mcap
from skills.jobs.attempts import Work
from skills.kinematics import POINTING_DOWN, angle_between, matrix_of, quaternion_of
from skills.library.operation.integrity import planned
from skills.library.perform import perform_job
from skills.library.plans.plans import find_plan, trajectory_of
from skills.library.policies import releases
from skills.library.policies.gate import GateLimits
from skills.library.policies.training import request_training
from skills.planning.handoff import turn
from skills.planning.plan import driven_pass
from skills.schemas.training import TrainingIn
from skills.settings import Settings
from tests.library import cases
from tests.library.test_replay import gate, judged

TURN_RAD = np.radians(60)


def turning(turn_rad: float = TURN_RAD, *, beside: bool = False) -> bytes:
    """Record the hand-off with a jaw that turns evenly; if requested, with PSM_M 15 mm beside its end."""
    tip = cases.points_mm()
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    target = matrix_of([[np.sin(turn_rad / 2), 0.0, 0.0, np.cos(turn_rad / 2)]])[0] @ POINTING_DOWN
    rotation = quaternion_of(turn(POINTING_DOWN, target, np.linspace(0, 1, len(tip))))
    motions = [Motion("PSM2", "/PSM2/measured_cp", "PSM2_base", stamps_ns, tip, rotation)]
    if beside:
        there = np.tile(tip[-1] + [15.0, 0.0, 0.0], (len(tip), 1))
        towards = np.tile([0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)], (len(tip), 1))
        motions.append(Motion("PSM1", "/PSM1/measured_cp", "PSM2_base", stamps_ns, there, towards))
    return write_mcap(Recording(format="mcap", integrity="full", motions=tuple(motions)))


def taught(database: Database, data: bytes) -> None:
    cases.store(database, cases.upload(data, "application/vnd.mcap"), arm="PSM2")
    cases.train(database, release=True)


def test_a_plan_states_that_its_jaw_turns_as_the_surgeons(database: Database):
    taught(database, turning())
    plan = cases.add_plan(database)
    about = plan.about
    assert (about.orientation, about.departure, about.a2) == ("recorded", None, None)
    assert about.passes[0].turn_deg == pytest.approx(60, abs=0.1)
    assert 0 < about.trajectory.tempo <= 1
    with database.reading() as session:
        motion = trajectory_of(planned(find_plan(session, plan.sha256)))
    ends = matrix_of(motion.rotation_xyzw[[0, -1]])
    assert np.degrees(angle_between(ends[:1], ends[1:]))[0] == pytest.approx(60, abs=1e-3)
    judged(database, plan)
    gate(database, plan)


def test_a_plan_that_holds_the_jaw_is_not_exported(database: Database):
    taught(database, turning())
    plan = cases.add_plan(database, orientation="constant")
    assert plan.about.orientation == "demonstrated"
    assert plan.about.departure.deg == pytest.approx(60, abs=1e-3)
    assert plan.about.departure.handoff_needle_tip_mm > 10
    judged(database, plan)
    with pytest.raises(Conflict, match=r"turned it by up to 60\.0 degrees: .* plan again without a constant"):
        gate(database, plan)
    gate(database, plan, constant_turn_deg=61.0)


def test_a_small_turn_may_be_held(database: Database):
    taught(database, turning(np.radians(9)))
    plan = cases.add_plan(database, orientation="constant")
    judged(database, plan)
    gate(database, plan)


def test_a_version_checked_with_the_jaw_held_is_not_released(database: Database, monkeypatch: pytest.MonkeyPatch):
    cases.store(database, cases.upload(turning(), "application/vnd.mcap"), arm="PSM2")
    monkeypatch.setattr(
        "skills.library.policies.gate.driven_pass",
        lambda *given: replace(driven_pass(*given), orientation="demonstrated"),
    )
    version = cases.train(database)
    with pytest.raises(Conflict, match=r"turns by 60\.0 degrees, over 10.*train it again"):
        cases.release(database, version)
    assert [training_released(database, limit_deg) for limit_deg in (10.0, 61.0)] == [False, True]


def training_released(database: Database, constant_turn_deg: float) -> bool:
    """Ask for the release of the version by a training, in an installation that states this limit."""
    settings = Settings(database_url=database.url, constant_turn_deg=constant_turn_deg)
    with database.writing() as session:
        asked = TrainingIn(surgeon="kestrel", suture=cases.SUTURE, release=True)
        job = request_training(session, asked, "test", GateLimits.of(settings)).job
    if job.state == "queued":
        assert Work(database, settings, perform_job).try_once(job.row, job.attempt, 0)
    with database.reading() as session:
        return session.scalar(select(Release)) is not None


def test_a2_ends_where_both_arms_were_recorded(database: Database):
    taught(database, turning(beside=True))
    plan = cases.add_plan(database, handoff=None)
    assert plan.about.a2 == "recorded"
    assert plan.about.psm_m.approach == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
    paper = cases.add_plan(database, handoff=None, a2="paper")
    assert (paper.about.a2, paper.sha256 != plan.sha256) == ("paper", True)
    other = cases.add_plan(database, psm_m={"approach": (-0.94, 0.1, -0.33)})
    assert other.about.a2 == "paper"
    with pytest.raises(BadPlan, match="was not recorded"):
        cases.add_plan(database, psm_m={"approach": (-0.94, 0.1, -0.33)}, a2="recorded")


def test_positions_alone_are_planned_with_the_jaw_held_and_said_so(database: Database):
    cases.trained(database, release=True)
    plan = cases.add_plan(database)
    assert (plan.about.orientation, plan.about.departure) == ("assumed tool-down", None)
    assert plan.about.trajectory.jaw == "constant"
    with pytest.raises(BadPlan, match="no orientation"):
        cases.add_plan(database, orientation="recorded")
    judged(database, plan)
    gate(database, plan)


def test_a_plan_of_several_follows_their_pose_style(database: Database):
    demos = [
        cases.store(database, cases.upload(turning(rad), "application/vnd.mcap"), arm="PSM2")
        for rad in (TURN_RAD, TURN_RAD / 2)
    ]
    cases.train(database, demos=[one.sha256 for one in demos], release=True)
    plan = cases.add_plan(database)
    assert plan.about.orientation == "recorded"
    assert plan.about.passes[0].turn_deg == pytest.approx(45, abs=2)  # the mean of 60 and 30


@pytest.mark.parametrize(
    ("turns_deg", "driven", "limit_deg", "refused"),
    [
        ([None], {"orientation": "demonstrated"}, 0.0, False),
        ([12.0], {"orientation": "demonstrated"}, 12.0, False),
        ([12.0], {"orientation": "demonstrated"}, 11.9, True),
        ([None, 3.0, 12.0], {"orientation": "demonstrated"}, 11.9, True),
        ([12.0, 90.0], {"orientation": "recorded"}, 0.0, False),
        ([90.0], None, 0.0, False),
    ],
)
def test_a_version_checked_with_the_jaw_held_may_turn_so_far(turns_deg, driven, limit_deg, refused, monkeypatch):
    turns = iter(turns_deg)
    monkeypatch.setattr(releases, "departure_of", lambda _demo: None if (deg := next(turns)) is None else Turn(deg))
    demos = [SimpleNamespace(demo=None) for _ in turns_deg]
    policy = SimpleNamespace(
        manifest=SimpleNamespace(grid_certificate=SimpleNamespace(driven=driven and SimpleNamespace(**driven))),
        demonstrations=demos,
    )
    found = releases._held(policy, limit_deg)
    assert bool(found) == refused
    assert all(f"turns by 12.0 degrees, over {limit_deg:g}" in one.text for one in found)


class Turn(NamedTuple):
    """A departure of a demonstration's orientation from its first one."""

    deg: float
