"""Policies: what is served, its history, and what it does from a place."""

from typing import Annotated

from fastapi import APIRouter, Header, Path, Query, Request, Response
from sqlalchemy.orm import Session

from skills.api.access import needs
from skills.api.answers import JSON, NPZ, Encoded, answer, negotiate
from skills.api.conditions import names
from skills.api.deps import SLUG, Actor, Db, Digest, Limit, RowCursor, Slug
from skills.api.documented import ends, gives, gives_page, says
from skills.api.replies import Giving, say
from skills.api.schemas.given import NextStep, Page, Policy, PolicySummary, Rollout
from skills.api.schemas.given import Version as GivenVersion
from skills.api.schemas.sent import NextIn, RolloutIn
from skills.api.schemas.written import summary_out, version_out
from skills.api.served import Served
from skills.api.strict import Strict
from skills.errors import PreconditionFailed
from skills.library import policies, releases
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.verified import learnt
from skills.settings import MEBIBYTE
from skills.style.policy import next_step

router = APIRouter(route_class=Strict, tags=["policies"], max_body_size=MEBIBYTE)

Version = Annotated[int, Path(ge=1, le=2**31)]
Accept = Annotated[str, Header(max_length=500)]
Match = Annotated[str | None, Header(max_length=2000)]


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
        found = policies.list_served(session, limit, cursor, surgeon, suture)
        return give.page([summary_out(one) for one in found], limit, found[-1].row if found else None)


@router.head("/policies/{surgeon}/{suture}", dependencies=[needs("reader")], include_in_schema=False)
@router.get(
    "/policies/{surgeon}/{suture}", dependencies=[needs("reader")], **gives(Policy, 404, 410, 412, 415, as_well=(NPZ,))
)
async def get_policy(
    surgeon: Slug,
    suture: Slug,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Match = None,
    if_match: Match = None,
) -> Response:
    """Serve the style's released policy: JSON, or with `Accept: application/x-npz` its arrays with the Q values.

    Encoded once and given from memory, for as long as nothing has changed (`skills.api.served`).
    """
    served: Served = request.app.state.served
    return answer(await served.body(surgeon, suture, negotiate(accept)), if_none_match, if_match)


@router.get(
    "/policies/{surgeon}/{suture}/versions", dependencies=[needs("reader")], **gives_page(Page[GivenVersion], 404, 410)
)
def list_versions(
    surgeon: Slug, suture: Slug, db: Db, give: Giving, limit: Limit = 50, cursor: RowCursor = None
) -> Response:
    """List the versions of a style, the newest first."""
    with db.reading() as session:
        found = policies.list_versions(session, surgeon, suture, limit, cursor)
        return give.page([version_out(row) for row in found], limit, found[-1].version if found else None)


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}",
    dependencies=[needs("reader")],
    **gives(Policy, 404, 410, 412, 415, as_well=(NPZ,)),
)
def get_version(
    surgeon: Slug,
    suture: Slug,
    version: Version,
    db: Db,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Match = None,
    if_match: Match = None,
) -> Response:
    """Give one version of a style, released or not."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        policy = policies.find_version(session, surgeon, suture, version)
        return answer(encoded.policy(policy, None, accept), if_none_match, if_match)


@router.get("/policy-versions/{policy}", dependencies=[needs("reader")], **gives(Policy, 404, 412, 415, as_well=(NPZ,)))
def get_policy_version(
    policy: Digest,
    db: Db,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Match = None,
    if_match: Match = None,
) -> Response:
    """Give a policy version by its digest, as it is cited."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        found = policies.find_by_digest(session, policy)
        return answer(encoded.policy(found, None, accept), if_none_match, if_match)


@router.post(
    "/policies/{surgeon}/{suture}/versions/{version}/release",
    dependencies=[needs("releaser")],
    **says(PolicySummary, 404, 409, 410, 412),
)
def release(
    surgeon: Slug, suture: Slug, version: Version, db: Db, request: Request, actor: Actor, if_match: Match = None
) -> Response:
    """Release a version if it passes the gate; an older one too, to roll back.

    `If-Match` takes the ETag of the JSON served now, so that nobody's release is overtaken unseen.
    """
    encoded: Encoded = request.app.state.encoded
    with db.writing() as session:
        policy = policies.find_version(session, surgeon, suture, version)
        if if_match is not None:
            _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        released = releases.release(session, policy, actor)
        return say(summary_out(released))


@router.delete("/policies/{surgeon}/{suture}/release", dependencies=[needs("releaser")], **ends(404, 409, 410, 412))
def withdraw(surgeon: Slug, suture: Slug, db: Db, request: Request, actor: Actor, if_match: Match = None) -> None:
    """Withdraw what is released: nothing of the style is served until somebody releases again.

    `If-Match` takes the ETag of the JSON served now.
    """
    encoded: Encoded = request.app.state.encoded
    with db.writing() as session:
        if if_match is not None:
            _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
        releases.withdraw(session, who, what.slug, actor)


@router.post("/policies/{surgeon}/{suture}/rollouts", dependencies=[needs("reader")], **says(Rollout, 404, 410))
def roll_out(surgeon: Slug, suture: Slug, body: RolloutIn, db: Db) -> Response:
    """Follow the policy from a place to the goal."""
    with db.reading() as session:
        return say(policies.about_rollout(policies.choose(session, surgeon, suture, body.version), body.start_mm))


@router.post("/policies/{surgeon}/{suture}/next", dependencies=[needs("reader")], **says(NextStep, 404, 410))
def next_action(surgeon: Slug, suture: Slug, body: NextIn, db: Db) -> Response:
    """Say what the policy would do at a place; nothing moves."""
    with db.reading() as session:
        policy = policies.policy_of(session, surgeon, suture).policy
        step = next_step(learnt(policy), body.position_mm, body.phase)
        about = {"version": policy.version, "sha256": policy.sha256, "frame": policy.manifest["frame"]}
        return say(about | vars(step))


def _refuse_overtaken(session: Session, encoded: Encoded, surgeon: str, suture: str, if_match: str) -> None:
    """Refuse to decide about a policy that is no longer the one that the client looked at.

    Raises:
        PreconditionFailed: Another one is released now.
    """
    served = policies.policy_of(session, surgeon, suture)
    if not names(if_match, encoded.policy(served.policy, served.release, JSON).etag):
        raise PreconditionFailed("Another policy is released now; look at it, then decide again.")
