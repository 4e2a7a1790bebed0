"""Whether it lives, whether it can work, and its figures."""

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse

from skills.api.access import needs, open_to_all
from skills.api.documented import says
from skills.api.metrics import CONTENT_TYPE, Metrics
from skills.api.replies import say
from skills.api.schemas.given import Alive, Ready
from skills.jobs.readiness import refuse_unready
from skills.settings import Settings

router = APIRouter(tags=["operating"])


@router.get("/healthz", dependencies=[open_to_all()], **says(Alive))
def alive() -> Response:
    """Say that the process answers."""
    return say({"status": "ok", "use": "research use only"})


@router.get("/readyz", dependencies=[needs("reader", whole=True)], **says(Ready))
def ready(request: Request) -> Response:
    """Try the database, the job queue and its workers; 503 where one cannot be used, with its name."""
    settings: Settings = request.app.state.settings
    return say({"status": "ready", "workers": refuse_unready(settings)})


@router.get("/metrics", dependencies=[needs("reader", whole=True)], response_class=PlainTextResponse)
def metrics(request: Request) -> Response:
    """Give the figures of this process and of the installation, for Prometheus."""
    figures: Metrics = request.app.state.metrics
    return Response(figures.text(), media_type=CONTENT_TYPE)
