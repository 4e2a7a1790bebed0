"""Results of trainings and batches, with what their styles serve now."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    select,
)
from sqlalchemy.orm import Session

from skills.db import rfc3339
from skills.db.models import (
    PolicyVersion,
    Release,
    Surgeon,
)
from skills.db.service_tables import Job, StyleToRetrain
from skills.library.people.consent import refusal
from skills.library.policies.gate import remedy
from skills.library.policies.releases import is_served

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
