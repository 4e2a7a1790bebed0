"""Training of a style: from its demonstration to a certified policy version, and to its release if requested.

    request_training --> Job
    Job's request --train_style--> Learnt --store_style--> PolicyVersion and its pose style
    Lessons, their recordings --with_partners--> Lessons with the other arm's motion, for the pose style

Learning and certifying run outside any transaction; the result is packed before the transaction that stores it.
"""

from collections.abc import Sequence
from contextlib import closing

from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion, Surgeon
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.deep import require_installed
from skills.errors import BadInput
from skills.gridworld.hazards import refuse_unfit
from skills.gridworld.reward import RewardLevels
from skills.learning.in_scene import scene_learner
from skills.learning.policy import Learner, refuse_loops, refuse_too_large
from skills.learning.q_learning import PhaseQLearning
from skills.learning.ties import rule_in
from skills.library.operation import jobs
from skills.library.operation.jobs import RequestedJob, Store
from skills.library.people.consent import require
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import releases
from skills.library.policies.combined import BEST, choose_demos
from skills.library.policies.gate import DEFAULT_LIMITS, GateLimits
from skills.library.policies.learning import combined_lesson, learn_style, lessons, store_style, with_partners
from skills.library.policies.requests import ANY, TrainingRequest
from skills.library.policies.versions import find_by_digest
from skills.library.recordings.demos import find_demo
from skills.library.recordings.recordings import confined_reader
from skills.schemas.training import TrainingIn, TrainingResult
from skills.settings import Settings


def request_training(
    session: Session, training: TrainingIn, actor: str, limits: GateLimits = DEFAULT_LIMITS
) -> RequestedJob:
    """Queue the training of a style, with all defaults resolved.

    Several demonstrations are combined, independently of the order in which they are named. If an equal training with
    `release` is done and the style now serves another version, or none, the training's version is released again if it
    passes the gate, in the caller's transaction; the job's result contains the outcome.

    Args:
        session: The caller's transaction.
        training: The request. Without `demos` the newest demonstration of the style is meant that may be learnt from,
            without `combine` `BEST`, and without `learner` phase Q-learning with its defaults.
        actor: The owner of the caller's key.
        limits: The gate's limits.

    Raises:
        NotFound: The surgeon, the suture type or a demonstration is unknown.
        Conflict: There is no active demonstration; one is marked recovery or failure, and the request does not have
            outcomes "any"; or the surgeon's consent does not cover training.
        BadInput: A demonstration belongs to another style or is named twice, there are too many, or they cannot be
            combined; or costs of a scene are given without it.
        BadSettings: Learning would need too much memory, or going round in circles would pay more than arriving; or the
            scene is in another frame or is touched by the demonstration, or the learner does not learn in a scene.
        NotInstalled: The learner needs a library that is not installed.
    """
    request, who = training_request(session, training, limits)
    requested = jobs.ask(session, request, who, actor)
    if requested.new or not training.release or requested.job.state != "succeeded":
        return requested
    return requested._replace(did=_release_again(session, requested.job, actor, limits.constant_turn_deg))


def training_request(session: Session, training: TrainingIn, limits: GateLimits) -> tuple[TrainingRequest, Surgeon]:
    """Return the request of a training's job with all defaults resolved, and the surgeon; see `request_training`."""
    learner = learner_to_train(training.chosen)
    who, what = find_surgeon(session, training.surgeon), find_suture_type(session, training.suture)
    require(who, "training")
    any_outcome = training.outcomes == ANY
    chosen = choose_demos(session, who, what.slug, training.demos, any_outcome=any_outcome)
    # Before the job is queued, so that the caller sees the error at once.
    refuse_too_large(chosen[-1].path, learner, in_scene=training.scene is not None)
    combine = training.combine or (BEST if len(chosen) > 1 else None)
    if combine is not None and len(chosen) == 1:
        raise BadInput("A single demonstration is not combined; name several in `demos`, or omit `combine`.")
    if training.depth_along is not None:
        _refuse_depth_along(training.depth_along, learner, chosen[-1].frame)
    if (surroundings := training.surroundings) is not None:
        scene_learner(learner)
        if training.depth_along is not None:
            raise BadInput("In a scene depths are not compared, but have a cost; omit `depth_along`.")
        for demo in chosen:
            refuse_unfit(surroundings.scene, demo.path, demo.frame)
    elif training.scene_costs is not None:
        raise BadInput("scene_costs are costs of a scene; give the scene too, or omit them.")
    request = TrainingRequest(
        surgeon=who.slug,
        suture=what.slug,
        demos=[demo.sha256 for demo in chosen],
        learner=learner,
        near=limits.near,
        odds=None if surroundings is None else limits.odds,
        seed=training.seed,
        release=training.release,
        combine=combine,
        outcomes=ANY if any_outcome else None,
        depth_along=training.depth_along,
        surroundings=surroundings,
    )
    return request, who


def learner_to_train(chosen: Learner | None) -> Learner:
    """Return the learner of a request, by default phase Q-learning, if it can be used here.

    Raises:
        BadSettings: With its settings going round in circles pays more than arriving.
        NotInstalled: It needs a library that is not installed.
    """
    learner = chosen or PhaseQLearning()
    refuse_loops(RewardLevels(), learner)  # those of every demonstration that is added
    require_installed(learner)
    return learner


def _refuse_depth_along(depth_along: Sequence[float], learner: Learner, frame: str) -> None:
    """Refuse a direction of depth that would not be used, or is none."""
    if frame.endswith("_base"):
        raise BadInput(f"In {frame} depth is the distance from the remote centre; omit `depth_along`.")
    if not learner.phased:
        raise BadInput(f"The learner '{learner.kind}' does not compare depths; omit `depth_along`.")
    rule_in(frame, depth_along)


def _release_again(session: Session, job: Job, actor: str, constant_turn_deg: float) -> str:
    """Release the version of a finished training unless its style serves it already; return the effect in words."""
    assert job.result is not None, "it has succeeded"
    result = TrainingResult.model_validate(job.result)
    version = find_by_digest(session, result.sha256)
    served = releases.served(session, version.surgeon, version.suture)
    if served is not None and served.policy_row == version.row:
        return f"Nothing: the style serves version {version.version} already."
    released = releases.try_release(session, version, actor, constant_turn_deg)
    job.result = result.model_copy(update=released._asdict()).model_dump()
    session.flush()
    because = released.not_released_because
    return f"Version {version.version} was released." if because is None else f"Nothing: {because}"


def train_style(database: Database, request: TrainingRequest, settings: Settings) -> Store[TrainingResult]:
    """Learn, certify and measure the requested style; the returned function stores the result."""
    with database.reading() as session:
        found = lessons(session, [find_demo(session, one).row for one in request.demos])
    reader = confined_reader(settings)
    with closing(reader.server):  # it starts only if a recording is not cached
        found = with_partners(database, found, reader.parse)
    lesson = combined_lesson(found, request.combine)
    learnt = learn_style(lesson, request, settings, jobs.progress_callback(database, request))

    def store(session: Session, actor: str) -> TrainingResult:
        version = session.get_one(PolicyVersion, store_style(session, learnt).row)
        released = releases.NOT_REQUESTED
        if request.release:
            released = releases.try_release(session, version, actor, settings.constant_turn_deg)
        return TrainingResult(
            policy_version=version.version,
            sha256=version.sha256,
            releasable=version.releasable,
            **released._asdict(),
        )

    return store
