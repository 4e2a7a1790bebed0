"""The motion of a plan: JSON, a table, or the bag that a robot replays; and what came of replaying it."""

import csv
import io
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Query, Response

from skills.api.access import needs
from skills.api.answers import JSON
from skills.api.deps import DIGEST, Configured, Db, Digest
from skills.api.documented import gives
from skills.api.replies import Giving
from skills.api.routes.policies import Accept
from skills.api.schemas.given import Comparison
from skills.api.schemas.given import Trajectory as GivenTrajectory
from skills.db.session import Database
from skills.errors import UnknownFormat
from skills.library.comparison import compare_with_plan
from skills.library.plans import find_plan, trajectory_of
from skills.library.replay import replay_bag
from skills.library.verified import planned
from skills.recordings.replay import rows_of_pass
from skills.settings import Settings
from skills.style.plan import MAX_PASSES
from skills.style.trajectory import Trajectory

router = APIRouter(tags=["plans"])

BAG, TABLE = "application/zip", "text/csv"
COLUMNS = (
    "t_s,pass,phase,x_mm,y_mm,z_mm,qx,qy,qz,qw,yaw_rad,pitch_rad,insertion_mm,roll_rad,wrist_pitch_rad,wrist_yaw_rad"
)

_PASS: Any = Query(alias="pass", ge=0, lt=MAX_PASSES, description="One pass alone, counted from 0 as in reports.")
PassIndex = Annotated[int | None, _PASS]
OnePass = Annotated[int, _PASS]


@router.get(
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
    accept: Accept = "*/*",
) -> Response:
    """Give the motion of a plan, sampled: JSON, `Accept: text/csv` a table, `Accept: application/zip` the replay bag.

    The bag is 409 until a feasible playback exists for exactly this plan, its policy is the released one, its
    demonstration stands, consent covers an export, and every pass is certain enough to succeed.
    """
    media_type = _media_type(accept)
    content = _contents(db, plan, pass_index, media_type, settings)
    given = give.bytes(content, media_type)
    if media_type == BAG:
        which = "" if pass_index is None else f"-pass-{pass_index}"
        given.headers["Content-Disposition"] = f'attachment; filename="replay-{plan[:12]}{which}.zip"'
    return given


@router.get("/plans/{plan}/comparison", dependencies=[needs("reader")], **gives(Comparison, 404))
def compare(
    plan: Digest, demo: Annotated[str, Query(pattern=DIGEST)], db: Db, give: Giving, pass_index: OnePass = 0
) -> Response:
    """Compare a pass of a plan with a demonstration that is the recording of its replay."""
    with db.reading() as session:
        return give(compare_with_plan(session, plan, demo, pass_index))


def _media_type(accept: str) -> str:
    """Choose what the client names first.

    Raises:
        UnknownFormat: It takes none of the three.
    """
    for one in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if one in (JSON, TABLE, BAG):
            return one
        if one in ("*/*", "application/*"):
            return JSON
    raise UnknownFormat(f"A trajectory is given as {JSON}, {TABLE}, or {BAG} for replay.")


def _contents(db: Database, plan: str, pass_index: int | None, media_type: str, settings: Settings) -> bytes:
    if media_type == BAG:
        asked = {"tip_error_mm": settings.replay_tip_error_mm, "lower_bound": settings.replay_lower_bound}
        return replay_bag(db, plan, pass_index=pass_index, **asked)
    with db.reading() as session:
        trajectory = trajectory_of(planned(find_plan(session, plan)))
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
