"""Policies: what is served, its history, and what it does from a place."""

from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Request, Response

from skills.api.answers import Encoded, answer
from skills.api.deps import Actor, Db, Digest, Limit, RowCursor, Slug, page
from skills.api.schemas import NextIn, RolloutIn, version_out
from skills.db.base import rfc3339 as at
from skills.errors import PreconditionFailed
from skills.library import policies, releases
from skills.library.catalogue import find_surgeon, find_suture_type
from skills.library.verified import learnt
from skills.settings import MEBIBYTE
from skills.style.policy import next_step

router = APIRouter(tags=["policies"], max_body_size=MEBIBYTE)

Version = Annotated[int, Path(ge=1, le=2**31)]
Accept = Annotated[str, Header(max_length=500)]
Match = Annotated[str | None, Header(max_length=2000)]


@router.get("/policies")
def list_policies(db: Db, limit: Limit = 50, cursor: RowCursor = None) -> dict[str, Any]:
    """List the styles that serve a policy."""
    with db.reading() as session:
        found = policies.list_served(session, limit, cursor)
        items = [
            {
                "surgeon": one.policy.surgeon.slug,
                "suture": one.suture,
                "released_at": at(one.released_at),
                "released_by": one.released_by,
                **version_out(one.policy),
            }
            for one in found
        ]
        return page(items, limit, found[-1].row if found else None)


@router.get("/policies/{surgeon}/{suture}")
def get_policy(
    surgeon: Slug, suture: Slug, db: Db, request: Request, accept: Accept = "*/*", if_none_match: Match = None
) -> Response:
    """Serve the style's released policy: JSON, or with `Accept: application/x-npz` its arrays with the Q values."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        served = policies.policy_of(session, surgeon, suture)
        return answer(encoded.policy(served.policy, served.release, accept), if_none_match)


@router.get("/policies/{surgeon}/{suture}/versions")
def list_versions(surgeon: Slug, suture: Slug, db: Db, limit: Limit = 50, cursor: RowCursor = None) -> dict[str, Any]:
    """List the versions of a style, the newest first."""
    with db.reading() as session:
        found = policies.list_versions(session, surgeon, suture, limit, cursor)
        return page([version_out(row) for row in found], limit, found[-1].version if found else None)


@router.get("/policies/{surgeon}/{suture}/versions/{version}")
def get_version(
    surgeon: Slug,
    suture: Slug,
    version: Version,
    db: Db,
    request: Request,
    accept: Accept = "*/*",
    if_none_match: Match = None,
) -> Response:
    """Give one version of a style, released or not."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        policy = policies.find_version(session, surgeon, suture, version)
        return answer(encoded.policy(policy, None, accept), if_none_match)


@router.get("/policy-versions/{policy}")
def get_policy_version(
    policy: Digest, db: Db, request: Request, accept: Accept = "*/*", if_none_match: Match = None
) -> Response:
    """Give a policy version by its digest, as it is cited."""
    encoded: Encoded = request.app.state.encoded
    with db.reading() as session:
        found = policies.find_by_digest(session, policy)
        return answer(encoded.policy(found, None, accept), if_none_match)


@router.post("/policies/{surgeon}/{suture}/versions/{version}/release")
def release(
    surgeon: Slug, suture: Slug, version: Version, db: Db, request: Request, actor: Actor, if_match: Match = None
) -> dict[str, Any]:
    """Release a version if it passes the gate; an older one too, to roll back.

    `If-Match` takes the ETag of the JSON served now, so that nobody's release is overtaken unseen.
    """
    encoded: Encoded = request.app.state.encoded
    with db.writing() as session:
        policy = policies.find_version(session, surgeon, suture, version)
        if if_match is not None:
            served = policies.policy_of(session, surgeon, suture)
            tag = encoded.policy(served.policy, served.release, "application/json").etag
            if if_match.strip() not in (tag, "*"):
                raise PreconditionFailed("Another policy is released now; look at it, then decide again.")
        released = releases.release(session, policy, actor)
        return {"released_at": at(released.released_at), "released_by": released.released_by, **version_out(policy)}


@router.delete("/policies/{surgeon}/{suture}/release", status_code=204)
def withdraw(surgeon: Slug, suture: Slug, db: Db, actor: Actor) -> None:
    """Withdraw what is released: nothing of the style is served until somebody releases again."""
    with db.writing() as session:
        who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
        releases.withdraw(session, who, what.slug, actor)


@router.post("/policies/{surgeon}/{suture}/rollouts")
def roll_out(surgeon: Slug, suture: Slug, body: RolloutIn, db: Db) -> dict[str, Any]:
    """Follow the policy from a place to the goal."""
    with db.reading() as session:
        return policies.about_rollout(policies.choose(session, surgeon, suture, body.version), body.start_mm)


@router.post("/policies/{surgeon}/{suture}/next")
def next_action(surgeon: Slug, suture: Slug, body: NextIn, db: Db) -> dict[str, Any]:
    """Say what the policy would do at a place; nothing moves."""
    with db.reading() as session:
        policy = policies.policy_of(session, surgeon, suture).policy
        step = next_step(learnt(policy), body.position_mm, body.phase)
        return {"version": policy.version, "sha256": policy.sha256, "frame": policy.manifest["frame"], **vars(step)}
