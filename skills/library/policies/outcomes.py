"""Jobs and styles of batches as they are answered, with what their styles serve now.

A row stores the effect of the job: `released` in the result of a training, `now_released` in the comparison of a
batch's style. Another version may have been released since, or none may be served any more. So every answer about a job
is made here: `released` and `now_released` are the present state, `was_released` is the effect of the job.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import PolicyVersion, Release, Surgeon
from skills.db.service_tables import Job, StyleToRetrain
from skills.library.operation.jobs import TRAINING
from skills.library.people.consent import refusal
from skills.library.policies.gate import remedy
from skills.library.policies.releases import Released, Style, is_served
from skills.schemas import operation as schemas
from skills.schemas.operation import ServedNow
from skills.schemas.policies import GateRefusal
from skills.schemas.training import RetrainedStyle, ServedTraining, StyleComparison, TrainingResult


@dataclass(frozen=True)
class _Serving:
    """The versions that styles serve now, and by surgeon why consent does not cover training, where it does not."""

    served: dict[Style, ServedNow]
    refused: dict[int, str]

    @classmethod
    def of(cls, session: Session, styles: Collection[Style]) -> "_Serving":
        surgeons = {surgeon for surgeon, _ in styles}
        found = session.scalars(select(Surgeon).where(Surgeon.row.in_(surgeons))) if surgeons else ()
        refused = {one.row: str(why) for one in found if (why := refusal(one, "training")) is not None}
        return cls(served_by(session, styles), refused)

    def released_now(self, style: Style, sha256: str, asked: bool, then: Released) -> Released:
        """Return whether a style serves a version, and if a requested release is not in force, why and the remedy."""
        served = self.served.get(style)
        if served is not None and served.sha256 == sha256:
            return Released(True, None, None)
        if not asked:
            return Released(False, None, None)
        if then.not_released_because is not None:
            return then._replace(released=False)
        if served is not None:
            because = f"It was released, and since then version {served.version} was released."
            return Released(False, because, "Request the release again if this version is to be served in its place.")
        if (refused := self.refused.get(style[0])) is not None:
            because = f"It was released, and is no longer served. {refused}"
            return Released(False, because, remedy([GateRefusal("consent", refused)]))
        because = "It was released, and since then it was withdrawn."
        return Released(False, because, "Request the release again if this version is to be served.")


def describe_job(session: Session, job: Job, did: str | None = None) -> schemas.Job:
    """Return a job of any kind, with the effect of the request that it answers."""
    return describe_jobs(session, [job])[0].model_copy(update={"did": did})


def describe_jobs(session: Session, jobs: Sequence[Job]) -> list[schemas.Job]:
    """Return jobs of any kind; only trainings serve a style."""
    trainings: dict[int, Style] = {
        job.row: (job.surgeon_row, job.request["suture"])
        for job in jobs
        if job.kind == TRAINING and job.surgeon_row is not None
    }
    serving = _Serving.of(session, trainings.values())
    described = []
    for job in jobs:
        answer = schemas.Job.model_validate(job)
        if (style := trainings.get(job.row)) is not None:
            answer = answer.model_copy(
                update={"served": serving.served.get(style), "result": _result(job, style, serving)}
            )
        described.append(answer)
    return described


def _result(job: Job, style: Style, serving: _Serving) -> dict[str, Any] | None:
    if job.result is None:
        return None
    result = TrainingResult.model_validate(job.result)
    then = Released(result.released, result.not_released_because, result.remedy)
    now = serving.released_now(style, result.sha256, job.request["release"], then)
    return ServedTraining(**dict(result) | now._asdict(), was_released=result.released).model_dump()


def describe_styles(session: Session, styles: Sequence[StyleToRetrain]) -> list[RetrainedStyle]:
    """Return styles of a batch, each with the comparison of its version with the released one."""
    serving = _Serving.of(session, {_style(one) for one in styles})
    return [
        RetrainedStyle.from_attributes_of(
            one,
            surgeon=one.demonstration.surgeon.slug,
            suture=one.demonstration.suture,
            demo=one.demonstration.sha256,
            stale_because=one.stale,
            policy_version=None if one.policy is None else one.policy.version,
            sha256=None if one.policy is None else one.policy.sha256,
            comparison=_comparison(one, serving),
            served=serving.served.get(_style(one)),
        )
        for one in styles
    ]


def _style(row: StyleToRetrain) -> Style:
    return row.demonstration.surgeon_row, row.demonstration.suture


def _comparison(row: StyleToRetrain, serving: _Serving) -> StyleComparison | None:
    stored = row.comparison
    if stored is None or row.policy is None:
        return None
    then = Released(stored.now_released, stored.not_released_because, stored.remedy)
    asked = then.released or then.not_released_because is not None
    now = serving.released_now(_style(row), row.policy.sha256, asked, then)
    fields = vars(stored) | {"now_released": now.released, "not_released_because": now.not_released_because}
    return StyleComparison(**fields | {"remedy": now.remedy}, was_released=then.released)


def served_by(session: Session, styles: Iterable[Style]) -> dict[Style, ServedNow]:
    """Return the versions that some styles serve, with one statement; styles that serve nothing are left out."""
    wanted = set(styles)
    if not wanted:
        return {}
    by = PolicyVersion
    query = select(Release.surgeon_row, Release.suture, Release.released_at, by.version, by.sha256).join(
        by, by.row == Release.policy_row
    )
    mine = Release.surgeon_row.in_({surgeon for surgeon, _ in wanted}), Release.suture.in_({name for _, name in wanted})
    return {
        (surgeon, suture): ServedNow(version=version, sha256=sha256, released_at=at)
        for surgeon, suture, at, version, sha256 in session.execute(query.where(*mine, is_served()))
    }
