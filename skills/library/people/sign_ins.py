"""Sign-ins to the page, each of which stands for an API key.

A sign-in to the page takes a key once; a cookie of 256 random bits then stands for it, of which the SHA-256 is stored,
as for keys. A sign-in ends when it was not used for a while, when it reaches its maximum age, when it is signed out,
and when its key is revoked or expires.
"""

import hashlib
import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import delete, or_, select, update
from sqlalchemy.orm import Session

from skills.db import in_parts, now
from skills.db.history import HISTORY
from skills.db.service_tables import Key, SignIn, record_event
from skills.library.operation.history import edited_rows
from skills.library.people.keys import KEYS_AT_ONCE, SECRET_BYTES, Holder, digest_of, held, written_by_service

NOTED_S = 60  # the interval at which use is stored, not at each request: a read should not cause a write


@dataclass(frozen=True)
class SignInLifetime:
    """The lifetime of a sign-in: the longest time without use, and the maximum age."""

    idle_s: float
    most_s: float


def sign_in(session: Session, key_id: str, lasts: SignInLifetime) -> str:
    """Create a sign-in with a valid key and return its cookie; expired sign-ins are deleted."""
    at = now()
    idle, old = at - timedelta(seconds=lasts.idle_s), at - timedelta(seconds=lasts.most_s)
    session.execute(delete(SignIn).where(or_(SignIn.used_at < idle, SignIn.created_at < old)))
    cookie = secrets.token_urlsafe(SECRET_BYTES)
    key = session.scalars(select(Key).where(Key.id == key_id)).one()
    session.add(SignIn(digest=digest_of(cookie), key_row=key.row, created_at=at, used_at=at))
    record_event(session, key.owner, "sign-in", "key", key_id)
    return cookie


def signed_in(session: Session, cookies: Iterable[str], lasts: SignInLifetime) -> dict[str, tuple[Holder, bool]]:
    """Return the holders signed in with several cookies, and whether `note_use` is due.

    Sign-ins that ended, and those that the service did not write, or whose key it did not, are left out.
    """
    holders: dict[str, tuple[Holder, bool]] = {}
    by_digest = {digest_of(cookie): cookie for cookie in cookies}
    at = now()
    for some in in_parts(list(by_digest), KEYS_AT_ONCE):
        rows = session.scalars(select(SignIn).where(SignIn.digest.in_(some))).all()
        names = [found.digest for found in rows]
        edited = edited_rows(session.connection(), session.info[HISTORY], SignIn.__tablename__, names)
        keys = {key.row for key in written_by_service(session, list({found.key for found in rows}))}
        for found in rows:
            if found.digest in edited or found.key_row not in keys:
                continue
            idle_s, age_s = (at - found.used_at).total_seconds(), (at - found.created_at).total_seconds()
            # The key's own expiry is left to the caller, as in `holders_of`.
            if found.key.revoked_at is None and idle_s < lasts.idle_s and age_s < lasts.most_s:
                holders[by_digest[found.digest]] = held(found.key), idle_s > NOTED_S
    return holders


def note_use(session: Session, cookie: str) -> None:
    """Store the time of a sign-in's last use."""
    session.execute(update(SignIn).where(SignIn.digest == digest_of(cookie)).values(used_at=now()))


def sign_out(session: Session, cookie: str) -> None:
    """End a sign-in."""
    session.execute(delete(SignIn).where(SignIn.digest == digest_of(cookie)))


def csrf_of(cookie: str) -> str:
    """Return the token that a page's requests carry in addition to the cookie: no other site can read or compute it."""
    return hmac.new(cookie.encode(), b"suture-skills csrf", hashlib.sha256).hexdigest()
