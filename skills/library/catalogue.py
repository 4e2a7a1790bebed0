"""Surgeons and suture types."""

import hashlib
import secrets
import tomllib
from collections.abc import Sequence
from datetime import date
from importlib import resources
from typing import Any

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.models import Erasure, Surgeon, SutureType
from skills.errors import Conflict, Erased, NotFound
from skills.library.events import record


def put_surgeon(session: Session, slug: str, about: dict[str, Any], actor: str) -> tuple[Surgeon, bool]:
    """Write a surgeon whole: (the row, whether it is new).

    Raises:
        Erased: A surgeon of this pseudonym was erased.
    """
    surgeon = known_surgeon(session, slug)
    if surgeon is None:
        _refuse_erased(session, slug)
        surgeon = Surgeon(slug=slug, subject=secrets.token_hex(16), **about)
        session.add(surgeon)
        record(session, actor, "add", "surgeon", surgeon.subject, surgeon)
        session.flush()
        return surgeon, True
    for name, value in about.items():
        setattr(surgeon, name, value)
    record(session, actor, "change", "surgeon", surgeon.subject, surgeon)
    return surgeon, False


def known_surgeon(session: Session, slug: str) -> Surgeon | None:
    """Look for a surgeon; None where there is none of this pseudonym."""
    return session.scalar(select(Surgeon).where(Surgeon.slug == slug))


def find_surgeon(session: Session, slug: str) -> Surgeon:
    """Find a surgeon.

    Raises:
        NotFound: There is none of this pseudonym.
        Erased: There was one.
    """
    surgeon = known_surgeon(session, slug)
    if surgeon is None:
        _refuse_erased(session, slug)
        raise NotFound(f"There is no surgeon '{slug}'; add one with PUT /surgeons/{slug}.")
    return surgeon


def list_surgeons(
    session: Session, limit: int, after: str | None, search: str | None = None, skill_level: str | None = None
) -> Sequence[Surgeon]:
    """List surgeons in the order of their pseudonyms: those in whose pseudonym `search` is, in any case."""
    query = select(Surgeon).where(Surgeon.slug > (after or ""))
    if search is not None:
        query = query.where(Surgeon.slug.icontains(search, autoescape=True))
    if skill_level is not None:
        query = query.where(Surgeon.skill_level == skill_level)
    return session.scalars(query.order_by(Surgeon.slug).limit(limit)).all()


def check_consent(surgeon: Surgeon, use: str, today: date | None = None) -> None:
    """Refuse a use that the surgeon's consent, where one is recorded, does not cover.

    Raises:
        Conflict: It names other uses, or has run out.
    """
    consent = surgeon.consent
    if consent is None:
        return
    if use not in consent["uses"]:
        raise Conflict(f"The consent of '{surgeon.slug}' does not cover {use}; it covers {', '.join(consent['uses'])}.")
    until = consent.get("until")
    if until is not None and not (today or now().date()) <= date.fromisoformat(until):
        raise Conflict(f"The consent of '{surgeon.slug}' ran out on {until}.")


def put_suture_type(session: Session, slug: str, about: dict[str, Any], actor: str) -> tuple[SutureType, bool]:
    """Write a suture type whole: (the row, whether it is new)."""
    suture = known_suture_type(session, slug)
    created = suture is None
    if suture is None:
        suture = SutureType(slug=slug, **about)
        session.add(suture)
    else:
        for name, value in about.items():
            setattr(suture, name, value)
    record(session, actor, "add" if created else "change", "suture-type", slug)
    return suture, created


def known_suture_type(session: Session, slug: str) -> SutureType | None:
    """Look for a suture type; None where the catalogue has none of this name."""
    return session.get(SutureType, slug)


def find_suture_type(session: Session, slug: str) -> SutureType:
    """Find a suture type.

    Raises:
        NotFound: The catalogue has none of this name.
    """
    suture = known_suture_type(session, slug)
    if suture is None:
        raise NotFound(f"There is no suture type '{slug}'; GET /suture-types lists them, PUT adds one.")
    return suture


def list_suture_types(
    session: Session, limit: int, after: str | None, search: str | None = None
) -> Sequence[SutureType]:
    """List suture types in the order of their slugs: those in whose slug, name or family `search` is, in any case."""
    query = select(SutureType).where(SutureType.slug > (after or ""))
    if search is not None:
        told = (SutureType.slug, SutureType.name, SutureType.family)
        query = query.where(or_(*(column.icontains(search, autoescape=True) for column in told)))
    return session.scalars(query.order_by(SutureType.slug).limit(limit)).all()


def seed_catalogue(session: Session) -> int:
    """Write the catalogue of `seeds/` into an empty one: how many suture types were added."""
    if session.scalar(select(func.count()).select_from(SutureType)):
        return 0
    text = (resources.files("skills") / "seeds" / "suture_types.toml").read_text()
    types: list[dict[str, Any]] = tomllib.loads(text)["suture_type"]
    for one in types:
        put_suture_type(session, one.pop("slug"), one, "seeds")
    return len(types)


def _refuse_erased(session: Session, slug: str) -> None:
    if any(salted(e.salt, slug) == e.digest for e in session.scalars(select(Erasure))):
        raise Erased("This surgeon's data was erased for good; use another pseudonym for new recordings.")


def salted(salt: str, slug: str) -> str:
    """Digest a pseudonym so that it can be known again, but not be read."""
    return hashlib.sha256(f"{salt}:{slug}".encode()).hexdigest()
