"""Routes of trainings and jobs, and of policies: the released one of a style, versions, releases, rollouts and cards.

A retraining is a batch of styles. A policy card is the JSON or HTML description of a version, built from verified
values only.
"""

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

from fastapi import Header, Path, Query, Request, Response, WebSocket
from sqlalchemy.orm import Session

from skills.api.authorisation import Asking, needs, refuse_release
from skills.api.dependencies import Actor, Configured, Db, Digest, Jobs, Limit, RowCursor, Slug, room_for_a_job
from skills.api.encoded_policies import NPZ, Encoded, negotiate
from skills.api.job_events import Watching
from skills.api.openapi import ends, gives, gives_page, gives_stream, router_of, says, starts_job
from skills.api.pages import HTML, standalone_headers, wants_page
from skills.api.pages.drawings import card_page
from skills.api.policy_cache import POSES, SIGNATURE, PolicyCache
from skills.api.responses import JSON, Condition, Giving, accepted, answer, json_of, names, say, tag_of
from skills.api.sessions import Sessions
from skills.api.streams import Stream
from skills.api.strict_json import Strict
from skills.db.models import PolicyVersion
from skills.db.session import Database
from skills.errors import PreconditionFailed
from skills.learning.policy import next_step
from skills.library.operation import jobs as asked
from skills.library.operation import locks
from skills.library.operation.integrity import learnt
from skills.library.operation.jobs import PART, attempts_to_submit, count
from skills.library.operation.proofs import head_over, sign_files
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.plans.tries import request_try
from skills.library.policies import releases, versions
from skills.library.policies.cards import Card, card_of
from skills.library.policies.releases import outcomes_of_styles
from skills.library.policies.retraining import find_retraining, list_styles, request_retraining, retrained_json
from skills.library.policies.training import near_limits, odds_limits, request_training
from skills.library.policies.versions import about_next, poses_of, summary_json, version_json
from skills.schemas import Page
from skills.schemas.cards import PolicyCard
from skills.schemas.operation import Job
from skills.schemas.policies import NextStep, Policy, PolicySummary, Rollout, RolloutIn
from skills.schemas.policies import Version as GivenVersion
from skills.schemas.pose_styles import NextIn, NextPose, PoseStyle
from skills.schemas.requests import JOB, SLUG
from skills.schemas.training import Retraining, RetrainingIn, TrainingIn
from skills.schemas.tries import TryIn
from skills.settings import MEBIBYTE
from skills.transparency.notes import read_notes
from skills.transparency.statements import SignedEnvelope

job_router = router_of(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)

JobId = Annotated[str, Path(pattern=JOB)]
EVENTS = gives_stream("job", Job, "The job at every change, until it has ended.", 404)

router = router_of(route_class=Strict, tags=["policies"], max_body_size=MEBIBYTE)

Version = Annotated[int, Path(ge=1, le=2**31)]
Accept = Annotated[str, Header(max_length=500)]


@job_router.post("/trainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def train(body: TrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of a style; an equal request returns the same job.

    With `release`, an equal request whose version is not the one that the style serves now releases it, if it passes
    the gate. `did` states the effect of the request; `result.released` and `served` state what is served now.
    """
    refuse_release(caller, body.release)
    with db.writing([locks.surgeon(body.surgeon)]) as session:
        job, new, did = request_training(session, body, actor, near_limits(settings), odds_limits(settings))
        answer = accepted(session, job, did)
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@job_router.post("/tries", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def try_recording(body: TryIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking) -> Response:
    """Take a stored recording to a verdict: cut, learn, certify, release if wanted, plan at its own place, play.

    The job's `result.steps` has each step as it is done. What the request leaves open is asked: the job then ends with
    the choices, and the request is sent again with one of them. Nothing is released without `release` true.
    """
    refuse_release(caller, body.release is True)
    with db.writing([locks.surgeon(body.surgeon)]) as session:
        job, new, did = request_try(session, body, actor)
        answer = accepted(session, job, did)
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@job_router.get("/jobs", dependencies=[needs("reader")], **gives_page(Page[Job]))
def list_jobs(
    db: Db,
    give: Giving,
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None = None,
    kind: Literal["training", "retraining", "playback", "pictures", "dataset", "try"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List jobs, the newest first."""
    with db.reading() as session:
        found = asked.list_jobs(session, limit, cursor, state, kind)
        return give.page(asked.describe_jobs(session, found), limit, found[-1].row if found else None)


@job_router.get("/jobs/{job}", dependencies=[needs("reader")], **gives(Job, 404))
def get_job(job: JobId, db: Db, give: Giving) -> Response:
    """Return a job."""
    with db.reading() as session:
        return give(asked.describe_job(session, asked.find_job(session, job)))


@job_router.get("/jobs/{job}/events", dependencies=[needs("reader")], **EVENTS)
async def watch_job(job: JobId, db: Db, caller: Asking, request: Request) -> Stream:
    """Stream a job's changes as server-sent events until it has ended; comments keep the connection alive."""
    watching: Watching = request.app.state.watching
    events = watching.events(db, job, caller.key, partial(request.scope["ask_again"], request.scope))
    return Stream(events, "text/event-stream", {"Cache-Control": "no-store"})


@job_router.delete("/jobs/{job}", dependencies=[needs("trainer")], **says(Job, 404, 409))
def cancel_job(job: JobId, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Cancel a job that has not ended."""
    with db.reading() as session:
        row = asked.find_job(session, job).row
    with db.writing([locks.job(row)]) as session:
        cancelled = asked.cancel(session, job, actor)
        told = attempts_to_submit(session, cancelled)
        said = asked.describe_job(session, cancelled)
    for row, attempt in told:
        jobs.cancel(row, attempt)
    return say(said)


retraining_router = router_of(route_class=Strict, tags=["jobs"], max_body_size=MEBIBYTE)


@retraining_router.post("/retrainings", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def retrain(body: RetrainingIn, db: Db, jobs: Jobs, actor: Actor, caller: Asking, settings: Configured) -> Response:
    """Request the training of many styles again; an equal request for the same styles returns the same job.

    With `release`, an equal request creates a new job if some of the styles serve another version now than when the job
    ended; the new job covers only these. `did` states the effect of the request.
    """
    refuse_release(caller, body.release)
    job, new, did = request_retraining(db, body, actor, near_limits(settings), odds_limits(settings))
    with db.reading() as session:
        told = attempts_to_submit(session, job) if new else []
        answer = accepted(session, job, did)
    for row, attempt in told:
        jobs.submit(row, attempt, PART)
    return answer


@retraining_router.get("/retrainings/{job}", dependencies=[needs("reader")], **gives_page(Retraining, 404))
def get_retraining(
    job: JobId,
    db: Db,
    give: Giving,
    state: Literal["queued", "done", "failed", "cancelled"] | None = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """Return a batch: its job, the number of its styles in each state, and the styles, all or of one state."""
    with db.reading() as session:
        found = find_retraining(session, job)
        styles = list_styles(session, found, limit, cursor, state)
        about = {**dict(asked.describe_job(session, found)), "styles": count(session, found.row)}
        came_of = outcomes_of_styles(session, styles)
        items = [retrained_json(style, came_of[style.row]) for style in styles]
        return give.page(items, limit, styles[-1].row if styles else None, **about)


# ---- policies ------------------------------------------------------------------------------------------------------


@router.get("/policies", dependencies=[needs("reader")], **gives_page(Page[PolicySummary], 404, 410))
def list_policies(
    db: Db,
    give: Giving,
    surgeon: Annotated[str | None, Query(pattern=SLUG)] = None,
    suture: Annotated[str | None, Query(pattern=SLUG)] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List the styles that serve a policy."""
    with db.reading() as session:
        found = versions.list_served(session, limit, cursor, surgeon, suture)
        return give.page([summary_json(one) for one in found], limit, found[-1].row if found else None)


@router.head("/policies/{surgeon}/{suture}", dependencies=[needs("reader")], include_in_schema=False)
@router.get(
    "/policies/{surgeon}/{suture}", dependencies=[needs("reader")], **gives(Policy, 404, 410, 412, 415, as_well=(NPZ,))
)
# async, because a response from the cache takes less time than starting a thread for it
async def get_policy(
    surgeon: Slug,
    suture: Slug,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Condition = None,
    if_match: Condition = None,
) -> Response:
    """Return the style's released policy: JSON, or with `Accept: application/x-npz` its arrays with the Q values.

    It is encoded once and served from memory until something changes (`skills.api.policy_cache`).
    """
    served: PolicyCache = request.app.state.served
    return answer(await served.body(surgeon, suture, negotiate(accept)), if_none_match, if_match)


@router.get(
    "/policies/{surgeon}/{suture}/pose-style", dependencies=[needs("reader")], **gives(PoseStyle, 404, 410, 412)
)
async def get_pose_style(
    surgeon: Slug, suture: Slug, request: Request, if_none_match: Condition = None, if_match: Condition = None
) -> Response:
    """Return the pose style of the style's released policy, if its tube is certified.

    404 says why there is none: nothing is released, the version is older than pose styles, its demonstrations have no
    orientation, or the certificate does not hold.
    """
    served: PolicyCache = request.app.state.served
    return answer(await served.body(surgeon, suture, POSES), if_none_match, if_match)


@router.get(
    "/policies/{surgeon}/{suture}/signature", dependencies=[needs("reader")], **gives(SignedEnvelope, 404, 410, 412)
)
async def get_policy_signature(
    surgeon: Slug, suture: Slug, request: Request, if_none_match: Condition = None, if_match: Condition = None
) -> Response:
    """Return this service's signature of the style's released policy: of its JSON, its arrays and its pose style.

    The policy itself has the same bytes with or without it. `skills policy verify` checks a file offline.
    """
    served: PolicyCache = request.app.state.served
    return answer(await served.body(surgeon, suture, SIGNATURE), if_none_match, if_match)


@router.get(
    "/policies/{surgeon}/{suture}/versions", dependencies=[needs("reader")], **gives_page(Page[GivenVersion], 404, 410)
)
def list_versions(
    surgeon: Slug, suture: Slug, db: Db, give: Giving, limit: Limit = 50, cursor: RowCursor = None
) -> Response:
    """List the versions of a style, the newest first."""
    with db.reading() as session:
        found = versions.list_versions(session, surgeon, suture, limit, cursor)
        return give.page([version_json(row) for row in found], limit, found[-1].version if found else None)


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}",
    dependencies=[needs("reader")],
    **gives(Policy, 404, 409, 410, 412, 415, as_well=(NPZ,)),
)
def get_version(
    surgeon: Slug,
    suture: Slug,
    version: Version,
    db: Db,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Condition = None,
    if_match: Condition = None,
) -> Response:
    """Return one version of a style, released or not, while the surgeon's consent covers training."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        policy = versions.followable(versions.find_version(session, surgeon, suture, version))
        return answer(encoded.policy(policy, None, accept), if_none_match, if_match)


@router.get(
    "/policy-versions/{policy}", dependencies=[needs("reader")], **gives(Policy, 404, 409, 412, 415, as_well=(NPZ,))
)
def get_policy_version(
    policy: Digest,
    db: Db,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Condition = None,
    if_match: Condition = None,
) -> Response:
    """Return a policy version by the digest under which it is cited, while the surgeon's consent covers training."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        found = versions.followable(versions.find_by_digest(session, policy))
        return answer(encoded.policy(found, None, accept), if_none_match, if_match)


@router.post(
    "/policies/{surgeon}/{suture}/versions/{version}/release",
    dependencies=[needs("releaser")],
    **says(PolicySummary, 404, 409, 410, 412),
)
def release(
    surgeon: Slug,
    suture: Slug,
    version: Version,
    db: Db,
    request: Request,
    actor: Actor,
    settings: Configured,
    if_match: Condition = None,
) -> Response:
    """Release a version if it passes the gate; releasing an older version rolls back.

    `If-Match` takes the ETag of the JSON that is served now, so that a concurrent release is not overwritten unnoticed.
    """
    encoded: Encoded = request.app.state.encoded
    with db.writing([locks.surgeon(surgeon)]) as session:
        policy = versions.find_version(session, surgeon, suture, version)
        if if_match is not None:
            _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        released = releases.release(session, policy, actor, constant_turn_deg=settings.constant_turn_deg)
        return say(summary_json(released))


@router.delete("/policies/{surgeon}/{suture}/release", dependencies=[needs("releaser")], **ends(404, 409, 410, 412))
def withdraw(surgeon: Slug, suture: Slug, db: Db, request: Request, actor: Actor, if_match: Condition = None) -> None:
    """Withdraw the released policy: the style serves nothing until a version is released again.

    `If-Match` takes the ETag of the JSON that is served now.
    """
    encoded: Encoded = request.app.state.encoded
    with db.writing([locks.surgeon(surgeon)]) as session:
        if if_match is not None:
            _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
        releases.withdraw(session, who, what.slug, actor)


@router.post("/policies/{surgeon}/{suture}/rollouts", dependencies=[needs("reader")], **says(Rollout, 404, 409, 410))
def roll_out(surgeon: Slug, suture: Slug, body: RolloutIn, db: Db) -> Response:
    """Follow the policy from a position to the goal."""
    with db.reading() as session:
        found = versions.about_rollout(versions.choose(session, surgeon, suture, body.version), body.start_mm)
        return say(found.model_dump(mode="json"))


@router.post("/policies/{surgeon}/{suture}/next", dependencies=[needs("reader")], **says(NextStep | NextPose, 404, 410))
def next_action(surgeon: Slug, suture: Slug, body: NextIn, db: Db) -> Response:
    """Return the policy's next action at a position, or the next pose of the pose style at a pose; nothing moves."""
    with db.reading() as session:
        policy = versions.policy_of(session, surgeon, suture).policy
        if body.rotation_xyzw is not None:
            poses = poses_of(policy)
            found = about_next(policy, poses, body.position_mm, body.rotation_xyzw, body.phase)
            return say(found.model_dump(mode="json"))
        step = next_step(learnt(policy), body.position_mm, body.phase)
        about = {"version": policy.version, "sha256": policy.sha256, "frame": policy.manifest["frame"]}
        return say(NextStep(**about, **vars(step)).model_dump(mode="json"))


@router.websocket("/policies/{surgeon}/{suture}/session", dependencies=[needs("reader")])
async def follow(surgeon: Slug, suture: Slug, socket: WebSocket) -> None:
    """Open a session of the released pose style (`skills.api.sessions`)."""
    sessions: Sessions = socket.app.state.sessions
    await sessions.serve(socket, surgeon, suture)


def _refuse_overtaken(session: Session, encoded: Encoded, surgeon: str, suture: str, if_match: str) -> None:
    """Check that If-Match names the policy that is released now.

    Raises:
        PreconditionFailed: Another one is released now.
    """
    served = versions.policy_of(session, surgeon, suture)
    if not names(if_match, encoded.policy(served.policy, served.release, JSON).etag):
        raise PreconditionFailed("Another policy is released now; read it, then repeat the request.")


card_router = router_of(tags=["policies"], max_body_size=MEBIBYTE)


@card_router.get(
    "/policies/{surgeon}/{suture}/versions/{version}/card",
    dependencies=[needs("reader")],
    **gives(PolicyCard, 404, 409, 410, 415, as_well=(HTML,)),
)
def get_policy_card(
    surgeon: Slug, suture: Slug, version: Version, db: Db, accept: Accept = "*/*", if_none_match: Condition = None
) -> Response:
    """Return the policy card of a version: JSON, or with `Accept: text/html` one file to attach to a paper.

    It states whether the version is released now and what rests on it, so its ETag changes with these.
    """
    as_page = wants_page(accept, "A policy card")
    find = versions.choose if as_page else versions.find_version
    card = _card(db, lambda session: find(session, surgeon, suture, version))
    return _answer(card, as_page, if_none_match)


@card_router.get(
    "/policies/{surgeon}/{suture}/versions/{version}/card/signature",
    dependencies=[needs("reader")],
    **gives(SignedEnvelope, 404, 410),
)
def get_policy_card_signature(surgeon: Slug, suture: Slug, version: Version, db: Db, give: Giving) -> Response:
    """Return this service's signature of the policy card of a version as it is now: of its JSON and of its page."""
    card = _card(db, lambda session: versions.find_version(session, surgeon, suture, version))
    assert card.facts.history is not None
    (head,) = read_notes(card.facts.history.note)
    files = {"card.json": _content(card, as_page=False), "card.html": _content(card, as_page=True)}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    policy = card.facts.policy.sha256
    facts = {"surgeon": surgeon, "suture": suture, "version": version, "policy": policy}
    return give.bytes(sign_files(db.history, head, digests, kind="card", **facts), JSON)


@card_router.get(
    "/policy-versions/{policy}/card",
    dependencies=[needs("reader")],
    **gives(PolicyCard, 404, 409, 415, as_well=(HTML,)),
)
def get_policy_version_card(
    policy: Digest, db: Db, accept: Accept = "*/*", if_none_match: Condition = None
) -> Response:
    """Return the policy card of a version by the digest under which it is cited."""
    as_page = wants_page(accept, "A policy card")
    seen = versions.followable if as_page else lambda version: version
    card = _card(db, lambda session: seen(versions.find_by_digest(session, policy)))
    return _answer(card, as_page, if_none_match)


def _card(db: Database, find: Callable[[Session], PolicyVersion]) -> Card:
    with db.reading() as session:
        version = find(session)
        card, row = card_of(session, version), version.row
    return card.under(head_over(db, [("policy_versions", row)]))


def _content(card: Card, *, as_page: bool) -> bytes:
    return card_page(card).encode() if as_page else json_of(card.written(), indented=True)


def _answer(card: Card, as_page: bool, if_none_match: str | None) -> Response:
    content = _content(card, as_page=as_page)
    tag, told = tag_of(content), card.facts.policy
    name = f"{told.surgeon}-{told.suture}-v{told.version}-card.{'html' if as_page else 'json'}"
    headers = {
        "ETag": tag,
        "Vary": "Accept",
        "Cache-Control": "no-cache",
        "Content-Disposition": f'inline; filename="{name}"',  # the name under which a browser saves it
        **(standalone_headers("card") if as_page else {}),
    }
    if if_none_match is not None and names(if_none_match, tag):
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=HTML if as_page else JSON)
