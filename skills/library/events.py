"""The record of who did what to what, when. People appear by the random subject of their row only."""

import secrets
from typing import cast

from sqlalchemy import Table, insert
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Event, Surgeon
from skills.packing import canonical, sha256

ADD = insert(cast(Table, Event.__table__))


def record(
    session: Session, actor: str, action: str, object_kind: str, object_id: str, surgeon: Surgeon | None = None
) -> None:
    """Add an event to the caller's transaction."""
    at = now()
    subject = surgeon.subject if surgeon else None
    identity = [at.isoformat(), actor, action, object_kind, object_id, subject, secrets.token_hex(8)]
    event = {
        "sha256": sha256(canonical(identity)),
        "at": at,
        "actor": actor,
        "action": action,
        "object_kind": object_kind,
        "object_id": object_id,
        "subject": subject,
    }
    session.execute(ADD, event)
