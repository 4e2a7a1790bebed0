"""Asking for many styles to be trained again, and looking at what became of them.

What a batch is made of stands in `skills.library.batches`, how it is carried out in `skills.library.batch_work`.
"""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, func, insert, select
from sqlalchemy.orm import Session

from skills.db.books import Job, StyleToRetrain
from skills.db.models import Demonstration, PolicyVersion, Surgeon, SutureType
from skills.deep.learning import require_installed
from skills.errors import Conflict, NotFound
from skills.library import batches, jobs
from skills.library.batches import BATCH, PART
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.training import describe_learner
from skills.packing import canonical, sha256
from skills.style.learning.learners import LEARNER_VERSION, Learner
from skills.style.learning.q_learning import PhaseQLearning

MOST_IN_A_PART = 50  # styles: the engine's cost of one, some 30 ms, is then spread over a second of work
FEWEST_PARTS = 16  # where there are so many styles: parts are what several workers share


def request_retraining(
    session: Session,
    actor: str,
    *,
    surgeon: str | None = None,
    suture: str | None = None,
    only_stale: bool = False,
    learner: Learner | None = None,
    release: bool = False,
) -> tuple[Job, bool]:
    """Ask for styles to be trained again, from the newest active demonstration of each: the job, and whether it is new.

    Which styles these are is settled now; they and all defaults are the job's identity. With `only_stale` a style whose
    newest version rests on that demonstration, these settings and this learner is left out; if that leaves none, the
    job has succeeded at once.

    Raises:
        NotFound: The surgeon or the suture type is unknown.
        Conflict: There is no active demonstration.
        LearnerNotInstalled: The learner needs what is not installed here.
    """
    require_installed(learner := learner or PhaseQLearning())
    who = find_surgeon(session, surgeon) if surgeon is not None else None
    what = find_suture_type(session, suture) if suture is not None else None
    demos = _newest_demos(session, who, what)
    if not demos:
        raise Conflict("There is no active demonstration of what was asked for; POST /demos adds one.")
    asked: dict[str, Any] = {
        "surgeon": surgeon,
        "suture": suture,
        "only_stale": only_stale,
        "learner": describe_learner(learner),
        "learner_version": LEARNER_VERSION,
        "seed": 0,
        "release": release,
    }
    stale = _reasons(session, demos, asked, who, what)
    chosen = [demo for demo in demos if stale[demo.row] or not only_stale]
    asked |= {"styles": len(chosen), "demos_sha256": sha256(canonical([demo.sha256 for demo in chosen]))}
    job, new = jobs.ask(session, BATCH, asked, who, actor)
    if new:
        _divide(session, job, [{"demonstration_row": demo.row, "stale": stale[demo.row]} for demo in chosen])
        batches.settle(session, job.row)  # where there are no styles
        session.refresh(job)
    return job, new


@dataclass(frozen=True)
class _Newest:
    """The newest active demonstration of a style."""

    row: int
    sha256: str
    surgeon_row: int
    suture: str


def _newest_demos(session: Session, surgeon: Surgeon | None, suture: SutureType | None) -> list[_Newest]:
    of = Demonstration
    newest = select(func.max(of.row)).where(of.withdrawn_at.is_(None), *_styles(of, surgeon, suture))
    newest = newest.group_by(of.surgeon_row, of.suture)
    query = select(of.row, of.sha256, of.surgeon_row, of.suture).where(of.row.in_(newest)).order_by(of.row)
    return [_Newest(*row) for row in session.execute(query)]


def _styles(
    of: type[Demonstration] | type[PolicyVersion], surgeon: Surgeon | None, suture: SutureType | None
) -> list[ColumnElement[bool]]:
    """Write which rows are of the styles that were asked for."""
    asked = [] if surgeon is None else [of.surgeon_row == surgeon.row]
    return asked if suture is None else [*asked, of.suture == suture.slug]


def _reasons(
    session: Session,
    demos: Sequence[_Newest],
    asked: dict[str, Any],
    surgeon: Surgeon | None,
    suture: SutureType | None,
) -> dict[int, list[str]]:
    """Say of each demonstration's style why its newest version is not what this training would make of it, if so."""
    of = PolicyVersion
    last = select(func.max(of.version).label("version"), of.surgeon_row, of.suture).group_by(of.surgeon_row, of.suture)
    newest = last.where(*_styles(of, surgeon, suture)).subquery()
    said = [of.manifest[name] for name in ("demos", "learner", "settings", "seed", "learner_version")]
    query = select(of.surgeon_row, of.suture, *said).join(
        newest,
        (of.surgeon_row == newest.c.surgeon_row) & (of.suture == newest.c.suture) & (of.version == newest.c.version),
    )
    versions = {(surgeon, suture): about for surgeon, suture, *about in session.execute(query)}
    settings = {name: value for name, value in asked["learner"].items() if name != "kind"}
    learnt = (asked["learner"]["kind"], settings, asked["seed"])
    reasons: dict[int, list[str]] = {}
    for demo in demos:
        version = versions.get((demo.surgeon_row, demo.suture))
        if version is None:
            reasons[demo.row] = ["never trained"]
            continue
        rests_on, *how, learner_version = version
        found = {
            "a newer demonstration": demo.sha256 not in rests_on,
            "other settings": tuple(how) != learnt,
            "a newer learner": learner_version != asked["learner_version"],
        }
        reasons[demo.row] = [reason for reason, holds in found.items() if holds]
    return reasons


def _divide(session: Session, job: Job, styles: Sequence[dict[str, Any]]) -> None:
    """Give every style its row, and hand them out to parts of about the same size."""
    size = max(1, min(MOST_IN_A_PART, -(-len(styles) // FEWEST_PARTS)))
    for first in range(0, len(styles), size):
        part = Job(
            id=secrets.token_hex(8),
            kind=PART,
            identity=jobs.identity_of(PART, {"retraining": job.id, "first": first}),
            request={},
            surgeon_row=job.surgeon_row,
            asked_by=job.asked_by,
        )
        session.add(part)
        session.flush()
        part.request = {"retraining": job.row, "part": part.row}  # nothing personal
        part.identity = jobs.identity_of(PART, part.request)
        rows = [{"job_row": job.row, "part_row": part.row, **style} for style in styles[first : first + size]]
        session.execute(insert(StyleToRetrain), rows)


def find_retraining(session: Session, job_id: str) -> Job:
    """Find a batch by its job's id."""
    job = session.scalar(select(Job).where(Job.id == job_id, Job.kind == BATCH))
    if job is None:
        raise NotFound("There is no such retraining; GET /jobs lists all jobs.")
    return job


def list_styles(
    session: Session, job: Job, limit: int, after: int | None, state: str | None
) -> Sequence[StyleToRetrain]:
    """List the styles of a batch, in the order in which they were asked for."""
    of = StyleToRetrain
    query = select(of).where(of.job_row == job.row, of.row > (after or 0)).order_by(of.row).limit(limit)
    return session.scalars(query if state is None else query.where(of.state == state)).all()
