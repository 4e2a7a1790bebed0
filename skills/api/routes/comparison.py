"""Routes of atlases, nearest neighbours, recognition and scores.

An atlas compares the demonstrations of a suture type. A score compares a demonstration, or a part of a recording, with
a style; nothing of it is stored.
"""

from typing import Annotated

from fastapi import Query, Response

from skills.api.authorisation import needs
from skills.api.dependencies import Db, Digest, Parse, Slug
from skills.api.openapi import gives, router_of, says
from skills.api.pages import drawings
from skills.api.responses import Giving, say
from skills.api.routes.pages import Picked, WebPage
from skills.api.routes.pages import router as page_router
from skills.errors import BadInput, Conflict, NotFound
from skills.library.comparison import scores
from skills.library.comparison.atlas import CONFOUNDED, DISTANCE, MOST, SESSIONS, atlas_of, atlases
from skills.library.comparison.neighbours import nearest_to
from skills.library.comparison.recognition import recognise_recording
from skills.library.operation import styles
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.schemas.comparison import Atlas, Nearest, RecognisedRecording
from skills.schemas.requests import COUNT, DIGEST, SLUG
from skills.schemas.scores import Progress, Score, ScoreIn

atlas_router = router_of("atlas")


score_router = router_of("scores")


Clusters = Annotated[
    int | None, Query(ge=1, le=MOST, description="Number of clusters; by default as many as are found.")
]


AskedDemo = Annotated[
    str | None, Query(pattern=DIGEST, description="Digest of a demonstration whose surgeon is to be recognised.")
]


@atlas_router.get("/styles/{suture}/atlas", **gives("reader", Atlas, 404, 409))
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


@atlas_router.get("/demos/{demo}/nearest", **gives("reader", Nearest, 404, 409))
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


@atlas_router.get("/styles/{suture}/recognition", **gives("reader", RecognisedRecording, 404, 409))
def recognise(
    suture: Slug,
    db: Db,
    parse: Parse,
    give: Giving,
    recording: Annotated[str, Query(pattern=DIGEST, description="Digest of a recording with a demonstration.")],
) -> Response:
    """Recognise the surgeon of a whole recording by all its movements, with its session left out.

    It reads the recordings of the suture type, so it takes seconds for tens of recordings.
    """
    return give(recognise_recording(db, recording, suture, parse))


@score_router.post("/scores", **says("reader", Score, 404, 409, 410))
def score(body: ScoreIn, db: Db, parse: Parse) -> Response:
    """Score a motion: its figures compared with the reference's, its deviation, percentiles, and a curve over time.

    Research use only; not a credential.
    """
    return say(scores.score(db, body, parse))


@score_router.get("/surgeons/{surgeon}/progress", **gives("reader", Progress, 404, 409, 410))
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


MOST_PAIRS = 60  # of surgeons, shown on a page


@page_router.get("/pages/atlas", dependencies=[needs("reader")])
def show_atlases(page: WebPage) -> Response:
    """Show the suture types that have demonstrations to compare."""
    with page.db.reading() as session:
        return page.show("atlases.html", found=atlases(session))


@page_router.get("/pages/atlas/{suture}", dependencies=[needs("reader")])
def show_atlas(
    suture: Slug,
    page: WebPage,
    scaled: bool = False,
    clusters: Annotated[str, Query(pattern=COUNT)] = "",
    demo: Annotated[str | None, Query(pattern=DIGEST)] = None,
) -> Response:
    """Show an atlas: chart, distances with their dendrogram, surgeons, and the recognition of a demonstration."""
    number = int(clusters or 0) or None  # a form sends an empty text for a field without a value
    try:
        found = atlas_of(page.db, suture, scaled=scaled, clusters=number, demo=demo)
    except (Conflict, BadInput) as refused:
        raise NotFound(refused.words()) from refused  # rendered as a page that states the reason
    pairs = sorted(found.differences, key=lambda one: -one.distance)[:MOST_PAIRS]
    drawn = {
        "chart": drawings.chart(found),
        "matrix": drawings.matrix(found),
        "marks": drawings.keys(found),
        "thirds": [drawings.thirds(one.shares) for one in pairs],
        "most": drawings.MOST_GROUPS,
    }
    with page.db.reading() as session:
        return page.show(
            "atlas.html",
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
def show_surgeon(surgeon: Slug, page: WebPage, suture: Picked = None, against: Picked = None) -> Response:
    """Show a surgeon over time: the demonstrations of a suture type, session by session, beside a style's reference."""
    with page.db.reading() as session:
        found = find_surgeon(session, surgeon)
        listed = [style for style in styles.styles_of(session, found) if style.demos]
        chosen = suture or next((style.suture for style in listed), None)
        others = scores.references(session, chosen) if chosen else []
    compared = against or next((one.slug for one in others if one.slug != surgeon), surgeon)
    shown, refused = None, ""
    if chosen:
        try:
            shown = scores.progress(page.db, surgeon, chosen, compared)
        except (Conflict, BadInput, NotFound) as error:
            refused = error.words()  # beside what else is known of the surgeon
    return page.show(
        "surgeon.html",
        surgeon=found,
        styles=listed,
        asked={"suture": chosen, "against": compared},
        others=others,
        shown=shown,
        refused=refused,
        curve=drawings.score_curve(shown.demos, "") if shown is not None and len(shown.demos) > 1 else None,
    )
