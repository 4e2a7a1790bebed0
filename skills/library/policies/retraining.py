"""Requests to train many styles again (batches), and queries of their results.

`skills.library.operation.jobs` describes the rows of a batch, `skills.library.policies.batches` trains its styles.
"""

import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import ColumnElement, Text, cast, func, insert, select, update
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.models import Demonstration, PolicyVersion, Surgeon, SutureType
from skills.db.service_tables import Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Conflict, NotFound
from skills.learning.certificate import NearLimits, OddsLimits
from skills.learning.policy import LEARNER_VERSION, describe_learner, learner_of
from skills.library.operation import jobs, locks
from skills.library.operation.jobs import (
    BATCH,
    JOIN_AS_SERVED,
    PART,
    PartRequest,
    RequestedJob,
    RetrainingRequest,
    did_nothing,
)
from skills.library.people.consent import require
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies.gate import GATE_VERSION, limits_of
from skills.library.policies.outcomes import Style
from skills.library.policies.served_settings import ServedSettings, in_pieces, learner_for, settings_of_served
from skills.library.policies.training import POSES_VERSION, learner_to_train
from skills.library.recordings.demos import newest_demos
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import RetrainingIn

MOST_IN_A_PART = 50  # styles: the engine's overhead for a part, some 30 ms, is then spread over a second of work
STYLES_AT_ONCE = 500  # rows that one transaction adds: others wait for it, on SQLite all writers
FEWEST_PARTS = 16  # if there are so many styles: workers share a batch part by part


def request_retraining(
    database: Database,
    batch: RetrainingIn,
    actor: str,
    near: NearLimits | None = None,
    odds: OddsLimits | None = None,
) -> RequestedJob:
    """Queue a batch that trains styles again, each from its newest demonstration that may be learnt from.

    One that is marked recovery or failure is left out, even if the style serves a version trained from any outcome. A
    style that serves a policy of several demonstrations is learnt from the same number of its newest ones, combined in
    the same way. Unless the request names a learner, a style keeps the joining rule of the policy that it serves. A
    style that serves a policy learnt in a scene is learnt in the same scene, and unless the request names a learner, by
    the same one.

    The styles are chosen now; they and all defaults are the job's identity. With `only_stale` a style is left out if
    its newest version was learnt from that demonstration, with these settings and this learner, in that scene, was not
    refused by an older release gate, and was checked with the same limits at the near starts; if no style remains, the
    job has succeeded at once.

    If an equal batch with `release` is done, and some of its styles now serve another version than when it ended, the
    new job consists of these styles: they are learnt again, which gives the same versions, and released by the same
    rules.

    The styles are chosen by reading alone, and added to the job in several short transactions: workers may begin with
    the first ones before the last ones are added.

    Args:
        database: The database, restricted to the rows that the caller may see.
        batch: The request. Without `surgeon` or `suture` styles of all of them are trained, and without `learner` phase
            Q-learning with its defaults learns.
        actor: The owner of the caller's key.
        near: The gate's limit at the starts near the demonstrated one; None for its defaults.
        odds: The gate's limits in a scene; None for their defaults.

    Raises:
        NotFound: The surgeon or the suture type is unknown.
        Conflict: There is no demonstration that may be learnt from, the consent of the only surgeon does not cover
            training, or this surgeon was erased meanwhile.
        BadSettings: With the learner's settings going round in circles pays more than arriving.
        LearnerNotInstalled: The learner needs a library that is not installed.
    """
    with database.reading() as session:
        request, styles = choose_styles(session, batch, near, odds)
    names = [] if batch.surgeon is None else [locks.surgeon(batch.surgeon)]
    with database.writing([locks.BATCHES, *names]) as session:
        who = None if batch.surgeon is None else find_surgeon(session, batch.surgeon)
        job, new = jobs.ask(session, BATCH, request, who, actor)
        if not new:
            return RequestedJob(job, False, _did_nothing(session, job))
    # Rows are inserted only for a new job; an equal one has its own.
    size = max(1, min(MOST_IN_A_PART, -(-len(styles) // FEWEST_PARTS)))
    at_once = STYLES_AT_ONCE // size * size
    for first in range(0, len(styles), at_once):
        with database.writing([locks.job(job.row)]) as session:
            if session.scalar(select(Job.row).where(Job.row == job.row, Job.state.in_(jobs.ACTIVE))) is None:
                break  # cancelled or erased meanwhile
            _divide(session, job, styles[first : first + at_once], size)
    with database.writing([locks.job(job.row)]) as session:
        session.execute(update(Job).where(Job.row == job.row).values(submitted_at=now()), **jobs.UNSYNCHRONISED)
        jobs.settle(session, job.row)  # a batch without styles, or whose styles are all done, ends here
        told = session.get(Job, job.row)
    if told is None:
        raise Conflict("The surgeon was erased while the batch was requested.")
    if not styles:
        return RequestedJob(told, True, "Nothing: no style needs training.")
    counted = f"{len(styles)} {'style' if len(styles) == 1 else 'styles'}"
    why = " that serve another version than when an equal batch ended" if "after" in request else ""
    return RequestedJob(told, True, f"A new job is queued, of {counted}{why}.")


def choose_styles(
    session: Session, batch: RetrainingIn, near: NearLimits | None = None, odds: OddsLimits | None = None
) -> tuple[RetrainingRequest, list[dict[str, Any]]]:
    """Return the request of a batch's job, and for each of its styles the demonstration and why it is stale.

    The arguments and errors are those of `request_retraining`.
    """
    learner = learner_to_train(batch.chosen)
    who = None if batch.surgeon is None else find_surgeon(session, batch.surgeon)
    if who is not None:
        require(who, "training")
    what = None if batch.suture is None else find_suture_type(session, batch.suture)
    demos = _newest_demos(session, who, what)
    if not demos:
        add = Remedy(Action.ADD_DEMO, surgeon=batch.surgeon or "SURGEON", suture=batch.suture or "SUTURE")
        why = "There is no active demonstration of the requested styles; one marked recovery or failure does not count."
        raise Conflict(why, add)
    asked: RetrainingRequest = {
        "surgeon": batch.surgeon,
        "suture": batch.suture,
        "only_stale": batch.only_stale,
        "learner": describe_learner(learner),
        "learner_version": LEARNER_VERSION,
        "gate": GATE_VERSION,
        "poses": POSES_VERSION,
        "near": asdict(near or NearLimits()),
        "odds": asdict(odds or OddsLimits()),
        "joins": JOIN_AS_SERVED if batch.chosen is None else None,
        "seed": 0,
        "release": batch.release,
    }
    served = settings_of_served(session, None if who is None else [who.row])
    stale = _reasons(session, demos, asked, served, who, what)
    chosen = [demo for demo in demos if stale[demo.row] or not batch.only_stale]
    request, unsettled = _unsettled(session, asked, chosen, served)
    return request, [{"demonstration_row": demo.row, "stale": stale[demo.row]} for demo in unsettled]


def _unsettled(
    session: Session, asked: RetrainingRequest, chosen: Sequence["_Newest"], served: dict[Style, ServedSettings]
) -> tuple[RetrainingRequest, Sequence["_Newest"]]:
    """Return the request to make, and its styles; if an equal batch is done, only the styles that it would now release.

    `after` names that batch, so that the request differs from it, while a repetition of the request does not differ.
    """
    while True:
        digest = sha256(canonical([_made_of(session, demo, served.get(demo.style), asked) for demo in chosen]))
        request: RetrainingRequest = {**asked, "styles": len(chosen), "demos_sha256": digest}
        known = jobs.find_live(session, BATCH, request)
        if known is None or known.state != "succeeded" or not asked["release"]:
            return request, chosen
        left = jobs.changed_since(session, known.row)
        if not left:
            return request, chosen
        chosen = [demo for demo in chosen if demo.row in left]
        asked = {**asked, "after": known.id}


def _made_of(session: Session, demo: "_Newest", served: ServedSettings | None, asked: RetrainingRequest) -> list[Any]:
    """Return the combination of a style, the digests of its newest demonstrations, its rule and its scene."""
    if served is None:
        return [None, [demo.sha256], None, None]
    kind, demos = None, [demo.sha256]
    if served.combining is not None:
        kind, newest = served.combining, newest_demos(session, demo.surgeon_row, demo.suture, served.demos)
        demos = [one.sha256 for one in newest]
    rule = served.join_share if asked["joins"] == JOIN_AS_SERVED else None
    return [kind, demos, rule, None if served.surroundings is None else served.surroundings.as_json()]


def _did_nothing(session: Session, job: Job) -> str:
    if job.state != "succeeded" or not job.request["release"]:
        return did_nothing(job)
    serving, done = jobs.count_serving(session, job.row)
    return f"Nothing: an equal batch trained {done} styles, and {serving} of them serve its version, as when it ended."


@dataclass(frozen=True)
class _Newest:
    """The newest demonstration of a style that may be learnt from."""

    row: int
    sha256: str
    surgeon_row: int
    suture: str

    @property
    def style(self) -> Style:
        """The surgeon's row, and the suture type."""
        return self.surgeon_row, self.suture


def _newest_demos(session: Session, surgeon: Surgeon | None, suture: SutureType | None) -> list[_Newest]:
    of = Demonstration
    newest = select(func.max(of.row)).where(of.learnable, *_styles(of, surgeon, suture))
    newest = newest.group_by(of.surgeon_row, of.suture)
    query = select(of.row, of.sha256, of.surgeon_row, of.suture).where(of.row.in_(newest)).order_by(of.row)
    return [_Newest(*row) for row in session.execute(query)]


def _styles(
    of: type[Demonstration] | type[PolicyVersion], surgeon: Surgeon | None, suture: SutureType | None
) -> list[ColumnElement[bool]]:
    """Return the conditions that select rows of the requested styles."""
    asked = [] if surgeon is None else [of.surgeon_row == surgeon.row]
    return asked if suture is None else [*asked, of.suture == suture.slug]


def _reasons(
    session: Session,
    demos: Sequence[_Newest],
    asked: RetrainingRequest,
    served: dict[Style, ServedSettings],
    surgeon: Surgeon | None,
    suture: SutureType | None,
) -> dict[int, list[str]]:
    """Return, by demonstration, why its style's newest version is stale; an empty list if it is up to date.

    It is up to date if it was learnt from this demonstration with these settings and this learner, in the scene of the
    served version, not refused by an older gate, and checked with the same limits at the near starts.
    """
    of = PolicyVersion
    last = select(func.max(of.version).label("version"), of.surgeon_row, of.suture).group_by(of.surgeon_row, of.suture)
    newest = last.where(*_styles(of, surgeon, suture)).subquery()
    query = select(of.surgeon_row, of.suture, of.releasable, cast(of.manifest, Text)).join(
        newest,
        (of.surgeon_row == newest.c.surgeon_row) & (of.suture == newest.c.suture) & (of.version == newest.c.version),
    )
    of_style = {demo.style: demo for demo in demos}
    reasons = {demo.row: ["never trained"] for demo in demos}
    for who, what, releasable, text in in_pieces(session, query):
        demo = of_style.get((who, what))
        if demo is None:
            continue
        manifest, kept = PolicyManifest.model_validate_json(text), served.get((who, what))
        certificate, near = manifest.grid_certificate, NearLimits(**asked["near"])
        learner = learner_of(learner_for(asked, kept))
        odds = None if manifest.scene is None else manifest.scene.near
        found = {
            "a newer demonstration": demo.sha256 not in manifest.demos,
            "another scene": manifest.surroundings != (None if kept is None else kept.surroundings),
            "other settings": (manifest.learnt_with, manifest.seed) != (learner, asked["seed"]),
            "a newer learner": manifest.learner_version != asked["learner_version"],
            "refused by an older gate": not releasable and certificate.gate != asked["gate"],
            "other limits at the near starts": limits_of(NearLimits, certificate.near) != near
            or (odds is not None and limits_of(OddsLimits, odds) != OddsLimits(**asked["odds"])),
        }
        reasons[demo.row] = [reason for reason, holds in found.items() if holds]
    return reasons


def _divide(session: Session, job: Job, styles: Sequence[dict[str, Any]], size: int) -> None:
    """Insert a row for each of some styles, and divide them into parts; a demonstration that was erased is left out."""
    demos = [style["demonstration_row"] for style in styles]
    there = set(session.scalars(select(Demonstration.row).where(Demonstration.row.in_(demos))))
    left = [style for style in styles if style["demonstration_row"] in there]
    parts = [_new_part(job) for _ in range(0, len(left), size)]
    session.add_all(parts)
    session.flush()
    rows = []
    for number, part in enumerate(parts):
        request: PartRequest = {"retraining": job.row, "part": part.row}
        part.request, part.identity = {**request}, jobs.identity_of(PART, request)
        rows += [{"job_row": job.row, "part_row": part.row, **style} for style in left[number * size :][:size]]
    session.execute(insert(StyleToRetrain), rows)


def _new_part(job: Job) -> Job:
    """Return a part of a batch without its request, which names the part's row."""
    return Job(
        id=(name := secrets.token_hex(8)),
        kind=PART,
        identity=jobs.identity_of(PART, {"retraining": job.id, "part": name}),
        request={},
        surgeon_row=job.surgeon_row,
        requested_by=job.requested_by,
    )


def find_retraining(session: Session, job_id: str) -> Job:
    """Return a batch by its job's id."""
    job = session.scalar(select(Job).where(Job.id == job_id, Job.kind == BATCH, *jobs.shown()))
    if job is None:
        raise NotFound("There is no retraining with this job id.", Remedy(Action.LIST_JOBS))
    return job


def list_styles(
    session: Session, job: Job, limit: int, after: int | None, state: str | None
) -> Sequence[StyleToRetrain]:
    """List the styles of a batch, in the order in which they were requested.

    Args:
        session: The caller's transaction.
        job: The batch.
        limit: The length of the page.
        after: The row of the last style of the page before.
        state: List only styles in this state.
    """
    of = StyleToRetrain
    query = select(of).where(of.job_row == job.row, of.row > (after or 0)).order_by(of.row).limit(limit)
    return session.scalars(query if state is None else query.where(of.state == state)).all()
