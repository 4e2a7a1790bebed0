"""Keys: what lets a person or a program in, and what it may do.

A key is `skills_ID_SECRET`: the id is no secret and is how people tell keys apart, the secret is 256 random bits. It is
shown once; what is stored is the SHA-256 of the whole. A slow hash would protect what people think up, which can be
guessed; 2^256 cannot be tried, and a fast one lets every request be checked.

The owner's name is what events and releases bear. It is an owner's and not a key's, so that somebody who changes keys
keeps what they brought; two keys may overlap.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.base import now, rfc3339
from skills.db.books import Key
from skills.db.seen import Only
from skills.errors import BadInput, Conflict, NotFound
from skills.library.catalogue import find_surgeon
from skills.library.events import record
from skills.settings import Role

LADDER: tuple[Role, ...] = ("reader", "uploader", "trainer", "releaser", "admin")  # each may do what those before may
SECRET_BYTES = 32
SHAPE = re.compile(r"skills_([0-9a-f]{8})_[A-Za-z0-9_-]{43}")
OWNER = r"^[A-Za-z0-9][A-Za-z0-9 ._@-]{0,63}$"
OURS = frozenset({"local", "seeds", "restore", "worker"})  # names that events have of what nobody has a key for


@dataclass(frozen=True)
class Holder:
    """Who a key belongs to: the key's id, its owner, role and end, and the surgeons that it is restricted to.

    `surgeons` are pseudonyms, `only` is the same for queries; None: all of them.
    """

    key: str
    owner: str
    role: Role
    expires_at: datetime | None
    surgeons: frozenset[str] | None
    only: Only | None

    def counts(self, at: datetime) -> bool:
        """Tell whether the key has not run out."""
        return self.expires_at is None or at < self.expires_at


def create_key(
    session: Session,
    owner: str,
    role: Role,
    actor: str,
    *,
    expires_at: datetime | None = None,
    surgeons: Sequence[str] | None = None,
) -> tuple[Key, str]:
    """Make a key: its row, and the key itself, which is stored nowhere and cannot be shown again.

    Args:
        session: The caller's transaction.
        owner: Whose it is; events bear this name.
        role: What it may do.
        actor: Who makes it.
        expires_at: From when on it does not count any more.
        surgeons: The pseudonyms that it is restricted to; None: all, also those to come.

    Raises:
        BadInput: The name is none, the end has passed, or an admin would be restricted.
        NotFound: A surgeon is unknown.
    """
    if not is_owner(owner):
        raise BadInput(f"An owner's name has 1 to 64 letters, digits, spaces or ._@-, and is none of {sorted(OURS)}.")
    if expires_at is not None and not now() < expires_at:
        raise BadInput("The key would have run out already; give a later end, or none.")
    if surgeons is not None and (role == "admin" or not surgeons):
        raise BadInput("An admin acts on the whole installation; restrict a lower role, to at least one surgeon.")
    key_id = secrets.token_hex(4)
    text = f"skills_{key_id}_{secrets.token_urlsafe(SECRET_BYTES)}"
    key = Key(
        id=key_id,
        digest=digest_of(text),
        owner=owner,
        role=role,
        restricted=surgeons is not None,
        surgeons=[find_surgeon(session, one) for one in sorted(set(surgeons or ()))],
        created_by=actor,
        expires_at=expires_at,
    )
    session.add(key)
    record(session, actor, "create", "key", key_id)
    session.flush()
    return key, text


def revoke_key(session: Session, key_id: str, actor: str) -> Key:
    """Revoke a key and end what was signed in with it; revoking it again changes nothing.

    Raises:
        NotFound: There is none of this id.
    """
    key = session.scalar(select(Key).where(Key.id == key_id))
    if key is None:
        raise NotFound("There is no key of this id; `skills keys list` shows them.")
    if key.revoked_at is None:
        key.revoked_at = now()
        record(session, actor, "revoke", "key", key_id)
    return key


def list_keys(session: Session, limit: int | None = None, after: int | None = None) -> Sequence[Key]:
    """List all keys, in the order in which they were made."""
    return session.scalars(select(Key).where(Key.row > (after or 0)).order_by(Key.row).limit(limit)).all()


def is_keyless(session: Session) -> bool:
    """Tell whether no key was ever made: one that ran out or was revoked must not open the installation to all."""
    return session.scalar(select(Key.row).limit(1)) is None


def refuse_without_keys(session: Session) -> None:
    """Refuse to go on where nobody could get in.

    Raises:
        Conflict: There is no key that counts.
    """
    if not any(key.revoked_at is None and held(key).counts(now()) for key in list_keys(session)):
        raise Conflict(
            "Beyond loopback everybody needs a key, and there is none that counts; "
            "`skills keys create OWNER --role admin` makes one."
        )


def holder_of(session: Session, text: str) -> Holder | None:
    """Find who a key belongs to, if it is one that stands; whether it has run out is the caller's to ask."""
    shape = SHAPE.fullmatch(text)
    if shape is None:
        return None
    key = session.scalar(select(Key).where(Key.id == shape[1]))
    if key is None or not hmac.compare_digest(key.digest, digest_of(text)):
        return None
    return None if key.revoked_at is not None else held(key)


def held(key: Key) -> Holder:
    """Write a key's row as who it belongs to."""
    slugs = frozenset(surgeon.slug for surgeon in key.surgeons) if key.restricted else None
    only = _only(key.owner, frozenset(surgeon.row for surgeon in key.surgeons)) if key.restricted else None
    return Holder(key.id, key.owner, key.role, key.expires_at, slugs, only)  # type: ignore[arg-type]


def about_key(key: Key) -> dict[str, Any]:
    """Write a key as people are told of it."""
    ended = "revoked" if key.revoked_at is not None else "active" if held(key).counts(now()) else "expired"
    return {
        "key": key.id,
        "owner": key.owner,
        "role": key.role,
        "surgeons": [surgeon.slug for surgeon in key.surgeons] if key.restricted else None,
        "created_at": rfc3339(key.created_at),
        "created_by": key.created_by,
        "expires_at": rfc3339(key.expires_at),
        "revoked_at": rfc3339(key.revoked_at),
        "state": ended,
    }


def is_owner(name: str) -> bool:
    """Tell whether a name can be an owner's: it is none of those that events have for what nobody has a key for."""
    return re.fullmatch(OWNER, name) is not None and name not in OURS


def digest_of(text: str) -> str:
    """Digest a secret as it is stored."""
    return hashlib.sha256(text.encode()).hexdigest()


@lru_cache(256)  # its rules are compiled once, not at every look-up
def _only(owner: str, rows: frozenset[int]) -> Only:
    return Only(owner, rows)
