"""Signing in to the page: a key is given once, and a cookie of 256 random bits stands for it until it is over.

What is stored of the cookie is its SHA-256, as of keys. A sign-in is over when it was not used for a while, when it is
old, when it is signed out, and when its key is revoked or runs out.
"""

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import delete, or_, select, update
from sqlalchemy.orm import Session

from skills.db.base import now
from skills.db.books import Key, SignIn
from skills.library.events import record
from skills.library.keys import SECRET_BYTES, Holder, digest_of, held

NOTED_S = 60  # use is written down so often, not at each request: reading should not write


@dataclass(frozen=True)
class Lasts:
    """How long a sign-in lasts: unused, and at most."""

    idle_s: float
    most_s: float


def sign_in(session: Session, key_id: str, lasts: Lasts) -> str:
    """Begin a sign-in with a key that counts, and give its cookie; sign-ins that are over are forgotten."""
    at = now()
    idle, old = at - timedelta(seconds=lasts.idle_s), at - timedelta(seconds=lasts.most_s)
    session.execute(delete(SignIn).where(or_(SignIn.used_at < idle, SignIn.created_at < old)))
    cookie = secrets.token_urlsafe(SECRET_BYTES)
    key = session.scalars(select(Key).where(Key.id == key_id)).one()
    session.add(SignIn(digest=digest_of(cookie), key_row=key.row, created_at=at, used_at=at))
    record(session, key.owner, "sign-in", "key", key_id)
    return cookie


def signed_in(session: Session, cookie: str, lasts: Lasts) -> tuple[Holder, bool] | None:
    """Find who is signed in with a cookie; and whether `note_use` is due."""
    found = session.get(SignIn, digest_of(cookie))
    if found is None or found.key.revoked_at is not None:
        return None
    at = now()
    idle_s, age_s = (at - found.used_at).total_seconds(), (at - found.created_at).total_seconds()
    if not (idle_s < lasts.idle_s and age_s < lasts.most_s):
        return None
    return held(found.key), idle_s > NOTED_S


def note_use(session: Session, cookie: str) -> None:
    """Write down that a sign-in is in use."""
    session.execute(update(SignIn).where(SignIn.digest == digest_of(cookie)).values(used_at=now()))


def sign_out(session: Session, cookie: str) -> None:
    """End a sign-in."""
    session.execute(delete(SignIn).where(SignIn.digest == digest_of(cookie)))


def csrf_of(cookie: str) -> str:
    """Compute what a page's requests carry beside the cookie: no other site can read it, nor compute it."""
    return hmac.new(cookie.encode(), b"suture-skills csrf", hashlib.sha256).hexdigest()
