"""Learning of one style: from packed demonstrations to a certified policy version that is stored."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import LargeBinary, func, insert, select, type_coerce
from sqlalchemy.orm import Session, aliased

from skills.arrays import xyz
from skills.comparison.combining import followed
from skills.db import models
from skills.db.models import Demonstration, PolicyVersion, Surgeon
from skills.db.packed import Sealed, seal, unpack_as
from skills.db.service_tables import record_events
from skills.db.session import Database
from skills.deep import Progress, learn_policy
from skills.demonstration.demonstration import Demo, partner_motion
from skills.demonstration.partner import PartnerMotion
from skills.demonstration.recording import Recording
from skills.errors import Conflict, NotFound, SkillsError
from skills.gridworld.grid import discretisation_rmse
from skills.gridworld.hazards import hazards_of
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning.certificate import certify, near_odds, near_starts
from skills.learning.evaluation import check_in_space, measure
from skills.learning.in_scene import certify_in_scene, learn_in_scene, scene_learner
from skills.learning.policy import Policy, describe_settings
from skills.learning.ties import rule_in
from skills.learning.tube import certified_poses
from skills.library.operation.integrity import poses_identity_of, scene_digest
from skills.library.people.consent import refusal, require
from skills.library.policies.combined import describe_combined
from skills.library.policies.gate import driven_or_refused, pose_refusals, refusals
from skills.library.policies.releases import Style
from skills.library.policies.requests import TrainingRequest
from skills.library.recordings.recordings import Parser, stored_recording
from skills.remedies import Action, Remedy
from skills.schemas import DemoOutcome
from skills.schemas import policies as schemas
from skills.schemas.grids import Grid
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import CombineIn
from skills.settings import Settings

ERASED = "A demonstration was erased while the training used it."


CERTIFICATE_NOTE = (
    "Checked on the grid: every greedy action against exact dynamic programming, and every start by following it; "
    "the demonstrated pass as it is driven (`driven.path`) against the arm's joint limits in closed form. It says "
    "nothing about the arm's accuracy. Research use only."
)


@dataclass(frozen=True, eq=False)
class Lesson:
    """A demonstration to learn from, its values still packed, with its surgeon.

    For several combined demonstrations it is the one at whose place their path lies; `others` are the rows of the rest,
    and `combined` is the description of the combination in the manifest. `outcomes` are those of all its
    demonstrations, the oldest first; None is not known. `shown` are these demonstrations, still packed, and `at` is the
    index of the one at whose place they lie; empty for a single one. `partners` is the other arm's motion along each of
    them (`with_partners`), and `recording` the digest of the recording of a single one.
    """

    row: int
    sha256: str
    surgeon: Surgeon
    suture: str
    demo: bytes
    reward: bytes
    outcomes: tuple[DemoOutcome | None, ...]
    recording: str
    partners: tuple[PartnerMotion | None, ...] = (None,)
    others: tuple[int, ...] = ()
    combined: schemas.Combined | None = None
    shown: tuple[bytes, ...] = ()
    at: int = 0

    @property
    def style(self) -> Style:
        """The surgeon's row, and the suture type."""
        return self.surgeon.row, self.suture

    @cached_property
    def motion(self) -> Demo:
        """The unpacked demonstration.

        Raises:
            Corrupt: It does not match its digest.
        """
        return unpack_as(Demo, self.demo)


@dataclass(frozen=True, eq=False)
class Learnt:
    """A learnt and certified policy, already packed, so that no transaction has to wait for the packing."""

    lesson: Lesson
    training: str
    sha256: str
    manifest: PolicyManifest
    policy: bytes
    coverage: bytes
    poses: Sealed | None


class Stored(NamedTuple):
    """The row and the version number of a stored policy, and whether this transaction has stored it."""

    row: int
    version: int
    new: bool


def lessons(session: Session, demonstrations: Sequence[int]) -> list[Lesson]:
    """Return the lessons of some demonstrations, in the order of the rows."""
    of = Demonstration
    packed = type_coerce(of.demo, LargeBinary), type_coerce(models.StoredRewardMap.map, LargeBinary)
    query = (
        select(of.row, of.sha256, Surgeon, of.suture, *packed, of.outcome, models.StoredRecording.sha256)
        .join(Surgeon, Surgeon.row == of.surgeon_row)
        .join(models.StoredRecording, models.StoredRecording.row == of.recording_row)
        .join(models.StoredRewardMap, models.StoredRewardMap.demonstration_row == of.row)
        .where(of.row.in_(demonstrations))
    )
    found = session.execute(query.order_by(of.row))
    return [
        Lesson(row, sha256, surgeon, suture, demo, reward, (outcome,), recording)
        for row, sha256, surgeon, suture, demo, reward, outcome, recording in found
    ]


def with_partners(database: Database, lessons: Sequence[Lesson], parse: Parser) -> list[Lesson]:
    """Return lessons of one style with the other arm's motion along each demonstration, if every one has it.

    It is computed from the recordings, because a demonstration has only the pose in which the other arm takes the
    needle. A recording that cannot be read refuses the training: an equal one would have another result elsewhere.

    Args:
        database: The database; no transaction is open while a recording is read.
        lessons: At least one, none of them combined.
        parse: The reader of recordings that are not cached.

    Raises:
        Conflict: The surgeon's consent does not cover training.
        NotFound: A demonstration was erased since.
        Corrupt: A value does not match its digest.
        BadRecording: A recording is not cached, and cannot be read any more.
    """
    require(lessons[0].surgeon, "training")  # before a recording is read
    demos = [one.motion for one in lessons]
    arms = {None if demo.partner is None or demo.rotation_xyzw is None else demo.partner.arm for demo in demos}
    if len(arms) > 1 or None in arms:
        return [*lessons]
    found: list[Lesson] = []
    recording: Recording | None = None
    for number, (lesson, demo) in enumerate(zip(lessons, demos, strict=True)):
        if recording is None or lesson.recording != lessons[number - 1].recording:
            recording = None  # before the next one is read, so that only one is in memory
            try:
                recording = stored_recording(database, lesson.recording, parse).recording
            except NotFound:
                raise NotFound(ERASED) from None
        motion = partner_motion(recording, demo)
        if motion is None:
            return [*lessons]
        found.append(replace(lesson, partners=(motion,)))
    return found


def combined_lesson(lessons: Sequence[Lesson], combine: CombineIn | None) -> Lesson:
    """Combine the lessons of one style, the oldest first, into one; a single one (None) is returned as it is.

    Raises:
        Corrupt: A demonstration does not match its digest.
        BadPath: They cannot be aligned, or their combined path has no path in the grid.
    """
    if combine is None:
        return lessons[0]
    rewards = [unpack_as(RewardMap, lesson.reward) for lesson in lessons]
    found = followed([one.motion for one in lessons], [reward.path for reward in rewards], combine.kind)
    at = found.combined.at
    return replace(
        lessons[at],
        demo=seal(found.demo).packed,
        reward=seal(sparse_reward(found.path, rewards[at].levels)).packed,
        outcomes=tuple(outcome for lesson in lessons for outcome in lesson.outcomes),
        shown=tuple(lesson.demo for lesson in lessons),
        partners=tuple(partner for lesson in lessons for partner in lesson.partners),
        at=at,
        others=tuple(lesson.row for lesson in lessons if lesson is not lessons[at]),
        combined=describe_combined(found, combine.kind, [lesson.sha256 for lesson in lessons]),
    )


def learn_style(
    lesson: Lesson, request: TrainingRequest, settings: Settings, progress: Progress | None = None
) -> Learnt:
    """Learn, certify and measure a style from a lesson, as a training requests it; no transaction is open.

    Args:
        lesson: The demonstration.
        request: The training's request, as `request_training` writes it.
        settings: Limits of time and memory.
        progress: Progress callback.

    Raises:
        LearningFailed: The process of a deep learner crashed or exceeded its limits.
        Conflict: The surgeon's consent does not cover it.
        Corrupt: The demonstration does not match its digest.
        BadSettings: It cannot be learnt with these settings.
    """
    require(lesson.surgeon, "training")  # fails early; the check that counts is repeated in the transaction that stores
    demo, reward = lesson.motion, unpack_as(RewardMap, lesson.reward)
    if (given := request.surroundings) is not None:
        hazards = hazards_of(given.scene, reward.path, demo.frame, given.costs)
        policy = learn_in_scene(reward, scene_learner(request.learner), hazards, request.seed)
        return certified(lesson, request, demo, policy)
    policy = learn_policy(
        reward,
        request.learner,
        request.seed,
        ties=rule_in(demo.frame, request.depth_along),
        progress=progress,
        timeout_s=settings.learning_timeout_s,
        memory_bytes=settings.learning_memory_bytes,
    )
    return certified(lesson, request, demo, policy)


def certified(lesson: Lesson, request: TrainingRequest, demo: Demo, policy: Policy) -> Learnt:
    """Certify and measure a policy that was learnt from a demonstration, and pack all of it."""
    certificate, covered = certify(policy)
    in_scene = None
    if policy.hazards is not None:
        in_scene, odds = certify_in_scene(policy, policy.hazards)
        covered = replace(covered, finishing=odds.finishes, touching=odds.touches)
    shown = [unpack_as(Demo, one) for one in lesson.shown] or [demo]
    poses = certified_poses(shown, lesson.at, lesson.partners, policy.learner.join_share)
    numbers, coverage = seal(policy), seal(covered)
    driven, undriven = driven_or_refused(policy, demo)
    near = near_starts(policy, covered.share, request.near)
    chances = (
        None if in_scene is None or request.odds is None else near_odds(policy, covered, request.near, request.odds)
    )
    manifest = PolicyManifest(
        surgeon=request.surgeon,
        suture=request.suture,
        arm=demo.arm,
        frame=demo.frame,
        instrument=demo.instrument,
        grid=Grid(**asdict(policy.path.grid)),
        start_mm=xyz(policy.path.tip_mm[0]),
        goal_mm=xyz(policy.path.tip_mm[-1]),
        waypoints=policy.path.states.tolist(),
        phases=policy.domain.phases,
        learner=policy.learner.kind,
        learner_version=request.learner_version,
        settings=describe_settings(policy.learner),
        reward_levels=policy.levels,
        seed=policy.seed,
        demos=request.demos,
        training=schemas.TrainingFigures(**vars(policy.training)),
        metrics=measure(policy.replay, discretisation_rmse(demo.tip_mm, policy.path.grid, policy.path.hysteresis)),
        coverage=schemas.Coverage(
            starts_reaching_goal=certificate.starts_reaching,
            starts_joining_nearest=certificate.starts_joining_nearest,
            n_states=certificate.starts,
            sha256=coverage.digest,
            mean_share=certificate.mean_share,
            median_share=certificate.median_share,
            starts_goal_alone=certificate.starts_goal_alone,
        ),
        grid_certificate=schemas.GridCertificate(
            states_checked=certificate.checked,
            states_finishing=certificate.finishing,
            suboptimal_actions=certificate.suboptimal,
            actions_off_rule=certificate.off_rule,
            demonstration_reproduced=certificate.demonstration_reproduced,
            refused_because=(
                *refusals(policy, certificate, near, chances),
                *pose_refusals(poses, request.near),
                *undriven,
            ),
            gate=request.gate,
            near=near,
            driven=driven,
            note=CERTIFICATE_NOTE,
        ),
        combined=lesson.combined,
        rollouts=check_in_space(policy),
        # Without a training from any outcome none of them is marked recovery or failure.
        outcomes=[*lesson.outcomes] if request.outcomes else None,
        joining=_joining(policy),
        ties=policy.ties,
        scene=None
        if policy.surroundings is None or in_scene is None or chances is None
        else schemas.PolicyScene(
            sha256=scene_digest(policy.surroundings.scene),
            scene=policy.surroundings.scene,
            costs=policy.surroundings.costs,
            certificate=in_scene,
            near=chances,
        ),
    )
    return Learnt(
        lesson=lesson,
        training=request.identity,
        sha256=manifest.identity(numbers.digest),
        manifest=manifest,
        policy=numbers.packed,
        coverage=coverage.packed,
        poses=None if poses is None else seal(poses),
    )


def store_style(session: Session, learnt: Learnt) -> Stored:
    """Store a learnt policy as the next version of its style; an equal one is not stored twice.

    Raises:
        NotFound: A demonstration was erased since.
        Conflict: A demonstration was withdrawn since, or marked recovery or failure without a training from any
            outcome; or the surgeon's consent does not cover training any more.
    """
    (stored,) = store_styles(session, [learnt])
    if isinstance(stored, SkillsError):
        raise stored
    return stored


def store_styles(session: Session, learnt: Sequence[Learnt]) -> list[Stored | SkillsError]:
    """Store learnt policies of different styles, as `store_style` does, with a few statements for all of them.

    Returns:
        For each, in order, the stored version, or the error for which it was not stored.
    """
    states = demo_states(session, [one.lesson.row for one in learnt])
    known = find_stored(session, [one.sha256 for one in learnt])
    refused = {one.sha256: _refusal(session, one, states.get(one.lesson.row)) for one in learnt}
    # A version that is already stored is returned as it is, so a retry of a job stores nothing twice.
    new = [one for one in learnt if one.sha256 not in known and refused[one.sha256] is None]
    if new:
        of_style = [states[one.lesson.row] for one in new]
        values = [_version(one, max(of.last or 0, of.used or 0) + 1) for one, of in zip(new, of_style, strict=True)]
        session.execute(insert(PolicyVersion), values)
        known |= find_stored(session, [one.sha256 for one in new], new=True)
        record_events(session, "worker", "train", "policy-version", [(one.sha256, one.lesson.surgeon) for one in new])
    rests_on = [
        {"policy_row": known[one.sha256].row, "demonstration_row": other} for one in new for other in one.lesson.others
    ]
    if rests_on:
        session.execute(insert(models.PolicyDemonstration), rests_on)
    poses = [
        {"policy_row": known[one.sha256].row, "poses": one.poses.packed}
        | {"sha256": poses_identity_of(one.sha256, one.poses.digest)}
        for one in new
        if one.poses is not None
    ]
    if poses:
        session.execute(insert(models.StoredPoses), poses)
    return [refused[one.sha256] or known[one.sha256] for one in learnt]


def demo_states(session: Session, rows: Sequence[int]) -> dict[int, Any]:
    """Return, by row, the states of demonstrations that decide on storing, and the last numbers of their styles.

    `last` is the number of the newest version that is stored, and `used` of the newest one that is not any more.
    """
    of, version, erased = Demonstration, aliased(PolicyVersion), aliased(models.LastUsed)
    last = select(func.max(version.version)).where(version.surgeon_row == of.surgeon_row, version.suture == of.suture)
    used = select(func.max(erased.last)).where(erased.surgeon_row == of.surgeon_row, erased.suture == of.suture)
    numbers = last.scalar_subquery().label("last"), used.scalar_subquery().label("used")
    query = select(of.row, of.withdrawn_at, of.outcome, Surgeon.slug, Surgeon.consent, *numbers)
    found = session.execute(query.join(Surgeon, Surgeon.row == of.surgeon_row).where(of.row.in_(rows)))
    return {one.row: one for one in found}


def find_stored(session: Session, digests: Sequence[str], *, new: bool = False) -> dict[str, Stored]:
    """Return those of some policies that are stored, by digest."""
    query = select(PolicyVersion.sha256, PolicyVersion.row, PolicyVersion.version)
    found = session.execute(query.where(PolicyVersion.sha256.in_(digests)))
    return {sha256: Stored(row, version, new) for sha256, row, version in found}


def _refusal(session: Session, learnt: Learnt, state: Any) -> SkillsError | None:
    """Return the error that forbids storing.

    A demonstration was erased, withdrawn or marked since, or consent has ended.
    """
    others = [session.get(Demonstration, row) for row in learnt.lesson.others]
    if state is None or None in others:
        return NotFound(ERASED)
    if any(one.withdrawn_at is not None for one in (state, *others)):
        return Conflict("A demonstration was withdrawn while the training used it.")
    marked = [one.outcome for one in (state, *others) if one.outcome not in (None, models.SUCCESS)]
    if marked and learnt.manifest.outcomes is None:
        why = f"A demonstration was marked {marked[0]} while the training used it."
        return Conflict(why, Remedy(Action.TRAIN_ANY))
    return refusal(state, "training")


def _version(learnt: Learnt, version: int) -> dict[str, Any]:
    """Return the values of a row of `PolicyVersion`."""
    return {
        "sha256": learnt.sha256,
        "training": learnt.training,
        "surgeon_row": learnt.lesson.surgeon.row,
        "suture": learnt.lesson.suture,
        "version": version,
        "demonstration_row": learnt.lesson.row,
        "manifest": learnt.manifest,
        "releasable": not learnt.manifest.grid_certificate.refused_because,
        "learnt": learnt.policy,
        "covered": learnt.coverage,
    }


def _joining(policy: Policy) -> schemas.Joining | None:
    """Return the joining table of a policy; None by the rule nearest, which every client knows."""
    domain = policy.domain
    if domain.finishes_unjoined:
        return None
    states = np.flatnonzero(domain.joins)
    return schemas.Joining(
        join_share=domain.join_share,
        states=tuple(states.tolist()),
        phases=tuple(domain.joins[states].tolist()),
    )
