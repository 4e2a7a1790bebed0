"""Routes of plans: suture points, plans, trajectories, replay bags, playbacks and pictures; and of timelines.

`POST /suture-points` reads the suture points for a plan from a simulator's recording, `POST /reach` maps where they can
be. The motion of a plan is returned as JSON, as a table, or as the bag that a robot replays; a recording of the replay
is compared with the plan. A still picture of a playback comes with its verdict; the film and the plots are drawn
afterwards. A timeline is the columns of any motion, the same as a file for viewers, and the page that plays them.
"""

import csv
import io
from collections.abc import Callable
from typing import Annotated, Any, Literal

import orjson
from fastapi import Query, Request, Response
from pydantic import Field

from skills.api.authorisation import Asking, needs
from skills.api.dependencies import Actor, Configured, Db, Digest, Jobs, Limit, Parse, Read, RowCursor, room_for_a_job
from skills.api.openapi import gives, gives_file, gives_page, makes, router_of, says, starts_job
from skills.api.pages import render
from skills.api.responses import JSON, Giving, accepted, as_asked, say, stored
from skills.api.routes.pages import PageRoute
from skills.api.routes.policies import Accept
from skills.api.routes.recordings import RAW_BODY
from skills.api.strict_json import Strict
from skills.api.uploads import Incoming
from skills.db.session import Database
from skills.errors import UnknownFormat
from skills.fields import as_json
from skills.formats import BYTES, MCAP
from skills.formats.bag_writer import timeline_mcap
from skills.formats.replay_bag import rows_of_pass
from skills.library.operation import locks, overview
from skills.library.operation.jobs import QUEUED, did_nothing
from skills.library.plans import plans, playbacks
from skills.library.plans.plans import (
    find_suture_points,
    map_style,
    motion_of,
    plan_json,
    plan_summary_json,
    trajectory_of,
)
from skills.library.plans.playbacks import find_playback, playback_json, shown_playback
from skills.library.plans.replay import compare_with_plan, conditions_of, replay_bag
from skills.library.recordings.timelines import Source, check_export, chosen, motion_named, timeline_of
from skills.planning.plan import MAX_PASSES
from skills.planning.trajectory import Trajectory
from skills.schemas import Page
from skills.schemas.plans import Plan, PlanIn, PlanSummary
from skills.schemas.plans import Trajectory as GivenTrajectory
from skills.schemas.playbacks import Comparison, Playback, PlaybackIn
from skills.schemas.reach import Reach, ReachIn
from skills.schemas.recordings import SuturePoints
from skills.schemas.requests import DIGEST, FRAME, Name, Schema
from skills.schemas.timelines import MotionTimeline
from skills.settings import MEBIBYTE, Settings
from skills.verification.playback import Pictures

router = router_of(route_class=Strict, tags=["plans"], max_body_size=MEBIBYTE)


@router.post("/plans", dependencies=[needs("trainer")], **makes(Plan, 404, 409, 410))
def make_plan(body: PlanIn, db: Db, actor: Actor) -> Response:
    """Stack a style's grid world at suture points."""
    row, created = plans.plan_sutures(db, body, actor)
    with db.reading() as session:
        return stored(plan_json(plans.find_plan(session, row.sha256)), created, f"/plans/{row.sha256}")


@router.get("/plans", dependencies=[needs("reader")], **gives_page(Page[PlanSummary], 410))
def list_plans(db: Db, give: Giving, limit: Limit = 50, cursor: RowCursor = None) -> Response:
    """List plans, the newest first, each with its newest playback."""
    with db.reading() as session:
        found = overview.newest_plans(session, cursor, limit)
        written = [plan_summary_json(plan, played) for plan, played in found]
        return give.page(written, limit, found[-1][0].row if found else None)


@router.get("/plans/{plan}", dependencies=[needs("reader")], **gives(Plan, 404, 409))
def get_plan(plan: Digest, db: Db, give: Giving) -> Response:
    """Return a plan with its paths, while the surgeon's consent covers training."""
    with db.reading() as session:
        return give(plan_json(plans.followed_plan(session, plan)))


@router.post("/reach", dependencies=[needs("trainer")], **says(Reach, 404, 409, 410))
def map_reach(body: ReachIn, db: Db) -> Response:
    """Return where a style can be planned: reach, joint margins and clearances over positions and rotations.

    A place is `yes` if a plan of that pass alone keeps all limits of the verdict's closed form, `no` if it does not,
    and `in doubt` next to a limit. Several passes, and the arms' errors, are left to plan and playback. Nothing is
    stored.
    """
    return say(map_style(db, body).model_dump(mode="json"))


@router.post("/playbacks", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409))
def play(body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, settings: Configured) -> Response:
    """Request the playback of a plan in the simulator."""
    with db.reading() as session:
        surgeon = plans.find_plan(session, body.plan).policy.surgeon.slug
    with db.writing([locks.surgeon(surgeon)]) as session:
        job, new = playbacks.request_playback(session, body.plan, actor, settings, body.arm_errors)
        answer = accepted(session, job, QUEUED if new else did_nothing(job))
    # after the commit; if the engine cannot be notified now, a worker finds the job's row later
    if new:
        jobs.submit(job.row, job.attempt, job.kind)
    return answer


@router.get("/playbacks/{playback}", dependencies=[needs("reader")], **gives(Playback, 404))
def get_playback(playback: Digest, db: Db, give: Giving, settings: Configured) -> Response:
    """Return the simulator's verdict on a plan."""
    with db.reading() as session:
        row = playbacks.find_playback(session, playback)
        written = playback_json(row, playbacks.headline_of(row, settings))
        return give(written | {"policy": playbacks.standing_of(session, row)})


suture_point_router = router_of(tags=["plans"])


class SuturePointsUpload(Schema):
    """Query parameters of a scene upload: the arm whose base frame is used, and the frame's name."""

    arm: Name | None = None
    frame: Annotated[str, Field(pattern=FRAME)] | None = Field(
        default=None, description="The name of the arm's base frame, in which marks without a base of the arm are."
    )


@suture_point_router.post(
    "/suture-points", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **says(SuturePoints)
)
def read_suture_points(upload: Incoming, asked: Annotated[SuturePointsUpload, Query()], read: Read) -> Response:
    """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame; nothing is stored.

    `is_goal` proposes the exits as goals of passes: there the needle comes out and is handed over. A suture point of a
    plan takes `position_mm`, and as its rotation `turn_xyzw` if the style was demonstrated at the first of them.
    """
    return say(find_suture_points(upload, asked.arm, asked.frame, read).model_dump(mode="json"))


trajectory_router = router_of(tags=["plans"])

BAG, TABLE = "application/zip", "text/csv"
COLUMNS = (
    "t_s,pass,phase,x_mm,y_mm,z_mm,qx,qy,qz,qw,yaw_rad,pitch_rad,insertion_mm,roll_rad,wrist_pitch_rad,wrist_yaw_rad"
)

_PASS: Any = Query(alias="pass", ge=0, lt=MAX_PASSES, description="A single pass, counted from 0 as in reports.")
PassIndex = Annotated[int | None, _PASS]
OnePass = Annotated[int, _PASS]


@trajectory_router.get(
    "/plans/{plan}/trajectory",
    dependencies=[needs("reader")],
    **gives(GivenTrajectory, 404, 409, 415, as_well=(TABLE, BAG)),
)
def get_trajectory(
    plan: Digest,
    db: Db,
    settings: Configured,
    give: Giving,
    pass_index: PassIndex = None,
    handoff: Annotated[
        Literal["none"] | None, Query(description="`none` is required for the bag of a plan without a hand-off.")
    ] = None,
    accept: Accept = "*/*",
) -> Response:
    """Return the sampled motion of a plan: JSON, `Accept: text/csv` a table, `Accept: application/zip` the replay bag.

    All of them are 409 if the surgeon's consent does not cover training. The bag is 409 until a feasible playback
    exists for exactly this plan, its policy is the released one, its demonstration is not withdrawn, the consent covers
    an export, and every pass is certain enough to succeed; for a plan without a hand-off it also needs `handoff=none`.
    """
    media_type = _media_type(accept)
    content = _contents(db, plan, pass_index, handoff, media_type, settings)
    given = give.bytes(content, media_type)
    if media_type == BAG:
        which = "" if pass_index is None else f"-pass-{pass_index}"
        given.headers["Content-Disposition"] = f'attachment; filename="replay-{plan[:12]}{which}.zip"'
    return given


@trajectory_router.get("/plans/{plan}/comparison", dependencies=[needs("reader")], **gives(Comparison, 404, 409))
def compare(
    plan: Digest, demo: Annotated[str, Query(pattern=DIGEST)], db: Db, give: Giving, pass_index: OnePass = 0
) -> Response:
    """Compare a pass of a plan with a demonstration cut from the recording of its replay."""
    with db.reading() as session:
        return give(compare_with_plan(session, plan, demo, pass_index))


def _media_type(accept: str) -> str:
    """Return the media type that the client names first.

    Raises:
        UnknownFormat: It accepts none of the three.
    """
    for one in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if one in (JSON, TABLE, BAG):
            return one
        if one in ("*/*", "application/*"):
            return JSON
    raise UnknownFormat(
        f"A trajectory is available as {JSON}, {TABLE}, or {BAG} for replay; name one of them in Accept."
    )


def _contents(
    db: Database,
    plan: str,
    pass_index: int | None,
    handoff: Literal["none"] | None,
    media_type: str,
    settings: Settings,
) -> bytes:
    if media_type == BAG:
        return replay_bag(db, plan, pass_index=pass_index, handoff=handoff, **conditions_of(settings))
    with db.reading() as session:
        motion = motion_of(session, plan)
    trajectory = trajectory_of(motion)
    rows = _rows(trajectory, pass_index)
    return _table(rows) if media_type == TABLE else _json(rows, trajectory.rate_hz)


def _rows(trajectory: Trajectory, pass_index: int | None) -> list[list[Any]]:
    t, chosen = trajectory, rows_of_pass(trajectory, pass_index)
    parts = [part[chosen] for part in (t.stamps_s, t.pass_index, t.phase, t.tip_mm, t.rotation_xyzw, t.joints)]
    columns = [column for part in parts for column in (part.T.tolist() if part.ndim == 2 else [part.tolist()])]
    return [list(row) for row in zip(*columns, strict=True)]


def _table(rows: list[list[Any]]) -> bytes:
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(COLUMNS.split(","))
    writer.writerows(rows)
    return out.getvalue().encode()


def _json(rows: list[list[Any]], rate_hz: float) -> bytes:
    return orjson.dumps({"rate_hz": rate_hz, "columns": COLUMNS.split(","), "rows": rows})


picture_router = router_of(prefix="/playbacks/{playback}", tags=["plans"], max_body_size=MEBIBYTE)

PNG, GIF, MP4 = "image/png", "image/gif", "video/mp4"


def _given(kind: str) -> dict[str, Any]:
    """Describe a picture route; plain bytes are a second media type, for generated clients that know no other."""
    return gives_file((BYTES, kind), 404, 409)


@picture_router.get("/picture.png", dependencies=[needs("reader")], **_given(PNG))
def get_picture(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a still picture of the playback: the scene with all passes."""
    with db.reading() as session:
        return give.bytes(shown_playback(session, playback).measured.picture_png, as_asked(accept, PNG))


@picture_router.get("/animation.mp4", dependencies=[needs("reader")], **_given(MP4))
def get_animation(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return the film of the whole trajectory, as H.264."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_mp4), as_asked(accept, MP4))


@picture_router.get("/animation.gif", dependencies=[needs("reader")], **_given(GIF))
def get_animation_gif(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return the same film as a GIF."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.animation_gif), as_asked(accept, GIF))


@picture_router.get("/joints.png", dependencies=[needs("reader")], **_given(PNG))
def get_joints_plot(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a plot of the joints of both arms over time, with their limits."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.joints_png), as_asked(accept, PNG))


@picture_router.get("/clearance.png", dependencies=[needs("reader")], **_given(PNG))
def get_clearance_plot(playback: Digest, db: Db, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a plot of the distances between surfaces over time, with the permitted minimum."""
    return give.bytes(_drawn(db, playback, lambda drawn: drawn.clearance_png), as_asked(accept, PNG))


@picture_router.post("/pictures", dependencies=[needs("trainer"), room_for_a_job], **starts_job(404, 409))
def draw_pictures(playback: Digest, db: Db, actor: Actor) -> Response:
    """Request the film and the plots; every new playback has requested them already, so this returns that job.

    The engine is not notified, because nobody waits for pictures: a worker finds the job in the queue by itself.
    """
    with db.reading() as session:
        surgeon = find_playback(session, playback).plan.policy.surgeon.slug
    with db.writing([locks.surgeon(surgeon)]) as session:
        job, new = playbacks.request_pictures(session, shown_playback(session, playback), actor)
        return accepted(session, job, QUEUED if new else did_nothing(job))


def _drawn(db: Database, playback: str, which: Callable[[Pictures], bytes]) -> bytes:
    with db.reading() as session:
        return which(playbacks.find_pictures(session, shown_playback(session, playback)))


timeline_router = router_of(tags=["timelines"], max_body_size=MEBIBYTE)
timeline_page_router = router_of(route_class=PageRoute, include_in_schema=False, max_body_size=MEBIBYTE)

SPAN, MOST_MARKS = r"^\d{1,6}(\.\d{1,6})?-\d{1,6}(\.\d{1,6})?$", 20


@timeline_router.get(
    "/timelines/{source}/{digest}",
    dependencies=[needs("reader")],
    **gives(MotionTimeline, 404, 409, 415, as_well=(MCAP,)),
)
def get_timeline(source: Source, digest: Digest, db: Db, tell: Parse, give: Giving, accept: Accept = "*/*") -> Response:
    """Return a recording, a demonstration, a learnt path or a plan as columns on one clock, to be played.

    At most 200 rows a second and 24,000 in all. `Accept: application/vnd.mcap` returns an MCAP file for viewers such as
    Foxglove, which is not for execution. 409: the surgeon's consent does not cover training, for a policy version or a
    plan, or an export, for the file of a recording or a demonstration; or somebody recorded allows no use.
    """
    mcap = _is_mcap(accept)
    if mcap:
        with db.reading() as session:
            check_export(session, source, digest)
    found = timeline_of(db, source, digest, tell)
    if not mcap:
        return give({"source": source, "sha256": digest, "timeline": as_json(found)})
    given = give.bytes(timeline_mcap(found, f"{source}/{digest}"), MCAP)
    given.headers["Content-Disposition"] = f'attachment; filename="{source}-{digest[:12]}-to-look-at.mcap"'
    return given


def _is_mcap(accept: str) -> bool:
    """Return whether the client names MCAP before JSON.

    Raises:
        UnknownFormat: It accepts neither.
    """
    for one in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if one == MCAP:
            return True
        if one in (JSON, "application/*", "*/*"):
            return False
    raise UnknownFormat(f"A timeline is available as {JSON} or {MCAP}; name one of them in Accept.")


@timeline_page_router.get("/pages/player/{source}/{digest}", dependencies=[needs("reader")])
def show_player(
    source: Source,
    digest: Digest,
    request: Request,
    caller: Asking,
    db: Db,
    beside: Annotated[str | None, Query(max_length=100)] = None,
    mark: Annotated[list[Annotated[str, Query(pattern=SPAN)]] | None, Query(max_length=MOST_MARKS)] = None,
) -> Response:
    """Show the player of a motion; `beside` is another one, such as `plans/DIGEST`, to be played in step with it.

    Each `mark` is a part to show, such as `1.5-2.25`: seconds on the clock of the first motion.
    """
    with db.reading() as session:
        shown, choices = chosen(session, source, digest)
        other = motion_named(session, beside) if beside else None
        if other is not None and other not in choices:
            choices = [other, *choices]  # such as one of a link to an older demonstration than those of the list
        marks = [[float(end) for end in one.split("-")] for one in mark or ()]
        return render(request, "player.html", caller, shown=shown, choices=choices, other=other, marks=marks)
