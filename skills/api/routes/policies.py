"""Routes of trainings and jobs, and of policies: the released one of a style, versions, releases, rollouts and cards.

A retraining is a batch of styles. A policy card is the JSON or HTML description of a version, built from verified
values only.
"""

from fastapi import Response, WebSocket
from sqlalchemy.orm import Session

from skills.api.authorisation import needs
from skills.api.dependencies import (
    Accept,
    Actor,
    Configured,
    Db,
    Digest,
    Encoder,
    ListingByRow,
    OfSurgeon,
    OfSuture,
    Served,
    Slug,
    Version,
)
from skills.api.encoded_policies import FORMATS, NPZ, Encoded
from skills.api.openapi import ends, gives, router_of, says
from skills.api.policy_cache import POSES, SIGNATURE
from skills.api.responses import JSON, Condition, Conditional, names, negotiate, say
from skills.api.sessions import Sessions
from skills.errors import PreconditionFailed
from skills.learning.policy import next_step
from skills.library.operation import locks
from skills.library.operation.integrity import learnt
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.policies import answers, releases, versions
from skills.library.policies.answers import summarise
from skills.library.policies.pose_styles import find_next, poses_of
from skills.schemas import Page
from skills.schemas.policies import NextStep, Policy, PolicySummary, Rollout, RolloutIn
from skills.schemas.policies import Version as GivenVersion
from skills.schemas.pose_styles import NextIn, NextPose, PoseStyle
from skills.transparency.statements import SignedEnvelope

router = router_of("policies")


# ---- policies ------------------------------------------------------------------------------------------------------


@router.get("/policies", **gives("reader", Page[PolicySummary], 404, 410))
def list_policies(db: Db, listing: ListingByRow, surgeon: OfSurgeon = None, suture: OfSuture = None) -> Response:
    """List the styles that serve a policy."""
    with db.reading() as session:
        found = versions.list_served(session, listing.limit, listing.cursor, surgeon, suture)
        return listing.page([summarise(one) for one in found], found)


@router.head("/policies/{surgeon}/{suture}", dependencies=[needs("reader")], include_in_schema=False)
@router.get("/policies/{surgeon}/{suture}", **gives("reader", Policy, 404, 410, 412, 415, as_well=(NPZ,)))
# async, because a response from the cache takes less time than starting a thread for it
async def get_policy(surgeon: Slug, suture: Slug, served: Served, conditions: Conditional, accept: Accept) -> Response:
    """Return the style's released policy: JSON, or with `Accept: application/x-npz` its arrays with the Q values.

    It is encoded once and served from memory until something changes (`skills.api.policy_cache`).
    """
    return conditions.answer(await served.body(surgeon, suture, negotiate(accept, *FORMATS)))


@router.get("/policies/{surgeon}/{suture}/pose-style", **gives("reader", PoseStyle, 404, 410, 412))
async def get_pose_style(surgeon: Slug, suture: Slug, served: Served, conditions: Conditional) -> Response:
    """Return the pose style of the style's released policy, if its tube is certified.

    404 says why there is none: nothing is released, the version is older than pose styles, its demonstrations have no
    orientation, or the certificate does not hold.
    """
    return conditions.answer(await served.body(surgeon, suture, POSES))


@router.get("/policies/{surgeon}/{suture}/signature", **gives("reader", SignedEnvelope, 404, 410, 412))
async def get_policy_signature(surgeon: Slug, suture: Slug, served: Served, conditions: Conditional) -> Response:
    """Return this service's signature of the style's released policy: of its JSON, its arrays and its pose style.

    The policy itself has the same bytes with or without it. `skills policy verify` checks a file offline.
    """
    return conditions.answer(await served.body(surgeon, suture, SIGNATURE))


@router.get("/policies/{surgeon}/{suture}/versions", **gives("reader", Page[GivenVersion], 404, 410))
def list_versions(surgeon: Slug, suture: Slug, db: Db, listing: ListingByRow) -> Response:
    """List the versions of a style, the newest first."""
    with db.reading() as session:
        found = versions.list_versions(session, surgeon, suture, listing.limit, listing.cursor)
        return listing.page([GivenVersion.model_validate(row) for row in found], found, by="version")


@router.get(
    "/policies/{surgeon}/{suture}/versions/{version}",
    **gives("reader", Policy, 404, 409, 410, 412, 415, as_well=(NPZ,)),
)
def get_version(
    surgeon: Slug, suture: Slug, version: Version, db: Db, encoded: Encoder, conditions: Conditional, accept: Accept
) -> Response:
    """Return one version of a style, released or not, while the surgeon's consent covers training."""
    with db.reading() as session:
        policy = versions.followable(versions.find_version(session, surgeon, suture, version))
        return conditions.answer(encoded.policy(policy, None, accept))


@router.get("/policy-versions/{policy}", **gives("reader", Policy, 404, 409, 412, 415, as_well=(NPZ,)))
def get_policy_version(policy: Digest, db: Db, encoded: Encoder, conditions: Conditional, accept: Accept) -> Response:
    """Return a policy version by the digest under which it is cited, while the surgeon's consent covers training."""
    with db.reading() as session:
        found = versions.followable(versions.find_by_digest(session, policy))
        return conditions.answer(encoded.policy(found, None, accept))


@router.post(
    "/policies/{surgeon}/{suture}/versions/{version}/release", **says("releaser", PolicySummary, 404, 409, 410, 412)
)
def release(
    surgeon: Slug,
    suture: Slug,
    version: Version,
    db: Db,
    encoded: Encoder,
    actor: Actor,
    settings: Configured,
    if_match: Condition = None,
) -> Response:
    """Release a version if it passes the gate; releasing an older version rolls back.

    `If-Match` takes the ETag of the JSON that is served now, so that a concurrent release is not overwritten unnoticed.
    """
    with db.writing([locks.surgeon(surgeon)]) as session:
        policy = versions.find_version(session, surgeon, suture, version)
        _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        released = releases.release(session, policy, actor, constant_turn_deg=settings.constant_turn_deg)
        return say(summarise(released))


@router.delete("/policies/{surgeon}/{suture}/release", **ends("releaser", 404, 409, 410, 412))
def withdraw(surgeon: Slug, suture: Slug, db: Db, encoded: Encoder, actor: Actor, if_match: Condition = None) -> None:
    """Withdraw the released policy: the style serves nothing until a version is released again.

    `If-Match` takes the ETag of the JSON that is served now.
    """
    with db.ending([locks.surgeon(surgeon)]) as session:
        _refuse_overtaken(session, encoded, surgeon, suture, if_match)
        who, what = find_surgeon(session, surgeon), find_suture_type(session, suture)
        releases.withdraw(session, who, what.slug, actor)


@router.post("/policies/{surgeon}/{suture}/rollouts", **says("reader", Rollout, 404, 409, 410))
def roll_out(surgeon: Slug, suture: Slug, body: RolloutIn, db: Db) -> Response:
    """Follow the policy from a position to the goal."""
    with db.reading() as session:
        return say(answers.roll_out(versions.choose(session, surgeon, suture, body.version), body.start_mm))


@router.post("/policies/{surgeon}/{suture}/next", **says("reader", NextStep | NextPose, 404, 410))
def next_action(surgeon: Slug, suture: Slug, body: NextIn, db: Db) -> Response:
    """Return the policy's next action at a position, or the next pose of the pose style at a pose; nothing moves."""
    with db.reading() as session:
        policy = versions.served_release(session, surgeon, suture).policy
        if body.rotation_xyzw is not None:
            poses = poses_of(policy)
            return say(find_next(policy, poses, body.position_mm, body.rotation_xyzw, body.phase))
        step = next_step(learnt(policy), body.position_mm, body.phase)
        name = {"version": policy.version, "sha256": policy.sha256, "frame": policy.manifest.frame}
        return say(NextStep.model_validate(name | vars(step)))


@router.websocket("/policies/{surgeon}/{suture}/session", dependencies=[needs("reader")])
async def follow(surgeon: Slug, suture: Slug, socket: WebSocket) -> None:
    """Open a session of the released pose style (`skills.api.sessions`)."""
    sessions: Sessions = socket.app.state.sessions
    await sessions.serve(socket, surgeon, suture)


def _refuse_overtaken(session: Session, encoded: Encoded, surgeon: str, suture: str, if_match: str | None) -> None:
    """Check that If-Match, where it is sent, names the policy that is released now.

    Raises:
        PreconditionFailed: Another one is released now.
    """
    if if_match is None:
        return
    served = versions.served_release(session, surgeon, suture)
    if not names(if_match, encoded.policy(served.policy, served, JSON).etag):
        raise PreconditionFailed("Another policy is released now; read it, then repeat the request.")
