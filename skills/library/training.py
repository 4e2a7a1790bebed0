"""Training a style: from its demonstration to a certified policy version, and to its release if that was asked."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple, cast

from sqlalchemy import LargeBinary, Table, bindparam, func, insert, select, type_coerce
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, Job, PolicyVersion, StoredRewardMap, Surgeon
from skills.db.packed import seal, unpack_as
from skills.db.session import Database
from skills.errors import BadInput, BadSettings, Conflict, NotFound
from skills.library import jobs, releases
from skills.library.catalogue import check_consent, find_surgeon, find_suture_type
from skills.library.demos import find_demo, newest_demo
from skills.library.events import record
from skills.library.verified import policy_identity_of
from skills.packing import canonical, sha256
from skills.settings import Settings
from skills.style.certificate import Certificate, certify
from skills.style.demo import Demo
from skills.style.evaluation import Metrics, discretisation_rmse, measure
from skills.style.kinematics import POINTING_DOWN, reachable
from skills.style.learning.learners import LEARNER_VERSION, LEARNERS, Learner, refuse_too_large
from skills.style.learning.q_learning import PhaseQLearning, Training
from skills.style.plan import rotation_of
from skills.style.policy import Policy, learn_policy
from skills.style.reward import RewardLevels, RewardMap

Store = Callable[[Session, str], dict[str, Any]]

# Statements that every style goes through, built once: to build one takes as long as to run it.
_VERSIONS, _DEMOS = (cast(Table, one.__table__) for one in (PolicyVersion, Demonstration))
_OF_STYLE = _VERSIONS.alias("of_style")
STANDING = (
    select(
        _DEMOS.c.withdrawn_at,
        select(func.max(_OF_STYLE.c.version))
        .where(_OF_STYLE.c.surgeon_row == _DEMOS.c.surgeon_row, _OF_STYLE.c.suture == _DEMOS.c.suture)
        .scalar_subquery(),
        _VERSIONS.c.row,
        _VERSIONS.c.version,
    )
    .select_from(_DEMOS.outerjoin(_VERSIONS, _VERSIONS.c.sha256 == bindparam("sha256")))
    .where(_DEMOS.c.row == bindparam("demonstration"))
)
ADD = insert(_VERSIONS).returning(_VERSIONS.c.row, _VERSIONS.c.version)
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
    learner: Learner | None = None,
    seed: int = 0,
    release: bool = False,
) -> tuple[Job, bool]:
    """Ask for a style to be trained, all defaults resolved: the job, and whether it is a new one.

    Raises:
        NotFound: The surgeon, the suture type or the demonstration is unknown.
        Conflict: There is no active demonstration, or the surgeon's consent does not cover training.
        BadInput: More than one demonstration, or one of another style.
        BadSettings: Learning it would need too much memory.
    """
    who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
    check_consent(who, "training")
    if demos is not None and len(demos) != 1:
        raise BadInput("A policy is learnt from exactly one demonstration; name one, or none for the newest.")
    demo = find_demo(session, demos[0]) if demos else newest_demo(session, who.row, what.slug)
    if demo is None:
        raise Conflict(f"'{surgeon}' has no active demonstration of '{suture}'; POST /demos adds one.")
    if (demo.surgeon_row, demo.suture) != (who.row, what.slug):
        raise BadInput("The demonstration belongs to another style.")
    if demo.withdrawn_at is not None:
        raise Conflict("The demonstration was withdrawn.")
    learner = learner or PhaseQLearning()
    refuse_too_large(demo.path, learner)
    request = {
        "surgeon": who.slug,
        "suture": what.slug,
        "demos": [demo.sha256],
        "learner": describe_learner(learner),
        "learner_version": LEARNER_VERSION,
        "seed": seed,
        "release": release,
    }
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
    """A demonstration as it is learnt from, its values still packed, and whose it is."""

    row: int
    sha256: str
    surgeon: Surgeon
    suture: str
    demo: bytes
    reward: bytes


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


def train_style(database: Database, request: dict[str, Any], _settings: Settings) -> Store:
    """Learn, certify and measure what was asked for; the returned function stores it."""
    with database.reading() as session:
        (lesson,) = lessons(session, [find_demo(session, request["demos"][0]).row])
    learnt = learn_style(lesson, request)

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


def learn_style(lesson: Lesson, request: dict[str, Any]) -> Learnt:
    """Learn, certify and measure a style from a demonstration, as a training asks for it; no transaction is open.

    Raises:
        Conflict: The surgeon's consent does not cover it.
        Corrupt: The demonstration is not what was stored.
        BadSettings: It cannot be learnt with these settings.
    """
    check_consent(lesson.surgeon, "training")
    demo, reward = unpack_as(Demo, lesson.demo), unpack_as(RewardMap, lesson.reward)
    policy = learn_policy(reward, learner_of(request["learner"]), request["seed"])
    certificate, covered = certify(policy)
    numbers, coverage = seal(policy), seal(covered)
    refused_because = refusals(policy, certificate, demo)
    manifest = describe_policy(policy, certificate, coverage.digest, demo, request, refused_because)
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
        NotFound: The demonstration was erased meanwhile.
        Conflict: It was withdrawn meanwhile.
    """
    lesson = learnt.lesson
    found = session.execute(STANDING, {"demonstration": lesson.row, "sha256": learnt.sha256}).first()
    if found is None:
        raise NotFound("The demonstration was erased while it was being learnt.")
    withdrawn_at, last, *known = found
    if known[0] is not None:
        return Stored(*known)
    if withdrawn_at is not None:
        raise Conflict("The demonstration was withdrawn while it was being learnt.")
    values = {
        "sha256": learnt.sha256,
        "training": learnt.training,
        "surgeon_row": lesson.surgeon.row,
        "suture": lesson.suture,
        "version": (last or 0) + 1,
        "demonstration_row": lesson.row,
        "manifest": learnt.manifest,
        "releasable": not learnt.manifest["grid_certificate"]["refused_because"],
        "learnt": learnt.policy,
        "covered": learnt.coverage,
    }
    stored = session.execute(ADD, values).one()
    record(session, "worker", "train", "policy-version", learnt.sha256, lesson.surgeon)
    return Stored(*stored)


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
    }


def describe_grid(policy: Policy) -> dict[str, Any]:
    """Write a policy's grid world."""
    grid = policy.path.grid
    return {"origin_mm": list(grid.origin_mm), "cell_mm": grid.cell_mm, "shape": list(grid.shape)}


def _said(of: Learner | RewardLevels | Training | Metrics) -> dict[str, Any]:
    """Write numbers by their names, tuples as lists, as they come back from the database."""
    named = ((field.name, getattr(of, field.name)) for field in fields(of))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in named}
