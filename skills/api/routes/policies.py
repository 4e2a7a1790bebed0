"""Routes of trainings and jobs, and of policies: the released one of a style, versions, releases, rollouts and cards.

A retraining is a batch of styles. A policy card is the JSON or HTML description of a version, built from verified
values only.
"""

from typing import Annotated

from fastapi import Query, Request, Response, WebSocket
from sqlalchemy.orm import Session

from skills.api.authorisation import needs
from skills.api.dependencies import Accept, Actor, Configured, Db, Digest, Limit, RowCursor, Slug, Version
from skills.api.encoded_policies import NPZ, Encoded, negotiate
from skills.api.openapi import ends, gives, gives_page, router_of, says
from skills.api.policy_cache import POSES, SIGNATURE, PolicyCache
from skills.api.responses import JSON, Condition, Giving, answer, names, say
from skills.api.sessions import Sessions
from skills.api.strict_json import Strict
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
from skills.schemas.requests import SLUG
from skills.settings import MEBIBYTE
from skills.transparency.statements import SignedEnvelope

router = router_of(route_class=Strict, tags=["policies"], max_body_size=MEBIBYTE)


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
        return give.page([summarise(one) for one in found], limit, found[-1].row if found else None)


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
        return give.page(
            [GivenVersion.model_validate(row) for row in found], limit, found[-1].version if found else None
        )


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
        return say(summarise(released))


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
        return say(answers.roll_out(versions.choose(session, surgeon, suture, body.version), body.start_mm))


@router.post("/policies/{surgeon}/{suture}/next", dependencies=[needs("reader")], **says(NextStep | NextPose, 404, 410))
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


def _refuse_overtaken(session: Session, encoded: Encoded, surgeon: str, suture: str, if_match: str) -> None:
    """Check that If-Match names the policy that is released now.

    Raises:
        PreconditionFailed: Another one is released now.
    """
    served = versions.served_release(session, surgeon, suture)
    if not names(if_match, encoded.policy(served.policy, served, JSON).etag):
        raise PreconditionFailed("Another policy is released now; read it, then repeat the request.")
