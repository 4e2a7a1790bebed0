"""Suture points from a simulator's recording, for `POST /plans`."""

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query, Response

from skills.api.access import needs
from skills.api.deps import Incoming, Read
from skills.api.documented import says
from skills.api.replies import say
from skills.api.routes.demos import RAW_BODY
from skills.api.schemas.given import SuturePoints
from skills.api.schemas.sent import Name, Schema
from skills.library.suture_points import find_suture_points

router = APIRouter(tags=["plans"])


class SuturePointsUpload(Schema):
    """All that the query may hold: whose base frame is wanted, and its name (see `receive`)."""

    arm: Name | None = None
    rate_hz: float | None = None
    frame: str | None = None


@router.post("/suture-points", dependencies=[needs("uploader")], openapi_extra=RAW_BODY, **says(SuturePoints))
def read_suture_points(upload: Incoming, asked: Annotated[SuturePointsUpload, Query()], read: Read) -> Response:
    """Read the Entry and Exit marks of a simulator's MCAP file, in an arm's base frame; nothing is stored.

    `is_goal` proposes the exits as goals of passes: there the needle comes out and is handed over. A suture point of a
    plan takes `position_mm`, and as its rotation `turn_xyzw` where the style was demonstrated at the first of them.
    """
    return say(asdict(find_suture_points(upload, asked.arm, read)))
