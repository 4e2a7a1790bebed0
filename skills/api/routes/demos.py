"""Routes of demonstrations. Storing one never starts a training."""

from functools import partial
from typing import Annotated

from fastapi import Query, Request, Response

from skills.api.authorisation import erasing_is_for_admins, needs
from skills.api.dependencies import Accept, Actor, Db, Digest, Jobs, Limit, Parse, RowCursor
from skills.api.openapi import ends, gives, gives_file, gives_page, makes, router_of
from skills.api.pages import HTML, standalone_headers, wants_page
from skills.api.pages.drawings import report_page
from skills.api.responses import Condition, Giving, refuse_changed, stored
from skills.api.routes.recordings import RAW_BODY
from skills.api.streams import stored_file
from skills.api.strict_json import Strict
from skills.api.uploads import Incoming
from skills.formats import BYTES, MEDIA_TYPES
from skills.library.operation import locks
from skills.library.operation.sweep import drop_contents, sweep_erased
from skills.library.people import erasure
from skills.library.recordings import demos
from skills.library.recordings.reports import full_report
from skills.schemas import OutcomeAsked, Page
from skills.schemas.demos import DemoIn, Demonstration, DemoPath, OutcomeIn, RewardMap
from skills.schemas.recordings import TableIn
from skills.schemas.requests import DIGEST, SLUG
from skills.settings import MEBIBYTE

uploads = router_of(tags=["demonstrations"])


router = router_of(route_class=Strict, tags=["demonstrations"], max_body_size=MEBIBYTE)


class DemoUpload(DemoIn, TableIn):
    """Query parameters of an upload of a demonstration: `DemoIn`, and what a table or a LeRobot episode leaves open."""


@uploads.post("/demos", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Demonstration, 404, 409, 410))
def upload_demo(
    upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, parse: Parse, actor: Actor
) -> Response:
    """Store a recording and one demonstration of it, both or neither."""
    return _stored(demos.upload_demo(db, upload.read_as(asked), asked, actor, parse))


@router.post("/recordings/{recording}/demos", dependencies=[needs("uploader")], **makes(Demonstration, 404, 409, 410))
def add_demo(recording: Digest, body: DemoIn, db: Db, parse: Parse, actor: Actor) -> Response:
    """Cut one demonstration out of a stored recording."""
    return _stored(demos.add_demo(db, recording, body, actor, parse))


def _stored(added: demos.Added) -> Response:
    # The part that this request named, which may name the stored one in another way.
    demo = Demonstration.model_validate(added.row).model_copy(update={"segment": added.segment})
    return stored(demo, added.new, f"/demos/{demo.sha256}")


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
    outcome: Annotated[
        OutcomeAsked | None, Query(description="Only those that are marked so; unknown: only those without a mark.")
    ] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        found = demos.list_demos(session, limit, cursor, surgeon, suture, recording, active, outcome)
        return give.page([Demonstration.model_validate(row) for row in found], limit, found[-1].row if found else None)


@router.get("/demos/{demo}", dependencies=[needs("reader")], **gives(Demonstration, 404))
def get_demo(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration."""
    with db.reading() as session:
        return give(Demonstration.model_validate(demos.find_demo(session, demo)))


@router.get("/demos/{demo}/recording", dependencies=[needs("reader")], **gives_file((BYTES, *MEDIA_TYPES), 404, 409))
def get_demo_recording(
    demo: Digest, db: Db, request: Request, if_none_match: Condition = None, accept: Accept = "*/*"
) -> Response:
    """Return the bytes of a demonstration's recording as uploaded; all are verified before the first is sent."""
    read = partial(demos.exported_chunk, db, demo)
    find = partial(demos.exported_recording, demo_sha256=demo)
    return stored_file(request, db, find, read, accept=accept, if_none_match=if_none_match)


@router.get("/demos/{demo}/path", dependencies=[needs("reader")], **gives(DemoPath, 404, 409))
def get_path(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration's states in the grid and its motion as recorded."""
    with db.reading() as session:
        return give(demos.path_of_demo(demos.shown_demo(session, demo)))


@router.get(
    "/demos/{demo}/report", dependencies=[needs("reader")], **gives(Demonstration, 404, 409, 415, as_well=(HTML,))
)
def get_report(demo: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a demonstration's quality report, with advice: JSON, or with `Accept: text/html` a page."""
    as_page = wants_page(accept, "A report")
    with db.reading() as session:
        row = demos.shown_demo(session, demo) if as_page else demos.find_demo(session, demo)
        about = Demonstration.model_validate(row).model_copy(update={"report": full_report(row)})
        if as_page:
            page = give.bytes(report_page(about, row.demo, row.path).encode(), HTML)
            page.headers.update(standalone_headers("demo_report"))
            return page
        return give(about)


@router.get("/demos/{demo}/reward-map", dependencies=[needs("reader")], **gives(RewardMap, 404, 409))
def get_reward_map(demo: Digest, db: Db, give: Giving) -> Response:
    """Return the rewards of Algorithm 1 for a demonstration, without the states whose reward is `other`."""
    with db.reading() as session:
        return give(demos.reward_map_of(session, demos.shown_demo(session, demo)))


@router.put("/demos/{demo}/outcome", dependencies=[needs("releaser")], **gives(Demonstration, 404, 412))
def mark_demo(
    demo: Digest, body: OutcomeIn, db: Db, give: Giving, actor: Actor, if_match: Condition = None
) -> Response:
    """Mark a demonstration as success, recovery or failure; the last two withdraw the releases that rest on it.

    Releases of versions that were trained with outcomes "any" stay.
    """
    with db.reading() as session:
        surgeon = demos.find_demo(session, demo).surgeon.slug
    with db.writing([locks.surgeon(surgeon)]) as session:
        if if_match:
            refuse_changed(Demonstration.model_validate(demos.find_demo(session, demo)), if_match)
        return give(Demonstration.model_validate(demos.mark_demo(session, demo, body.outcome, body.reason, actor)))


@router.delete("/demos/{demo}", dependencies=[needs("releaser"), erasing_is_for_admins], **ends(404, 409, 412))
def withdraw_demo(
    demo: Digest, db: Db, jobs: Jobs, actor: Actor, erase: bool = False, if_match: Condition = None
) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and its derived data."""
    dropped: erasure.Dropped = []
    with db.reading() as session:
        found = demos.find_demo(session, demo)
        refuse_changed(Demonstration.model_validate(found), if_match)
        surgeon, erased = found.surgeon.slug, erasure.erased_with(session, found.surgeon, found) if erase else []
    drop_contents(db, erased)
    with db.writing(None if erase else [locks.surgeon(surgeon)]) as session:
        if if_match:
            refuse_changed(Demonstration.model_validate(demos.find_demo(session, demo)), if_match)
        demos.withdraw_demo(session, demo, actor)
        if erase:
            dropped = erasure.erase_demo(session, demo, actor)
    if erase:
        sweep_erased(db)
        db.forget()
    # after the commit, because one transaction cannot span our database and the engine's
    for row, attempt in dropped:
        jobs.cancel(row, attempt)
