"""Whether it lives, and whether it can work."""

from typing import Any

from fastapi import APIRouter
from sqlalchemy import text

from skills.api.deps import Db

router = APIRouter(tags=["operating"])


@router.get("/healthz")
def alive() -> dict[str, str]:
    """Say that the process answers."""
    return {"status": "ok", "use": "research use only"}


@router.get("/readyz")
def ready(db: Db) -> dict[str, Any]:
    """Say that the database answers; 503 where it does not."""
    with db.reading() as session:
        session.execute(text("SELECT 1 FROM suture_types LIMIT 1"))
    return {"status": "ready"}
