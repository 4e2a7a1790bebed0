"""Routes of atlases and their pages, and of scores.

An atlas compares the demonstrations of a suture type. A score compares a demonstration, or a part of a recording, with
a style; nothing of it is stored.
"""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from skills.api.authorisation import Asking, needs
from skills.api.dependencies import Db, Read, Slug, Strict
from skills.api.openapi import gives, says
from skills.api.pages import drawings, render
from skills.api.responses import Giving, say
from skills.api.routes.pages import PageRoute
from skills.errors import BadInput, Conflict, NotFound
from skills.library import scores
from skills.library.atlas import CONFOUNDED, DISTANCE, MOST, SESSIONS, atlas_of, atlases
from skills.library.catalogue import find_suture_type
from skills.schemas.given import Atlas, Score
from skills.schemas.requests import COUNT, DIGEST, ScoreIn
from skills.settings import MEBIBYTE

router = APIRouter(tags=["atlas"], max_body_size=MEBIBYTE)

Clusters = Annotated[
    int | None, Query(ge=1, le=MOST, description="Number of clusters; by default as many as are found.")
]
AskedDemo = Annotated[
    str | None, Query(pattern=DIGEST, description="Digest of a demonstration whose surgeon is to be recognised.")
]


@router.get("/styles/{suture}/atlas", dependencies=[needs("reader")], **gives(Atlas, 404, 409))
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


score_router = APIRouter(route_class=Strict, tags=["scores"], max_body_size=MEBIBYTE)


@score_router.post("/scores", dependencies=[needs("reader")], **says(Score, 404, 409, 410))
def score(body: ScoreIn, db: Db, read: Read) -> Response:
    """Score a motion: its figures compared with the reference's, its deviation, percentiles, and a curve over time.

    Research use only; not a credential.
    """
    return say(scores.score(db, body, read))
