"""Routes of timelines: the columns of any motion, the same as a file for viewers, and the page that plays them."""

from typing import Annotated

from fastapi import Query, Response

from skills.api.authorisation import needs
from skills.api.dependencies import Accept, Db, Digest, Parse
from skills.api.openapi import gives, router_of
from skills.api.responses import JSON, Giving, negotiate
from skills.api.routes.pages import WebPage
from skills.api.routes.pages import router as page_router
from skills.formats import MCAP
from skills.formats.bag_writer import timeline_mcap
from skills.library.recordings.timelines import FIND, Source, check_export, chosen, motion_named, timeline_of
from skills.schemas.timelines import MotionTimeline

router = router_of("timelines")


SPAN, MOST_MARKS = r"^\d{1,6}(\.\d{1,6})?-\d{1,6}(\.\d{1,6})?$", 20


@router.get("/timelines/{source}/{digest}", **gives("reader", MotionTimeline, 404, 409, 415, as_well=(MCAP,)))
def get_timeline(source: Source, digest: Digest, db: Db, parse: Parse, give: Giving, accept: Accept) -> Response:
    """Return a recording, a demonstration, a learnt path or a plan as columns on one clock, to be played.

    At most 200 rows a second and 24,000 in all. `Accept: application/vnd.mcap` returns an MCAP file for viewers such as
    Foxglove, which is not for execution. 409: the surgeon's consent does not cover training, for a policy version or a
    plan, or an export, for the file of a recording or a demonstration; or somebody recorded allows no use.
    """
    mcap = negotiate(accept, "A timeline", JSON, MCAP) == MCAP
    with db.reading() as session:
        digest = FIND[source](session, digest).sha256  # in full: the argument may be a prefix
        if mcap:
            check_export(session, source, digest)
    found = timeline_of(db, source, digest, parse)
    if not mcap:
        return give(MotionTimeline(source=source, sha256=digest, timeline=found))
    given = give.bytes(timeline_mcap(found, f"{source}/{digest}"), MCAP)
    given.headers["Content-Disposition"] = f'attachment; filename="{source}-{digest[:12]}-to-look-at.mcap"'
    return given


@page_router.get("/pages/player/{source}/{digest}", dependencies=[needs("reader")])
def show_player(
    source: Source,
    digest: Digest,
    page: WebPage,
    beside: Annotated[str | None, Query(max_length=100)] = None,
    mark: Annotated[list[Annotated[str, Query(pattern=SPAN)]] | None, Query(max_length=MOST_MARKS)] = None,
) -> Response:
    """Show the player of a motion; `beside` is another one, such as `plans/DIGEST`, to be played in step with it.

    Each `mark` is a part to show, such as `1.5-2.25`: seconds on the clock of the first motion.
    """
    with page.db.reading() as session:
        shown, choices = chosen(session, source, digest)
        other = motion_named(session, beside) if beside else None
        if other is not None and other not in choices:
            choices = [other, *choices]  # such as one of a link to an older demonstration than those of the list
        marks = [[float(end) for end in one.split("-")] for one in mark or ()]
        return page.show("player.html", shown=shown, choices=choices, other=other, marks=marks)
