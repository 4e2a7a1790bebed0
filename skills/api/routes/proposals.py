"""Routes of proposed hand-offs: the list of all recordings' proposals, the decision on one, and their page."""

from typing import Annotated, Literal

from fastapi import Path, Query, Request, Response

from skills.api.authorisation import Asking, needs
from skills.api.dependencies import Actor, Db, Digest, Limit, RowCursor, Strict, Tell
from skills.api.openapi import gives_page, router_of, says
from skills.api.pages import render
from skills.api.responses import Giving, say
from skills.api.routes.pages import PageRoute, Picked
from skills.library import locks, overview, proposals
from skills.library.proposals import proposal_json
from skills.library.recordings import find_recording
from skills.schemas import ProposalState
from skills.schemas.given import Page, Proposal
from skills.schemas.requests import DIGEST, SLUG, ProposalIn
from skills.settings import MEBIBYTE

router = router_of(route_class=Strict, tags=["demonstrations"], max_body_size=MEBIBYTE)
page_router = router_of(route_class=PageRoute, include_in_schema=False, max_body_size=MEBIBYTE)

Number = Annotated[int, Path(ge=1, le=1_000_000, description="The number of the proposal, counted from 1.")]


@router.get("/proposals", dependencies=[needs("reader")], **gives_page(Page[Proposal], 404, 410))
def list_proposals(
    db: Db,
    give: Giving,
    state: Annotated[ProposalState | None, Query(description="Only those in this state.")] = None,
    recording: Annotated[str | None, Query(pattern=DIGEST)] = None,
    surgeon: Annotated[str | None, Query(pattern=SLUG)] = None,
    suture: Annotated[
        str | None, Query(pattern=SLUG, description="Only accepted ones, whose demonstration is of this suture type.")
    ] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List the hand-offs proposed in recordings, those of the newest recording first.

    A page may be shorter than `limit`, or empty, though `next` names another one.
    """
    asked = {"recording": recording, "surgeon": surgeon, "suture": suture}
    with db.reading() as session:
        found, following = proposals.list_proposals(session, limit, cursor, state=state, **asked)
        return give.page([proposal_json(one) for one in found], len(found), following)


@router.put("/recordings/{recording}/proposals/{number}", dependencies=[needs("uploader")], **says(Proposal, 404, 409))
def decide_proposal(recording: Digest, number: Number, body: ProposalIn, db: Db, actor: Actor) -> Response:
    """Reject a proposed hand-off, or open a rejected one again; `POST /recordings/{recording}/demos` accepts it."""
    with db.reading() as session:
        recording = find_recording(session, recording).sha256  # in full: the argument may be a prefix
    with db.writing([locks.recording(recording)]) as session:
        return say(proposal_json(proposals.decide(session, recording, number, body.state, body.note, actor)))


@page_router.get("/pages/proposals", dependencies=[needs("reader")])
def show_proposals(
    request: Request,
    caller: Asking,
    db: Db,
    state: Literal["", "open", "accepted", "rejected"] = "open",
    recording: Picked = None,
    surgeon: Picked = None,
    suture: Picked = None,
    cursor: RowCursor = None,
) -> Response:
    """Show proposed hand-offs, to be accepted, corrected or rejected; a form sends an empty text for any of them."""
    asked = {"recording": recording or None, "surgeon": surgeon or None, "suture": suture or None}
    with db.reading() as session:
        found, following = proposals.list_proposals(session, overview.MOST, cursor, state=state or None, **asked)
        return render(
            request,
            "proposals.html",
            caller,
            found=found,
            following=following,
            asked=asked | {"state": state},
            surgeons=overview.all_surgeons(session),
            sutures=overview.all_suture_types(session),
        )


@page_router.get("/pages/recordings/{recording}/proposals", dependencies=[needs("reader")])
def draw_proposals(recording: Digest, caller: Asking, db: Db, tell: Tell) -> Response:
    """Return the paths of the tip in all proposals of a recording, for their small pictures."""
    return say({"paths_mm": proposals.paths_of(db, recording, tell)}, headers={"Cache-Control": "no-store"})
