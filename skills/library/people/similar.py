"""Stored names that are similar to a misspelt one, for "did you mean"."""

from collections.abc import Iterable

from sqlalchemy import func, or_, select
from sqlalchemy.orm import InstrumentedAttribute, Session

MOST = 500  # names that are compared with an unknown one


def similar_names(session: Session, column: InstrumentedAttribute[str], given: str) -> Iterable[str]:
    """Return names of a similar length with the same first two or last three characters, among the visible ones."""
    like = or_(column.startswith(given[:2], autoescape=True), column.endswith(given[-3:], autoescape=True))
    long = func.length(column).between(len(given) - 3, len(given) + 3)
    return session.scalars(select(column).where(like, long).limit(MOST))
