"""The history: a leaf of a Merkle log for each change of a logged row, written in the transaction of the change.

Triggers note the key of every row that a transaction adds, changes or removes, by whatever statement. Before the commit
`History.settle` reads these rows as they then are and adds a leaf for each:

    entry     what is logged for good: table, change, time, *commitment*, and the hash of the row's leaf before
    commitment   SHA-256 over the digests of all logged columns; each is salted with 32 random bytes of the leaf
    seal      a MAC of the entry by the signing key, which is not in the database: a process of the service wrote it

When a row is deleted, its leaves lose salt, digests and key. Their entries stay, and reveal nothing that could be
guessed, so all proofs stay valid. `skills.library.operation.history` numbers the leaves, signs the tree and verifies
all of it.

`skills.db.logged_rows` names the logged tables and columns.
"""

import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, cast

import orjson
from sqlalchemy import (
    JSON,
    BigInteger,
    Connection,
    Engine,
    Index,
    LargeBinary,
    String,
    Table,
    insert,
    inspect,
    select,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column

from skills.db import Base, RowId, now, rfc3339
from skills.db.kept_heads import heads_beside, last_head, set_aside
from skills.db.logged_rows import (
    ADDED,
    CACHES,
    OF_LEAF,
    ROWS_AT_ONCE,
    Logged,
    commitment_to,
    compact,
    digests_of,
    logged,
    schema_of,
    united,
    united_rows,
)
from skills.errors import BadSettings, Corrupt, NotReady
from skills.remedies import Action, Remedy
from skills.transparency import HASH_BYTES, Checkpoint, Note, Seal, SigningKey, Tree, leaf_hash, read_notes

ADD, CHANGE, REMOVE = "add", "change", "remove"
SCHEMA = "schema"  # the name under which triggers, indexes and constraints are logged as if they were rows
SALT_BYTES = 32
SIGNED_AT_ONCE = 1000  # leaves in one transaction, some 50 ms
ORIGIN = "suture-skills/"  # and 16 random hex digits: the name of one log


class Leaf(Base):
    """A leaf of the history; `number` is its place in the tree, None until it is under a signed checkpoint.

    `digests` are of the row's columns, by their names; together with `salt` and `key` they are removed with the row.
    """

    __tablename__ = "history"

    row: Mapped[RowId]
    number: Mapped[int | None] = mapped_column(BigInteger, unique=True)
    table_name: Mapped[str] = mapped_column(String(64))
    key: Mapped[str | None] = mapped_column(String(300))
    entry: Mapped[str] = mapped_column(String(1000))
    seal: Mapped[bytes] = mapped_column(LargeBinary)
    salt: Mapped[bytes | None] = mapped_column(LargeBinary)
    digests: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))

    __table_args__ = (
        Index("ix_history_key", "table_name", "key"),
        Index(
            "ix_history_unsigned",
            "row",
            sqlite_where=text("number IS NULL"),
            postgresql_where=text("number IS NULL"),
        ),
    )


class StoredCheckpoint(Base):
    """A signed head of the history, and the hashes of the complete subtrees of its tree, from which it grows."""

    __tablename__ = "history_checkpoints"

    row: Mapped[RowId]
    size: Mapped[int] = mapped_column(BigInteger, index=True)
    note: Mapped[str] = mapped_column(String(1000))
    subtrees: Mapped[bytes] = mapped_column(LargeBinary)
    signed_at: Mapped[datetime] = mapped_column(default=now)


LEAVES = cast(Table, Leaf.__table__)
CHECKPOINTS = cast(Table, StoredCheckpoint.__table__)

# ---- the notes of a transaction ------------------------------------------------------------------------------------

# Triggers note changed rows until the commit. On SQLite, with one writer, that is in a table. On PostgreSQL it is in
# settings of the transaction, which cost no page and end with it: "skills.notes0" and, where there are many, further
# ones up to the number in "skills.noting", which only connections of the service have.
NOTING_CONNECTION = "-c skills.noting=0"  # for the options of a connection
FORGET_NOTES = "DELETE FROM history_notes"
_TAKEN = {
    "sqlite": "DELETE FROM history_notes RETURNING rowid, table_name, change, key, changed",
    # The rows are then read by their keys: one plan for all numbers of them, where planning took longer than reading.
    "postgresql": "SELECT current_setting('skills.noting', true), current_setting('skills.notes0', true), "
    "set_config('skills.notes0', '', true), set_config('plan_cache_mode', 'force_generic_plan', true), "
    "set_config('enable_seqscan', 'off', true)",
}
_FURTHER = (
    "SELECT current_setting('skills.notes' || n, true), set_config('skills.notes' || n, '', true), "
    "set_config('skills.noting', '0', true) FROM generate_series(1, %s) n"
)
REMOVED = (
    "The history of this database was removed, so nobody can tell what was changed in it.",
    "Put the right copy of the database back, or restore a backup into an empty one.",
)
HISTORY = "history"  # in a session's `info`: the `History` of its database
NOTING = "noting"  # in a connection's `info`: whether its transactions note changes


@dataclass(frozen=True)
class Effect:
    """Whether a row existed before a transaction, whether it exists after it, and the columns that were changed.

    `written` says that the row was inserted, so all of its columns are the transaction's.
    """

    before: bool
    after: bool
    written: bool
    changed: frozenset[str]


def effects_of(notes: Iterable[tuple[str, str, str, str | None]]) -> dict[str, dict[str, Effect]]:
    """Return the effects of a transaction's notes, by table and key, in the order of their first notes."""
    found: dict[str, dict[str, Effect]] = {}
    for table, change, key, changed in notes:
        of_table = found.setdefault(table, {})
        so_far = of_table.get(key, Effect(change != ADD, True, False, frozenset()))
        columns = so_far.changed.union((changed or "").split())
        of_table[key] = Effect(so_far.before, change != REMOVE, so_far.written or change == ADD, columns)
    return found


def take_notes(connection: Connection) -> list[Any]:
    """Remove and return the notes of the transaction so far: table, change, key and changed columns, in their order."""
    taken = connection.exec_driver_sql(_TAKEN[connection.dialect.name])
    if connection.dialect.name == "sqlite":
        return [note for _, *note in sorted(taken, key=itemgetter(0))]
    last, noted, *_ = taken.one()
    if int(last or 0):
        noted += "".join(part for part, *_ in connection.exec_driver_sql(_FURTHER, (int(last),)))
    return [json.loads(note) for note in noted.splitlines()] if noted else []


# ---- writing leaves ------------------------------------------------------------------------------------------------


class History:
    """The history of one database, written with the signing key of this installation."""

    def __init__(self, engine: Engine, key_file: Path, heads_file: Path | None) -> None:
        """Name the database, the file of the key, and that of the kept heads; they are read at the first use."""
        self._engine = engine
        self.key_file = key_file
        self.heads_file = heads_file or heads_beside(key_file, engine.url)
        self._why: tuple[Any, ...] = ()  # nothing is served or written
        self._agreed: tuple[str | None, Note | None] | None = None  # the newest checkpoint, and the kept head
        self._seal: Seal | None = None
        self._origin: str | None = None

    @cached_property
    def key(self) -> SigningKey:
        """The signing key.

        Raises:
            BadSettings: The file is missing or cannot be read.
            Corrupt: It is not a key.
        """
        try:
            return SigningKey.read(self.key_file.read_text())
        except (OSError, UnicodeDecodeError) as error:
            why = "is missing" if isinstance(error, FileNotFoundError) else "cannot be read"
            raise BadSettings(
                f"The signing key {why}, and this database has a history that was begun with one.",
                "Put its file back, or name it in SKILLS_SIGNING_KEY.",
            ) from error

    def origin(self, connection: Connection) -> str | None:
        """Return the name of the log; None where none was begun."""
        if self._origin is None:
            first = connection.scalar(select(CHECKPOINTS.c.note).order_by(CHECKPOINTS.c.row).limit(1))
            self._origin = None if first is None else first.partition("\n")[0]
        return self._origin

    @property
    def refused(self) -> NotReady | None:
        """Why nothing of the database is served or written, see `compare`; a new error, without an old traceback."""
        return NotReady(*self._why) if self._why else None

    def kept_head(self) -> Note | None:
        """Return the head that was kept last; None if none was.

        Raises:
            NotReady: It cannot be read.
        """
        try:
            return last_head(self.heads_file)
        except NotReady as refused:
            self._why = (refused.message, *refused.remedies)
            raise

    def kept_heads(self, origin: str) -> list[Note]:
        """Return all kept heads of one log.

        Raises:
            Corrupt: The file has anything else.
        """
        if not self.heads_file.exists():
            return []
        return [note for note in read_notes(self.heads_file.read_text()) if note.checkpoint.origin == origin]

    def compare(self, connection: Connection, kept: Note | None) -> None:
        """Compare the database with the signing key and with the head that was kept last; the result is `refused`.

        Args:
            connection: In a transaction.
            kept: The head, read before the transaction began, as it must not be newer than what that sees.

        Raises:
            NotReady: The database is not the one that was signed last: older, another one, or signed with another key.
        """
        newest = newest_checkpoint(connection)
        if (newest, kept) == self._agreed:
            return
        try:
            self._refuse_another(connection, newest, kept)
        except NotReady as refused:
            self._why, self._agreed = (refused.message, *refused.remedies), None
            raise
        self._why, self._agreed = (), (newest, kept)

    def _refuse_another(self, connection: Connection, newest: str | None, kept: Note | None) -> None:
        """Refuse the database; the message names no path, for it is also given to callers without a key."""
        if newest is None:
            if kept is not None:
                raise NotReady(*REMOVED)
            return  # no history was begun
        try:
            (note,), key = read_notes(newest), self.key
        except (BadSettings, Corrupt) as error:
            raise NotReady(error.message, *error.remedies) from error
        if not note.signed_by(key.public):
            raise NotReady(
                "The history of this database was signed with another key, and what is written with this one could not "
                "be verified.",
                "Name the file of the right key in SKILLS_SIGNING_KEY. If it is lost, restore a backup into an empty "
                "database, whose history then goes on with this key.",
            )
        if kept is None or kept == note:
            return
        head, here = kept.checkpoint, note.checkpoint
        if head.origin != here.origin and here.size == 0:
            return  # a history that has just begun takes the place of another
        known = select(CHECKPOINTS.c.row).where(CHECKPOINTS.c.size == head.size, CHECKPOINTS.c.note == kept.text)
        if connection.scalar(known) is None:
            is_older = head.origin == here.origin and here.size < head.size
            raise NotReady(
                f"This database is {'older' if is_older else 'another'} than the one whose history was kept last: that "
                f"one has {head.size} leaves, and this {here.size} without that head. Withdrawn releases and consents, "
                "revoked keys and erased surgeons may be back in it.",
                "Put the right copy of the database back.",
                Remedy(Action.ACCEPT_ROLLBACK),
            )

    def settle(self, connection: Connection) -> None:
        """Add a leaf for each logged row that the transaction has changed; call it before the commit.

        Raises:
            NotReady: The database is not the one that was signed last, see `compare`.
        """
        if not connection.info.get(NOTING):
            return  # the job engine's database, or one that is not migrated yet
        effects = effects_of(take_notes(connection))
        at = rfc3339(now())
        every = [(table, key) for table, of_table in effects.items() if table in logged() for key in of_table]
        for first in range(0, len(every), ROWS_AT_ONCE):
            some: dict[str, dict[str, Effect]] = {}
            for table, key in every[first : first + ROWS_AT_ONCE]:
                some.setdefault(table, {})[key] = effects[table][key]
            rows, latest = changed_rows(connection, some)
            leaves: list[dict[str, Any]] = []
            for table, of_table in some.items():
                leaves += _leaves_of(connection, logged()[table], of_table, rows[table], latest[table], at)
            self._write(connection, leaves)

    def _write(self, connection: Connection, leaves: Sequence[dict[str, Any]]) -> None:
        if not leaves:
            return
        if self._seal is None:
            origin = self.origin(connection)
            self.compare(connection, self.kept_head())
            if origin is None:
                raise NotReady(*REMOVED)
            self._seal = self.key.seal_of(origin)
        if (refused := self.refused) is not None:
            raise refused
        for leaf in leaves:
            leaf["seal"] = self._seal.of(leaf["entry"].encode())
        add_leaves(connection, leaves)

    # ---- beginning, migrations and restorations

    def begin(self, connection: Connection) -> None:
        """Begin a history, if there is none: make a key, and log the schema.

        Raises:
            NotReady: There are rows, so there was a history: to log them as found would vouch for them.
        """
        connection.info[NOTING] = True
        if not inspect(connection).has_table(LEAVES.name) or self.origin(connection) is not None:
            return
        if any(True for table in logged().values() for _ in table.pages(connection)):
            self._why = REMOVED
            raise NotReady(*REMOVED)
        self.sign_empty(connection)
        take_notes(connection)
        self.log_schema(connection)

    def sign(self, connection: Connection, *, adopt: bool = False) -> str | None:
        """Number the leaves that have no number yet, at most some, and sign the tree that they extend.

        Leaves without a valid seal are left alone: nobody who wrote them had the key, and `skills verify` names them.

        Args:
            connection: In a transaction in which nobody else signs.
            adopt: Take over a history that was signed with another key, with all its leaves.

        Returns:
            The signed checkpoint; None where there is nothing to sign.

        Raises:
            BadSettings: The signing key cannot be read.
            Corrupt: The stored tree is not the one that was signed last; nothing is signed on top of it.
        """
        query = select(LEAVES.c.row, LEAVES.c.entry, LEAVES.c.seal).where(LEAVES.c.number.is_(None))
        query = query.order_by(LEAVES.c.row).limit(None if adopt else SIGNED_AT_ONCE)
        # a leaf that an erasure is changing waits for the next time, so that neither waits for the other
        leaves = connection.execute(query.with_for_update(skip_locked=True)).all()
        if not leaves and not adopt:
            return None
        origin, tree = self._continued(connection, adopt)
        seal = self.key.seal_of(origin)
        numbered = []
        for row, entry, sealed in leaves:
            if adopt or hmac.compare_digest(sealed, seal.of(entry.encode())):
                numbered.append((tree.size, row))
                tree.append(leaf_hash(entry.encode()))
        if not numbered and not adopt:
            return None
        if numbered:
            _number_leaves(connection, numbered)
        note = self.key.sign(Checkpoint(origin, tree.size, tree.root))
        stored = {"size": tree.size, "note": note, "subtrees": b"".join(tree.subtrees)}
        connection.execute(insert(CHECKPOINTS), [stored])
        return note

    def _continued(self, connection: Connection, adopt: bool) -> tuple[str, Tree]:
        """Return the log's name and its tree as signed last."""
        columns = (CHECKPOINTS.c.size, CHECKPOINTS.c.note, CHECKPOINTS.c.subtrees)
        size, text_of, hashes = connection.execute(select(*columns).order_by(CHECKPOINTS.c.row.desc()).limit(1)).one()
        (note,) = read_notes(text_of)
        subtrees = [hashes[at : at + HASH_BYTES] for at in range(0, len(hashes), HASH_BYTES)]
        signed = note.checkpoint
        if len(subtrees) == size.bit_count() and (adopt or note.signed_by(self.key.public)):
            tree = Tree(size, subtrees)
            if (signed.origin, signed.size, signed.root) == (self.origin(connection), size, tree.root):
                return signed.origin, tree
        raise Corrupt(
            "The history is not as it was signed last with this signing key, so nothing is signed on top of it.",
            Remedy(Action.VERIFY),
        )

    def sign_empty(self, connection: Connection) -> None:
        """Write the first checkpoint of a new log, of no leaves, with a key that is made if there is none."""
        self.make_key()
        empty = Checkpoint(ORIGIN + secrets.token_hex(8), 0, Tree().root)
        connection.execute(insert(CHECKPOINTS), [{"size": 0, "note": self.key.sign(empty), "subtrees": b""}])

    def make_key(self) -> None:
        """Make a signing key that only this user can read, if there is no file of that name.

        Raises:
            BadSettings: The file would be beside the database, or cannot be written.
        """
        file = self.key_file
        if file.exists():
            return
        if self._engine.dialect.name == "sqlite":
            beside, around = Path(self._engine.url.database or "").resolve().parent, file.resolve().parents
            # somebody who keeps the database in the home folder has the state folder below it
            if beside == around[0] or (beside in around and not Path.home().resolve().is_relative_to(beside)):
                raise BadSettings(
                    f"The signing key {file} would be in the folder of the database, whose owner could then rewrite "
                    "the history.",
                    "Name a file in another folder in SKILLS_SIGNING_KEY.",
                )
        try:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{file.name}-", dir=file.parent)  # mode 0600
            with os.fdopen(handle, "w") as out:
                out.write(str(SigningKey(secrets.token_bytes(32))))
                out.flush()
                os.fsync(out.fileno())
            try:
                os.link(name, file)  # unlike a rename it never replaces the key of another process
            except FileExistsError:
                pass
            finally:
                Path(name).unlink()
        except OSError as error:
            raise BadSettings(
                f"The signing key {file} cannot be made: {error.strerror}.", "Name another file in SKILLS_SIGNING_KEY."
            ) from error

    def log_schema(self, connection: Connection) -> None:
        """Log the changes of triggers, indexes and constraints since they were last logged, after a migration."""
        at = rfc3339(now())
        here, known = schema_of(connection), latest_leaves(connection, SCHEMA)
        leaves = []
        for name, sql in here.items():
            if name not in known:
                leaves.append(new_leaf(SCHEMA, ADD, at, name, digested(("sql",), (sql,))))
            elif not known[name].matches(("sql",), (sql,)):
                leaves.append(new_leaf(SCHEMA, CHANGE, at, name, digested(("sql",), (sql,)), known[name]))
        gone = [name for name in known if name not in here]
        self._write(connection, [*leaves, *removals(connection, SCHEMA, gone, known, at)])

    def go_on_after_restore(self, connection: Connection) -> None:
        """Continue the history of a backup in the database that it was just loaded into.

        Its rows were logged before, so the notes of their insertion are dropped. A history that was signed
        with another key goes on with the one of this installation.

        Raises:
            Corrupt: The tree of the backup is not the one that was signed.
        """
        take_notes(connection)
        connection.info[NOTING] = True
        self._origin = self._seal = None
        set_aside(self.heads_file)  # of a database that was here before
        if self.origin(connection) is None:
            self.begin(connection)
            return
        self.make_key()
        if not read_notes(newest_checkpoint(connection) or "")[0].signed_by(self.key.public):
            self.sign(connection, adopt=True)
        self.log_schema(connection)


def newest_checkpoint(connection: Connection) -> str | None:
    """Return the newest signed checkpoint as a note; None where no history was begun."""
    note: str | None = connection.scalar(select(CHECKPOINTS.c.note).order_by(CHECKPOINTS.c.row.desc()).limit(1))
    return note


def _number_leaves(connection: Connection, numbered: Sequence[tuple[int, int]]) -> None:
    """Give leaves their numbers, each with the row of its leaf."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql('UPDATE history SET number = ? WHERE "row" = ?', list(numbered))
    else:
        connection.exec_driver_sql(
            "UPDATE history SET number = given.number FROM unnest(%s::bigint[], %s::bigint[]) AS given(number, of_row) "
            'WHERE history."row" = given.of_row',
            tuple(list(column) for column in zip(*numbered, strict=True)),
        )


def _leaves_of(
    connection: Connection,
    table: Logged,
    effects: Mapping[str, Effect],
    rows: Iterable[Any],
    latest: Mapping[str, "Latest"],
    at: str | None,
) -> Iterator[dict[str, Any]]:
    name = table.raw.name
    for row in rows:
        key = table.key_of(row)
        if not effects[key].before:
            # after an earlier leaf only where somebody has emptied a cache
            yield new_leaf(name, ADD, at, key, digested(table.columns, row), latest.get(key))
        elif key in latest and effects[key].written:  # removed, and added again
            yield new_leaf(name, CHANGE, at, key, digested(table.columns, row), latest[key])
        elif key in latest and (changed := effects[key].changed) and latest[key].is_committed:
            # the other columns keep their digests: if somebody else has changed one, that stays to be found
            digests = {**latest[key].of_row, **latest[key].digests_of(changed, row)}
            yield new_leaf(name, CHANGE, at, key, (latest[key].salt, digests), latest[key])
        # a row without a leaf, or with one that was changed, is not the service's: `skills verify` goes on naming it
    gone = [key for key, effect in effects.items() if effect.before and not effect.after]
    yield from removals(connection, name, gone, latest, at)


@dataclass(frozen=True)
class Latest:
    """The newest leaf of a row that exists."""

    row: int
    entry: str
    salt: bytes
    digests: Mapping[str, str]
    number: int | None = None
    seal: bytes = b""

    @property
    def hash(self) -> str:
        """The hash of its entry, by which the row's next leaf names it."""
        return leaf_hash(self.entry.encode()).hex()

    @property
    def is_committed(self) -> bool:
        """Whether its digests are those that were logged, and of the same columns."""
        return bool(orjson.loads(self.entry)["commitment"] == commitment_to(self.digests))

    @cached_property
    def of_row(self) -> Mapping[str, str]:
        """The digests of all columns: one that was added after the leaf has the value that its migration gave it."""
        added = ADDED.get(orjson.loads(self.entry)["table"], {})
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
    columns = (LEAVES.c.key, LEAVES.c.row, LEAVES.c.entry, LEAVES.c.salt, LEAVES.c.digests)
    of_rows = (LEAVES.c.table_name == table, LEAVES.c.key.is_not(None))
    query = select(*columns, LEAVES.c.number, LEAVES.c.seal).where(*of_rows).order_by(LEAVES.c.row)
    if keys is None:
        return {key: Latest(*about) for key, *about in connection.execute(query)}
    found = {}
    for at in range(0, len(keys), ROWS_AT_ONCE):
        these = query.where(LEAVES.c.key.in_(keys[at : at + ROWS_AT_ONCE]))
        found.update({key: Latest(*about) for key, *about in connection.execute(these)})
    return found


def changed_rows(
    connection: Connection, effects: Mapping[str, Mapping[str, Effect]]
) -> tuple[dict[str, list[Any]], dict[str, dict[str, Latest]]]:
    """Return the rows that a transaction has left, and the newest leaves of those of before, by table.

    One statement reads all of them: what a small transaction costs is the number of its statements.
    """
    rows: dict[str, list[Any]] = {table: [] for table in effects}
    latest: dict[str, dict[str, Latest]] = {table: {} for table in effects}
    left = {table: [key for key, effect in of_table.items() if effect.after] for table, of_table in effects.items()}
    before = {
        table: [key for key, effect in of_table.items() if effect.before or table in CACHES]
        for table, of_table in effects.items()
    }
    parts = [logged()[table] for table, keys in left.items() if keys]
    given: list[Sequence[Any]] = [known.firsts_of(left[known.raw.name]) for known in parts]
    given += [keys for keys in before.values() if keys]
    if not given:
        return rows, latest
    dialect, found = connection.dialect, []
    logged_before = tuple(table for table, keys in before.items() if keys)
    statement, of_bytes = united(dialect.name, tuple(known.raw.name for known in parts), logged_before)
    for part, values in united_rows(connection, statement, of_bytes, given):
        if part >= len(parts):
            found.append(values[: len(OF_LEAF)])
            continue
        known = parts[part]
        for at, read in known.readers(dialect):
            values[at] = read(values[at])
        row = known.row(*values[: len(known.columns)])
        if (effect := effects[known.raw.name].get(known.key_of(row))) and effect.after:
            rows[known.raw.name].append(row)
    for table, key, row, entry, salt, digests in sorted(found, key=itemgetter(2)):
        if dialect.name == "sqlite" and digests is not None:
            digests = json.loads(digests)
        latest[table][key] = Latest(row, entry, salt, digests)
    return rows, latest


_ADDED = ("table_name", "key", "entry", "seal", "salt", "digests")
_ADDING = {
    "sqlite": "INSERT INTO history (table_name, key, entry, seal, salt, digests) VALUES (?, ?, ?, ?, ?, ?)",
    "postgresql": "INSERT INTO history (table_name, key, entry, seal, salt, digests) SELECT leaf->>0, leaf->>1, "
    "leaf->>2, decode(leaf->>3, 'hex'), decode(leaf->>4, 'hex'), (leaf->>5)::json "
    "FROM json_array_elements(%s::json) AS given(leaf)",
}


def add_leaves(connection: Connection, leaves: Sequence[Mapping[str, Any]]) -> None:
    """Insert leaves in their order, in one statement on PostgreSQL.

    There all of them are one text: a driver escapes each quote of each text in an array by itself, which took longer
    than the rest of the history together.
    """
    rows = [[leaf[name] for name in _ADDED] for leaf in leaves]
    if connection.dialect.name == "sqlite":
        added = [(*values, None if digests is None else compact(digests)) for *values, digests in rows]
        connection.exec_driver_sql(_ADDING["sqlite"], added)
    else:
        for row in rows:
            row[3], row[4] = (None if part is None else part.hex() for part in (row[3], row[4]))
        connection.exec_driver_sql(_ADDING["postgresql"], (orjson.dumps(rows).decode(),))


Digested = tuple[bytes, dict[str, str]]


def digested(names: Sequence[str], values: Sequence[Any]) -> Digested:
    """Return a new salt, and the digests of a row's columns with it."""
    salt = secrets.token_bytes(SALT_BYTES)
    return salt, digests_of(names, values, salt)


def new_leaf(
    table: str, change: str, at: str | None, key: str | None, of: Digested | None, after: Latest | None = None
) -> dict[str, Any]:
    """Return the columns of a new leaf, without its seal."""
    salt, digests = of or (None, None)
    entry = {
        "table": table,
        "change": change,
        "at": at,
        "commitment": None if digests is None else commitment_to(digests),
        "previous": None if after is None else after.hash,
    }
    return {
        "table_name": table, "key": key, "entry": compact(entry), "salt": salt, "digests": digests,
    }  # fmt: skip


_BLANKING = {
    "sqlite": "UPDATE history SET salt = NULL, digests = NULL, key = NULL WHERE table_name = ? "
    "AND key IN (SELECT value FROM json_each(?))",
    "postgresql": "UPDATE history SET salt = NULL, digests = NULL, key = NULL WHERE table_name = %s "
    "AND key = ANY(%s::text[])",
}


def removals(
    connection: Connection, table: str, keys: Sequence[str], latest: Mapping[str, Latest], at: str | None
) -> Iterator[dict[str, Any]]:
    """Yield a leaf for each removed row, and remove what the row's earlier leaves reveal about it."""
    known = [key for key in keys if key in latest]
    if not known:
        return
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(_BLANKING["sqlite"], (table, json.dumps(known)))
    else:
        connection.exec_driver_sql(_BLANKING["postgresql"], (table, known))
    for key in known:
        yield new_leaf(table, REMOVE, at, None, None, latest[key])
