"""The pages of atlases: which there are, and one drawn."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from skills.api.access import Asking, needs
from skills.api.deps import DIGEST, Db, Slug
from skills.api.pages import atlas_drawing
from skills.api.pages.page import render
from skills.api.routes.pages import PageRoute
from skills.errors import BadInput, Conflict, NotFound
from skills.library.atlas import CONFOUNDED, DISTANCE, SESSIONS, atlas_of, atlases
from skills.library.catalogue import find_suture_type
from skills.settings import MEBIBYTE

MOST_PAIRS = 60  # of surgeons, on a page

router = APIRouter(route_class=PageRoute, include_in_schema=False, max_body_size=MEBIBYTE)


@router.get("/pages/atlas", dependencies=[needs("reader")])
def show_atlases(request: Request, caller: Asking, db: Db) -> Response:
    """Show of which suture types there is something to compare."""
    with db.reading() as session:
        return render(request, "atlases.html", caller, found=atlases(session))


@router.get("/pages/atlas/{suture}", dependencies=[needs("reader")])
def show_atlas(
    suture: Slug,
    request: Request,
    caller: Asking,
    db: Db,
    scaled: bool = False,
    clusters: Annotated[str, Query(pattern=r"^\d{0,4}$")] = "",
    demo: Annotated[str | None, Query(pattern=DIGEST)] = None,
) -> Response:
    """Show an atlas: the chart, distances with their dendrogram, surgeons, and whose style a demonstration is."""
    number = int(clusters or 0) or None  # a form sends what was left empty
    try:
        found = atlas_of(db, suture, scaled=scaled, clusters=number, demo=demo)
    except (Conflict, BadInput) as refused:
        raise NotFound(str(refused)) from refused  # for a person: a page that says why there is none
    pairs = sorted(found.differences, key=lambda one: -one.distance)[:MOST_PAIRS]
    marks = atlas_drawing.marks(found)
    drawn = {
        "chart": atlas_drawing.chart(found),
        "matrix": atlas_drawing.matrix(found),
        "marks": {surgeon: atlas_drawing.key(mark) for surgeon, mark in marks.items()},
        "thirds": [atlas_drawing.thirds(one.shares) for one in pairs],
        "most": atlas_drawing.MOST_GROUPS,
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
