"""Routes of recordings and demonstrations. Storing one never starts a training."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from sqlalchemy import select

from skills.api.authorisation import Asking, erasing_is_for_admins, needs
from skills.api.dependencies import Actor, Db, Digest, Incoming, Jobs, Limit, RowCursor, Strict, Tell
from skills.api.openapi import ends, gives, gives_file, gives_page, makes
from skills.api.pages import HTML, standalone_headers, wants_page
from skills.api.pages.drawings import report_page
from skills.api.responses import Condition, Giving, Stream, as_asked, names, recording_pieces, refuse_changed, stored
from skills.api.routes.policies import Accept
from skills.db.models import StoredRewardMap
from skills.formats import BYTES, MEDIA_TYPES
from skills.library import demos, erasure
from skills.library.demos import demo_json, path_json, recording_json, reward_map_json
from skills.schemas.given import Demonstration, DemoPath, Page, Recording, RewardMap
from skills.schemas.requests import DIGEST, SLUG, DemoIn, Schema, SlugField
from skills.settings import MEBIBYTE

uploads = APIRouter(tags=["demonstrations"])
router = APIRouter(route_class=Strict, tags=["demonstrations"], max_body_size=MEBIBYTE)

RAW_BODY = {
    "requestBody": {
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in (BYTES, *MEDIA_TYPES)},
    }
}


class RecordingQuery(Schema):
    """Query parameters of an upload of a recording; `rate_hz` and `frame` describe a table (see `receive`)."""

    rate_hz: float | None = None
    frame: str | None = None
    surgeon: SlugField | None = Field(
        None, description="The surgeon who was recorded; erasing this surgeon deletes the recording."
    )


class DemoUpload(DemoIn):
    """Query parameters of an upload of a demonstration: `DemoIn`, and the description of a table (see `receive`)."""

    rate_hz: float | None = None
    frame: str | None = None


@uploads.post(
    "/recordings", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Recording, 404, 409, 410)
)
def add_recording(
    upload: Incoming, asked: Annotated[RecordingQuery, Query()], db: Db, read: Tell, actor: Actor
) -> Response:
    """Store a recording, once for equal bytes, and propose the hand-offs in it."""
    row, created = demos.store_recording(db, upload, actor, read, asked.surgeon)
    return stored(recording_json(row), created, f"/recordings/{row.sha256}")


@uploads.post("/demos", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Demonstration, 404, 409, 410))
def upload_demo(upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, read: Tell, actor: Actor) -> Response:
    """Store a recording and one demonstration of it, both or neither."""
    return _stored(demos.upload_demo(db, upload, asked, actor, read))


@router.get("/recordings/{recording}", dependencies=[needs("reader")], **gives(Recording, 404))
def get_recording(recording: Digest, db: Db, give: Giving) -> Response:
    """Return a recording."""
    with db.reading() as session:
        return give(recording_json(demos.find_recording(session, recording)))


@router.delete("/recordings/{recording}", dependencies=[needs("uploader")], **ends(404, 409))
def delete_recording(recording: Digest, db: Db, caller: Asking) -> None:
    """Delete a recording without demonstrations permanently; allowed to its uploader and to admins."""
    with db.writing() as session:
        erasure.delete_recording(session, recording, caller.name, anybodys=caller.role == "admin")
    db.forget()


@router.post("/recordings/{recording}/demos", dependencies=[needs("uploader")], **makes(Demonstration, 404, 409, 410))
def add_demo(recording: Digest, body: DemoIn, db: Db, read: Tell, actor: Actor) -> Response:
    """Cut one demonstration out of a stored recording."""
    return _stored(demos.add_demo(db, recording, body, actor, read))


def _stored(added: demos.Added) -> Response:
    return stored(demo_json(added.row, added.taken), added.new, f"/demos/{added.row.sha256}")


@router.get("/demos", dependencies=[needs("reader")], **gives_page(Page[Demonstration], 404, 410))
def list_demos(
    db: Db,
    give: Giving,
    surgeon: Annotated[str | None, Query(pattern=SLUG)] = None,
    suture: Annotated[str | None, Query(pattern=SLUG)] = None,
    recording: Annotated[str | None, Query(pattern=DIGEST)] = None,
    active: Annotated[
        bool | None, Query(description="true: only active demonstrations; false: only withdrawn ones.")
    ] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        found = demos.list_demos(session, limit, cursor, surgeon, suture, recording, active)
        return give.page([demo_json(row) for row in found], limit, found[-1].row if found else None)


@router.get("/demos/{demo}", dependencies=[needs("reader")], **gives(Demonstration, 404))
def get_demo(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration."""
    with db.reading() as session:
        return give(demo_json(demos.find_demo(session, demo)))


@router.get(
    "/demos/{demo}/recording",
    dependencies=[needs("reader")],
    **gives_file((BYTES, *MEDIA_TYPES), 404, 409),
)
def get_demo_recording(
    demo: Digest, db: Db, request: Request, if_none_match: Condition = None, accept: Accept = "*/*"
) -> Response:
    """Return the bytes of a demonstration's recording as uploaded; all are verified before the first is sent."""
    with db.reading() as session:
        kept = demos.exported_recording(session, demo)
        media_type, sha256, tag = as_asked(accept, kept.media_type), kept.sha256, {"ETag": f'"{kept.sha256}"'}
        headers = {"Content-Length": str(kept.size_bytes), **tag}
    if if_none_match is not None and names(if_none_match, tag["ETag"]):
        return Response(status_code=304, headers=tag)
    # outside the session, because a slow client may keep the stream open for long
    return Stream(recording_pieces(db, demo, sha256, request.app.state.downloads), media_type, headers)


@router.get("/demos/{demo}/path", dependencies=[needs("reader")], **gives(DemoPath, 404))
def get_path(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration's states in the grid and its motion as recorded."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        return give(path_json(row))


@router.get("/demos/{demo}/report", dependencies=[needs("reader")], **gives(Demonstration, 404, 415, as_well=(HTML,)))
def get_report(demo: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a demonstration's quality report, with advice: JSON, or with `Accept: text/html` a page."""
    as_page = wants_page(accept, "A report")
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        about, report = demo_json(row), demos.full_report(row)
        if as_page:
            page = give.bytes(report_page(about, report, row.demo, row.path).encode(), HTML)
            page.headers.update(standalone_headers("demo_report"))
            return page
        return give(about | {"report": report})


@router.get("/demos/{demo}/reward-map", dependencies=[needs("reader")], **gives(RewardMap, 404))
def get_reward_map(demo: Digest, db: Db, give: Giving) -> Response:
    """Return the rewards of Algorithm 1 for a demonstration, without the states whose reward is `other`."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        kept = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == row.row)).one()
        return give(reward_map_json(row, kept))


@router.delete("/demos/{demo}", dependencies=[needs("releaser"), erasing_is_for_admins], **ends(404, 409, 412))
def withdraw_demo(
    demo: Digest, db: Db, jobs: Jobs, actor: Actor, erase: bool = False, if_match: Condition = None
) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and its derived data."""
    dropped: erasure.Dropped = []
    with db.writing() as session:
        if if_match:
            refuse_changed(demo_json(demos.find_demo(session, demo)), if_match)
        demos.withdraw_demo(session, demo, actor)
        if erase:
            dropped = erasure.erase_demo(session, demo, actor)
    if erase:
        db.forget()
    # after the commit, because one transaction cannot span our database and the engine's
    for row, attempt in dropped:
        jobs.cancel(row, attempt)
