"""Routes of health, readiness, metrics and the history, and the reference page of the calls."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import AwareDatetime

from skills.api.authorisation import needs, open_to_all
from skills.api.dependencies import Configured, Db
from skills.api.metrics import CONTENT_TYPE, ServiceMetrics
from skills.api.openapi import router_of, says
from skills.api.pages import render
from skills.api.responses import say
from skills.jobs.readiness import refuse_unready
from skills.library.operation.proofs import served_at as find_served
from skills.library.operation.proofs import signed_checkpoint
from skills.sandbox.containment import LAYERS
from skills.sandbox.forked import layers_held
from skills.schemas.requests import SLUG
from skills.schemas.responses import Alive, Ready, ServedAt, SignedCheckpoint
from skills.settings import MEBIBYTE

router = router_of("operating")


@router.get("/healthz", **says(None, Alive))
def alive() -> Response:
    """Report that the process answers requests."""
    return say({"status": "ok", "use": "research use only"})


@router.get("/readyz", **says("reader", Ready, whole=True))
def ready(settings: Configured) -> Response:
    """Check the database, the job queue and its workers; 503 with the name of the one that cannot be used.

    `containment` has the layers that contain readers, simulators and learners, and whether this system offers each.
    """
    workers, held = refuse_unready(settings), layers_held()
    return say({"status": "ready", "workers": workers, "containment": {name: name in held for name in LAYERS}})


@router.get("/history", **says("reader", ServedAt, 404, 410))
def served_at(
    db: Db,
    surgeon: Annotated[str, Query(pattern=SLUG)],
    suture: Annotated[str, Query(pattern=SLUG)],
    at: Annotated[AwareDatetime, Query(description="A moment with its zone, such as 2026-01-31T12:00:00Z.")],
) -> Response:
    """Return the version of a style that was served at a time, with proofs that need no trust in this service."""
    with db.reading() as session:
        return say(find_served(session, db.history, surgeon, suture, at))


@router.get("/history/checkpoint", **says("reader", SignedCheckpoint))
def newest_head(db: Db) -> Response:
    """Return the newest signed checkpoint of the history, to be kept elsewhere."""
    with db.reading() as session:
        return say(signed_checkpoint(session.connection(), db.history))


@router.get("/metrics", dependencies=[needs("reader", whole=True)], response_class=PlainTextResponse)
def metrics(request: Request) -> Response:
    """Return the metrics of this process and of the installation for Prometheus."""
    figures: ServiceMetrics = request.app.state.metrics
    return Response(figures.text(), media_type=CONTENT_TYPE)


reference_router = APIRouter(include_in_schema=False, max_body_size=MEBIBYTE)


@reference_router.get("/docs", dependencies=[open_to_all()])
def show_reference(request: Request) -> Response:
    """Show the calls of /openapi.json as a page on which they can be tried out."""
    return render(request, "reference.html", None)
