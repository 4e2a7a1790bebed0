"""Plans and their playback."""

import csv
import io
from typing import Any

import orjson
from fastapi import APIRouter, Response

from skills.api.deps import Actor, Db, Digest, Jobs
from skills.api.routes.policies import Accept
from skills.api.routes.trainings import accepted
from skills.api.schemas import PlanIn, PlaybackIn, plan_out, playback_out
from skills.errors import UnknownFormat
from skills.library import plans
from skills.library.verified import planned
from skills.settings import MEBIBYTE
from skills.style.trajectory import Trajectory

router = APIRouter(tags=["plans"], max_body_size=MEBIBYTE)

COLUMNS = (
    "t_s,pass,phase,x_mm,y_mm,z_mm,qx,qy,qz,qw,yaw_rad,pitch_rad,insertion_mm,roll_rad,wrist_pitch_rad,wrist_yaw_rad"
)


@router.post("/plans", status_code=201, responses={200: {}})
def make_plan(body: PlanIn, db: Db, actor: Actor, response: Response) -> dict[str, Any]:
    """Stack a style's grid world at suture points."""
    row, created = plans.plan_sutures(db, body.request, actor)
    response.status_code = 201 if created else 200
    response.headers["Location"] = f"/plans/{row.sha256}"
    with db.reading() as session:
        return plan_out(plans.find_plan(session, row.sha256))


@router.get("/plans/{plan}")
def get_plan(plan: Digest, db: Db) -> dict[str, Any]:
    """Look a plan up."""
    with db.reading() as session:
        return plan_out(plans.find_plan(session, plan))


@router.get("/plans/{plan}/trajectory")
def get_trajectory(plan: Digest, db: Db, accept: Accept = "*/*") -> Response:
    """Give the motion of a plan, sampled: JSON, or with `Accept: text/csv` a table."""
    kinds = [part.partition(";")[0].strip().lower() for part in accept.split(",")]
    if "application/zip" in kinds:
        raise UnknownFormat("The replay bag comes with a later version; take JSON or text/csv.")
    with db.reading() as session:
        trajectory = plans.trajectory_of(planned(plans.find_plan(session, plan)))
    if "text/csv" in kinds:
        return Response(_table(trajectory), media_type="text/csv")
    return Response(_json(trajectory), media_type="application/json")


@router.post("/playbacks", status_code=202, responses={200: {}})
def play(body: PlaybackIn, db: Db, jobs: Jobs, actor: Actor, response: Response) -> dict[str, Any]:
    """Ask for a plan to be played in the simulator."""
    with db.writing() as session:
        job, new = plans.request_playback(session, body.plan, actor)
    if new:
        jobs.tell(job.row, job.attempt)
    return accepted(job, response)


@router.get("/playbacks/{playback}")
def get_playback(playback: Digest, db: Db) -> dict[str, Any]:
    """Give the simulator's verdict on a plan."""
    with db.reading() as session:
        return playback_out(plans.find_playback(session, playback))


@router.get("/playbacks/{playback}/picture.png")
def get_picture(playback: Digest, db: Db) -> Response:
    """Give a still picture of the playback."""
    with db.reading() as session:
        return Response(plans.find_playback(session, playback).measured.picture_png, media_type="image/png")


def _rows(trajectory: Trajectory) -> list[list[Any]]:
    t = trajectory
    parts = (t.stamps_s, t.pass_index, t.phase, t.tip_mm, t.rotation_xyzw, t.joints)
    columns = [column for part in parts for column in (part.T.tolist() if part.ndim == 2 else [part.tolist()])]
    return [list(row) for row in zip(*columns, strict=True)]


def _table(trajectory: Trajectory) -> str:
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(COLUMNS.split(","))
    writer.writerows(_rows(trajectory))
    return out.getvalue()


def _json(trajectory: Trajectory) -> bytes:
    return orjson.dumps({"rate_hz": trajectory.rate_hz, "columns": COLUMNS.split(","), "rows": _rows(trajectory)})
