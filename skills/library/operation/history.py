"""The history, signed and verified: every logged row against its newest leaf, every leaf against the signed tree.

    leaves --sign_history--> checkpoints, in the database and in the file of its saved heads
    database, key, heads --verify_history--> findings, each named by table, key and column

What verification finds depends on what the attacker lacks. With the database alone nobody can write a leaf that the
signing key sealed, or a checkpoint that it signed. Somebody who puts back an older state of the whole database, with
its older checkpoint, is found by a later head that was saved elsewhere.
"""

import hmac
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from math import inf
from time import monotonic
from typing import Any

from sqlalchemy import Connection, exists, select, text, tuple_

from skills.db import in_parts
from skills.db.change_notes import REMOVE
from skills.db.history import SCHEMA, History
from skills.db.leaves import CHECKPOINTS, LEAVES, Latest, latest_leaves, newest_checkpoint
from skills.db.logged_rows import CACHES, ROWS_AT_ONCE, Logged, commitment_to, logged, schema_of
from skills.db.saved_heads import save_head
from skills.db.session import Database
from skills.db.tiles import TILES, fill_tiles, full_tiles, stored_tiles
from skills.errors import BadSettings, Corrupt, NotReady, SkillsError
from skills.remedies import Action, Remedy
from skills.transparency import merkle
from skills.transparency.notes import Note, read_notes

SIGNING_LOCK = 0x5C112  # ours: the number of the advisory lock under which one process at a time signs
SIGNING_S = 0.5  # ours: a worker must write its heartbeat meanwhile
NAMED = 20  # leaves that are named for one reason, of all that are counted

log = logging.getLogger(__name__)
Finding = tuple[str, str]
_Read = tuple[str, Sequence[Any] | Exception]  # a row's key, and its columns or the error of reading them


def sign_history(database: Database, at_most_s: float = inf) -> str | None:
    """Sign all leaves that no checkpoint covers yet, and keep the head outside the database.

    Several processes may call it; one at a time signs.

    Args:
        database: The database, without restriction.
        at_most_s: Stop after the transaction during which this time has passed.

    Returns:
        The last checkpoint; None where there was nothing to sign.

    Raises:
        NotReady: The database is not the one that was signed last.
        Corrupt: The stored tree is not the one that was signed last.
    """
    database.compare_history()
    note, began_s = None, monotonic()
    while (signed := _sign_some(database)) is not None:
        note = signed
        if monotonic() - began_s > at_most_s:
            break
    with database.reading() as session:  # also what others signed, or this process before it was killed
        newest = newest_checkpoint(session.connection())
    if newest is not None:
        save_head(database.history.heads_file, newest)
    return note


def is_last_signed(database: Database) -> bool:
    """Return whether it is the database that was signed last; log the reason when it is found not to be."""
    before = database.history.refused
    try:
        database.compare_history()
    except NotReady as refused:
        if before is None:
            log.critical("Nothing is served or written (%s). %s", database.history.heads_file, refused)
        return False
    return True


def sign_some_history(database: Database, at_most_s: float = SIGNING_S) -> bool:
    """Sign some of the history, if it is the right one, and return whether it is; work goes on where signing fails."""
    if not is_last_signed(database):
        return False
    try:
        sign_history(database, at_most_s)
    except (BadSettings, Corrupt) as error:
        log.error("The history is not signed: %s", error)
    return True


def _sign_some(database: Database) -> str | None:
    with database.reading() as session:
        if not session.scalar(select(exists().where(LEAVES.c.number.is_(None)))):
            return None
    with database.writing(()) as session:  # no other job depends on it
        connection = session.connection()
        if connection.dialect.name == "postgresql":
            mine = connection.scalar(text("SELECT pg_try_advisory_xact_lock(:lock)"), {"lock": SIGNING_LOCK})
            if not mine:
                return None
        note = database.history.sign(connection)
        if note is not None:
            fill_tiles(connection)
        return note


# ---- single rows -----------------------------------------------------------------------------------------------------


def logged_leaf(connection: Connection, history: History, table: str, key: str) -> Latest:
    """Return the newest leaf of a row that the service wrote, and that nobody else has changed since.

    Raises:
        Corrupt: The row is missing, or not as its leaf says, or the service did not write the leaf.
    """
    refuse_edited(connection, history, table, [key])
    return latest_leaves(connection, table, [key])[key]


def refuse_edited(connection: Connection, history: History, table: str, keys: Sequence[str]) -> None:
    """Refuse rows that somebody else than the service has written, see `edited_rows`.

    Raises:
        Corrupt: There is one.
    """
    if edited_rows(connection, history, table, keys):
        raise Corrupt(f"A row of {table} is not as the history has it, so it is not used.", Remedy(Action.VERIFY))


def edited_rows(connection: Connection, history: History, table: str, keys: Sequence[str]) -> list[str]:
    """Return the keys of rows that are missing, that are not as their newest leaves say, or whose leaves are forged.

    Rows that were put back together with their older leaf, and rows that are gone, are found by `verify_history`.
    """
    known, latest = logged()[table], latest_leaves(connection, table, keys)
    rows = {known.key_of(row): row for row in known.rows_of(connection, keys)}
    origin = history.origin(connection)
    edited = []
    for key in keys:
        leaf, row = latest.get(key), rows.get(key)
        if leaf is None or row is None or origin is None or not leaf.matches(known.columns, row):
            edited.append(key)
        elif not hmac.compare_digest(leaf.seal, history.key.seal_of(origin).of(leaf.entry.encode())):
            edited += [] if _is_signed(connection, leaf) else [key]
    for key in edited:
        log.error("%s %s is not as the history has it, and is not used; run `skills verify`.", table, key)
    return edited


def _is_signed(connection: Connection, leaf: Latest) -> bool:
    """Return whether a leaf is under the newest checkpoint, such as one of an installation that a backup came from."""
    (note,) = read_notes(newest_checkpoint(connection) or "")
    try:
        covered_leaf(connection, leaf, note.checkpoint)
    except Corrupt:
        return False
    return True


def covered_leaf(connection: Connection, leaf: Latest, signed: merkle.Checkpoint) -> list[bytes]:
    """Return the hashes that prove a leaf under a checkpoint (RFC 6962).

    Raises:
        Corrupt: They do not lead to its root.
    """
    if leaf.number is not None and leaf.number < signed.size:
        hashes = merkle.inclusion_proof(signed.size, leaf.number, merkle.node_from(stored_tiles(connection)))
        if merkle.proven_root(merkle.leaf_hash(leaf.entry.encode()), leaf.number, signed.size, hashes) == signed.root:
            return hashes
    raise Corrupt("The history is not as it was signed, so it proves nothing.", Remedy(Action.VERIFY))


# ---- verification ----------------------------------------------------------------------------------------------------


@dataclass
class Verified:
    """The leaves as a verification has read them, and the numbers of leaves and rows that it has compared."""

    leaves: int = 0
    rows: int = 0
    live: dict[bytes, tuple[str, str | None, int]] = field(default_factory=dict)  # by hash: table, key, row of the leaf
    hashes: dict[int, bytes] = field(default_factory=dict)  # by the number in the tree
    seen: set[bytes] = field(default_factory=set)  # the hashes of all leaves


def verify_history(
    connection: Connection, history: History, heads: Sequence[Note] | None, done: Verified
) -> Iterator[Finding]:
    """Verify the history and every logged row, in one consistent state.

    Args:
        connection: In a transaction that reads one state, and has read nothing yet.
        history: The history, with its key.
        heads: Checkpoints that were kept elsewhere; the history must continue each of them. None: those of its file.
        done: Empty; it counts what was compared.

    Yields:
        Findings: what is wrong, and why.
    """
    # before the first query: what others sign from now on is not in the state that is read
    saved = history.saved_heads() if heads is None else []
    origin = history.origin(connection)
    if origin is None:
        yield "history", "none was begun; run `skills migrate`"
        return
    try:
        public, seal = history.key.public, history.key.seal_of(origin)
    except SkillsError as error:
        yield "history", error.words()
        return
    signed, since, here = [], None, set()
    for row, stored, note in _checkpoints(connection):
        name = f"history_checkpoints {row}"
        here.add(note)
        if note is None or note.checkpoint.size != stored or note.checkpoint.origin != origin:
            yield name, "it is not a checkpoint of this history"
        elif note.signed_by(public):
            since = note.checkpoint.size if since is None else min(since, note.checkpoint.size)
            signed.append((name, note))
        elif since is not None:  # those before may be of the installation that a backup came from
            yield name, "it is not signed with the key of this installation"
    if since is None:
        yield "history", "no checkpoint is signed with the key of this installation"
    for note in [one for one in saved if one.checkpoint.origin == origin] if heads is None else heads:
        name = f"head of {note.checkpoint.size} leaves"
        if note.checkpoint.origin != origin:
            yield name, f"it is of the history {note.checkpoint.origin}, and this one is {origin}"
        elif not note.signed_by(public):
            yield name, "it is not signed with the key of this installation"
        else:
            signed.append((name, note))
            if note not in here and any(one is not None and one.checkpoint.size > note.checkpoint.size for one in here):
                yield name, "its checkpoint was removed from the database, which has later ones"
    leaves = select(LEAVES).order_by(LEAVES.c.row).execution_options(yield_per=ROWS_AT_ONCE)
    for leaf in connection.execute(leaves):
        name = f"{leaf.table_name} {leaf.key or '(erased)'}"
        for why in _wrong_with(leaf, done):
            yield name, why
        under_other_key = leaf.number is not None and since is not None and leaf.number < since
        if not under_other_key and not hmac.compare_digest(leaf.seal, seal.of(leaf.entry.encode())):
            yield name, f"its leaf {leaf.row} of the history was not written by the service: the seal is wrong"
        done.leaves += 1
    yield from _wrong_roots(done.hashes, signed)
    size = max((note.checkpoint.size for _, note in signed), default=0)
    yield from islice(_wrong_tiles(connection, done.hashes, size), NAMED)
    yield from _wrong_rows(connection, done)


def _checkpoints(connection: Connection) -> Iterator[tuple[int, int, Note | None]]:
    query = select(CHECKPOINTS.c.row, CHECKPOINTS.c.size, CHECKPOINTS.c.note, CHECKPOINTS.c.subtrees)
    for row, size, said, subtrees in connection.execute(query.order_by(CHECKPOINTS.c.row)):
        try:
            (note,) = read_notes(said)
            tree = merkle.Tree(size, [subtrees[at : at + 32] for at in range(0, len(subtrees), 32)])
        except (SkillsError, ValueError, AssertionError):
            note = None
        yield row, size, note if note is not None and tree.root == note.checkpoint.root else None


def _wrong_with(leaf: Any, read: Verified) -> Iterator[str]:
    """Add a leaf to those read, and yield the faults of its content and of its place among the row's leaves."""
    digest = merkle.leaf_hash(leaf.entry.encode())
    if leaf.number is not None:
        read.hashes[leaf.number] = digest
    if digest in read.seen:  # such as of a row that was erased, and put back together with its old leaf
        yield f"its leaf {leaf.row} is a copy of an earlier one"
    read.seen.add(digest)
    try:
        entry = json.loads(leaf.entry)
        table, change, commitment, previous = (entry[name] for name in ("table", "change", "commitment", "previous"))
        before = None if previous is None else bytes.fromhex(previous)
    except (ValueError, KeyError, TypeError):
        yield f"the entry of its leaf {leaf.row} cannot be read"
        return
    if table != leaf.table_name:
        yield f"the entry of its leaf {leaf.row} is of {table}"
    if leaf.digests is not None and commitment_to(leaf.digests) != commitment:
        yield f"the digests of its leaf {leaf.row} are not those that were logged"
    if before is not None and read.live.pop(before, None) is None:
        yield f"the leaf before its leaf {leaf.row} is missing, or was followed by another"
    if change != REMOVE:
        read.live[digest] = (table, leaf.key, leaf.row)


def _wrong_roots(hashes: dict[int, bytes], signed: Sequence[tuple[str, Note]]) -> Iterator[Finding]:
    """Yield the signed heads that the tree does not continue, and the numbers that are missing in it."""
    tree, size = merkle.Tree(), 0
    for name, note in sorted(signed, key=lambda one: one[1].checkpoint.size):
        size = note.checkpoint.size
        while tree.size < size and tree.size in hashes:
            tree.append(hashes[tree.size])
        if tree.size < size:
            yield name, f"it was signed over {size} leaves, and leaf {tree.size} is missing: the history was cut"
        elif tree.root != note.checkpoint.root:
            yield name, "the leaves are not those that were signed"
    beyond = [number for number in hashes if number >= size]
    for number in beyond[:NAMED]:
        yield f"leaf {number}", "it has a number, and no signed checkpoint covers it"


def _wrong_tiles(connection: Connection, hashes: dict[int, bytes], size: int) -> Iterator[Finding]:
    """Yield the tiles that are not of the leaves, that are missing, or that are of leaves that nobody signed."""
    below = [hashes.get(number) for number in range(size)]
    unknown = {(level, number) for level, number in connection.execute(select(TILES.c.level, TILES.c.number))}
    for level, full in full_tiles(size):
        roots: list[bytes | None] = []
        for number in range(full):
            of_tile = [
                one for one in below[number * merkle.TILE_WIDTH : (number + 1) * merkle.TILE_WIDTH] if one is not None
            ]
            if len(of_tile) < merkle.TILE_WIDTH:  # leaves are missing, which is named elsewhere
                roots.append(None)
                continue
            this = (TILES.c.level == level, TILES.c.number == number)
            stored = connection.execute(select(TILES.c.root, TILES.c.hashes).where(*this)).first()
            roots.append(merkle.root_of(of_tile))
            if stored is None:
                yield f"history_tiles {level}/{number}", "it is missing"
            elif tuple(stored) != (roots[-1], b"".join(of_tile)):
                yield f"history_tiles {level}/{number}", "its hashes are not those of the leaves"
        unknown -= {(level, number) for number in range(full)}
        below = roots
    for level, number in sorted(unknown):
        yield f"history_tiles {level}/{number}", "no signed checkpoint covers its leaves"


def _wrong_rows(connection: Connection, done: Verified) -> Iterator[Finding]:
    """Yield the rows that differ from their newest leaf, rows without a leaf, and leaves without their row."""
    newest: dict[str, dict[str, int]] = {}
    for table, key, row in done.live.values():
        of_table = newest.setdefault(table, {})
        if key is None:
            yield f"{table} (erased)", f"its leaf {row} has lost its content, and no leaf says that the row was removed"
        elif key in of_table:
            yield f"{table} {key}", f"its leaf {row} is another first leaf"
        else:
            of_table[key] = row
    schema: list[_Read] = [(key, (sql,)) for key, sql in schema_of(connection).items()]
    tables = [(name, known.columns, _pages(connection, known)) for name, known in logged().items()]
    for name, columns, pages in (*tables, (SCHEMA, ("sql",), iter([schema]))):
        left = newest.pop(name, {})
        for page in pages:
            yield from _wrong_page(connection, name, columns, page, left)
            done.rows += len(page)
        yield from _missing(name, left)
    for other, rows in newest.items():
        yield from _missing(other, rows)


def _pages(connection: Connection, table: Logged) -> Iterator[list[_Read]]:
    """Yield all rows some at a time: the key, and the logged columns or the error of reading them."""
    query = select(*table.key_columns).order_by(*table.key_columns).limit(ROWS_AT_ONCE)
    page = connection.execute(query).all()
    while page:
        keys = [table.key_of(row) for row in page]
        try:
            yield [(table.key_of(row), row) for row in table.rows_of(connection, keys)]
        except Exception:  # one of them cannot be read; reading each alone finds which
            yield [_alone(connection, table, key) for key in keys]
        page = connection.execute(query.where(tuple_(*table.key_columns) > tuple_(*page[-1]))).all()


def _alone(connection: Connection, table: Logged, key: str) -> _Read:
    try:
        (row,) = table.rows_of(connection, [key])
    except Exception as error:
        return key, error
    return key, row


def _wrong_page(
    connection: Connection, table: str, columns: Sequence[str], page: Sequence[_Read], left: dict[str, int]
) -> Iterator[Finding]:
    """Compare rows with their newest leaves, and remove these from those that are left."""
    leaves = {key: left.pop(key) for key, _ in page if key in left}
    about = (LEAVES.c.row, LEAVES.c.entry, LEAVES.c.salt, LEAVES.c.digests)
    found = {}
    for some in in_parts(sorted(leaves.values())):
        found.update({row[0]: row for row in connection.execute(select(*about).where(LEAVES.c.row.in_(some)))})
    for key, values in page:
        name = f"{table} {key}"
        if key not in leaves:
            yield name, "no leaf of the history says that it was added"
        elif isinstance(values, Exception):
            yield name, f"it cannot be compared with the history ({type(values).__name__})"
        elif (leaf := found[leaves[key]]).salt is None or leaf.digests is None:
            yield name, "its digests were removed from the history, and no leaf says that the row was"
        elif differing := Latest(*leaf).differing(columns, values):
            yield name, f"not as the history has it: {', '.join(differing)}"


def _missing(name: str, left: dict[str, int]) -> Iterator[Finding]:
    for key in left if name not in CACHES else ():
        yield f"{name} {key}", "it is missing, and no leaf of the history says that it was removed"
