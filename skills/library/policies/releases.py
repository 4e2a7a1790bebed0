"""Releases: the served version of a style, the release gate, and the results of jobs in terms of it.

A policy version is released, superseded by a later release, or withdrawn. The newest release of a style that is not
withdrawn is served, for as long as the surgeon's consent covers training. A withdrawal never lets an older release come
back by itself: the releases that the newest one superseded are withdrawn with it, so that nothing is served until
somebody releases again.

"Not worse" compares two policies of a style on the same demonstrations, because a policy measured against its own
demonstration alone is always near. These are all active demonstrations from which either was learnt: dynamic time
warping of each policy's path from its demonstrated start with every demonstration's path in its grid, in mm, and the
sum over the demonstrations.

A job's row stores the effect of the job: `released` in the result of a training, `now_released` in the comparison of a
batch's style. Another version may have been released since, or none may be served any more. So every response about a
job takes its result from here: `released` and `now_released` are the present state, `was_released` is the effect of the
job.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import groupby
from math import nan
from typing import Any

import numpy as np
from sqlalchemy import (
    ColumnElement,
    ScalarSelect,
    String,
    and_,
    bindparam,
    cast,
    exists,
    func,
    select,
    type_coerce,
)
from sqlalchemy.orm import Session, aliased

from skills.arrays import Floats
from skills.db import now, rfc3339
from skills.db.changes import announce
from skills.db.history import HISTORY
from skills.db.leaves import LEAVES
from skills.db.models import (
    Demonstration,
    PolicyVersion,
    Release,
    StoredPoses,
    Surgeon,
)
from skills.db.service_tables import Job, StyleToRetrain, record_event
from skills.demonstration.demonstration import Demo
from skills.errors import BadPlan, Conflict, NotFound
from skills.gridworld.grid import GridPath, GridWorld
from skills.kinematics import instrument_of
from skills.learning.certificate import (
    Certificate,
    NearOdds,
    NearStarts,
    least_gamma,
)
from skills.learning.dynamic_programming import FAINT
from skills.learning.evaluation import dtw
from skills.learning.policy import Policy
from skills.library.operation.history import refuse_edited
from skills.library.operation.integrity import learnt
from skills.library.people import consent
from skills.library.people.consent import refusal
from skills.planning.plan import CONSTANT_TURN_DEG, DrivenPass, departure_of, driven_pass
from skills.schemas.training import FitOnTheSame

ROUNDING_MM = 1e-6  # two sums of the same distances in different order differ by less


@dataclass(frozen=True, eq=False)
class Taught:
    """A demonstration that a policy may have been learnt from: its digest, its arm and frame, and its path."""

    sha256: str
    space: tuple[str, str]  # arm and frame; paths in different ones cannot be compared
    path: GridPath


@dataclass(frozen=True, eq=False)
class PolicyWay:
    """The path of a policy from its demonstrated start, shape (T, 3) in mm, with its arm and frame."""

    tip_mm: Floats
    space: tuple[str, str]


def not_worse(fit: FitOnTheSame) -> bool:
    """Return whether the trained policy is at least as near as the released one; false if they cannot be compared."""
    if fit.trained_mm is None or fit.released_mm is None:
        return False
    return fit.trained_mm <= fit.released_mm + ROUNDING_MM  # NaN is worse


def shown_mm(total_mm: float | None) -> str:
    """Return a DTW total in words."""
    return f"{nan if total_mm is None else total_mm:g}"


def fit_of(released: PolicyWay, trained: PolicyWay, demos: Sequence[Taught]) -> FitOnTheSame:
    """Measure two policies against the same demonstrations.

    Args:
        released: The path of the released policy.
        trained: The path of the new policy.
        demos: The demonstrations; the totals are None if there are none, or arms or frames differ.
    """
    one_space = {released.space, trained.space, *(demo.space for demo in demos)}
    return FitOnTheSame(
        tuple(demo.sha256 for demo in demos),
        *(_total_mm(way, demos) if len(one_space) == 1 and demos else None for way in (released, trained)),
    )


def _total_mm(way: PolicyWay, demos: Sequence[Taught]) -> float:
    return float(sum(dtw(way.tip_mm, demo.path.tip_mm).total_mm for demo in demos))


def way_of(manifest: Mapping[str, Any], policy: Callable[[], Policy]) -> PolicyWay:
    """Return the path of a policy from its demonstrated start.

    Args:
        manifest: The policy's manifest.
        policy: Loads the policy; called only if it does not reproduce its demonstration, because otherwise the manifest
            has the path.
    """
    space = manifest["arm"], manifest["frame"]
    if manifest["grid_certificate"]["demonstration_reproduced"] is not True:
        return PolicyWay(policy().replay.tip_mm, space)
    grid = GridWorld(
        tuple(manifest["grid"]["origin_mm"]), manifest["grid"]["cell_mm"], tuple(manifest["grid"]["shape"])
    )
    return PolicyWay(grid.centres_mm(np.array(manifest["waypoints"])), space)


def taught(session: Session, demonstrations: Collection[int]) -> dict[int, Taught]:
    """Return the active ones of some demonstrations, by row, the oldest first."""
    of = Demonstration
    query = select(of.row, of.sha256, of.arm, of.frame, of.path).where(of.row.in_(demonstrations))
    found = session.execute(query.where(of.withdrawn_at.is_(None)).order_by(of.row))
    return {row: Taught(sha256, (arm, frame), path) for row, sha256, arm, frame, path in found}


def fit_of_versions(session: Session, released: PolicyVersion, trained: PolicyVersion) -> FitOnTheSame:
    """Measure two stored versions of a style against the active demonstrations from which either was learnt."""
    rows = {one.row for version in (released, trained) for one in version.demonstrations}
    before, after = (way_of(one.manifest, partial(learnt, one)) for one in (released, trained))
    return fit_of(before, after, list(taught(session, rows).values()))


def _newest_leaf(table: type[Release | Surgeon]) -> ScalarSelect[Any]:
    of_row = (LEAVES.c.table_name == table.__tablename__, LEAVES.c.key == cast(table.row, String))
    return select(func.max(LEAVES.c.row)).where(*of_row).scalar_subquery()


# The newest release of a style that is not withdrawn, with columns that identify it for ever: row numbers are reused
# after an erasure. It is served if the surgeon's consent, returned as text, covers training. A pose style may be added
# to its version later. The newest leaves show that the service changed a row, although somebody changed it back.
STANDS = (
    select(
        Release.row,
        type_coerce(Release.released_at, String).label("released_at"),
        consent.AS_TEXT.label("consent"),
        StoredPoses.sha256.label("poses"),
        _newest_leaf(Release),
        _newest_leaf(Surgeon),
        PolicyVersion.sha256,
    )
    .join(Surgeon, Surgeon.row == Release.surgeon_row)
    .join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    .outerjoin(StoredPoses, StoredPoses.policy_row == Release.policy_row)
    .where(Surgeon.slug == bindparam("surgeon"), Release.suture == bindparam("suture"))
    .where(Release.withdrawn_at.is_(None))
    .order_by(Release.row.desc())
    .limit(1)
)
# Remedies by words in the reason for which a version is not released; the first match counts.
_OTHERWISE = "Train it with other settings or another learner, or record the hand-off again."
_REMEDIES = (
    ("consent", "Record a consent of the surgeon that covers training, then request the release again."),
    ("demonstration was withdrawn", "Train from a demonstration that is active, and request its release."),
    (
        "demonstration was marked",
        "Train from another demonstration, or with outcomes 'any' from this one, and request the release.",
    ),
    ("was released", "Request the release again if this version is to be served in its place."),
    ("was withdrawn.", "Request the release again if this version is to be served."),
    ("is worse than", "Release it by its number if it is to replace the released version anyway."),
    (
        "too small to be learnt",
        "Train it with a gamma nearer to 1, or lay the demonstration on larger cells.",
    ),
    ("not optimal", _OTHERWISE),
    ("do not reach the goal", _OTHERWISE),
    (
        "touches the scene",
        "Train it with value-iteration or a smaller slip, or record the hand-off further from the scene; the limits "
        "are SKILLS_SCENE_LEAST_FINISHING and SKILLS_SCENE_MOST_TOUCHING.",
    ),
    ("not the arm's base", "Record the arm's local/measured_cp, which is in its base, or its measured_js."),
    ("joint limits", "Record the hand-off further inside the arm's reach, or with the arm's base elsewhere."),
)


def remedy(reason: str) -> str:
    """Return the remedy for a reason for which a version is not released."""
    return next((remedy for words, remedy in _REMEDIES if words in reason), _OTHERWISE)


def standing(session: Session, surgeon_row: int, suture: str) -> Sequence[Release]:
    """List a style's releases that are not withdrawn, the newest first.

    That one is served, if consent covers training.
    """
    return session.scalars(
        select(Release)
        .where(Release.surgeon_row == surgeon_row, Release.suture == suture, Release.withdrawn_at.is_(None))
        .order_by(Release.row.desc())
    ).all()


def served(session: Session, surgeon: Surgeon, suture: str) -> Release | None:
    """Return the release that a style serves today; None if there is none or consent does not cover training."""
    releases = standing(session, surgeon.row, suture)
    return releases[0] if releases and consent.may(surgeon, "training") else None


def refuse_edited_release(session: Session, release: Release) -> None:
    """Refuse to serve a release if it, a later one of its style, its policy or its surgeon was not written by us.

    Raises:
        Corrupt: One of these rows is not as the history has it.
    """
    of_style = (Release.surgeon_row == release.surgeon_row, Release.suture == release.suture)
    releases = session.scalars(select(Release.row).where(*of_style, Release.row >= release.row)).all()
    decide = {"releases": releases, "policy_versions": [release.policy_row], "surgeons": [release.surgeon_row]}
    for table, rows in decide.items():
        refuse_edited(session.connection(), session.info[HISTORY], table, [str(row) for row in rows])


def serves(session: Session, policy: PolicyVersion) -> bool:
    """Return whether a policy version is the one that its style serves."""
    now = served(session, policy.surgeon, policy.suture)
    return now is not None and now.policy_row == policy.row


def shares_served(session: Session, suture: str) -> dict[str, float]:
    """Return the mean share of the demonstration that the starts of each served policy follow, by surgeon."""
    share = PolicyVersion.manifest["coverage", "mean_share"]
    query = select(Surgeon.slug, share).select_from(Release).join(Surgeon, Surgeon.row == Release.surgeon_row)
    query = query.join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    found = session.execute(query.where(Release.suture == suture, is_served()))
    return {surgeon: float(mean) for surgeon, mean in found}


def is_served() -> ColumnElement[bool]:
    """Return a condition on `Release`: its style serves it today; build it anew for each query (it has the date)."""
    later = aliased(Release)
    superseded = exists().where(
        later.surgeon_row == Release.surgeon_row,
        later.suture == Release.suture,
        later.row > Release.row,
        later.withdrawn_at.is_(None),
    )
    # A scalar and not `exists`: PostgreSQL turns that into a join, and then sorts rows that an index returns in order.
    agreed = select(consent.covered("training")).where(Surgeon.row == Release.surgeon_row).correlate(Release)
    return and_(Release.withdrawn_at.is_(None), ~superseded.correlate(Release), agreed.scalar_subquery())


def release(
    session: Session, policy: PolicyVersion, actor: str, *, constant_turn_deg: float = CONSTANT_TURN_DEG
) -> Release:
    """Release a policy version if it passes the gate; releasing the served version again changes nothing.

    Args:
        session: The caller's transaction.
        policy: The version.
        actor: The user who releases it.
        constant_turn_deg: The turn of the demonstration beyond which the joint limits must have been checked with it.

    Raises:
        Conflict: It does not pass, with the reasons; its demonstration was withdrawn, or marked recovery or failure; or
            the surgeon's consent does not cover training.
        Corrupt: The stored policy does not match its digest.
    """
    consent.require(policy.surgeon, "training")
    learnt(policy)
    served = standing(session, policy.surgeon_row, policy.suture)
    if served and served[0].policy_row == policy.row:
        return served[0]
    reasons = list(policy.manifest["grid_certificate"]["refused_because"])
    reasons += [f"its demonstration {what}" for what in policy.objections]
    reasons += _held(policy, constant_turn_deg)
    # Only phased policies have to reproduce their demonstration; one of the cell state must at least not be worse.
    if policy.manifest["phases"] == 1 and served:
        found = fit_of_versions(session, served[0].policy, policy)
        if not not_worse(found):
            trained, before = shown_mm(found.trained_mm), shown_mm(found.released_mm)
            reasons.append(
                "it follows the demonstrations worse than the released one "
                f"({trained} against {before} mm on the same {len(found.demos)})"
            )
    if reasons or not policy.releasable:
        raise Conflict(f"Version {policy.version} cannot be released: {'; '.join(reasons)}.", reasons=reasons)
    released = Release(policy=policy, surgeon_row=policy.surgeon_row, suture=policy.suture, released_by=actor)
    session.add(released)
    record_event(session, actor, "release", "policy-version", policy.sha256, policy.surgeon)
    session.flush()
    announce(session)
    return released


def _held(policy: PolicyVersion, constant_turn_deg: float) -> list[str]:
    """Return the reason against a version whose joint limits were checked with the jaw held, though it was turned."""
    driven = policy.manifest["grid_certificate"]["driven"]
    if driven is None or driven["orientation"] == "recorded":
        return []
    found = [departure_of(one.demo) for one in policy.demonstrations]
    turn_deg = max((one.deg for one in found if one is not None), default=0.0)
    if turn_deg <= constant_turn_deg:
        return []
    return [
        f"its joint limits were checked with the jaw held, but its demonstration turns by {turn_deg:.1f} degrees, over "
        f"{constant_turn_deg:g}, and a plan turns too; train it again"
    ]


def withdraw(session: Session, surgeon: Surgeon, suture: str, actor: str) -> list[Release]:
    """Withdraw all releases of a style, so that nothing is served until somebody releases again; return them.

    Raises:
        NotFound: Nothing of the style is released.
    """
    releases = list(standing(session, surgeon.row, suture))
    if not releases:
        raise NotFound(f"No policy of '{surgeon.slug}' and '{suture}' is released.")
    _withdraw(session, releases, actor)
    return releases


def withdraw_all(session: Session, surgeon: Surgeon, actor: str) -> list[Release]:
    """Withdraw all releases of all styles of a surgeon, and return them."""
    mine = select(Release).where(Release.surgeon_row == surgeon.row, Release.withdrawn_at.is_(None))
    releases = list(session.scalars(mine.order_by(Release.row)))
    _withdraw(session, releases, actor)
    return releases


def withdraw_resting_on(session: Session, demonstration: Demonstration, actor: str) -> list[Release]:
    """Withdraw the releases learnt from a demonstration; if the served one is among them, all of the style."""
    releases = standing(session, demonstration.surgeon_row, demonstration.suture)
    withdrawn = _with_superseded(releases, [r for r in releases if demonstration in r.policy.demonstrations])
    _withdraw(session, withdrawn, actor)
    return withdrawn


def withdraw_failed(session: Session, demonstration: Demonstration, actor: str) -> None:
    """Withdraw, as `withdraw_resting_on`, releases learnt from a demonstration that is marked recovery or failure.

    Those of versions that were trained from any outcome stay, unless they were superseded by one that is withdrawn.
    """
    releases = standing(session, demonstration.surgeon_row, demonstration.suture)
    resting = [one for one in releases if demonstration in one.policy.demonstrations]
    failed = [one for one in resting if not one.policy.of_any_outcome]
    _withdraw(session, _with_superseded(releases, failed), actor)


def withdraw_policies(session: Session, ended: Mapping[str, datetime], actor: str) -> None:
    """Withdraw releases of policies that ended later; if a served one is among them, all releases of its style.

    Args:
        session: The caller's transaction.
        ended: By the policy's SHA-256, the moment of its end; a release after that moment stays.
        actor: The actor of the events.
    """
    query = select(Release, PolicyVersion.sha256).join(PolicyVersion, PolicyVersion.row == Release.policy_row)
    query = query.where(Release.withdrawn_at.is_(None))
    query = query.order_by(Release.surgeon_row, Release.suture, Release.row.desc())
    withdrawn: list[Release] = []
    for _, style in groupby(session.execute(query), key=lambda one: (one[0].surgeon_row, one[0].suture)):
        named = [(one, policy) for one, policy in style]
        ending = [one for one, policy in named if policy in ended and one.released_at <= ended[policy]]
        withdrawn += _with_superseded([one for one, _ in named], ending)
    _withdraw(session, withdrawn, actor)


def _with_superseded(releases: Sequence[Release], ending: list[Release]) -> list[Release]:
    """Return the ending releases, or all releases of the style if the served one is among them, the newest first."""
    return list(releases) if releases and releases[0] in ending else ending


def _withdraw(session: Session, releases: Sequence[Release], actor: str) -> None:
    for one in releases:
        one.withdrawn_at = now()
        record_event(session, actor, "withdraw", "policy-version", one.policy.sha256, one.policy.surgeon)
    session.flush()
    announce(session)


TRAINING = "training"
Style = tuple[int, str]  # a surgeon's row and a suture type's slug


@dataclass(frozen=True)
class Outcome:
    """The result of a job or of a style of a batch as the API returns it, and the policy version that is served now."""

    served: dict[str, Any] | None
    result: dict[str, Any] | None


def outcomes_of(session: Session, jobs: Sequence[Job]) -> dict[int, Outcome]:
    """Return the outcomes of jobs of any kind, by row; only trainings serve a style."""
    trainings: dict[int, Style] = {
        job.row: (job.surgeon_row, job.request["suture"])
        for job in jobs
        if job.kind == TRAINING and job.surgeon_row is not None
    }
    served = served_by(session, trainings.values())
    refused = _refused(session, {surgeon for surgeon, _ in trainings.values()})
    return {job.row: _outcome(job, trainings.get(job.row), served, refused) for job in jobs}


def outcomes_of_styles(session: Session, styles: Sequence[StyleToRetrain]) -> dict[int, Outcome]:
    """Return the outcomes of styles of a batch, by row: the result is the comparison with the released version."""
    keys = {one.row: (one.demonstration.surgeon_row, one.demonstration.suture) for one in styles}
    served = served_by(session, keys.values())
    refused = _refused(session, {surgeon for surgeon, _ in keys.values()})
    told = {}
    for one in styles:
        now, result = served.get(keys[one.row]), one.comparison
        if result is not None and one.policy is not None:
            was = {"was_released": result["now_released"]}
            asked = result["now_released"] or result["not_released_because"] is not None
            released, because = _standing(one.policy.sha256, now, refused.get(keys[one.row][0]), asked, result)
            result = result | was | {"now_released": released} | because
        told[one.row] = Outcome(now, result)
    return told


def served_by(session: Session, styles: Collection[Style]) -> dict[Style, dict[str, Any]]:
    """Return the versions that some styles serve, with one statement; styles that serve nothing are left out."""
    if not styles:
        return {}
    by = PolicyVersion
    query = select(Release.surgeon_row, Release.suture, Release.released_at, by.version, by.sha256).join(
        by, by.row == Release.policy_row
    )
    mine = Release.surgeon_row.in_({surgeon for surgeon, _ in styles}), Release.suture.in_({name for _, name in styles})
    return {
        (surgeon, suture): {"version": version, "sha256": sha256, "released_at": rfc3339(at)}
        for surgeon, suture, at, version, sha256 in session.execute(query.where(*mine, is_served()))
    }


def _refused(session: Session, surgeons: Collection[int]) -> dict[int, str]:
    """Return, by row, why surgeons' consent does not cover training; surgeons whose consent does are left out."""
    if not surgeons:
        return {}
    found = session.scalars(select(Surgeon).where(Surgeon.row.in_(surgeons)))
    return {one.row: str(why) for one in found if (why := refusal(one, "training")) is not None}


def _outcome(job: Job, style: Style | None, served: dict[Style, dict[str, Any]], refused: dict[int, str]) -> Outcome:
    if style is None:
        return Outcome(None, job.result)
    now, result = served.get(style), job.result
    if result is not None:
        was = {"was_released": result["released"]}
        asked = job.request["release"]
        released, because = _standing(result["sha256"], now, refused.get(style[0]), asked, was | result)
        result = result | was | {"released": released} | because
    return Outcome(now, result)


def _standing(
    sha256: str, served: dict[str, Any] | None, refused: str | None, asked: bool, result: dict[str, Any]
) -> tuple[bool, dict[str, str | None]]:
    """Return whether a style serves a version now, and if a requested release is not in force, why and the remedy."""
    if served is not None and served["sha256"] == sha256:
        return True, {"not_released_because": None, "remedy": None}
    if not asked:
        return False, {"not_released_because": None, "remedy": None}
    because = result["not_released_because"]
    if because is None:
        now = "it was withdrawn" if served is None else f"version {served['version']} was released"
        because = f"It was released, and since then {now}."
        if served is None and refused is not None:
            because = f"It was released, and is no longer served. {refused}"
    return False, {"not_released_because": because, "remedy": remedy(because)}


def refusals(policy: Policy, certificate: Certificate, near: NearStarts, odds: NearOdds | None = None) -> list[str]:
    """Return the reasons on the grid against a release; the comparisons are written so that NaN fails.

    In a scene the odds count in place of optimal actions and of starts that reach the goal: sampled values are not
    exact beside rare and costly touches, and cells in tissue reach nothing.
    """
    if odds is not None:
        return [*_unlikely(odds), *_not_the_style(policy, certificate, near)]
    reasons = []
    if not certificate.every_action_optimal:
        reasons.append(f"{certificate.suboptimal} of {certificate.checked} greedy actions are not optimal")
    if not certificate.every_action_optimal and certificate.faint:
        gamma = least_gamma(policy)
        reasons.append(
            f"{certificate.faint} of them are so far from the path that their values, with gamma "
            f"{policy.learner.gamma:g}, are below {FAINT:g}, too small to be learnt; train with larger cells, or with "
            f"a gamma {'nearer to 1' if gamma is None else f'of {gamma:g}'}"
        )
    if certificate.starts_reaching < certificate.starts:
        missing = certificate.starts - certificate.starts_reaching
        reasons.append(f"{missing} of {certificate.starts} starts do not reach the goal")
    if certificate.off_rule:
        reasons.append(
            f"{certificate.off_rule} of {certificate.checked} greedy actions are not the ones that the rule among "
            "equally good actions selects"
        )
    return reasons + _not_the_style(policy, certificate, near)


def _unlikely(odds: NearOdds) -> list[str]:
    """Return the reason why the odds in a scene are against a release, if they are."""
    if odds.within:
        return []
    return [
        f"of {odds.starts} starts near the demonstrated one, one finishes with a probability of {odds.finishing:.1%}, "
        f"and one touches the scene with {odds.touching:.1%}; the gate requires at least {odds.least_finishing:.0%} "
        f"and at most {odds.most_touching:.0%}"
    ]


def _not_the_style(policy: Policy, certificate: Certificate, near: NearStarts) -> list[str]:
    """Return the reasons why a policy does not follow the demonstration from its start or near it."""
    reasons = []
    if policy.learner.phased and not certificate.demonstration_reproduced:
        reasons.append("the rollout from the demonstrated start is not the demonstration")
    if policy.learner.phased and not near.within:
        reasons.append(
            f"of {near.starts} starts within {near.radius_mm:g} mm of the demonstrated one, one follows only "
            f"{near.share:.0%} of the demonstration, and the gate requires {near.least_share:.0%}; train with a "
            f"joining rule such as --join {max(near.least_share, 0.5):g}, which leads them back to an earlier part"
        )
    return reasons


def driven_or_refused(policy: Policy, demo: Demo) -> tuple[DrivenPass | None, list[str]]:
    """Solve the demonstrated pass in closed form; return the result, None if impossible, and reasons against a release.

    NaN fails: a position is within the limits only if joints within the limits were found that put the tip there.
    """
    if not demo.frame.endswith("_base"):
        return None, [
            f"the frame '{demo.frame}' is not the arm's base, so its joint limits cannot be checked; demonstrate on a "
            "topic in the frame of the arm's base, such as local/measured_cp of a dVRK, or record its joints beside "
            "the poses"
        ]
    try:
        driven = driven_pass(policy, demo)
    except BadPlan as refused:
        why = refused.message.removesuffix(".")
        return None, [f"the demonstrated pass cannot be driven, so the joint limits were not checked: {why}"]
    if driven.beyond == 0:
        return driven, []
    nearest, arm = driven.nearest_limit, instrument_of(demo.instrument).arm.name
    where = ", ".join(f"{value:.1f}" for value in nearest.tip_mm)
    needs = (
        "no joints put the tip there"
        if nearest.value is None or nearest.margin is None
        else f"the arm needs {nearest.joint} {nearest.value:.4f} {nearest.unit}, {-nearest.margin:.4f} {nearest.unit} "
        f"beyond the limit {nearest.limit:.4f} of the {arm} with {demo.instrument}"
    )
    what = "the fitted path" if driven.path == "fitted" else "through the centres of its cells"
    return driven, [
        f"the demonstrated pass as it is driven ({what}) leaves the joint limits: at ({where}) mm in {demo.frame} "
        f"{needs}, the furthest of {driven.beyond} of {driven.samples} places; demonstrate it further from that limit, "
        "or with the arm's base elsewhere"
    ]
