"""The audit log: actor, action, object and time. Surgeons appear only by the random subject of their row."""

import secrets
from collections.abc import Sequence
from datetime import datetime
from typing import Any, cast

from sqlalchemy import Table, insert
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Surgeon
from skills.db.service_tables import Event
from skills.packing import canonical, sha256

_ADD = insert(cast(Table, Event.__table__))


def record(
    session: Session, actor: str, action: str, object_kind: str, object_id: str, surgeon: Surgeon | None = None
) -> None:
    """Add an event to the caller's transaction."""
    record_each(session, actor, action, object_kind, [(object_id, surgeon)])


def record_each(
    session: Session, actor: str, action: str, object_kind: str, objects: Sequence[tuple[str, Surgeon | None]]
) -> None:
    """Add one event for each of several objects of one kind, each with its surgeon, to the caller's transaction."""
    if objects:
        at = now()
        # One statement on the bare table for all of them: a batch adds many events at once.
        session.execute(_ADD, [_event(at, actor, action, object_kind, *one) for one in objects])


def _event(
    at: datetime, actor: str, action: str, object_kind: str, object_id: str, surgeon: Surgeon | None
) -> dict[str, Any]:
    subject = surgeon.subject if surgeon else None
    # The random part makes the digests of two equal events at one moment different.
    identity = [at.isoformat(), actor, action, object_kind, object_id, subject, secrets.token_hex(8)]
    return {
        "sha256": sha256(canonical(identity)),
        "at": at,
        "actor": actor,
        "action": action,
        "object_kind": object_kind,
        "object_id": object_id,
        "subject": subject,
    }
