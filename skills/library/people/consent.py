"""Consent: whether a surgeon's data may be used for training, export or an atlas, or shown at all.

Every use is decided by `may` (or by `refusal` and `require`, which also give the reason), inside the transaction that
stores or returns the data. A transaction that stores holds the name of the surgeon from its beginning
(`skills.library.operation.locks`), so the consent that it reads is current. `covered` is the same rule in SQL, for
lists; a test compares the two.

A consent holds to the end of its last day, in UTC. If none is recorded, the study's protocol decides, and every use is
allowed.
"""

import json
from datetime import date
from functools import cache
from typing import Any, Literal

from sqlalchemy import BindParameter, ColumnElement, Row, Text, and_, bindparam, cast, or_

from skills.db import now
from skills.db.models import Surgeon
from skills.errors import Conflict
from skills.schemas.people import Consent

Use = Literal["training", "export", "atlas", "any"]  # the last one is covered by each of the others: docs/keys.md

Consenting = Surgeon | Row[*tuple[Any, ...]]  # a surgeon, or a row of a query with a surgeon's pseudonym and consent
CALLED = {"training": "training", "export": "export", "atlas": "atlas", "any": "that this is shown"}


def today() -> date:
    """Return the current date in UTC."""
    return now().date()


def refusal(surgeon: Consenting, use: Use) -> Conflict | None:
    """Return the reason why a surgeon's consent does not cover a use today; None if it does."""
    consent = surgeon.consent
    if consent is None:
        return None
    if use not in consent.uses and not (use == "any" and consent.uses):
        covers = ", ".join(consent.uses) or "nothing"
        return Conflict(f"The consent of '{surgeon.slug}' does not cover {CALLED[use]}; it covers {covers}.")
    # The last day itself is covered.
    if consent.until is not None and not today() <= consent.until:
        return Conflict(f"The consent of '{surgeon.slug}' expired on {consent.until}.")
    return None


def may(surgeon: Consenting, use: Use) -> bool:
    """Return whether a surgeon's consent covers a use today."""
    return refusal(surgeon, use) is None


def require(surgeon: Consenting, use: Use) -> None:
    """Refuse a use that a surgeon's consent does not cover today.

    Raises:
        Conflict: The consent does not name the use, or has expired.
    """
    if (refused := refusal(surgeon, use)) is not None:
        raise refused


def last_day(consent: Consent | None) -> date | None:
    """Return the last day on which a consent holds; None if it has no end."""
    return None if consent is None else consent.until


AS_TEXT = cast(Surgeon.consent, Text)


@cache
def covered(use: Use) -> ColumnElement[bool]:
    """Return `may` as a condition on `Surgeon`; each query has the date of the day on which it is executed."""
    until = Surgeon.consent["until"].as_string()
    # A substring search is exact: besides `uses`, the only text in a consent is a date.
    named = AS_TEXT.contains(json.dumps(use))
    day: BindParameter[str] = bindparam(None, callable_=lambda: today().isoformat())
    return or_(AS_TEXT.is_(None), and_(named, or_(until.is_(None), until >= day)))
