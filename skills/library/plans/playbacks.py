"""Playbacks: plans played in the simulator, and the verdict.

    plan --check_playback--> playback

A plan may be played even if its policy was withdrawn since: a verdict moves no arm. Every playback is returned with the
current state of the policy's release, and it is the replay bag that is refused for a policy that is not released.
"""

from typing import ClassVar, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import StoredPlayback
from skills.db.packed import digest
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.dynamics import Servo
from skills.library.operation import jobs
from skills.library.operation.integrity import find_by_digest, learnt, planned
from skills.library.operation.jobs import JobRequest, RequestedJob, Store
from skills.library.plans.arm_errors import stated_errors, stated_servo
from skills.library.plans.headline import CHECK_VERSION, headline
from skills.library.plans.plans import check_frame, find_plan, hand_of, trajectory_of
from skills.library.plans.playback_pictures import can_draw, request_pictures
from skills.library.policies import releases, versions
from skills.remedies import Action, Remedy
from skills.schemas import PolicyName
from skills.schemas.playbacks import FollowedPolicy, Headline, PictureLinks, Playback, Verdict, finite
from skills.schemas.results import PlaybackResult
from skills.settings import Settings
from skills.verification.arm_errors import ArmErrors
from skills.verification.verdict import judge_plan


class PlaybackRequest(JobRequest):
    """The request of a playback's job: the plan's digest, and the stated errors of the arms and servo of PSM_A."""

    kind: ClassVar[str] = "playback"

    plan: str
    check_version: int
    errors: ArmErrors
    stated_by: Literal["request", "installation"]
    servo: Servo | None = None


def request_playback(
    session: Session,
    plan_sha256: str,
    actor: str,
    settings: Settings,
    errors: ArmErrors | None = None,
    servo: Servo | None = None,
) -> RequestedJob:
    """Queue the playback of a plan in the simulator.

    Args:
        session: The caller's transaction.
        plan_sha256: The plan's digest.
        actor: The caller's name.
        settings: The installation's settings.
        errors: The errors of the arms that are to play it; None: those that the installation states.
        servo: How PSM_A is driven; None: as the installation states.

    Raises:
        BadPlan: Its frame is not the arm's base, so the simulator would place it wrongly.
        Conflict: The surgeon's consent does not cover training.
    """
    plan = find_plan(session, plan_sha256)
    versions.followable(plan.policy)
    check_frame(plan.about.frame)
    request = playback_request(plan.sha256, settings, errors, servo)
    return jobs.ask(session, request, plan.policy.surgeon, actor)


def playback_request(
    plan_sha256: str, settings: Settings, errors: ArmErrors | None, servo: Servo | None = None
) -> PlaybackRequest:
    """Return the request of a playback's job, all defaults resolved; the arguments are those of `request_playback`."""
    return PlaybackRequest(
        plan=plan_sha256,
        check_version=CHECK_VERSION,
        errors=stated_errors(settings.arm_errors) if errors is None else errors,
        servo=stated_servo(settings.servo) if servo is None else servo,
        stated_by="installation" if errors is None else "request",
    )


def check_playback(database: Database, request: PlaybackRequest, settings: Settings) -> Store[PlaybackResult]:
    """Play a plan in the simulator, judge it, and estimate its probability of success by Monte Carlo.

    The returned function stores all of it.
    """
    from skills.simulation.player import play

    with database.reading() as session:
        stored = find_plan(session, request.plan)
        plan, policy = planned(stored), PolicyName.model_validate(stored.policy)
        followed, demo = learnt(stored.policy), hand_of(stored.policy)
    check_frame(plan.frame)
    trajectory = trajectory_of(plan)
    measured = play(trajectory, timeout_s=settings.playback_timeout_s, memory_bytes=settings.playback_memory_bytes)
    verdict = judge_plan(
        plan, trajectory, measured, policy=followed, demo=demo, errors=request.errors, servo=request.servo
    )
    report = finite(
        Verdict(
            **vars(verdict.report),
            estimate=verdict.success,
            stated_by=request.stated_by,
            check_version=request.check_version,
            failure_sentence=verdict.failure_sentence,
            scene=verdict.scene,
            executed=verdict.executed,
            tissue="not given" if plan.scene is None or plan.scene.tissue is None else "judged",
            plan=request.plan,
            trajectory=digest(trajectory),
            policy=policy,
            frame=plan.frame,
        )
    )

    def store(session: Session, actor: str) -> PlaybackResult:
        # A retry of the job computes the same report and digest, and must not store it twice.
        known = session.scalar(select(StoredPlayback).where(StoredPlayback.sha256 == report.identity))
        if known is None:
            plan = find_plan(session, request.plan)
            known = StoredPlayback(
                sha256=report.identity, plan=plan, feasible=report.feasible, report=report, measured=measured
            )
            session.add(known)
            record_event(session, actor, "play", "playback", report.identity, plan.policy.surgeon)
            session.flush()
            if can_draw():
                request_pictures(session, known, actor)
        return PlaybackResult(playback=known.sha256, feasible=known.feasible)

    return store


def find_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Return a playback by its digest."""
    return find_by_digest(session, StoredPlayback, playback_sha256, "playback", Remedy(Action.ADD_PLAYBACK))


def shown_playback(session: Session, playback_sha256: str) -> StoredPlayback:
    """Return a playback by its digest, whose motion is shown.

    Raises:
        Conflict: The surgeon's consent does not cover training (any more).
    """
    playback = find_playback(session, playback_sha256)
    versions.followable(playback.plan.policy)
    return playback


def headline_of(playback: StoredPlayback, settings: Settings) -> Headline:
    """Return the headline of a playback at the errors and the lower bound of the installation's settings."""
    errors, lower_bound = stated_errors(settings.arm_errors), settings.replay_lower_bound
    return headline(playback.plan.about, playback.report, errors=errors, lower_bound=lower_bound)


def describe_playback(session: Session, row: StoredPlayback, settings: Settings) -> Playback:
    """Return a playback with its headline, and whether its style serves the policy that its plan follows.

    All of its pictures but the first are drawn after the verdict, where the extra `pictures` is installed.
    """
    here, policy = f"/playbacks/{row.sha256}", row.plan.policy
    return Playback.from_attributes_of(
        row,
        id=row.sha256,
        plan=row.plan.sha256,
        headline=headline_of(row, settings),
        picture=f"{here}/picture.png",
        pictures=PictureLinks(
            picture=f"{here}/picture.png",
            animation_mp4=f"{here}/animation.mp4",
            animation_gif=f"{here}/animation.gif",
            joints=f"{here}/joints.png",
            clearance=f"{here}/clearance.png",
        ),
        policy=FollowedPolicy(version=policy.version, sha256=policy.sha256, released=releases.serves(session, policy)),
    )
