"""Routes of demonstrations. Storing one never starts a training."""

from functools import partial
from typing import Annotated

from fastapi import Query, Response

from skills.api.authorisation import Asking
from skills.api.dependencies import (
    Accept,
    Actor,
    Db,
    Digest,
    Jobs,
    ListingByRow,
    OfRecording,
    OfSurgeon,
    OfSuture,
    Parse,
)
from skills.api.openapi import ends, gives, gives_file, makes, router_of
from skills.api.pages import standalone_headers
from skills.api.pages.drawings import report_page
from skills.api.responses import HTML, JSON, Giving, IfMatch, negotiate, stored
from skills.api.routes.recordings import RAW_BODY, uploads
from skills.api.streams import stored_file
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

router = router_of("demonstrations")


OnlyActive = Annotated[bool | None, Query(description="true: only active demonstrations; false: only withdrawn ones.")]
OnlyOutcome = Annotated[
    OutcomeAsked | None, Query(description="Only those that are marked so; unknown: only those without a mark.")
]


class DemoUpload(DemoIn, TableIn):
    """Query parameters of an upload of a demonstration: `DemoIn`, and what a table or a LeRobot episode leaves open."""


@uploads.post("/demos", openapi_extra=RAW_BODY, **makes("uploader", Demonstration, 404, 409, 410))
def upload_demo(
    upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, parse: Parse, actor: Actor
) -> Response:
    """Store a recording and one demonstration of it, both or neither."""
    return _stored(demos.upload_demo(db, upload.read_as(asked), asked, actor, parse))


@router.post("/recordings/{recording}/demos", **makes("uploader", Demonstration, 404, 409, 410))
def add_demo(recording: Digest, body: DemoIn, db: Db, parse: Parse, actor: Actor) -> Response:
    """Cut one demonstration out of a stored recording."""
    return _stored(demos.add_demo(db, recording, body, actor, parse))


def _stored(added: demos.Added) -> Response:
    # The part that this request named, which may name the stored one in another way.
    demo = Demonstration.model_validate(added.row).model_copy(update={"segment": added.segment})
    return stored(demo, added.new, f"/demos/{demo.sha256}")


@router.get("/demos", **gives("reader", Page[Demonstration], 404, 410))
def list_demos(
    db: Db,
    listing: ListingByRow,
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    recording: OfRecording = None,
    active: OnlyActive = None,
    outcome: OnlyOutcome = None,
) -> Response:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        page = listing.limit, listing.cursor
        found = demos.list_demos(session, *page, surgeon, suture, recording, active, outcome)
        return listing.page([Demonstration.model_validate(row) for row in found], found)


@router.get("/demos/{demo}", **gives("reader", Demonstration, 404))
def get_demo(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration."""
    with db.reading() as session:
        return give(Demonstration.model_validate(demos.find_demo(session, demo)))


@router.get("/demos/{demo}/recording", **gives_file("reader", (BYTES, *MEDIA_TYPES), 404, 409))
def get_demo_recording(demo: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return the bytes of a demonstration's recording as uploaded; all are verified before the first is sent."""
    read = partial(demos.exported_chunk, db, demo)
    find = partial(demos.exported_recording, demo_sha256=demo)
    return stored_file(give, db, find, read, accept)


@router.get("/demos/{demo}/path", **gives("reader", DemoPath, 404, 409))
def get_path(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration's states in the grid and its motion as recorded."""
    with db.reading() as session:
        return give(demos.path_of_demo(demos.shown_demo(session, demo)))


@router.get("/demos/{demo}/report", **gives("reader", Demonstration, 404, 409, 415, as_well=(HTML,)))
def get_report(demo: Digest, db: Db, give: Giving, accept: Accept) -> Response:
    """Return a demonstration's quality report, with advice: JSON, or with `Accept: text/html` a page."""
    as_page = negotiate(accept, "A report", JSON, HTML) == HTML
    with db.reading() as session:
        row = demos.shown_demo(session, demo) if as_page else demos.find_demo(session, demo)
        about = Demonstration.model_validate(row).model_copy(update={"report": full_report(row)})
        if as_page:
            page = give.bytes(report_page(about, row.demo, row.path).encode(), HTML)
            page.headers.update(standalone_headers("demo_report"))
            return page
        return give(about)


@router.get("/demos/{demo}/reward-map", **gives("reader", RewardMap, 404, 409))
def get_reward_map(demo: Digest, db: Db, give: Giving) -> Response:
    """Return the rewards of Algorithm 1 for a demonstration, without the states whose reward is `other`."""
    with db.reading() as session:
        return give(demos.reward_map_of(session, demos.shown_demo(session, demo)))


@router.put("/demos/{demo}/outcome", **gives("releaser", Demonstration, 404, 412))
def mark_demo(demo: Digest, body: OutcomeIn, db: Db, give: Giving, actor: Actor, conditions: IfMatch) -> Response:
    """Mark a demonstration as success, recovery or failure; the last two withdraw the releases that rest on it.

    Releases of versions that were trained with outcomes "any" stay.
    """
    with db.reading() as session:
        surgeon = demos.find_demo(session, demo).surgeon.slug
    with db.ending([locks.surgeon(surgeon)]) as session:
        conditions.refuse_changed(Demonstration.model_validate(demos.find_demo(session, demo)))
        return give(Demonstration.model_validate(demos.mark_demo(session, demo, body.outcome, body.reason, actor)))


@router.delete("/demos/{demo}", **ends("releaser", 404, 409, 412))
def withdraw_demo(demo: Digest, db: Db, jobs: Jobs, caller: Asking, conditions: IfMatch, erase: bool = False) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and its derived data."""
    if erase:
        caller.must_be("admin")  # before anything is looked up, as the role of a route is
    dropped: erasure.Dropped = []
    with db.reading() as session:
        found = demos.find_demo(session, demo)
        conditions.refuse_changed(Demonstration.model_validate(found))
        surgeon, erased = found.surgeon.slug, erasure.erased_with(session, found.surgeon, found) if erase else []
    drop_contents(db, erased)
    with db.ending(None if erase else [locks.surgeon(surgeon)]) as session:
        conditions.refuse_changed(Demonstration.model_validate(demos.find_demo(session, demo)))
        demos.withdraw_demo(session, demo, caller.name)
        if erase:
            dropped = erasure.erase_demo(session, demo, caller.name)
    if erase:
        sweep_erased(db)
    # after the commit, because one transaction cannot span our database and the engine's
    for row, attempt in dropped:
        jobs.cancel(row, attempt)
