"""Whether it lives, whether it can work, and its figures."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse

from skills.api.metrics import CONTENT_TYPE, Metrics
from skills.jobs.readiness import refuse_unready
from skills.settings import Settings

router = APIRouter(tags=["operating"])


@router.get("/healthz")
def alive() -> dict[str, str]:
    """Say that the process answers."""
    return {"status": "ok", "use": "research use only"}


@router.get("/readyz")
def ready(request: Request) -> dict[str, Any]:
    """Try the database, the job queue and its workers; 503 where one cannot be used, with its name."""
    settings: Settings = request.app.state.settings
    return {"status": "ready", "workers": refuse_unready(settings)}


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(request: Request) -> Response:
    """Give the figures of this process and of the installation, for Prometheus."""
    figures: Metrics = request.app.state.metrics
    return Response(figures.text(), media_type=CONTENT_TYPE)
