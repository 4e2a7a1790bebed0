"""Requests to train many styles again (batches), and queries of their results.

`skills.library.operation.jobs` describes the rows of a batch, `skills.library.policies.batches` trains its styles.
"""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, Text, cast, func, insert, select, update
from sqlalchemy.orm import Session

from skills.db import in_parts, now
from skills.db.models import Demonstration, PolicyVersion, Surgeon, SutureType
from skills.db.service_tables import Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Conflict, NotFound
from skills.library.operation import jobs, locks
from skills.library.operation.jobs import BATCH, PART, PartRequest, RequestedJob
from skills.library.people.consent import require
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies.gate import DEFAULT_LIMITS, GateLimits
from skills.library.policies.releases import Style
from skills.library.policies.requests import (
    JOIN_AS_SERVED,
    RetrainingRequest,
    TrainingRequest,
    in_pieces,
    request_of,
    requests_of_served,
)
from skills.library.policies.training import learner_to_train
from skills.library.recordings.demos import newest_demos
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.schemas.policies import PolicyManifest
from skills.schemas.training import RetrainingIn

MOST_IN_A_PART = 50  # styles: the engine's overhead for a part, some 30 ms, is then spread over a second of work
STYLES_AT_ONCE = 500  # rows that one transaction adds: others wait for it, on SQLite all writers
FEWEST_PARTS = 4  # if there are so many styles: workers share a batch part by part


def request_retraining(
    database: Database, batch: RetrainingIn, actor: str, limits: GateLimits = DEFAULT_LIMITS
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
        limits: The gate's limits.

    Raises:
        NotFound: The surgeon or the suture type is unknown.
        Conflict: There is no demonstration that may be learnt from, the consent of the only surgeon does not cover
            training, or this surgeon was erased meanwhile.
        BadSettings: With the learner's settings going round in circles pays more than arriving.
        NotInstalled: The learner needs a library that is not installed.
    """
    with database.reading() as session:
        request, styles = choose_styles(session, batch, limits)
    names = [] if batch.surgeon is None else [locks.surgeon(batch.surgeon)]
    with database.writing([locks.BATCHES, *names]) as session:
        who = None if batch.surgeon is None else find_surgeon(session, batch.surgeon)
        requested = jobs.ask(session, request, who, actor)
        job = requested.job
        if not requested.new and (job.submitted_at is not None or job.state not in jobs.ACTIVE):
            return requested if job.state != "succeeded" or not request.release else _done_before(session, job)
    # An equal job that lacks some of its rows, because its request is under way or was interrupted, gets them here.
    size = max(1, min(MOST_IN_A_PART, -(-len(styles) // FEWEST_PARTS)))
    at_once = STYLES_AT_ONCE // size * size
    for first in range(0, len(styles), at_once):
        with database.writing([locks.job(job.row)]) as session:
            if session.scalar(select(Job.row).where(Job.row == job.row, Job.state.in_(jobs.ACTIVE))) is None:
                break  # cancelled or erased meanwhile
            _divide(session, job, [*styles.items()][first : first + at_once], size)
    with database.writing([locks.job(job.row)]) as session:
        session.execute(update(Job).where(Job.row == job.row).values(submitted_at=now()), **jobs.UNSYNCHRONISED)
        jobs.settle(session, job.row)  # a batch without styles, or whose styles are all done, ends here
        row = session.get(Job, job.row)
    if row is None:
        raise Conflict("The surgeon was erased while the batch was requested.")
    if not requested.new:
        return RequestedJob(row, True, "An equal job is queued already; the rest of its styles were added to it.")
    if not styles:
        return RequestedJob(row, True, "Nothing: no style needs training.")
    counted = f"{len(styles)} {'style' if len(styles) == 1 else 'styles'}"
    why = " that serve another version than when an equal batch ended" if request.after else ""
    return RequestedJob(row, True, f"A new job is queued, of {counted}{why}.")


def choose_styles(
    session: Session, batch: RetrainingIn, limits: GateLimits = DEFAULT_LIMITS
) -> tuple[RetrainingRequest, dict[int, list[str]]]:
    """Return the request of a batch's job, and by the demonstration of each of its styles why it is stale.

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
    asked = RetrainingRequest(
        surgeon=batch.surgeon,
        suture=batch.suture,
        only_stale=batch.only_stale,
        learner=learner,
        near=limits.near,
        odds=limits.odds,
        joins=JOIN_AS_SERVED if batch.chosen is None else None,
        release=batch.release,
    )
    served = requests_of_served(session, None if who is None else [who.row])
    trainings = {demo.row: _training_of(session, demo, asked, served.get(demo.style)) for demo in demos}
    stale = _reasons(session, demos, trainings, asked, _styles(PolicyVersion, who, what))
    chosen = [demo.row for demo in demos if stale[demo.row] or not batch.only_stale]
    request, unsettled = _unsettled(session, asked, chosen, trainings)
    return request, {row: stale[row] for row in unsettled}


def _training_of(
    session: Session, demo: "_Newest", asked: RetrainingRequest, served: TrainingRequest | None
) -> TrainingRequest:
    """Return the training of a style: of its newest demonstration, or of as many as its served policy combines."""
    demos = [demo.sha256]
    if served is not None and served.combine is not None:
        newest = newest_demos(session, demo.surgeon_row, demo.suture, len(served.demos))
        demos = [one.sha256 for one in newest]
    return asked.training_of((demo.surgeon, demo.suture), demos, served)


def _unsettled(
    session: Session, asked: RetrainingRequest, chosen: Sequence[int], trainings: dict[int, TrainingRequest]
) -> tuple[RetrainingRequest, Sequence[int]]:
    """Return the request to make, and the demonstrations of its styles.

    If an equal batch is done, these are only the styles that it would now release. `after` names that batch, so that
    the request differs from it, while a repetition of the request does not differ.
    """
    while True:
        digest = sha256(canonical([trainings[row].stored for row in chosen]))
        request = asked.model_copy(update={"styles": len(chosen), "demos_sha256": digest})
        known = jobs.find_live(session, request)
        if known is None or known.state != "succeeded" or not asked.release:
            return request, chosen
        left = jobs.changed_since(session, known.row)
        if not left:
            return request, chosen
        chosen = [row for row in chosen if row in left]
        asked = asked.model_copy(update={"after": known.id})


def _done_before(session: Session, job: Job) -> RequestedJob:
    serving, done = jobs.count_serving(session, job.row)
    did = f"Nothing: an equal batch trained {done} styles, and {serving} of them serve its version, as when it ended."
    return RequestedJob(job, False, did)


@dataclass(frozen=True)
class _Newest:
    """The newest demonstration of a style that may be learnt from."""

    row: int
    sha256: str
    surgeon_row: int
    surgeon: str
    suture: str

    @property
    def style(self) -> Style:
        """The surgeon's row, and the suture type."""
        return self.surgeon_row, self.suture


def _newest_demos(session: Session, surgeon: Surgeon | None, suture: SutureType | None) -> list[_Newest]:
    of = Demonstration
    newest = select(func.max(of.row)).where(of.learnable, *_styles(of, surgeon, suture))
    newest = newest.group_by(of.surgeon_row, of.suture)
    query = select(of.row, of.sha256, of.surgeon_row, Surgeon.slug, of.suture).join(Surgeon)
    return [_Newest(*row) for row in session.execute(query.where(of.row.in_(newest)).order_by(of.row))]


def _styles(
    of: type[Demonstration] | type[PolicyVersion], surgeon: Surgeon | None, suture: SutureType | None
) -> list[ColumnElement[bool]]:
    """Return the conditions that select rows of the requested styles."""
    asked = [] if surgeon is None else [of.surgeon_row == surgeon.row]
    return asked if suture is None else [*asked, of.suture == suture.slug]


def _reasons(
    session: Session,
    demos: Sequence[_Newest],
    trainings: dict[int, TrainingRequest],
    asked: RetrainingRequest,
    styles: list[ColumnElement[bool]],
) -> dict[int, list[str]]:
    """Return, by demonstration, why its style's newest version is stale; an empty list if it is up to date.

    It is up to date if it was learnt from this demonstration with the settings of the training that would be made, in
    the same scene, not refused by an older gate, and checked with the same limits. So is a style of which the last
    batch has made such a version, which may be an older one; with `release`, if it serves what it served then.
    """
    of = PolicyVersion
    last = select(func.max(of.version).label("version"), of.surgeon_row, of.suture).group_by(of.surgeon_row, of.suture)
    newest = last.where(*styles).subquery()
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
        reasons[demo.row] = _differences(demo, PolicyManifest.model_validate_json(text), releasable, trainings, asked)
    stale = {demo.row: demo for demo in demos if reasons[demo.row]}
    made = StyleToRetrain
    last_made = select(func.max(made.row)).where(made.state == "done").group_by(made.demonstration_row)
    columns = made.demonstration_row, of.releasable, cast(of.manifest, Text), made.comparison, jobs.served_now()
    again = select(*columns).join(made.policy).join(Job, Job.row == made.job_row).join(made.demonstration)
    again = again.where(Job.request["release"].as_boolean() == asked.release)
    for some in in_parts([*stale]):
        of_some = last_made.where(made.demonstration_row.in_(some))
        for row, releasable, text, compared, now_serves in in_pieces(session, again.where(made.row.in_(of_some))):
            manifest = PolicyManifest.model_validate_json(text)
            differs = _differences(stale[row], manifest, releasable, trainings, asked)
            if not differs and (not asked.release or now_serves == jobs.served_then(compared)):
                reasons[row] = []
    return reasons


def _differences(
    demo: _Newest,
    manifest: PolicyManifest,
    releasable: bool,
    trainings: dict[int, TrainingRequest],
    asked: RetrainingRequest,
) -> list[str]:
    """Return why a version is not what a training would make of its style."""
    made, wanted = request_of(manifest), trainings[demo.row]
    found = {
        "a newer demonstration": demo.sha256 not in made.demos,
        "another scene": made.surroundings != wanted.surroundings,
        "other settings": (made.learner, made.seed) != (wanted.learner, wanted.seed),
        "a newer learner": manifest.learner_version != wanted.learner_version,
        "refused by an older gate": not releasable and manifest.grid_certificate.gate != wanted.gate,
        "other limits at the near starts": made.near != wanted.near or made.odds not in (None, asked.odds),
    }
    return [reason for reason, holds in found.items() if holds]


def _divide(session: Session, job: Job, styles: Sequence[tuple[int, list[str]]], size: int) -> None:
    """Insert the missing rows of some styles, and divide them into parts; an erased demonstration is left out."""
    demos, of = [row for row, _ in styles], StyleToRetrain
    there = set(session.scalars(select(Demonstration.row).where(Demonstration.row.in_(demos))))
    there -= set(session.scalars(select(of.demonstration_row).where(of.job_row == job.row)))
    left = [(row, stale) for row, stale in styles if row in there]
    if not left:
        return
    parts = [
        # without its request and identity, which name its row
        Job(
            id=(name := secrets.token_hex(8)),
            kind=PART,
            identity=sha256(name.encode()),
            request={},
            surgeon_row=job.surgeon_row,
            requested_by=job.requested_by,
        )
        for _ in range(0, len(left), size)
    ]
    session.add_all(parts)
    session.flush()
    rows = []
    for number, part in enumerate(parts):
        request = PartRequest(retraining=job.row, part=part.row)
        part.request, part.identity = request.stored, request.identity
        rows += [
            {"job_row": job.row, "part_row": part.row, "demonstration_row": row, "stale": stale}
            for row, stale in left[number * size :][:size]
        ]
    session.execute(insert(StyleToRetrain), rows)


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
