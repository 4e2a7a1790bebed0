"""Recordings and demonstrations. Storing one never trains."""

from typing import Annotated, Any

import numpy as np
import orjson
from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import select

from skills.api.answers import JSON
from skills.api.deps import SLUG, Actor, Db, Digest, Incoming, Jobs, Limit, Read, RowCursor, page
from skills.api.pages.demo import demo_page
from skills.api.pages.page import HEADERS
from skills.api.routes.policies import Accept
from skills.api.schemas import DemoIn, Schema, demo_out, recording_out
from skills.db.models import Job, StoredRewardMap
from skills.errors import UnknownFormat
from skills.library import demos, erasure, recordings
from skills.library.demos import Cut
from skills.recordings import MEDIA_TYPES
from skills.settings import MEBIBYTE

uploads = APIRouter(tags=["demonstrations"])
router = APIRouter(tags=["demonstrations"], max_body_size=MEBIBYTE)

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


@uploads.post("/recordings", status_code=201, openapi_extra=RAW_BODY, responses={200: {}})
def add_recording(
    upload: Incoming, _asked: Annotated[RecordingUpload, Query()], db: Db, read: Read, actor: Actor, response: Response
) -> dict[str, Any]:
    """Store a recording's bytes once, and propose the hand-offs in it."""
    row, created = recordings.store_recording(db, upload, actor, read)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/recordings/{row.sha256}"
    return recording_out(row)


@uploads.post("/demos", status_code=201, openapi_extra=RAW_BODY, responses={200: {}})
def upload_demo(
    upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, read: Read, actor: Actor, response: Response
) -> dict[str, Any]:
    """Store a recording and one demonstration of it, both or neither."""
    row, created = demos.upload_demo(db, upload, asked.cut(), actor, read)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/demos/{row.sha256}"
    return demo_out(row)


@router.get("/recordings/{recording}")
def get_recording(recording: Digest, db: Db) -> dict[str, Any]:
    """Look a recording up."""
    with db.reading() as session:
        return recording_out(recordings.find_recording(session, recording))


@router.post("/recordings/{recording}/demos", status_code=201, responses={200: {}})
def add_demo(recording: Digest, body: DemoIn, db: Db, read: Read, actor: Actor, response: Response) -> dict[str, Any]:
    """Cut one demonstration out of a stored recording."""
    row, created = demos.add_demo(db, recording, Cut(**body.model_dump()), actor, read)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/demos/{row.sha256}"
    return demo_out(row)


@router.get("/demos")
def list_demos(
    db: Db,
    surgeon: Annotated[str | None, Query(pattern=SLUG)] = None,
    suture: Annotated[str | None, Query(pattern=SLUG)] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> dict[str, Any]:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        found = demos.list_demos(session, limit, cursor, surgeon, suture)
        return page([demo_out(row) for row in found], limit, found[-1].row if found else None)


@router.get("/demos/{demo}")
def get_demo(demo: Digest, db: Db) -> dict[str, Any]:
    """Look a demonstration up."""
    with db.reading() as session:
        return demo_out(demos.find_demo(session, demo))


@router.get("/demos/{demo}/recording")
def get_demo_recording(demo: Digest, db: Db) -> Response:
    """Give the recording's bytes back exactly."""
    with db.reading() as session:
        stored = demos.find_demo(session, demo).recording
        headers = {"Content-Length": str(stored.size_bytes), "ETag": f'"{stored.sha256}"'}
        media_type, sha256 = stored.media_type, stored.sha256

    def pieces() -> Any:
        with db.reading() as session:
            yield from recordings.recording_bytes(session, recordings.find_recording(session, sha256))

    return StreamingResponse(pieces(), headers=headers, media_type=media_type)


@router.get("/demos/{demo}/path")
def get_path(demo: Digest, db: Db) -> dict[str, Any]:
    """Give the demonstration as its states in the grid, and as it was recorded."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        path, recorded = row.path, row.demo
        return {
            "demo": row.sha256,
            "frame": row.frame,
            "grid": row.report["grid"],
            "hysteresis": path.hysteresis,
            "states": path.states.tolist(),
            "path_mm": path.tip_mm.tolist(),
            "stamps_s": recorded.stamps_s.tolist(),
            "recorded_mm": recorded.tip_mm.tolist(),
        }


@router.get("/demos/{demo}/report", responses={200: {"content": {"text/html": {}}}})
def get_report(demo: Digest, db: Db, accept: Accept = "*/*") -> Response:
    """Say what kind of demonstration it is and what to do about it: JSON, or with `Accept: text/html` a page."""
    as_page = _wants_page(accept)
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        about, report = demo_out(row), demos.full_report(row)
        if as_page:
            return Response(demo_page(about, report, row.demo, row.path), headers=HEADERS, media_type="text/html")
        return Response(orjson.dumps(about | {"report": report}), headers={"Vary": "Accept"}, media_type=JSON)


def _wants_page(accept: str) -> bool:
    """Choose between a page and JSON, the first that the client names."""
    for wanted in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if wanted in ("text/html", "text/*"):
            return True
        if wanted in (JSON, "application/*", "*/*"):
            return False
    raise UnknownFormat("A report is given as application/json or text/html.")


@router.get("/demos/{demo}/reward-map")
def get_reward_map(demo: Digest, db: Db) -> dict[str, Any]:
    """Give the rewards of Algorithm 1, those that are not `other`."""
    with db.reading() as session:
        row = demos.find_demo(session, demo)
        stored = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == row.row)).one()
        rewards, levels = stored.map.rewards, stored.map.levels
        special = np.flatnonzero(rewards != levels.other)
        return {
            "demo": row.sha256,
            "sha256": stored.sha256,
            "grid": row.report["grid"],
            "levels": {
                "goal": levels.goal,
                "visited": levels.visited,
                "other": levels.other,
                "off_grid": levels.off_grid,
            },
            "states": special.tolist(),
            "rewards": rewards[special].tolist(),
        }


@router.delete("/demos/{demo}", status_code=204)
def withdraw_demo(demo: Digest, db: Db, jobs: Jobs, actor: Actor, erase: bool = False) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and all derived from it."""
    dropped: list[Job] = []
    with db.writing() as session:
        demos.withdraw_demo(session, demo, actor)
        if erase:
            dropped = erasure.erase_demo(session, demo, actor)
    if erase:
        db.forget()
    for job in dropped:
        jobs.cancel(job.row, job.attempt)
