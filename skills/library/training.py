"""Training a style: from its demonstration to a certified policy version, and to its release if that was asked."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, Job, PolicyVersion, StoredRewardMap
from skills.db.packed import digest
from skills.db.session import Database
from skills.errors import BadInput, BadSettings, Conflict
from skills.library import jobs, releases
from skills.library.catalogue import check_consent, find_surgeon, find_suture_type
from skills.library.demos import find_demo, newest_demo
from skills.library.events import record
from skills.library.verified import policy_identity
from skills.packing import canonical, sha256
from skills.settings import Settings
from skills.style.certificate import Certificate, Coverage, certify
from skills.style.demo import Demo
from skills.style.evaluation import discretisation_rmse, measure
from skills.style.kinematics import POINTING_DOWN, reachable
from skills.style.learning.learners import LEARNER_VERSION, LEARNERS, Learner, refuse_too_large
from skills.style.learning.q_learning import PhaseQLearning
from skills.style.plan import rotation_of
from skills.style.policy import Policy, learn_policy, rollout_from

Store = Callable[[Session, str], dict[str, Any]]
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


def train_style(database: Database, request: dict[str, Any], _settings: Settings) -> Store:
    """Learn, certify and measure what was asked for; the returned function stores it."""
    with database.reading() as session:
        demonstration = find_demo(session, request["demos"][0])
        stored = select(StoredRewardMap).where(StoredRewardMap.demonstration_row == demonstration.row)
        reward, demo = session.scalars(stored).one().map, demonstration.demo
    policy = learn_policy(reward, learner_of(request["learner"]), request["seed"])
    certificate, covered = certify(policy)
    reasons = refusals(policy, certificate, demo)
    manifest = describe_policy(policy, certificate, covered, demo, request, reasons)
    identity = policy_identity(manifest, policy)

    def store(session: Session, actor: str) -> dict[str, Any]:
        demonstration = find_demo(session, request["demos"][0])
        version = _store(session, demonstration, policy, covered, manifest, identity, request)
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


def _store(
    session: Session,
    demonstration: Demonstration,
    policy: Policy,
    covered: Coverage,
    manifest: dict[str, Any],
    identity: str,
    request: dict[str, Any],
) -> PolicyVersion:
    known = session.scalar(select(PolicyVersion).where(PolicyVersion.sha256 == identity))
    if known is not None:
        return known
    if demonstration.withdrawn_at is not None:
        raise Conflict("The demonstration was withdrawn while it was being learnt.")
    style = (PolicyVersion.surgeon_row == demonstration.surgeon_row, PolicyVersion.suture == demonstration.suture)
    last = session.scalar(select(func.max(PolicyVersion.version)).where(*style)) or 0
    version = PolicyVersion(
        sha256=identity,
        training=sha256(canonical(request)),
        surgeon=demonstration.surgeon,
        suture=demonstration.suture,
        version=last + 1,
        demonstration=demonstration,
        manifest=manifest,
        releasable=not manifest["grid_certificate"]["refused_because"],
        learnt=policy,
        covered=covered,
    )
    session.add(version)
    record(session, "worker", "train", "policy-version", identity, demonstration.surgeon)
    session.flush()
    return version


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
        rotations = [POINTING_DOWN if rotation is None else rotation] * len(policy.path.states)
        within = reachable(policy.path.tip_mm, rotations, demo.instrument)
        if not within.all():
            out = int((~within).sum())
            reasons.append(f"{out} of {len(within)} places of the demonstrated pass are outside the joint limits")
    return reasons


def describe_policy(
    policy: Policy,
    certificate: Certificate,
    covered: Coverage,
    demo: Demo,
    request: dict[str, Any],
    refused_because: list[str],
) -> dict[str, Any]:
    """Write what a client is told of a policy (interface.md), but for its version, digest, release and arrays."""
    path, grid = policy.path, policy.path.grid
    lost_mm = discretisation_rmse(demo.tip_mm, grid, path.hysteresis)
    metrics = asdict(measure(rollout_from(policy, path.start), lost_mm))
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
        "settings": asdict(policy.learner),
        "reward_levels": asdict(policy.levels),
        "seed": policy.seed,
        "demos": request["demos"],
        "training": asdict(policy.training),
        "metrics": _lists(metrics),
        "coverage": {
            "starts_reaching_goal": certificate.starts_reaching,
            "starts_joining_nearest": certificate.starts_joining_nearest,
            "n_states": certificate.starts,
            "sha256": digest(covered),
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


def _lists(of: dict[str, Any]) -> dict[str, Any]:
    """Write tuples as lists, as they come back from the database."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in of.items()}
