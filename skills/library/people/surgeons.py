"""Surgeons, known by pseudonyms."""

import hashlib
import secrets
from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.changes import announce
from skills.db.models import Erasure, Surgeon
from skills.db.row_visibility import ONLY
from skills.db.service_tables import record_event
from skills.errors import Erased, NotFound
from skills.library.people.consent import may
from skills.library.people.similar import similar_names
from skills.library.policies import releases
from skills.remedies import Action, Remedy, did_you_mean
from skills.schemas.people import Consent, SurgeonIn


def put_surgeon(session: Session, slug: str, asked: SurgeonIn, actor: str) -> tuple[Surgeon, bool]:
    """Create or replace a surgeon with all fields; return the row, and whether it is new.

    Raises:
        Erased: A surgeon of this pseudonym was erased.
    """
    surgeon = known_surgeon(session, slug)
    new = surgeon is None
    if surgeon is None:
        _refuse_erased(session, slug)
        surgeon = Surgeon(slug=slug, subject=secrets.token_hex(16))
        session.add(surgeon)
    for name in SurgeonIn.model_fields.keys() - {"consent"}:
        setattr(surgeon, name, getattr(asked, name))
    record_event(session, actor, "add" if new else "change", "surgeon", surgeon.subject, surgeon)
    consent = None if asked.consent is None else Consent.model_validate(asked.consent)
    put_consent(session, surgeon, consent, actor)
    return surgeon, new


def put_consent(session: Session, surgeon: Surgeon, consent: Consent | None, actor: str) -> None:
    """Replace a surgeon's consent.

    If consent to training ends, or had ended and is given again, the releases of all styles are withdrawn.
    """
    covered, before = may(surgeon, "training"), surgeon.consent  # the decision below needs the old consent
    surgeon.consent = consent
    session.flush()
    if consent == before:
        return
    if not (covered and may(surgeon, "training")):  # also if it had expired: serving needs a new release
        releases.withdraw_all(session, surgeon, actor)
    announce(session)  # every service process caches the last day of consent


def known_surgeon(session: Session, slug: str) -> Surgeon | None:
    """Return a surgeon, or None if there is none of this pseudonym."""
    return session.scalar(select(Surgeon).where(Surgeon.slug == slug))


def find_surgeon(session: Session, slug: str) -> Surgeon:
    """Return a surgeon.

    Raises:
        NotFound: There is none of this pseudonym, among those that the caller may see.
        Erased: The surgeon of this pseudonym was erased; only a caller who may see all surgeons learns that.
    """
    surgeon = known_surgeon(session, slug)
    if surgeon is None:
        _refuse_erased(session, slug)
        near = did_you_mean(slug, similar_names(session, Surgeon.slug, slug))
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


def _refuse_erased(session: Session, slug: str) -> None:
    # Each erasure has its own salt, so the pseudonym is digested with every one. A restricted key learns nothing.
    if ONLY not in session.info and any(salted(e.salt, slug) == e.digest for e in session.scalars(select(Erasure))):
        raise Erased("This surgeon's data was erased permanently; use another pseudonym for new recordings.")


def salted(salt: str, slug: str) -> str:
    """Return a salted digest of a pseudonym, by which it can be recognised but not read."""
    return hashlib.sha256(f"{salt}:{slug}".encode()).hexdigest()
