"""Scores: a demonstration, or a part of a recording, against a style. Nothing of one is stored."""

from fastapi import APIRouter, Response

from skills.api.access import needs
from skills.api.deps import Db, Read
from skills.api.documented import says
from skills.api.replies import say
from skills.api.schemas.given import Score
from skills.api.schemas.sent import ScoreIn
from skills.api.strict import Strict
from skills.library import scores
from skills.settings import MEBIBYTE

router = APIRouter(route_class=Strict, tags=["scores"], max_body_size=MEBIBYTE)


@router.post("/scores", dependencies=[needs("reader")], **says(Score, 404, 409, 410))
def score(body: ScoreIn, db: Db, read: Read) -> Response:
    """Score a motion: figures beside the reference's, where it deviates, percentiles, and a curve over time.

    Research use only; not a credential.
    """
    return say(scores.score(db, body.asked, read))
