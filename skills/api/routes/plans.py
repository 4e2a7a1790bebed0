"""Routes of plans: suture points, plans, trajectories, replay bags, playbacks and pictures; and of timelines.

`POST /suture-points` reads the suture points for a plan from a simulator's recording, `POST /reach` maps where they can
be. The motion of a plan is returned as JSON, as a table, or as the bag that a robot replays; a recording of the replay
is compared with the plan. A still picture of a playback comes with its verdict; the film and the plots are drawn
afterwards. A timeline is the columns of any motion, the same as a file for viewers, and the page that plays them.
"""

import csv
import io
from typing import Annotated, Any, Literal

import orjson
from fastapi import Query, Response
from pydantic import Field

from skills.api.dependencies import Accept, Actor, Configured, Db, Digest, ListingByRow, Read
from skills.api.openapi import gives, makes, router_of, says, uploads_of
from skills.api.responses import JSON, Giving, negotiate, say, stored
from skills.api.routes.recordings import RAW_BODY
from skills.api.uploads import Incoming
from skills.db.session import Database
from skills.library.operation import overview
from skills.library.plans import plans
from skills.library.plans.description import describe_stored, summarise
from skills.library.plans.plans import find_suture_points, motion_of, trajectory_of
from skills.library.plans.reach import map_style
from skills.library.plans.replay import describe_segments, replay_bag
from skills.library.plans.replay_comparison import compare_with_plan
from skills.library.plans.replay_gate import ReplayConditions
from skills.planning.plan import MAX_PASSES
from skills.planning.trajectory import Trajectory, rows_of_pass
from skills.schemas import Page
from skills.schemas.plans import Plan, PlanIn, PlanSummary, SegmentIndex
from skills.schemas.plans import Trajectory as GivenTrajectory
from skills.schemas.playbacks import Comparison
from skills.schemas.reach import Reach, ReachIn
from skills.schemas.recordings import SuturePoints
from skills.schemas.requests import DIGEST, FRAME, Name, Schema
from skills.settings import Settings

router = router_of("plans")


@router.post("/plans", **makes("trainer", Plan, 404, 409, 410))
def make_plan(body: PlanIn, db: Db, actor: Actor) -> Response:
    """Stack a style's grid world at suture points."""
    row, created = plans.plan_sutures(db, body, actor)
    return stored(describe_stored(row), created, f"/plans/{row.sha256}")


@router.get("/plans", **gives("reader", Page[PlanSummary], 410))
def list_plans(db: Db, listing: ListingByRow) -> Response:
    """List plans, the newest first, each with its newest playback."""
    with db.reading() as session:
        found = overview.newest_plans(session, listing.cursor, listing.limit)
        return listing.page([summarise(plan, played) for plan, played in found], [plan for plan, _ in found])


@router.get("/plans/{plan}", **gives("reader", Plan, 404, 409))
def get_plan(plan: Digest, db: Db, give: Giving) -> Response:
    """Return a plan with its paths, while the surgeon's consent covers training."""
    with db.reading() as session:
        return give(describe_stored(plans.followed_plan(session, plan)))


@router.post("/reach", **says("trainer", Reach, 404, 409, 410))
def map_reach(body: ReachIn, db: Db) -> Response:
    """Return where a style can be planned: reach, joint margins and clearances over positions and rotations.

    A place is `yes` if a plan of that pass alone keeps all limits of the verdict's closed form, `no` if it does not,
    and `in doubt` next to a limit. Several passes, and the arms' errors, are left to plan and playback. Nothing is
    stored.
    """
    return say(map_style(db, body))


suture_point_router = uploads_of("plans")


class SuturePointsUpload(Schema):
    """Query parameters of a scene upload: the arm whose base frame is used, and the frame's name."""

    arm: Name | None = None
    frame: Annotated[str, Field(pattern=FRAME)] | None = Field(
        default=None, description="The name of the arm's base frame, in which marks without a base of the arm are."
    )


@suture_point_router.post("/suture-points", openapi_extra=RAW_BODY, **says("uploader", SuturePoints))
def read_suture_points(upload: Incoming, asked: Annotated[SuturePointsUpload, Query()], read: Read) -> Response:
    """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame; nothing is stored.

    `is_goal` proposes the exits as goals of passes: there the needle comes out and is handed over. A suture point of a
    plan takes `position_mm`, and as its rotation `turn_xyzw` if the style was demonstrated at the first of them.
    """
    return say(find_suture_points(upload, asked.arm, asked.frame, read))


BAG, TABLE = "application/zip", "text/csv"
COLUMNS = (
    "t_s,pass,phase,x_mm,y_mm,z_mm,qx,qy,qz,qw,yaw_rad,pitch_rad,insertion_mm,roll_rad,wrist_pitch_rad,wrist_yaw_rad"
)

_PASS: Any = Query(alias="pass", ge=0, lt=MAX_PASSES, description="A single pass, counted from 0 as in reports.")
PassIndex = Annotated[int | None, _PASS]
OnePass = Annotated[int, _PASS]


@router.get("/plans/{plan}/trajectory", **gives("reader", GivenTrajectory, 404, 409, 415, as_well=(TABLE, BAG)))
def get_trajectory(
    plan: Digest,
    db: Db,
    settings: Configured,
    give: Giving,
    accept: Accept,
    pass_index: PassIndex = None,
    handoff: Annotated[
        Literal["none"] | None, Query(description="`none` is required for the bag of a plan without a hand-off.")
    ] = None,
) -> Response:
    """Return the sampled motion of a plan: JSON, `Accept: text/csv` a table, `Accept: application/zip` the replay bag.

    All of them are 409 if the surgeon's consent does not cover training. The bag is by automatic segment, and 409 until
    a feasible playback exists for exactly this plan, its policy is the released one, its demonstration is not
    withdrawn, the consent covers an export, and every pass is certain enough to succeed; for a plan without a hand-off
    it also needs `handoff=none`.
    """
    media_type = negotiate(accept, "A trajectory", JSON, TABLE, BAG)
    content = _contents(db, plan, pass_index, handoff, media_type, settings)
    given = give.bytes(content, media_type)
    if media_type == BAG:
        given.headers["Content-Disposition"] = f'attachment; filename="replay-{plan[:12]}.zip"'
    return given


@router.get("/plans/{plan}/segments", **gives("reader", SegmentIndex, 404, 409))
def get_segments(plan: Digest, db: Db, give: Giving) -> Response:
    """Return the automatic segments of a plan: what comes when, who moves, and what must be true before each."""
    with db.reading() as session:
        return give(describe_segments(session, plan))


@router.get("/plans/{plan}/comparison", **gives("reader", Comparison, 404, 409))
def compare(
    plan: Digest, demo: Annotated[str, Query(pattern=DIGEST)], db: Db, give: Giving, pass_index: OnePass = 0
) -> Response:
    """Compare a pass of a plan with a demonstration cut from the recording of its replay."""
    with db.reading() as session:
        return give(compare_with_plan(session, plan, demo, pass_index))


def _contents(
    db: Database,
    plan: str,
    pass_index: int | None,
    handoff: Literal["none"] | None,
    media_type: str,
    settings: Settings,
) -> bytes:
    if media_type == BAG:
        return replay_bag(db, plan, ReplayConditions.of(settings, handoff))
    with db.reading() as session:
        motion = motion_of(session, plan)
    trajectory = trajectory_of(motion)
    rows = _rows(trajectory, pass_index)
    if media_type == TABLE:
        return _table(rows)
    return orjson.dumps({"rate_hz": trajectory.rate_hz, "columns": COLUMNS.split(","), "rows": rows})


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
