"""Routes of health, readiness and metrics, and the reference page of the calls, which loads nothing external."""

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse

from skills.api.authorisation import needs, open_to_all
from skills.api.metrics import CONTENT_TYPE, ServiceMetrics
from skills.api.openapi import says
from skills.api.pages.page import render
from skills.api.responses import say
from skills.jobs.readiness import refuse_unready
from skills.schemas.given import Alive, Ready
from skills.settings import MEBIBYTE, Settings

router = APIRouter(tags=["operating"])


@router.get("/healthz", dependencies=[open_to_all()], **says(Alive))
def alive() -> Response:
    """Report that the process answers requests."""
    return say({"status": "ok", "use": "research use only"})


@router.get("/readyz", dependencies=[needs("reader", whole=True)], **says(Ready))
def ready(request: Request) -> Response:
    """Check the database, the job queue and its workers; 503 with the name of the one that cannot be used."""
    settings: Settings = request.app.state.settings
    return say({"status": "ready", "workers": refuse_unready(settings)})


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
