"""Suture types: the catalogue of what surgeons demonstrate."""

import tomllib
from collections.abc import Sequence
from importlib import resources

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from skills.db.models import SutureType
from skills.db.service_tables import record_event
from skills.errors import NotFound
from skills.library.people.similar import similar_names
from skills.remedies import Action, Remedy, did_you_mean
from skills.schemas.people import SutureTypeIn


def put_suture_type(session: Session, slug: str, asked: SutureTypeIn, actor: str) -> tuple[SutureType, bool]:
    """Create or replace a suture type with all fields; return the row, and whether it is new."""
    suture = known_suture_type(session, slug)
    new = suture is None
    if suture is None:
        suture = SutureType(slug=slug)
        session.add(suture)
    for name in SutureTypeIn.model_fields:
        setattr(suture, name, getattr(asked, name))
    record_event(session, actor, "add" if new else "change", "suture-type", slug)
    return suture, new


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
        near = did_you_mean(slug, similar_names(session, SutureType.slug, slug))
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
        searched = (SutureType.slug, SutureType.name, SutureType.family)
        query = query.where(or_(*(column.icontains(search, autoescape=True) for column in searched)))
    return session.scalars(query.order_by(SutureType.slug).limit(limit)).all()


def seed_suture_types(session: Session) -> int:
    """Insert the suture types of `seeds/` into an empty catalogue; return the number of types that were added."""
    if session.scalar(select(func.count()).select_from(SutureType)):
        return 0
    text = (resources.files("skills") / "seeds" / "suture_types.toml").read_text()
    types = tomllib.loads(text)["suture_type"]
    for one in types:
        put_suture_type(session, one.pop("slug"), SutureTypeIn.model_validate(one), "seeds")
    return len(types)
