"""The catalogue: surgeons, by pseudonym, and suture types."""

import hashlib
import secrets
import tomllib
from collections.abc import Sequence
from importlib import resources
from typing import Any

from sqlalchemy import Select, func, or_, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from skills.db import rfc3339
from skills.db.changes import announce
from skills.db.models import Erasure, Surgeon, SutureType
from skills.db.row_visibility import ONLY
from skills.db.service_tables import record_event
from skills.errors import Erased, NotFound
from skills.library.people.consent import may
from skills.library.policies import releases
from skills.remedies import Action, Remedy, did_you_mean

NEAR = 500  # the most names that are compared with an unknown one for "did you mean"


def put_surgeon(session: Session, slug: str, about: dict[str, Any], actor: str) -> tuple[Surgeon, bool]:
    """Create or replace a surgeon with all fields; return the row, and whether it is new.

    If consent to training ends, or had ended and is given again, the releases of all styles are withdrawn.

    Raises:
        Erased: A surgeon of this pseudonym was erased.
    """
    surgeon = known_surgeon(session, slug)
    if surgeon is None:
        _refuse_erased(session, slug)
        surgeon = Surgeon(slug=slug, subject=secrets.token_hex(16), **about)
        session.add(surgeon)
        record_event(session, actor, "add", "surgeon", surgeon.subject, surgeon)
        session.flush()
        return surgeon, True
    # Before the fields are overwritten, because the decision below needs the old consent.
    covered, before = may(surgeon, "training"), surgeon.consent
    for name, value in about.items():
        setattr(surgeon, name, value)
    record_event(session, actor, "change", "surgeon", surgeon.subject, surgeon)
    if surgeon.consent != before:
        session.flush()
        if not (covered and may(surgeon, "training")):  # also if it had expired: serving needs a new release
            releases.withdraw_all(session, surgeon, actor)
        announce(session)  # every service process caches the last day of consent
    return surgeon, False


def known_surgeon(session: Session, slug: str) -> Surgeon | None:
    """Return a surgeon, or None if there is none of this pseudonym."""
    return session.scalar(select(Surgeon).where(Surgeon.slug == slug))


def find_surgeon(session: Session, slug: str) -> Surgeon:
    """Return a surgeon.

    Raises:
        NotFound: There is none of this pseudonym, among those that the caller may see.
        Erased: The surgeon of this pseudonym was erased; only a caller who may see all surgeons is told.
    """
    surgeon = known_surgeon(session, slug)
    if surgeon is None:
        _refuse_erased(session, slug)
        near = did_you_mean(slug, session.scalars(_near(Surgeon.slug, slug)))
        raise NotFound(f"There is no surgeon '{slug}'.", *near, Remedy(Action.ADD_SURGEON, surgeon=slug))
    return surgeon


def list_surgeons(
    session: Session, limit: int, after: str | None, search: str | None = None, skill_level: str | None = None
) -> Sequence[Surgeon]:
    """List surgeons in the order of their pseudonyms.

    Args:
        session: The caller's transaction.
        limit: The length of the page.
        after: The last pseudonym of the page before.
        search: List only pseudonyms that contain this text, ignoring case.
        skill_level: List only surgeons of this level.
    """
    query = select(Surgeon).where(Surgeon.slug > (after or ""))
    if search is not None:
        query = query.where(Surgeon.slug.icontains(search, autoescape=True))
    if skill_level is not None:
        query = query.where(Surgeon.skill_level == skill_level)
    return session.scalars(query.order_by(Surgeon.slug).limit(limit)).all()


def put_suture_type(session: Session, slug: str, about: dict[str, Any], actor: str) -> tuple[SutureType, bool]:
    """Create or replace a suture type with all fields; return the row, and whether it is new."""
    suture = known_suture_type(session, slug)
    created = suture is None
    if suture is None:
        suture = SutureType(slug=slug, **about)
        session.add(suture)
    else:
        for name, value in about.items():
            setattr(suture, name, value)
    record_event(session, actor, "add" if created else "change", "suture-type", slug)
    return suture, created


def known_suture_type(session: Session, slug: str) -> SutureType | None:
    """Return a suture type, or None if the catalogue has none of this name."""
    return session.get(SutureType, slug)


def find_suture_type(session: Session, slug: str) -> SutureType:
    """Return a suture type.

    Raises:
        NotFound: The catalogue has none of this name.
    """
    suture = known_suture_type(session, slug)
    if suture is None:
        near = did_you_mean(slug, session.scalars(_near(SutureType.slug, slug)))
        raise NotFound(f"There is no suture type '{slug}'.", *near, Remedy(Action.LIST_SUTURES, suture=slug))
    return suture


def list_suture_types(
    session: Session, limit: int, after: str | None, search: str | None = None
) -> Sequence[SutureType]:
    """List suture types in the order of their slugs.

    Args:
        session: The caller's transaction.
        limit: The length of the page.
        after: The last slug of the page before.
        search: List only those whose slug, name or family contains this text, ignoring case.
    """
    query = select(SutureType).where(SutureType.slug > (after or ""))
    if search is not None:
        told = (SutureType.slug, SutureType.name, SutureType.family)
        query = query.where(or_(*(column.icontains(search, autoescape=True) for column in told)))
    return session.scalars(query.order_by(SutureType.slug).limit(limit)).all()


def seed_catalogue(session: Session) -> int:
    """Insert the suture types of `seeds/` into an empty catalogue; return the number of types that were added."""
    if session.scalar(select(func.count()).select_from(SutureType)):
        return 0
    text = (resources.files("skills") / "seeds" / "suture_types.toml").read_text()
    types: list[dict[str, Any]] = tomllib.loads(text)["suture_type"]
    for one in types:
        put_suture_type(session, one.pop("slug"), one, "seeds")
    return len(types)


def _near(column: InstrumentedAttribute[str], given: str) -> Select[str]:
    """Return a query of names similar to a misspelt one: with the same first two or last three characters.

    It returns only names that the caller may see, of a similar length.
    """
    like = or_(column.startswith(given[:2], autoescape=True), column.endswith(given[-3:], autoescape=True))
    long = func.length(column).between(len(given) - 3, len(given) + 3)
    return select(column).where(like, long).limit(NEAR)


def _refuse_erased(session: Session, slug: str) -> None:
    # Each erasure has its own salt, so the pseudonym is digested with every one. A restricted key is not told.
    if ONLY not in session.info and any(salted(e.salt, slug) == e.digest for e in session.scalars(select(Erasure))):
        raise Erased("This surgeon's data was erased permanently; use another pseudonym for new recordings.")


def salted(salt: str, slug: str) -> str:
    """Return a salted digest of a pseudonym, by which it can be recognised but not read."""
    return hashlib.sha256(f"{salt}:{slug}".encode()).hexdigest()


def surgeon_json(row: Surgeon) -> dict[str, Any]:
    """Return a surgeon's JSON."""
    return {
        "surgeon": row.slug,
        "skill_level": row.skill_level,
        "handedness": row.handedness,
        "protocol": row.protocol,
        "consent": row.consent,
        "created_at": rfc3339(row.created_at),
    }


def suture_json(row: SutureType) -> dict[str, Any]:
    """Return a suture type's JSON."""
    return {
        "suture": row.slug,
        "name": row.name,
        "also_called": row.also_called,
        "family": row.family,
        "description": row.description,
    }
