"""API keys of people and programs.

A key is `skills_ID_SECRET`: the id is public and distinguishes keys, the secret is 256 random bits. A key is shown
once; its SHA-256 is stored. A slow hash would protect passwords that people choose, which can be guessed; 2^256 cannot
be searched, and a fast hash allows a check at every request.

Events and releases contain the owner's name. It belongs to the owner, not to the key: somebody who replaces a key keeps
access to their uploads, and two keys may be valid at the same time.
"""

import hashlib
import hmac
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from skills.db import in_parts, now
from skills.db.history import HISTORY
from skills.db.leaves import LEAVES
from skills.db.row_visibility import Only
from skills.db.service_tables import Key, KeySurgeon, record_event
from skills.errors import BadInput, Conflict, NotFound
from skills.library.operation.history import edited_rows
from skills.library.people.surgeons import find_surgeon
from skills.remedies import Action, Remedy
from skills.schemas import people as described
from skills.schemas.requests import OWNER
from skills.settings import Role

LADDER: tuple[Role, ...] = ("reader", "uploader", "trainer", "releaser", "admin")  # each role includes those before it
SECRET_BYTES = 32
KEYS_AT_ONCE = 500  # looked up in one query
SHAPE = re.compile(r"skills_([0-9a-f]{8})_[A-Za-z0-9_-]{43}")
OURS = frozenset({"local", "seeds", "restore", "worker"})  # actors in events that are not owners of keys
_only = lru_cache(256)(Only)  # the SQL rules of an `Only` are compiled once, not at every look-up


@dataclass(frozen=True)
class Holder:
    """The owner and permissions of a key: its id, owner, role and expiry, and the surgeons that it is restricted to.

    `surgeons` are pseudonyms, `only` is the same restriction for queries; None: no restriction.
    """

    key: str
    owner: str
    role: Role
    expires_at: datetime | None
    surgeons: frozenset[str] | None
    only: Only | None

    def counts(self, at: datetime) -> bool:
        """Return whether the key has not expired at a moment."""
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
    """Create a key; return its row, and the key itself, which is not stored and cannot be shown again.

    Args:
        session: The caller's transaction.
        owner: The owner's name, which events contain.
        role: The role, which defines the permissions.
        actor: The owner of the key that creates it.
        expires_at: The moment from which on it is invalid; None: it does not expire.
        surgeons: The pseudonyms that it is restricted to; None: all, including future ones.

    Raises:
        BadInput: The name is invalid, the expiry has passed, or an admin would be restricted.
        NotFound: A surgeon is unknown.
    """
    if not is_owner(owner):
        raise BadInput(
            f"An owner's name has 1 to 64 letters, digits, spaces or ._@-, and must not be one of {sorted(OURS)}."
        )
    if expires_at is not None and not now() < expires_at:
        raise BadInput("The key would be expired already; give a later end, or none.")
    if surgeons is not None and (role == "admin" or not surgeons):
        raise BadInput("An admin key cannot be restricted; use a lower role, with at least one surgeon.")
    # The id is not secret; the SHA-256 of the entire key is stored, never the key.
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
    record_event(session, actor, "create", "key", key_id)
    session.flush()
    return key, text


def revoke_key(session: Session, key_id: str, actor: str) -> Key:
    """Revoke a key, which also ends its sign-ins; a repetition changes nothing.

    Raises:
        NotFound: There is no key with this id.
    """
    key = session.scalar(select(Key).where(Key.id == key_id))
    if key is None:
        raise NotFound("There is no key with this id.", Remedy(Action.LIST_KEYS))
    if key.revoked_at is None:
        key.revoked_at = now()
        record_event(session, actor, "revoke", "key", key_id)
    return key


def list_keys(session: Session, limit: int | None = None, after: int | None = None) -> Sequence[Key]:
    """List all keys, in the order of their creation."""
    return session.scalars(select(Key).where(Key.row > (after or 0)).order_by(Key.row).limit(limit)).all()


def is_keyless(session: Session) -> bool:
    """Return whether no key was ever created: expired, revoked and deleted ones must not open it to everyone."""
    logged = exists().where(LEAVES.c.table_name == Key.__tablename__)
    return session.scalar(select(Key.row).limit(1)) is None and not session.scalar(select(logged))


def refuse_without_keys(session: Session) -> None:
    """Refuse to serve beyond loopback if nobody could authenticate.

    Raises:
        Conflict: There is no valid key.
    """
    if not any(key.revoked_at is None and held(key).counts(now()) for key in list_keys(session)):
        raise Conflict(
            "Beyond loopback every request needs a key, and there is no valid one.", Remedy(Action.CREATE_ADMIN_KEY)
        )


def holders_of(session: Session, texts: Iterable[str]) -> dict[str, Holder]:
    """Return the holders of those keys that are not revoked and that the service wrote, some at a time.

    The caller checks whether a key has expired.
    """
    found: dict[str, Holder] = {}
    shapes = [shape for shape in map(SHAPE.fullmatch, texts) if shape is not None]
    for some in in_parts(shapes, KEYS_AT_ONCE):
        rows = session.scalars(select(Key).where(Key.id.in_({shape[1] for shape in some}), Key.revoked_at.is_(None)))
        keys = {key.id: key for key in written_by_service(session, rows.all())}
        for shape in some:
            key = keys.get(shape[1])
            # Compared in constant time, so that timing does not reveal the digest.
            if key is not None and hmac.compare_digest(key.digest, digest_of(shape[0])):
                found[shape[0]] = held(key)
    return found


def written_by_service(session: Session, keys: Sequence[Key]) -> list[Key]:
    """Return the keys that nobody else than the service has written; each edited one is logged."""
    of_keys = {str(key.row): key for key in keys}
    of_surgeons = {f"{key.row}/{one.row}": key for key in keys if key.restricted for one in key.surgeons}
    history, connection = session.info[HISTORY], session.connection()
    wrong = [of_keys[row] for row in edited_rows(connection, history, Key.__tablename__, list(of_keys))]
    wrong += [of_surgeons[row] for row in edited_rows(connection, history, KeySurgeon.__tablename__, list(of_surgeons))]
    return [key for key in keys if key not in wrong]


def held(key: Key) -> Holder:
    """Return the holder of a key's row."""
    slugs = frozenset(surgeon.slug for surgeon in key.surgeons) if key.restricted else None
    only = _only(key.owner, frozenset(surgeon.row for surgeon in key.surgeons)) if key.restricted else None
    return Holder(key.id, key.owner, key.role, key.expires_at, slugs, only)


def about_key(key: Key) -> described.Key:
    """Return what an admin sees of a key, without its secret."""
    return described.Key(
        key=key.id,
        owner=key.owner,
        role=key.role,
        surgeons=[surgeon.slug for surgeon in key.surgeons] if key.restricted else None,
        created_at=key.created_at,
        created_by=key.created_by,
        expires_at=key.expires_at,
        revoked_at=key.revoked_at,
        state="revoked" if key.revoked_at is not None else "active" if held(key).counts(now()) else "expired",
    )


def is_owner(name: str) -> bool:
    """Return whether a name is a valid owner's name, and not reserved for actors without a key."""
    return re.fullmatch(OWNER, name) is not None and name not in OURS


def digest_of(text: str) -> str:
    """Return the digest under which a secret is stored."""
    return hashlib.sha256(text.encode()).hexdigest()
