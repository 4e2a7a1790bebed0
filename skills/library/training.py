"""Training a style: from its demonstration to a certified policy version, and to its release if that was asked."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, NamedTuple, cast

from sqlalchemy import LargeBinary, Result, Table, bindparam, func, insert, select, type_coerce, update
from sqlalchemy.orm import Session

from skills.db.books import Job
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, StoredRewardMap, Surgeon
from skills.db.packed import seal, unpack_as
from skills.db.session import Database
from skills.deep.learning import Tell, learn_policy, require_installed
from skills.errors import BadInput, BadSettings, Conflict, NotFound, SkillsError
from skills.library import jobs, releases
from skills.library.catalogue import check_consent, find_surgeon, find_suture_type
from skills.library.combined import BEST, choose_demos, combining_of, describe_combined
from skills.library.demos import find_demo
from skills.library.events import record_each
from skills.library.verified import policy_identity_of
from skills.packing import canonical, sha256
from skills.settings import Settings
from skills.style.certificate import Certificate, certify
from skills.style.combining import Combining, followed
from skills.style.demo import Demo
from skills.style.evaluation import Metrics, discretisation_rmse, measure
from skills.style.kinematics import POINTING_DOWN, reachable
from skills.style.learning.learners import LEARNER_VERSION, LEARNERS, Learner, refuse_too_large
from skills.style.learning.q_learning import PhaseQLearning, Training
from skills.style.plan import rotation_of
from skills.style.policy import Policy
from skills.style.reward import RewardLevels, RewardMap, sparse_reward
from skills.style.wandering import check_in_space

Store = Callable[[Session, str], dict[str, Any]]

# Statements that every style goes through, built once: to build one takes as long as to run it.
_VERSIONS, _DEMOS = (cast(Table, one.__table__) for one in (PolicyVersion, Demonstration))
_OF_STYLE = _VERSIONS.alias("of_style")
STANDING = select(
    _DEMOS.c.row,
    _DEMOS.c.withdrawn_at,
    select(func.max(_OF_STYLE.c.version))
    .where(_OF_STYLE.c.surgeon_row == _DEMOS.c.surgeon_row, _OF_STYLE.c.suture == _DEMOS.c.suture)
    .scalar_subquery()
    .label("last"),
).where(_DEMOS.c.row.in_(bindparam("demonstrations", expanding=True)))
KNOWN = select(_VERSIONS.c.sha256, _VERSIONS.c.row, _VERSIONS.c.version).where(
    _VERSIONS.c.sha256.in_(bindparam("digests", expanding=True))
)
ADD = insert(_VERSIONS).returning(_VERSIONS.c.sha256, _VERSIONS.c.row, _VERSIONS.c.version)
CERTIFICATE_NOTE = (
    "Checked on the grid: every greedy action against exact dynamic programming, and every start by following it; "
    "the demonstrated pass against the arm's joint limits in closed form. It says nothing about the arm's accuracy. "
    "Research use only."
)


def request_training(
    session: Session,
    surgeon: str,
    suture: str,
    actor: str,
    *,
    demos: list[str] | None = None,
    combine: Combining | None = None,
    learner: Learner | None = None,
    seed: int = 0,
    release: bool = False,
) -> tuple[Job, bool]:
    """Ask for a style to be trained, all defaults resolved: the job, and whether it is a new one.

    Several demonstrations are combined, in whatever order they are named.

    Raises:
        NotFound: The surgeon, the suture type or a demonstration is unknown.
        Conflict: There is no active demonstration, or the surgeon's consent does not cover training.
        BadInput: A demonstration of another style, one named twice, too many, or several that cannot be combined.
        BadSettings: Learning it would need too much memory.
        LearnerNotInstalled: The learner needs what is not installed here.
    """
    require_installed(learner := learner or PhaseQLearning())
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    check_consent(who, "training")
    chosen = choose_demos(session, who, what.slug, demos)
    refuse_too_large(chosen[-1].path, learner)
    request = {
        "surgeon": who.slug,
        "suture": what.slug,
        "demos": [demo.sha256 for demo in chosen],
        "learner": describe_learner(learner),
        "learner_version": LEARNER_VERSION,
        "seed": seed,
        "release": release,
    }
    if len(chosen) > 1:  # of one alone it is left out, so that an equal training is still known as it always was
        request["combine"] = {"kind": (combine or BEST).kind}
    elif combine is not None:
        raise BadInput("One demonstration is followed as it is; name several in `demos`, or leave `combine` out.")
    return jobs.ask(session, "training", request, who, actor)


def describe_learner(learner: Learner) -> dict[str, Any]:
    """Write a learner as JSON: its kind and its settings."""
    return {"kind": learner.kind, **asdict(learner)}


def learner_of(described: dict[str, Any]) -> Learner:
    """Read a learner back from JSON."""
    settings = dict(described)
    kind = settings.pop("kind", None)
    if kind not in LEARNERS:
        raise BadSettings(f"There is no learner of this kind; there are {', '.join(LEARNERS)}.")
    return LEARNERS[kind](**settings)


@dataclass(frozen=True, eq=False)
class Lesson:
    """A demonstration as it is learnt from, its values still packed, and whose it is.

    Where several were combined it is the one whose place their way has; `others` are the rows of the rest, and
    `combined` is what is told of it.
    """

    row: int
    sha256: str
    surgeon: Surgeon
    suture: str
    demo: bytes
    reward: bytes
    others: tuple[int, ...] = ()
    combined: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Learnt:
    """A policy that was learnt and certified, packed already, so that no transaction has to wait for that."""

    lesson: Lesson
    training: str
    sha256: str
    manifest: dict[str, Any]
    policy: bytes
    coverage: bytes


class Stored(NamedTuple):
    """Where a policy version stands."""

    row: int
    version: int


def train_style(database: Database, request: dict[str, Any], settings: Settings) -> Store:
    """Learn, certify and measure what was asked for; the returned function stores it."""
    with database.reading() as session:
        found = lessons(session, [find_demo(session, one).row for one in request["demos"]])
    lesson = combined_lesson(found, combining_of(request["combine"])) if "combine" in request else found[0]
    learnt = learn_style(lesson, request, settings, _telling(database, request))

    def store(session: Session, actor: str) -> dict[str, Any]:
        version = session.get_one(PolicyVersion, store_style(session, learnt).row)
        released, kept_back = False, None
        if request["release"]:
            try:
                releases.release(session, version, actor)
                released = True
            except Conflict as refused:
                kept_back = str(refused)
        return {
            "policy_version": version.version,
            "sha256": version.sha256,
            "releasable": version.releasable,
            "released": released,
            "not_released_because": kept_back,
        }

    return store


def _telling(database: Database, request: dict[str, Any]) -> Tell:
    """Write down how far a training has come; raises `Conflict` where nobody waits for it any more."""
    mine = (Job.identity == jobs.identity_of("training", request), Job.state == "running")

    def tell(share: float) -> None:
        with database.writing() as session:
            running = update(Job).where(*mine).values(progress=share).returning(Job.row)
            if session.execute(running).first() is None:
                raise Conflict("The training was cancelled while it was being learnt.")

    return tell


def lessons(session: Session, demonstrations: Sequence[int]) -> list[Lesson]:
    """Read what is learnt from, in the order of the rows."""
    of = Demonstration
    packed = type_coerce(of.demo, LargeBinary), type_coerce(StoredRewardMap.map, LargeBinary)
    query = (
        select(of.row, of.sha256, Surgeon, of.suture, *packed)
        .join(Surgeon, Surgeon.row == of.surgeon_row)
        .join(StoredRewardMap, StoredRewardMap.demonstration_row == of.row)
        .where(of.row.in_(demonstrations))
    )
    return [Lesson(*row) for row in session.execute(query.order_by(of.row))]


def combined_lesson(lessons: Sequence[Lesson], how: Combining) -> Lesson:
    """Combine lessons of one style, the oldest first, into one.

    Raises:
        Corrupt: A demonstration is not what was stored.
        BadPath: They cannot be laid on each other, or their way has no path in the grid.
    """
    rewards = [unpack_as(RewardMap, lesson.reward) for lesson in lessons]
    found = followed([unpack_as(Demo, one.demo) for one in lessons], [reward.path for reward in rewards], how)
    at = found.combined.at
    return replace(
        lessons[at],
        demo=seal(found.demo).packed,
        reward=seal(sparse_reward(found.path, rewards[at].levels)).packed,
        others=tuple(lesson.row for lesson in lessons if lesson is not lessons[at]),
        combined=describe_combined(found, how, [lesson.sha256 for lesson in lessons]),
    )


def learn_style(lesson: Lesson, request: dict[str, Any], settings: Settings, tell: Tell | None = None) -> Learnt:
    """Learn, certify and measure a style from a demonstration, as a training asks for it; no transaction is open.

    Raises:
        LearningFailed: The process of a learner beyond the table crashed, or was not done within its limits.
        Conflict: The surgeon's consent does not cover it.
        Corrupt: The demonstration is not what was stored.
        BadSettings: It cannot be learnt with these settings.
    """
    check_consent(lesson.surgeon, "training")
    demo, reward = unpack_as(Demo, lesson.demo), unpack_as(RewardMap, lesson.reward)
    policy = learn_policy(
        reward,
        learner_of(request["learner"]),
        request["seed"],
        tell=tell,
        timeout_s=settings.learning_timeout_s,
        memory_bytes=settings.learning_memory_bytes,
    )
    return certified(lesson, request, demo, policy)


def certified(lesson: Lesson, request: dict[str, Any], demo: Demo, policy: Policy) -> Learnt:
    """Certify and measure a policy that was learnt from a demonstration, and pack all of it."""
    certificate, covered = certify(policy)
    numbers, coverage = seal(policy), seal(covered)
    refused_because = refusals(policy, certificate, demo)
    manifest = describe_policy(policy, certificate, coverage.digest, demo, request, refused_because)
    if lesson.combined is not None:  # without it a digest is what it always was
        manifest["combined"] = lesson.combined
    return Learnt(
        lesson=lesson,
        training=sha256(canonical(request)),
        sha256=policy_identity_of(manifest, numbers.digest),
        manifest=manifest,
        policy=numbers.packed,
        coverage=coverage.packed,
    )


def store_style(session: Session, learnt: Learnt) -> Stored:
    """Store what was learnt as the next version of its style, once.

    Raises:
        NotFound: A demonstration was erased meanwhile.
        Conflict: One was withdrawn meanwhile.
    """
    (stored,) = store_styles(session, [learnt])
    if isinstance(stored, SkillsError):
        raise stored
    return stored


def store_styles(session: Session, learnt: Sequence[Learnt]) -> list[Stored | SkillsError]:
    """Store what was learnt of several styles, no two of one style, as `store_style` does: or why one is not stored."""
    standing = {one.row: one for one in session.execute(STANDING, {"demonstrations": [o.lesson.row for o in learnt]})}
    known = _stored(session.execute(KNOWN, {"digests": [one.sha256 for one in learnt]}))
    refused = {
        one.sha256: _refusal(session, one.lesson, standing.get(one.lesson.row))
        for one in learnt
        if one.sha256 not in known
    }
    new = [one for one in learnt if one.sha256 in refused and refused[one.sha256] is None]
    if new:
        values = [_version(one, (standing[one.lesson.row].last or 0) + 1) for one in new]
        known |= _stored(session.execute(ADD, values))
        record_each(session, "worker", "train", "policy-version", [(one.sha256, one.lesson.surgeon) for one in new])
    rests_on = [
        {"policy_row": known[one.sha256].row, "demonstration_row": other} for one in new for other in one.lesson.others
    ]
    if rests_on:
        session.execute(insert(PolicyDemonstration), rests_on)
    return [refused.get(one.sha256) or known[one.sha256] for one in learnt]


def _stored(found: Result[Any]) -> dict[str, Stored]:
    return {one.sha256: Stored(one.row, one.version) for one in found}


def _refusal(session: Session, lesson: Lesson, standing: Any) -> SkillsError | None:
    """Say why what was learnt may not be stored: a demonstration that it rests on has gone meanwhile."""
    others = [session.get(Demonstration, row) for row in lesson.others]
    if standing is None or None in others:
        return NotFound("A demonstration was erased while it was being learnt from.")
    if any(one.withdrawn_at is not None for one in (standing, *others)):
        return Conflict("A demonstration was withdrawn while it was being learnt from.")
    return None


def _version(learnt: Learnt, version: int) -> dict[str, Any]:
    """Write what was learnt as a row."""
    return {
        "sha256": learnt.sha256,
        "training": learnt.training,
        "surgeon_row": learnt.lesson.surgeon.row,
        "suture": learnt.lesson.suture,
        "version": version,
        "demonstration_row": learnt.lesson.row,
        "manifest": learnt.manifest,
        "releasable": not learnt.manifest["grid_certificate"]["refused_because"],
        "learnt": learnt.policy,
        "covered": learnt.coverage,
    }


def refusals(policy: Policy, certificate: Certificate, demo: Demo) -> list[str]:
    """List why a policy may not be released: the gate of interface.md, written so that NaN fails."""
    reasons = []
    if not certificate.every_action_optimal:
        reasons.append(f"{certificate.suboptimal} of {certificate.checked} greedy actions are not optimal")
    if certificate.starts_reaching < certificate.starts:
        missing = certificate.starts - certificate.starts_reaching
        reasons.append(f"{missing} of {certificate.starts} starts do not reach the goal")
    if policy.learner.phased and not certificate.demonstration_reproduced:
        reasons.append("the rollout from the demonstrated start is not the demonstration")
    if not demo.frame.endswith("_base"):
        reasons.append(f"the frame '{demo.frame}' is not the arm's base, so its joint limits cannot be checked")
    else:
        rotation = rotation_of(demo.rotation_xyzw)
        within = reachable(policy.path.tip_mm, POINTING_DOWN if rotation is None else rotation, demo.instrument)
        if not within.all():
            out = int((~within).sum())
            reasons.append(f"{out} of {len(within)} places of the demonstrated pass are outside the joint limits")
    return reasons


def describe_policy(
    policy: Policy,
    certificate: Certificate,
    coverage_sha256: str,
    demo: Demo,
    request: dict[str, Any],
    refused_because: list[str],
) -> dict[str, Any]:
    """Write what a client is told of a policy (interface.md), but for its version, digest, release and arrays."""
    path, grid = policy.path, policy.path.grid
    wandered = check_in_space(policy)
    lost_mm = discretisation_rmse(demo.tip_mm, grid, path.hysteresis)
    metrics = measure(policy.replay, lost_mm)
    return {
        "surgeon": request["surgeon"],
        "suture": request["suture"],
        "arm": demo.arm,
        "frame": demo.frame,
        "instrument": demo.instrument,
        "grid": describe_grid(policy),
        "start_mm": path.tip_mm[0].tolist(),
        "goal_mm": path.tip_mm[-1].tolist(),
        "waypoints": path.states.tolist(),
        "phases": policy.domain.phases,
        "learner": policy.learner.kind,
        "learner_version": request["learner_version"],
        "settings": _said(policy.learner),
        "reward_levels": _said(policy.levels),
        "seed": policy.seed,
        "demos": request["demos"],
        "training": _said(policy.training),
        "metrics": _said(metrics),
        "coverage": {
            "starts_reaching_goal": certificate.starts_reaching,
            "starts_joining_nearest": certificate.starts_joining_nearest,
            "n_states": certificate.starts,
            "sha256": coverage_sha256,
        },
        "grid_certificate": {
            "states_checked": certificate.checked,
            "states_finishing": certificate.finishing,
            "suboptimal_actions": certificate.suboptimal,
            "demonstration_reproduced": certificate.demonstration_reproduced,
            "refused_because": refused_because,
            "note": CERTIFICATE_NOTE,
        },
        **({} if wandered is None else {"rollouts": asdict(wandered)}),  # without it a digest is what it always was
    }


def describe_grid(policy: Policy) -> dict[str, Any]:
    """Write a policy's grid world."""
    grid = policy.path.grid
    return {"origin_mm": list(grid.origin_mm), "cell_mm": grid.cell_mm, "shape": list(grid.shape)}


def _said(of: Learner | RewardLevels | Training | Metrics) -> dict[str, Any]:
    """Write numbers by their names, tuples as lists, as they come back from the database."""
    named = ((field.name, getattr(of, field.name)) for field in fields(of))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in named}
