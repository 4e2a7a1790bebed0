"""Routes of recordings, and of the hand-offs proposed in them. Storing a recording never starts a training."""

from typing import Annotated, Literal

from fastapi import Path, Query, Response
from pydantic import Field

from skills.api.authorisation import Asking, needs
from skills.api.dependencies import Actor, Db, Digest, ListingByRow, OfRecording, OfSurgeon, Parse, RowCursor
from skills.api.openapi import ends, gives, makes, router_of, says, uploads_of
from skills.api.responses import Giving, say, stored
from skills.api.routes.pages import NOT_STORED, Picked, WebPage
from skills.api.routes.pages import router as page_router
from skills.api.uploads import Incoming
from skills.formats import BYTES, MEDIA_TYPES
from skills.library.operation import locks, overview
from skills.library.operation.sweep import drop_contents, sweep_erased
from skills.library.people import erasure
from skills.library.recordings import proposals, recordings
from skills.library.recordings.proposals import describe_proposal
from skills.library.recordings.recordings import describe_recording, find_recording
from skills.schemas import Page, ProposalState
from skills.schemas.demos import Proposal, ProposalIn
from skills.schemas.recordings import Recording, RecordingPreview, RecordingSummary, TableIn
from skills.schemas.requests import SLUG, SlugField

uploads = uploads_of("demonstrations")


router = router_of("demonstrations")


RAW_BODY = {
    "requestBody": {
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in (BYTES, *MEDIA_TYPES)},
    }
}


class RecordingQuery(TableIn):
    """Query parameters of an upload of a recording, with what a table or a LeRobot episode leaves open."""

    surgeon: SlugField | None = Field(
        None, description="The surgeon who was recorded; erasing this surgeon deletes the recording."
    )


@uploads.post("/recordings", openapi_extra=RAW_BODY, **makes("uploader", Recording, 404, 409, 410))
def add_recording(
    upload: Incoming, asked: Annotated[RecordingQuery, Query()], db: Db, parse: Parse, actor: Actor
) -> Response:
    """Store a recording, once for equal bytes, and propose the hand-offs in it."""
    row, created = recordings.store_recording(db, upload.read_as(asked), actor, parse, asked.surgeon)
    return stored(describe_recording(row), created, f"/recordings/{row.sha256}")


@uploads.post("/recordings/preview", openapi_extra=RAW_BODY, **says("uploader", RecordingPreview))
def preview_recording(upload: Incoming, asked: Annotated[TableIn, Query()], parse: Parse) -> Response:
    """Read a recording and return what would be understood of it, a table's columns included; nothing is stored."""
    return say(recordings.preview(upload.read_as(asked), parse))


@router.get("/recordings", **gives("reader", Page[RecordingSummary], 410))
def list_recordings(db: Db, listing: ListingByRow) -> Response:
    """List recordings, the newest first."""
    with db.reading() as session:
        found = overview.newest_recordings(session, listing.cursor, listing.limit)
        written = [recordings.summarise_recording(row, cut) for row, cut in found]
        return listing.page(written, [row for row, _ in found])


@router.get("/recordings/{recording}", **gives("reader", Recording, 404))
def get_recording(recording: Digest, db: Db, give: Giving) -> Response:
    """Return a recording."""
    with db.reading() as session:
        return give(describe_recording(recordings.find_recording(session, recording)))


@router.delete("/recordings/{recording}", **ends("uploader", 404, 409))
def delete_recording(recording: Digest, db: Db, caller: Asking) -> None:
    """Delete a recording without demonstrations permanently; allowed to its uploader and to admins."""
    as_admin = caller.role == "admin"
    with db.reading() as session:
        stored, alone = erasure.deletable_recording(session, recording, caller.name, as_admin=as_admin)
    recording = stored.sha256  # in full: the argument may be a prefix
    drop_contents(db, [stored.row] if alone else [])
    with db.ending([locks.recording(recording)]) as session:
        erasure.delete_recording(session, recording, caller.name, as_admin=as_admin)
    sweep_erased(db)


Number = Annotated[int, Path(ge=1, le=1_000_000, description="The number of the proposal, counted from 1.")]


@router.get("/proposals", **gives("reader", Page[Proposal], 404, 410))
def list_proposals(
    db: Db,
    listing: ListingByRow,
    state: Annotated[ProposalState | None, Query(description="Only those in this state.")] = None,
    recording: OfRecording = None,
    surgeon: OfSurgeon = None,
    suture: Annotated[
        str | None, Query(pattern=SLUG, description="Only accepted ones, whose demonstration is of this suture type.")
    ] = None,
) -> Response:
    """List the hand-offs proposed in recordings, those of the newest recording first.

    A page may be shorter than `limit`, or empty, though `next` names another one.
    """
    asked = {"recording": recording, "surgeon": surgeon, "suture": suture}
    with db.reading() as session:
        found, following = proposals.list_proposals(session, listing.limit, listing.cursor, state=state, **asked)
        return listing.give.page([describe_proposal(one) for one in found], following)


@router.put("/recordings/{recording}/proposals/{number}", **says("uploader", Proposal, 404, 409))
def decide_proposal(recording: Digest, number: Number, body: ProposalIn, db: Db, actor: Actor) -> Response:
    """Reject a proposed hand-off, or open a rejected one again; `POST /recordings/{recording}/demos` accepts it."""
    with db.reading() as session:
        recording = find_recording(session, recording).sha256  # in full: the argument may be a prefix
    with db.writing([locks.recording(recording)]) as session:
        return say(describe_proposal(proposals.decide(session, recording, number, body.state, body.note, actor)))


@page_router.get("/pages/proposals", dependencies=[needs("reader")])
def show_proposals(
    page: WebPage,
    state: Literal["", "open", "accepted", "rejected"] = "open",
    recording: Picked = None,
    surgeon: Picked = None,
    suture: Picked = None,
    cursor: RowCursor = None,
) -> Response:
    """Show proposed hand-offs, to be accepted, corrected or rejected; a form sends an empty text for any of them."""
    asked = {"recording": recording or None, "surgeon": surgeon or None, "suture": suture or None}
    with page.db.reading() as session:
        found, following = proposals.list_proposals(session, overview.MOST, cursor, state=state or None, **asked)
        return page.show(
            "proposals.html",
            found=found,
            following=following,
            asked=asked | {"state": state},
            surgeons=overview.surgeons_to_choose(session),
            sutures=overview.all_suture_types(session),
        )


@page_router.get("/pages/recordings/{recording}/proposals", dependencies=[needs("reader")])
def draw_proposals(recording: Digest, db: Db, parse: Parse) -> Response:
    """Return the paths of the tip in all proposals of a recording, for their small pictures."""
    return say({"paths_mm": proposals.paths_of(db, recording, parse)}, headers=NOT_STORED)
