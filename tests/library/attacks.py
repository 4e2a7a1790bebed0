"""Changes to a database by somebody who knows the code, and has neither the signing key nor a later head.

Triggers and references are bypassed without a trace. `cover_up` recomputes everything that can be recomputed without
the key: the digests of the row's columns, the entry, the tree, and the checkpoints around their old signatures.
"""

import json
import random
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

from sqlalchemy import Column, Connection, MetaData, Table, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from skills.db import now
from skills.db.change_notes import ADD
from skills.db.history import History
from skills.db.leaves import CHECKPOINTS, LEAVES, Latest, NewLeaf, latest_leaves, new_leaf, removals
from skills.db.logged_rows import CACHES, commitment_to, digests_of, logged
from skills.db.session import Database
from skills.library.operation.history import Finding, Verified, verify_history
from skills.packing import canonical
from skills.transparency.merkle import Tree, leaf_hash
from skills.transparency.notes import Note, read_notes

UNIQUE = ("sha256", "slug", "subject", "id", "identity")


@contextmanager
def tampering(database: Database) -> Iterator[Connection]:
    """Yield a connection whose changes no trigger sees, and which are undone at the end."""
    with database.engine.execution_options(writes=True).connect() as connection:
        if connection.dialect.name == "postgresql":
            connection.exec_driver_sql("SET LOCAL session_replication_role = replica")
            yield connection
        else:
            connection.exec_driver_sql("PRAGMA defer_foreign_keys=ON")
            triggers = connection.exec_driver_sql("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").all()
            for name, _ in triggers:
                connection.exec_driver_sql(f"DROP TRIGGER {name}")
            yield connection
        connection.rollback()


def found(connection: Connection, history: History, heads: tuple[Note, ...] = ()) -> list[Finding]:
    """Return the findings of a verification; on SQLite the dropped triggers are not counted."""
    findings = list(verify_history(connection, history, heads, Verified()))
    return [one for one in findings if not one[0].startswith("schema trigger")]


def cover_up(connection: Connection, table: str, key: str, kind: str) -> None:
    """Recompute what refers to a row that was changed, added or removed."""
    about = logged()[table]
    known = latest_leaves(connection, table, [key])
    rows = list(about.rows_of(connection, [key]))
    if kind == "add":
        columns = dict(zip(about.columns, rows[0], strict=True))
        forge(connection, [new_leaf(table, ADD, "2026-01-01T00:00:00Z", key, columns)])
    elif kind == "remove":
        forge(connection, removals(connection, table, [key], known, "2026-01-01T00:00:00Z"))
    elif key in known:
        rewrite(connection, known[key], digests_of(about.columns, rows[0], known[key].salt))
    sign_again(connection)


def forge(connection: Connection, leaves: Iterable[NewLeaf]) -> None:
    """Insert leaves under a seal that no key made."""
    connection.execute(insert(LEAVES), [{**leaf._asdict(), "seal": b"f" * 32} for leaf in leaves])


def rewrite(connection: Connection, leaf: Latest, digests: Mapping[str, str]) -> None:
    """Write other digests into a leaf, with the commitment to them."""
    entry = json.loads(leaf.entry) | {"commitment": commitment_to(digests)}
    values = {"digests": dict(digests), "entry": canonical(entry).decode()}
    connection.execute(update(LEAVES).where(LEAVES.c.row == leaf.row).values(**values))


def sign_again(connection: Connection) -> None:
    """Compute the tree of every checkpoint again, and keep the signatures, which cannot be computed."""
    leaves = connection.execute(select(LEAVES.c.entry).where(LEAVES.c.number.is_not(None)).order_by(LEAVES.c.number))
    hashes = [leaf_hash(entry.encode()) for (entry,) in leaves]
    for row, size, note in connection.execute(select(CHECKPOINTS.c.row, CHECKPOINTS.c.size, CHECKPOINTS.c.note)).all():
        tree = Tree()
        for one in hashes[:size]:
            tree.append(one)
        _, _, signature = note.rpartition("\n\n")
        head = read_notes(note)[0].checkpoint
        said = f"{type(head)(head.origin, tree.size, tree.root)}\n{signature}"
        values = {"note": said, "size": tree.size, "subtrees": b"".join(tree.subtrees)}
        connection.execute(update(CHECKPOINTS).where(CHECKPOINTS.c.row == row).values(**values))


def random_edit(connection: Connection, rng: random.Random) -> tuple[str, str]:
    """Change, add or remove a random row, or a random column of it; return its name, and the kind of the edit."""
    while True:
        try:
            with connection.begin_nested():
                return _some_edit(connection, rng)
        except IntegrityError:  # a value that must be unique and is not: no database would hold it, so another edit
            continue


def _some_edit(connection: Connection, rng: random.Random) -> tuple[str, str]:
    filled = {name: connection.execute(about.in_order).all() for name, about in logged().items()}
    table = rng.choice([name for name, rows in filled.items() if rows])
    about, row = logged()[table], rng.choice(filled[table])
    key = about.key_of(row)
    where = [column == getattr(row, column.name) for column in about.key_columns]
    # a cached row may be missing, which changes no answer
    kind = rng.choice(["change"] * 6 + ([] if table in CACHES else ["remove", "remove", "add"]))
    others = [name for name in about.columns if name not in about.keys]
    if kind == "add" and about.keys == ("row",):
        unique = _other_values(row, rng, [name for name in others if name in UNIQUE])
        values = {**row._mapping, **unique, "row": row.row + 1000, **_own_number(table, row)}
        values |= {"progress": 0.0, "attempt": 1} if table == "jobs" else {}
        columns = [Column(name, about.raw.c[name].type if name in about.columns else None) for name in values]
        connection.execute(insert(Table(table, MetaData(), *columns)), [values])
        return f"{table} {row.row + 1000}", "add"
    if kind == "change" and others:
        name = rng.choice(others)
        connection.execute(update(about.raw).where(*where).values(_other_values(row, rng, [name])))
    else:
        kind = "remove"
        connection.execute(delete(about.raw).where(*where))
    return f"{table} {key}", kind


def _own_number(table: str, row: Any) -> dict[str, int]:
    """Return other values of columns that are unique and refer to another row."""
    unique = {"reward_maps": "demonstration_row", "pose_styles": "policy_row", "playback_pictures": "playback_row"}
    unique |= {"policy_versions": "version", "datasets": "job_row"}
    return {unique[table]: getattr(row, unique[table]) + 1000} if table in unique else {}


def _other_values(row: Any, rng: random.Random, names: list[str]) -> dict[str, Any]:
    return {name: _other(getattr(row, name), rng, name) for name in names}


def _other(value: Any, rng: random.Random, name: str) -> Any:
    """Return another value of the same kind, near the old one."""
    match value:
        case bool():
            return not value
        case int():
            return value + rng.choice((1, 7, 1000))
        case float():
            return value + rng.choice((-0.25, 1e-9, 1.0))
        case bytes():
            at = rng.randrange(len(value))
            return value[:at] + bytes([value[at] ^ 1 << rng.randrange(8)]) + value[at + 1 :]
        case str():
            choices = {"role": ("reader", "admin"), "outcome": ("success", "failure"), "split": ("train", "test")}
            choices |= {"state": ("succeeded", "failed", "cancelled")}
            if name in choices:
                return rng.choice([one for one in choices[name] if one != value])
            at = rng.randrange(len(value)) if value else 0
            return value[:at] + ("0" if value[at : at + 1] != "0" else "1") + value[at + 1 :]
        case dict():
            return value | {"changed": rng.random()}
        case list():
            return [*value, "changed"]
        case None:
            if name.endswith("_at"):
                return now()
            if name in ("surgeon_row", "start_s", "end_s"):
                return 1
            return {"changed": True} if name in ("consent", "result") else "changed"
        case _:
            return value + timedelta(microseconds=rng.choice((1, 86_400_000_000)))
