"""Leaves of the history: what is logged of each change of a row, and the checkpoints over them.

    entry     what is logged for good: table, change, time, *commitment*, and the hash of the row's leaf before
    commitment   SHA-256 over the digests of all logged columns; each is salted with 32 random bytes of the leaf
    seal      a MAC of the entry by the signing key, which is not in the database: a process of the service wrote it

When a row is deleted, its leaves lose salt, digests and key. Their entries stay, and reveal nothing that could be
guessed, so all proofs stay valid.
"""

import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, NamedTuple, cast

import orjson
from sqlalchemy import JSON, BigInteger, Connection, Index, LargeBinary, String, Table, func, insert, select, update
from sqlalchemy.orm import Mapped, mapped_column

from skills.db import Numbered, in_parts, now, partial_index
from skills.db.change_notes import ADD, CHANGE, REMOVE, Effect
from skills.db.logged_rows import ADDED, CACHES, ROWS_AT_ONCE, commitment_to, compact, digests_of, logged
from skills.transparency.merkle import leaf_hash
from skills.transparency.signing_keys import Seal

SALT_BYTES = 32


class Leaf(Numbered):
    """A leaf of the history; `number` is its place in the tree, None until it is under a signed checkpoint.

    `digests` are of the row's columns, by their names; together with `salt` and `key` they are removed with the row.
    """

    __tablename__ = "history"

    number: Mapped[int | None] = mapped_column(BigInteger, unique=True)
    table_name: Mapped[str] = mapped_column(String(64))
    key: Mapped[str | None] = mapped_column(String(300))
    entry: Mapped[str] = mapped_column(String(1000))
    seal: Mapped[bytes] = mapped_column(LargeBinary)
    salt: Mapped[bytes | None] = mapped_column(LargeBinary)
    digests: Mapped[dict[str, str] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        Index("ix_history_key", "table_name", "key", "row"),
        partial_index("ix_history_unsigned", "row", where="number IS NULL"),
    )


class StoredCheckpoint(Numbered):
    """A signed head of the history, and the hashes of the complete subtrees of its tree, from which it grows."""

    __tablename__ = "history_checkpoints"

    size: Mapped[int] = mapped_column(BigInteger, index=True)
    note: Mapped[str] = mapped_column(String(1000))
    subtrees: Mapped[bytes] = mapped_column(LargeBinary)
    signed_at: Mapped[datetime] = mapped_column(default=now)


LEAVES = cast(Table, Leaf.__table__)
CHECKPOINTS = cast(Table, StoredCheckpoint.__table__)


def newest_checkpoint(connection: Connection) -> str | None:
    """Return the newest signed checkpoint as a note; None where no history was begun."""
    note: str | None = connection.scalar(select(CHECKPOINTS.c.note).order_by(CHECKPOINTS.c.row.desc()).limit(1))
    return note


# ---- reading leaves --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Latest:
    """The newest leaf of a row that exists."""

    row: int
    entry: str
    salt: bytes
    digests: Mapping[str, str]
    number: int | None = None
    seal: bytes = b""

    @cached_property
    def _logged(self) -> Any:
        return orjson.loads(self.entry)

    @property
    def hash(self) -> str:
        """The hash of its entry, by which the row's next leaf names it."""
        return leaf_hash(self.entry.encode()).hex()

    @property
    def is_committed(self) -> bool:
        """Whether its digests are those that were logged, and of the same columns."""
        return bool(self._logged["commitment"] == commitment_to(self.digests))

    @cached_property
    def of_row(self) -> Mapping[str, str]:
        """The digests of all columns: one that was added after the leaf has the value that its migration gave it."""
        added = ADDED.get(self._logged["table"], {})
        return {**digests_of(tuple(added), tuple(added.values()), self.salt), **self.digests}

    def digests_of(self, names: Iterable[str], row: Any) -> dict[str, str]:
        """Return the digests of some columns of a row with the salt of this leaf."""
        some = sorted(names)
        return digests_of(some, [getattr(row, name) for name in some], self.salt)

    def differing(self, names: Sequence[str], values: Sequence[Any]) -> list[str]:
        """Return the names of the columns that differ from a row."""
        here = digests_of(names, values, self.salt)
        return sorted(name for name in {*here, *self.of_row} if here.get(name) != self.of_row.get(name))

    def matches(self, names: Sequence[str], values: Sequence[Any]) -> bool:
        """Return whether a row is as it was logged."""
        return self.is_committed and not self.differing(names, values)


def latest_leaves(connection: Connection, table: str, keys: Sequence[str] | None = None) -> dict[str, Latest]:
    """Return the newest leaves of some rows that exist, or of all rows of a table, by key."""
    if keys is not None and not keys:
        return {}
    of = LEAVES.c
    # The newest of each row alone, because a row that changes often has very many.
    newest = select(func.max(of.row)).where(of.table_name == table, of.key.is_not(None)).group_by(of.key)
    parts = [newest] if keys is None else [newest.where(of.key.in_(some)) for some in in_parts(keys, ROWS_AT_ONCE)]
    query = select(of.key, of.row, of.entry, of.salt, of.digests, of.number, of.seal)
    found = (leaf for part in parts for leaf in connection.execute(query.where(of.row.in_(part))))
    return {key: Latest(*leaf) for key, *leaf in found}


# ---- writing leaves --------------------------------------------------------------------------------------------------


class NewLeaf(NamedTuple):
    """The columns of a new leaf, without its seal."""

    table_name: str
    key: str | None
    entry: str
    salt: bytes | None = None
    digests: dict[str, str] | None = None


def new_leaf(
    table: str, change: str, at: str | None, key: str, columns: Mapping[str, Any], after: Latest | None = None
) -> NewLeaf:
    """Return a leaf for a row with these logged columns, which follows the row's leaf before."""
    salt = secrets.token_bytes(SALT_BYTES)
    digests = digests_of(columns, columns.values(), salt)
    return NewLeaf(table, key, _entry(table, change, at, digests, after), salt, digests)


def _entry(table: str, change: str, at: str | None, digests: dict[str, str] | None, after: Latest | None) -> str:
    commitment = None if digests is None else commitment_to(digests)
    previous = None if after is None else after.hash
    return compact({"table": table, "change": change, "at": at, "commitment": commitment, "previous": previous})


def leaves_of_changes(
    connection: Connection, table: str, effects: Mapping[str, Effect], at: str | None
) -> Iterator[NewLeaf]:
    """Yield a leaf for each row of a table that a transaction has changed, read as it leaves them."""
    about = logged()[table]
    known = [key for key, effect in effects.items() if effect.before or table in CACHES]
    latest = latest_leaves(connection, table, known)
    for row in about.rows_of(connection, [key for key, effect in effects.items() if effect.after]):
        key, columns = about.key_of(row), dict(zip(about.columns, row, strict=True))
        effect, before = effects[key], latest.get(key)
        if not effect.before:
            # after an earlier leaf only where somebody has emptied a cache
            yield new_leaf(table, ADD, at, key, columns, before)
        elif before is not None and effect.written:  # removed, and added again
            yield new_leaf(table, CHANGE, at, key, columns, before)
        elif before is not None and effect.changed and before.is_committed:
            # the other columns keep their digests: if somebody else has changed one, that stays to be found
            digests = {**before.of_row, **before.digests_of(effect.changed, row)}
            yield NewLeaf(table, key, _entry(table, CHANGE, at, digests, before), before.salt, digests)
        # a row without a leaf, or with one that was changed, is not the service's: `skills verify` goes on naming it
    gone = [key for key, effect in effects.items() if effect.before and not effect.after]
    yield from removals(connection, table, gone, latest, at)


def removals(
    connection: Connection, table: str, keys: Iterable[str], latest: Mapping[str, Latest], at: str | None
) -> Iterator[NewLeaf]:
    """Yield a leaf for each removed row, and remove what the row's earlier leaves reveal about it."""
    known = [key for key in keys if key in latest]
    for some in in_parts(known, ROWS_AT_ONCE):
        theirs = (LEAVES.c.table_name == table, LEAVES.c.key.in_(some))
        connection.execute(update(LEAVES).where(*theirs).values(salt=None, digests=None, key=None))
    for key in known:
        yield NewLeaf(table, None, _entry(table, REMOVE, at, None, latest[key]))


def add_leaves(connection: Connection, leaves: Iterable[NewLeaf], seal: Seal) -> None:
    """Insert leaves in their order, each with its seal."""
    connection.execute(insert(LEAVES), [{**leaf._asdict(), "seal": seal.of(leaf.entry.encode())} for leaf in leaves])
