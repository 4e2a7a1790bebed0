"""Recordings and demonstrations. Storing one never trains."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import select

from skills.api.access import erasing_is_for_admins, needs
from skills.api.conditions import Condition, names, refuse_changed
from skills.api.deps import DIGEST, SLUG, Actor, Db, Digest, Incoming, Jobs, Limit, Read, RowCursor
from skills.api.documented import ends, gives, gives_file, gives_page, makes
from skills.api.pages.demo import demo_page
from skills.api.pages.page import HEADERS
from skills.api.pages.wanted import HTML, wants_page
from skills.api.replies import Giving, stored
from skills.api.routes.policies import Accept
from skills.api.schemas.given import Demonstration, DemoPath, Page, Recording, RewardMap
from skills.api.schemas.sent import DemoIn, Schema
from skills.api.schemas.written import demo_out, path_out, recording_out, reward_map_out
from skills.api.strict import Strict
from skills.db.books import Job
from skills.db.models import StoredRewardMap
from skills.library import demos, erasure, recordings
from skills.library.demos import Cut
from skills.recordings import MEDIA_TYPES
from skills.settings import MEBIBYTE

uploads = APIRouter(tags=["demonstrations"])
router = APIRouter(route_class=Strict, tags=["demonstrations"], max_body_size=MEBIBYTE)

RAW_BODY = {
    "requestBody": {
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in MEDIA_TYPES},
    }
}


class RecordingUpload(Schema):
    """All that the query may hold: how a table is to be read (see `receive`)."""

    rate_hz: float | None = None
    frame: str | None = None


class DemoUpload(DemoIn):
    """`DemoIn` in the query, beside what tells how a table is to be read (see `receive`)."""

    rate_hz: float | None = None
    frame: str | None = None

    def cut(self) -> Cut:
        """The request as the library knows it."""
        return Cut(**self.model_dump(exclude={"rate_hz", "frame"}))


@uploads.post("/recordings", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Recording))
def add_recording(
    upload: Incoming, _asked: Annotated[RecordingUpload, Query()], db: Db, read: Read, actor: Actor
) -> Response:
    """Store a recording's bytes once, and propose the hand-offs in it."""
    row, created = recordings.store_recording(db, upload, actor, read)
    return stored(recording_out(row), created, f"/recordings/{row.sha256}")


@uploads.post("/demos", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Demonstration, 404, 409, 410))
def upload_demo(upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, read: Read, actor: Actor) -> Response:
    """Store a recording and one demonstration of it, both or neither."""
    row, created = demos.upload_demo(db, upload, asked.cut(), actor, read)
    return stored(demo_out(row), created, f"/demos/{row.sha256}")


@router.get("/recordings/{recording}", dependencies=[needs("reader")], **gives(Recording, 404))
def get_recording(recording: Digest, db: Db, give: Giving) -> Response:
    """Look a recording up."""
    with db.reading() as session:
        return give(recording_out(recordings.find_recording(session, recording)))


@router.post("/recordings/{recording}/demos", dependencies=[needs("uploader")], **makes(Demonstration, 404, 409, 410))
def add_demo(recording: Digest, body: DemoIn, db: Db, read: Read, actor: Actor) -> Response:
    """Cut one demonstration out of a stored recording."""
    row, created = demos.add_demo(db, recording, Cut(**body.model_dump()), actor, read)
    return stored(demo_out(row), created, f"/demos/{row.sha256}")


@router.get("/demos", dependencies=[needs("reader")], **gives_page(Page[Demonstration], 404, 410))
def list_demos(
    db: Db,
    give: Giving,
    surgeon: Annotated[str | None, Query(pattern=SLUG)] = None,
    suture: Annotated[str | None, Query(pattern=SLUG)] = None,
    recording: Annotated[str | None, Query(pattern=DIGEST)] = None,
    active: Annotated[bool | None, Query(description="true leaves out what was withdrawn, false all else.")] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        found = demos.list_demos(session, limit, cursor, surgeon, suture, recording, active)
        return give.page([demo_out(row) for row in found], limit, found[-1].row if found else None)


@router.get("/demos/{demo}", dependencies=[needs("reader")], **gives(Demonstration, 404))
def get_demo(demo: Digest, db: Db, give: Giving) -> Response:
    """Look a demonstration up."""
    with db.reading() as session:
        return give(demo_out(demos.find_demo(session, demo)))


@router.get(
    "/demos/{demo}/recording",
    dependencies=[needs("reader")],
    **gives_file(MEDIA_TYPES, 404, 409),
)
def get_demo_recording(demo: Digest, db: Db, if_none_match: Condition = None) -> Response:
    """Give the recording's bytes back exactly."""
    with db.reading() as session:
        kept = demos.exported_recording(session, demo)
        media_type, sha256, tag = kept.media_type, kept.sha256, {"ETag": f'"{kept.sha256}"'}
        headers = {"Content-Length": str(kept.size_bytes), **tag}
    if if_none_match is not None and names(if_none_match, tag["ETag"]):
        return Response(status_code=304, headers=tag)

    def pieces() -> Any:
        with db.reading() as session:
            yield from recordings.recording_bytes(session, recordings.find_recording(session, sha256))

    return StreamingResponse(pieces(), headers=headers, media_type=media_type)


@router.get("/demos/{demo}/path", dependencies=[needs("reader")], **gives(DemoPath, 404))
def get_path(demo: Digest, db: Db, give: Giving) -> Response:
    """Give the demonstration as its states in the grid, and as it was recorded."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        return give(path_out(row))


@router.get("/demos/{demo}/report", dependencies=[needs("reader")], **gives(Demonstration, 404, 415, as_well=(HTML,)))
def get_report(demo: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Say what kind of demonstration it is and what to do about it: JSON, or with `Accept: text/html` a page."""
    as_page = wants_page(accept, "A report")
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        about, report = demo_out(row), demos.full_report(row)
        if as_page:
            page = give.bytes(demo_page(about, report, row.demo, row.path).encode(), HTML)
            page.headers.update(HEADERS)
            return page
        return give(about | {"report": report})


@router.get("/demos/{demo}/reward-map", dependencies=[needs("reader")], **gives(RewardMap, 404))
def get_reward_map(demo: Digest, db: Db, give: Giving) -> Response:
    """Give the rewards of Algorithm 1, those that are not `other`."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        kept = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == row.row)).one()
        return give(reward_map_out(row, kept))


@router.delete("/demos/{demo}", dependencies=[needs("releaser"), erasing_is_for_admins], **ends(404, 409, 412))
def withdraw_demo(
    demo: Digest, db: Db, jobs: Jobs, actor: Actor, erase: bool = False, if_match: Condition = None
) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and all derived from it."""
    dropped: list[Job] = []
    with db.writing() as session:
        if if_match:
            refuse_changed(demo_out(demos.find_demo(session, demo)), if_match)
        demos.withdraw_demo(session, demo, actor)
        if erase:
            dropped = erasure.erase_demo(session, demo, actor)
    if erase:
        db.forget()
    for job in dropped:
        jobs.cancel(job.row, job.attempt)
