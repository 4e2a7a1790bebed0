"""Routes of recordings, proposals, demonstrations and datasets, and of atlases and scores, which compare them.

Storing a recording or a demonstration never starts a training. An atlas compares the demonstrations of a suture type. A
score compares a demonstration, or a part of a recording, with a style; nothing of it is stored. A dataset has
demonstrations in the format of LeRobot, as a zip file.
"""

from functools import partial
from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import Field
from sqlalchemy import select

from skills.api.authorisation import Asking, erasing_is_for_admins, needs
from skills.api.dependencies import (
    Accept,
    Actor,
    Db,
    Digest,
    Incoming,
    Jobs,
    Limit,
    RowCursor,
    Slug,
    Strict,
    Tell,
    room_for_a_job,
)
from skills.api.openapi import ends, gives, gives_file, gives_page, makes, router_of, says, starts_job
from skills.api.pages import HTML, drawings, render, standalone_headers, wants_page
from skills.api.pages.drawings import report_page
from skills.api.responses import (
    Condition,
    Giving,
    Stream,
    accepted,
    as_asked,
    names,
    refuse_changed,
    say,
    stored,
    stored_pieces,
)
from skills.api.routes.pages import PageRoute, Picked
from skills.db.models import StoredRewardMap
from skills.errors import BadInput, Conflict, NotFound
from skills.formats import BYTES, MEDIA_TYPES
from skills.library.comparison import scores
from skills.library.comparison.atlas import CONFOUNDED, DISTANCE, MOST, SESSIONS, atlas_of, atlases
from skills.library.comparison.neighbours import nearest_to
from skills.library.comparison.recognition import recognise_recording
from skills.library.operation import locks, overview
from skills.library.operation.jobs import QUEUED, did_nothing
from skills.library.operation.sweep import drop_contents, sweep_erased
from skills.library.people import erasure
from skills.library.people.catalogue import find_surgeon, find_suture_type
from skills.library.recordings import datasets, demos, proposals, recordings
from skills.library.recordings.demos import demo_json, path_json, reward_map_json
from skills.library.recordings.proposals import proposal_json
from skills.library.recordings.recordings import find_recording, recording_json
from skills.schemas import OutcomeAsked, ProposalState
from skills.schemas.given import (
    Atlas,
    DatasetEpisodes,
    Demonstration,
    DemoPath,
    Nearest,
    Page,
    Progress,
    Proposal,
    RecognisedRecording,
    Recording,
    RecordingPreview,
    RecordingSummary,
    RewardMap,
    Score,
)
from skills.schemas.requests import (
    COUNT,
    DIGEST,
    SLUG,
    DatasetIn,
    DemoIn,
    OutcomeIn,
    ProposalIn,
    ScoreIn,
    SlugField,
    TableIn,
)
from skills.settings import MEBIBYTE

uploads = router_of(tags=["demonstrations"])
router = router_of(route_class=Strict, tags=["demonstrations"], max_body_size=MEBIBYTE)

RAW_BODY = {
    "requestBody": {
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in (BYTES, *MEDIA_TYPES)},
    }
}
atlas_router = router_of(tags=["atlas"], max_body_size=MEBIBYTE)

Clusters = Annotated[
    int | None, Query(ge=1, le=MOST, description="Number of clusters; by default as many as are found.")
]
AskedDemo = Annotated[
    str | None, Query(pattern=DIGEST, description="Digest of a demonstration whose surgeon is to be recognised.")
]


class RecordingQuery(TableIn):
    """Query parameters of an upload of a recording, with what a table or a LeRobot episode leaves open."""

    surgeon: SlugField | None = Field(
        None, description="The surgeon who was recorded; erasing this surgeon deletes the recording."
    )


class DemoUpload(DemoIn, TableIn):
    """Query parameters of an upload of a demonstration: `DemoIn`, and what a table or a LeRobot episode leaves open."""


@uploads.post(
    "/recordings", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Recording, 404, 409, 410)
)
def add_recording(
    upload: Incoming, asked: Annotated[RecordingQuery, Query()], db: Db, read: Tell, actor: Actor
) -> Response:
    """Store a recording, once for equal bytes, and propose the hand-offs in it."""
    row, created = recordings.store_recording(db, upload.read_as(asked.said), actor, read, asked.surgeon)
    return stored(recording_json(row), created, f"/recordings/{row.sha256}")


@uploads.post("/recordings/preview", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **says(RecordingPreview))
def preview_recording(upload: Incoming, asked: Annotated[TableIn, Query()], read: Tell) -> Response:
    """Read a recording and return what would be understood of it, a table's columns included; nothing is stored."""
    return say(recordings.preview(upload.read_as(asked.said), read))


@uploads.post("/demos", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **makes(Demonstration, 404, 409, 410))
def upload_demo(upload: Incoming, asked: Annotated[DemoUpload, Query()], db: Db, read: Tell, actor: Actor) -> Response:
    """Store a recording and one demonstration of it, both or neither."""
    return _stored(demos.upload_demo(db, upload.read_as(asked.said), asked, actor, read))


@router.get("/recordings", dependencies=[needs("reader")], **gives_page(Page[RecordingSummary], 410))
def list_recordings(db: Db, give: Giving, limit: Limit = 50, cursor: RowCursor = None) -> Response:
    """List recordings, the newest first."""
    with db.reading() as session:
        found = overview.newest_recordings(session, cursor, limit)
        written = [recordings.summary_json(row, cut) for row, cut in found]
        return give.page(written, limit, found[-1][0].row if found else None)


@router.get("/recordings/{recording}", dependencies=[needs("reader")], **gives(Recording, 404))
def get_recording(recording: Digest, db: Db, give: Giving) -> Response:
    """Return a recording."""
    with db.reading() as session:
        return give(recording_json(recordings.find_recording(session, recording)))


@router.delete("/recordings/{recording}", dependencies=[needs("uploader")], **ends(404, 409))
def delete_recording(recording: Digest, db: Db, caller: Asking) -> None:
    """Delete a recording without demonstrations permanently; allowed to its uploader and to admins."""
    anybodys = caller.role == "admin"
    with db.reading() as session:
        stored, alone = erasure.deletable_recording(session, recording, caller.name, anybodys=anybodys)
    recording = stored.sha256  # in full: the argument may be a prefix
    drop_contents(db, [stored.row] if alone else [])
    with db.writing([locks.recording(recording)]) as session:
        erasure.delete_recording(session, recording, caller.name, anybodys=anybodys)
    sweep_erased(db)
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
    outcome: Annotated[
        OutcomeAsked | None, Query(description="Only those that are marked so; unknown: only those without a mark.")
    ] = None,
    limit: Limit = 50,
    cursor: RowCursor = None,
) -> Response:
    """List demonstrations, the newest first."""
    with db.reading() as session:
        found = demos.list_demos(session, limit, cursor, surgeon, suture, recording, active, outcome)
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

    def refuse() -> None:
        with db.reading() as session:
            demos.exported_recording(session, demo)

    read = partial(demos.exported_chunk, db, demo)
    # outside the session, because a slow client may keep the stream open for long
    return Stream(stored_pieces(read, refuse, sha256, request.app.state.downloads), media_type, headers)


@router.get("/demos/{demo}/path", dependencies=[needs("reader")], **gives(DemoPath, 404, 409))
def get_path(demo: Digest, db: Db, give: Giving) -> Response:
    """Return a demonstration's states in the grid and its motion as recorded."""
    with db.reading() as session:
        return give(path_json(demos.shown_demo(session, demo)))


@router.get(
    "/demos/{demo}/report", dependencies=[needs("reader")], **gives(Demonstration, 404, 409, 415, as_well=(HTML,))
)
def get_report(demo: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a demonstration's quality report, with advice: JSON, or with `Accept: text/html` a page."""
    as_page = wants_page(accept, "A report")
    with db.reading() as session:
        row = demos.shown_demo(session, demo) if as_page else demos.find_demo(session, demo)
        about, report = demo_json(row), demos.full_report(row)
        if as_page:
            page = give.bytes(report_page(about, report, row.demo, row.path).encode(), HTML)
            page.headers.update(standalone_headers("demo_report"))
            return page
        return give(about | {"report": report})


@router.get("/demos/{demo}/reward-map", dependencies=[needs("reader")], **gives(RewardMap, 404, 409))
def get_reward_map(demo: Digest, db: Db, give: Giving) -> Response:
    """Return the rewards of Algorithm 1 for a demonstration, without the states whose reward is `other`."""
    with db.reading() as session:
        row = demos.shown_demo(session, demo)
        kept = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == row.row)).one()
        return give(reward_map_json(row, kept))


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
            refuse_changed(demo_json(demos.find_demo(session, demo)), if_match)
        return give(demo_json(demos.mark_demo(session, demo, body.outcome, body.reason, actor)))


@router.delete("/demos/{demo}", dependencies=[needs("releaser"), erasing_is_for_admins], **ends(404, 409, 412))
def withdraw_demo(
    demo: Digest, db: Db, jobs: Jobs, actor: Actor, erase: bool = False, if_match: Condition = None
) -> None:
    """Withdraw a demonstration and the releases that rest on it; with `erase`, delete it and its derived data."""
    dropped: erasure.Dropped = []
    with db.reading() as session:
        found = demos.find_demo(session, demo)
        refuse_changed(demo_json(found), if_match)
        surgeon, erased = found.surgeon.slug, erasure.erased_with(session, found.surgeon, found) if erase else []
    drop_contents(db, erased)
    with db.writing(None if erase else [locks.surgeon(surgeon)]) as session:
        if if_match:
            refuse_changed(demo_json(demos.find_demo(session, demo)), if_match)
        demos.withdraw_demo(session, demo, actor)
        if erase:
            dropped = erasure.erase_demo(session, demo, actor)
    if erase:
        sweep_erased(db)
        db.forget()
    # after the commit, because one transaction cannot span our database and the engine's
    for row, attempt in dropped:
        jobs.cancel(row, attempt)


# ---- atlases and scores --------------------------------------------------------------------------------------------


@atlas_router.get("/styles/{suture}/atlas", dependencies=[needs("reader")], **gives(Atlas, 404, 409))
def get_atlas(
    suture: Slug,
    db: Db,
    give: Giving,
    scaled: Annotated[bool, Query(description="Scale all demonstrations to the same size.")] = False,
    clusters: Clusters = None,
    demo: AskedDemo = None,
) -> Response:
    """Compare all demonstrations of a suture type whose surgeons' consent covers it.

    The first request takes as long as measuring does, seconds for hundreds of demonstrations; later ones measure only
    the distances of new demonstrations.
    """
    return give(atlas_of(db, suture, scaled=scaled, clusters=clusters, demo=demo))


MOST_NEAREST = 100  # neighbours of a demonstration


@atlas_router.get("/demos/{demo}/nearest", dependencies=[needs("reader")], **gives(Nearest, 404, 409))
def get_nearest(
    demo: Digest,
    db: Db,
    give: Giving,
    count: Annotated[int, Query(ge=1, le=MOST_NEAREST, description="Number of neighbours.")] = 10,
    scaled: Annotated[bool, Query(description="Scale all demonstrations to the same size.")] = False,
) -> Response:
    """Return the demonstrations of the same suture type that are nearest to one, among all of them and exactly.

    The first request after a start reads all shapes into memory, seconds for tens of thousands of demonstrations.
    """
    return give(nearest_to(db, demo, count, scaled=scaled))


@atlas_router.get(
    "/styles/{suture}/recognition", dependencies=[needs("reader")], **gives(RecognisedRecording, 404, 409)
)
def recognise(
    suture: Slug,
    db: Db,
    tell: Tell,
    give: Giving,
    recording: Annotated[str, Query(pattern=DIGEST, description="Digest of a recording with a demonstration.")],
) -> Response:
    """Recognise the surgeon of a whole recording by all its movements, with its session left out.

    It reads the recordings of the suture type, so it takes seconds for tens of recordings.
    """
    return give(recognise_recording(db, recording, suture, tell))


MOST_PAIRS = 60  # of surgeons, shown on a page

page_router = APIRouter(route_class=PageRoute, include_in_schema=False, max_body_size=MEBIBYTE)


@page_router.get("/pages/atlas", dependencies=[needs("reader")])
def show_atlases(request: Request, caller: Asking, db: Db) -> Response:
    """Show the suture types that have demonstrations to compare."""
    with db.reading() as session:
        return render(request, "atlases.html", caller, found=atlases(session))


@page_router.get("/pages/atlas/{suture}", dependencies=[needs("reader")])
def show_atlas(
    suture: Slug,
    request: Request,
    caller: Asking,
    db: Db,
    scaled: bool = False,
    clusters: Annotated[str, Query(pattern=COUNT)] = "",
    demo: Annotated[str | None, Query(pattern=DIGEST)] = None,
) -> Response:
    """Show an atlas: chart, distances with their dendrogram, surgeons, and the recognition of a demonstration."""
    number = int(clusters or 0) or None  # a form sends an empty text for a field without a value
    try:
        found = atlas_of(db, suture, scaled=scaled, clusters=number, demo=demo)
    except (Conflict, BadInput) as refused:
        raise NotFound(refused.words()) from refused  # rendered as a page that states the reason
    pairs = sorted(found.differences, key=lambda one: -one.distance)[:MOST_PAIRS]
    marks = drawings.marks(found)
    drawn = {
        "chart": drawings.chart(found),
        "matrix": drawings.matrix(found),
        "marks": {surgeon: drawings.key(mark) for surgeon, mark in marks.items()},
        "thirds": [drawings.thirds(one.shares) for one in pairs],
        "most": drawings.MOST_GROUPS,
    }
    with db.reading() as session:
        return render(
            request,
            "atlas.html",
            caller,
            suture=find_suture_type(session, suture),
            atlas=found,
            drawn=drawn,
            pairs=pairs,
            asked={"clusters": number, "demo": demo},
            confounded=CONFOUNDED,
            sessions=SESSIONS,
            distance=DISTANCE,
        )


@page_router.get("/pages/surgeons/{surgeon}", dependencies=[needs("reader")])
def show_surgeon(
    surgeon: Slug, request: Request, caller: Asking, db: Db, suture: Picked = None, against: Picked = None
) -> Response:
    """Show a surgeon over time: the demonstrations of a suture type, session by session, beside a style's reference."""
    with db.reading() as session:
        found = find_surgeon(session, surgeon)
        styles = [style for style in overview.styles_of(session, found) if style.demos]
        chosen = suture or next((style.suture for style in styles), None)
        others = scores.references(session, chosen) if chosen else []
    compared = against or next((one.slug for one in others if one.slug != surgeon), surgeon)
    shown, refused = None, ""
    if chosen:
        try:
            shown = scores.progress(db, surgeon, chosen, compared)
        except (Conflict, BadInput, NotFound) as error:
            refused = error.words()  # beside what else is known of the surgeon
    return render(
        request,
        "surgeon.html",
        caller,
        surgeon=found,
        styles=styles,
        asked={"suture": chosen, "against": compared},
        others=others,
        shown=shown,
        refused=refused,
        curve=drawings.score_curve(shown.demos, "") if shown is not None and len(shown.demos) > 1 else None,
    )


score_router = router_of(route_class=Strict, tags=["scores"], max_body_size=MEBIBYTE)


@score_router.post("/scores", dependencies=[needs("reader")], **says(Score, 404, 409, 410))
def score(body: ScoreIn, db: Db, tell: Tell) -> Response:
    """Score a motion: its figures compared with the reference's, its deviation, percentiles, and a curve over time.

    Research use only; not a credential.
    """
    return say(scores.score(db, body, tell))


@score_router.get("/surgeons/{surgeon}/progress", dependencies=[needs("reader")], **gives(Progress, 404, 409, 410))
def surgeon_progress(
    surgeon: Slug,
    db: Db,
    give: Giving,
    suture: Annotated[str, Query(pattern=SLUG, description="The suture type.")],
    against: Annotated[str, Query(pattern=SLUG, description="The surgeon whose style is the reference.")],
) -> Response:
    """Compare a surgeon's demonstrations with a style's reference, session by session.

    Research use only; not a credential.
    """
    return give(scores.progress(db, surgeon, suture, against))


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
            surgeons=overview.surgeons_to_choose(session),
            sutures=overview.all_suture_types(session),
        )


@page_router.get("/pages/recordings/{recording}/proposals", dependencies=[needs("reader")])
def draw_proposals(recording: Digest, caller: Asking, db: Db, tell: Tell) -> Response:
    """Return the paths of the tip in all proposals of a recording, for their small pictures."""
    return say({"paths_mm": proposals.paths_of(db, recording, tell)}, headers={"Cache-Control": "no-store"})


dataset_router = router_of(route_class=Strict, tags=["datasets"], max_body_size=MEBIBYTE)

ZIP = "application/zip"


@dataset_router.post("/datasets", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409, 410))
def export_dataset(body: DatasetIn, db: Db, jobs: Jobs, actor: Actor) -> Response:
    """Request the export of demonstrations as a LeRobot dataset; `result.dataset` of the job is its digest.

    409 if the consent of a surgeon in it does not cover an export.
    """
    with db.writing() as session:
        job, new = datasets.request_dataset(session, body, actor)
        answer = accepted(session, job, QUEUED if new else did_nothing(job))
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.tell(job.row, job.attempt, job.kind)
    return answer


@dataset_router.get("/datasets/{dataset}", dependencies=[needs("reader")], **gives_file((BYTES, ZIP), 404, 409))
def get_dataset(
    dataset: Digest, db: Db, request: Request, if_none_match: Condition = None, accept: Accept = "*/*"
) -> Response:
    """Return a dataset as a zip; all of it is verified before the first byte is sent.

    409 if a consent in it does not cover an export any more; consents are checked again for each chunk.
    """
    with db.reading() as session:
        kept = datasets.served_dataset(session, dataset)
        sha256, tag = kept.sha256, {"ETag": f'"{kept.sha256}"'}
        attached = {"Content-Disposition": f'attachment; filename="dataset-{sha256[:12]}.zip"'}
        headers = {"Content-Length": str(kept.size_bytes), **attached, **tag}
    if if_none_match is not None and names(if_none_match, tag["ETag"]):
        return Response(status_code=304, headers=tag)

    def refuse() -> None:
        with db.reading() as session:
            datasets.served_dataset(session, sha256)

    read = partial(datasets.dataset_chunk, db, sha256)
    # outside the session, because a slow client may keep the stream open for long
    return Stream(stored_pieces(read, refuse, sha256, request.app.state.downloads), as_asked(accept, ZIP), headers)


@dataset_router.get("/datasets/{dataset}/episodes", dependencies=[needs("reader")], **gives(DatasetEpisodes, 404))
def get_dataset_episodes(dataset: Digest, db: Db, give: Giving) -> Response:
    """Return the recording and the demonstrations of each episode of a dataset, which does not name them itself."""
    with db.reading() as session:
        return give(datasets.episodes_json(session, dataset))


@dataset_router.delete("/datasets/{dataset}", dependencies=[needs("trainer")], **ends(404))
def delete_dataset(dataset: Digest, db: Db, actor: Actor) -> None:
    """Delete a dataset and the job that made it; its demonstrations stay."""
    with db.writing() as session:
        datasets.delete_dataset(session, dataset, actor)
