"""The rows that the history logs: which tables and columns, each as the bytes that its digest covers.

Everything is logged but what `NOT_LOGGED` and `COLUMNS_NOT_LOGGED` name with a reason. Triggers, indexes and
constraints are logged as if each of them were a row.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache, cached_property
from json.encoder import encode_basestring_ascii
from typing import Any

import orjson
import sqlalchemy as sa
from sqlalchemy.types import NullType, TypeEngine

from skills.db import AsJson, Base, Moment, in_parts
from skills.db.packed import Packed
from skills.packing import sha256

DIGEST_BYTES = 16
ROWS_AT_ONCE = 200

OF_A_RUN = "the state of running processes, replaced every second"
IN_PIECES = "the row that the pieces belong to has their digest, which `skills verify` computes again"
SWEPT = "what the sweep has yet to delete, and nobody sees; `skills verify` finds one that names an existing row"
NOT_LOGGED = {
    "executors": OF_A_RUN,
    "retraining_styles": "the progress of a batch; the versions and releases that it made are logged",
    "loose_chunks": SWEPT,
    "erased_surgeons": SWEPT,
    "recording_chunks": IN_PIECES,
    "parsed_chunks": IN_PIECES,
    "dataset_chunks": IN_PIECES,
    "history": "the history itself",
    "history_checkpoints": "the history itself",
    "history_tiles": "hashes of the history, which `skills verify` computes again",
}
# Logged, but anybody may delete their rows at any time; a sign-in that is gone lets nobody in.
CACHES = ("measured_shapes", "parsed_recordings", "sign_ins")
COLUMNS_NOT_LOGGED = {
    ("jobs", "progress"): OF_A_RUN,
    ("jobs", "attempt"): OF_A_RUN,
    ("jobs", "submitted_at"): OF_A_RUN,
    ("jobs", "started_at"): OF_A_RUN,
    ("sign_ins", "used_at"): OF_A_RUN,
}
# By table, the columns that a migration has added to it, each with its value in the rows that there were. The leaves of
# these rows lack the columns; every later leaf has them.
ADDED: dict[str, dict[str, object]] = {}

# ---- rows as they are stored -----------------------------------------------------------------------------------------

KINDS: dict[str, TypeEngine[Any]] = {
    "bytes": sa.LargeBinary(),
    "json": sa.JSON(none_as_null=True),
    "moment": Moment(),
    "truth": sa.Boolean(),
    "plain": NullType(),  # text and numbers, which all drivers and JSON represent alike
}
PLAIN = (sa.String, sa.Integer, sa.BigInteger, sa.Float, sa.Double)


def kind_of(column: sa.Column[Any]) -> str:
    """Return the kind of a column, a key of `KINDS`, which decides how its values are represented elsewhere."""
    if isinstance(column.type, Packed | sa.LargeBinary):
        return "bytes"
    for kind, types in (("json", sa.JSON | AsJson), ("moment", Moment), ("truth", sa.Boolean), ("plain", PLAIN)):
        if isinstance(column.type, types):
            return kind
    raise AssertionError(f"no raw form of {column}")


def raw_table(name: str, columns: Iterable[tuple[str, str]]) -> sa.Table:
    """Return a table with raw columns, given by name and kind: serialised values stay bytes."""
    return sa.Table(name, sa.MetaData(), *(sa.Column(column, KINDS[kind]) for column, kind in columns))


@dataclass(frozen=True)
class Logged:
    """A logged table with raw columns: serialised values stay bytes."""

    raw: sa.Table
    keys: tuple[str, ...]
    of_text: bool  # whether keys are texts

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The names of the logged columns."""
        return tuple(str(column.name) for column in self.raw.columns)

    @cached_property
    def key_columns(self) -> list[sa.Column[Any]]:
        """The columns of the primary key."""
        return [self.raw.c[name] for name in self.keys]

    def key_of(self, row: Any) -> str:
        """Return the key of a row as text."""
        return "/".join(str(getattr(row, name)) for name in self.keys)

    def rows_of(self, connection: sa.Connection, keys: Sequence[str]) -> Iterator[Any]:
        """Yield the rows with some keys, of those that exist."""
        for some in map(frozenset, in_parts(keys, ROWS_AT_ONCE)):
            # By the values with which the keys begin: few other rows share them, and all indexes begin with them.
            firsts = sorted({key if self.of_text else int(key.partition("/")[0]) for key in some})
            rows = connection.execute(self._by_firsts, {"firsts": firsts})
            yield from (row for row in rows if self.key_of(row) in some)

    @cached_property
    def _by_firsts(self) -> sa.Select[Any]:
        """The query of the rows whose keys begin with some values, built once: every write of this table asks it."""
        return sa.select(self.raw).where(self.key_columns[0].in_(sa.bindparam("firsts", expanding=True)))

    @cached_property
    def in_order(self) -> sa.Select[Any]:
        """The query of all rows, in the order of their keys."""
        return sa.select(self.raw).order_by(*self.key_columns)


@cache
def logged() -> Mapping[str, Logged]:
    """Return the logged tables by name, each after those that it refers to."""
    return {table.name: _logged(table) for table in Base.metadata.sorted_tables if table.name not in NOT_LOGGED}


def _logged(table: sa.Table) -> Logged:
    columns = [(one.name, kind_of(one)) for one in table.columns if (table.name, one.name) not in COLUMNS_NOT_LOGGED]
    keys = list(table.primary_key)
    return Logged(raw_table(table.name, columns), tuple(key.name for key in keys), isinstance(keys[0].type, sa.String))


# ---- digests of rows ------------------------------------------------------------------------------------------------


def digests_of(names: Iterable[str], values: Iterable[Any], salt: bytes) -> dict[str, str]:
    """Return the salted digests of a row's columns in hex, by name."""
    return {
        name: hashlib.sha256(salt + name.encode() + as_bytes(value)).hexdigest()[: 2 * DIGEST_BYTES]
        for name, value in zip(names, values, strict=True)
    }


encode = json.JSONEncoder(separators=(",", ":")).encode


def as_bytes(value: Any) -> bytes:
    """Return the bytes that a value is digested by, equal on both back ends; the order in JSON objects counts."""
    if isinstance(value, str):
        return b"\0json" + encode_basestring_ascii(value).encode()
    if value is None:
        return b"\0none"
    if isinstance(value, bytes):
        return b"\0bytes" + value
    if isinstance(value, datetime):
        return b"\0moment" + value.isoformat().encode()
    if type(value) is int:
        return b"\0json%d" % value  # as the encoder does, which is slow for numbers
    return b"\0json" + encode(value).encode()


def commitment_to(digests: Mapping[str, str]) -> str:
    """Return the digest that stands for a row in the log."""
    return sha256(compact(digests).encode())


def compact(texts: Mapping[str, str | None]) -> str:
    """Return texts of ASCII without DEL by name as `canonical` does, in a thirtieth of its time."""
    return orjson.dumps(texts, option=orjson.OPT_SORT_KEYS).decode()


# ---- the database's schema, logged as if each of its objects were a row --------------------------------------------

_OBJECTS = {
    "sqlite": "SELECT type || ' ' || name, sql FROM sqlite_master WHERE type IN ('trigger', 'index', 'table', 'view') "
    "AND name NOT LIKE 'sqlite_%' AND name <> 'alembic_version' AND sql IS NOT NULL",
    "postgresql": """
        SELECT 'trigger ' || c.relname || ' ' || t.tgname, pg_get_triggerdef(t.oid) || ' ' || t.tgenabled::text
          FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid
         WHERE NOT t.tgisinternal AND c.relnamespace = current_schema()::regnamespace
        UNION ALL
        SELECT 'function ' || p.proname, pg_get_functiondef(p.oid)
          FROM pg_proc p WHERE p.pronamespace = current_schema()::regnamespace AND p.proname LIKE 'skills%'
        UNION ALL
        SELECT 'constraint ' || c.relname || ' ' || n.conname, pg_get_constraintdef(n.oid)
          FROM pg_constraint n JOIN pg_class c ON c.oid = n.conrelid
         WHERE n.connamespace = current_schema()::regnamespace AND c.relname = ANY(:tables) AND n.contype <> 'n'
        UNION ALL
        SELECT 'table ' || c.relname, string_agg(concat_ws(' ', a.attname, format_type(a.atttypid, a.atttypmod),
               CASE WHEN a.attnotnull THEN 'NOT NULL' END, pg_get_expr(d.adbin, c.oid)), ', ' ORDER BY a.attname)
          FROM pg_class c JOIN pg_attribute a ON a.attrelid = c.oid AND a.attnum > 0 AND NOT a.attisdropped
          LEFT JOIN pg_attrdef d ON d.adrelid = c.oid AND d.adnum = a.attnum
         WHERE c.relnamespace = current_schema()::regnamespace AND c.relname = ANY(:tables) GROUP BY c.relname
        UNION ALL
        SELECT 'index ' || indexname, indexdef FROM pg_indexes
         WHERE schemaname = current_schema() AND tablename = ANY(:tables)""",
}


# Columns that are not null are constraints since PostgreSQL 18, and were none before: their table's columns say it.
# PostgreSQL writes `IN ('a', 'b')` in one form where a migration made it, in another once `pg_dump` has copied it.
_COPIED = re.compile(r"ANY \(ARRAY\[((?:\('(?:[^']|'')*'::character varying\)::text(?:, )?)+)\]\)")
_ONE = re.compile(r"\(('(?:[^']|'')*'::character varying)\)::text")


def schema_of(connection: sa.Connection) -> dict[str, str]:
    """Return the definitions of triggers, functions, constraints, indexes and tables, by kind and name.

    They are the same for a database that was copied by `pg_dump`, also to another major version of PostgreSQL.
    """
    kind = connection.dialect.name
    given = {"tables": list(Base.metadata.tables)} if kind == "postgresql" else {}
    return {name: _as_migrated(sql) for name, sql in connection.execute(sa.text(_OBJECTS[kind]), given)}


def _as_migrated(sql: str) -> str:
    return _COPIED.sub(lambda found: "ANY ((ARRAY[" + _ONE.sub(r"\1", found[1]) + "])::text[])", sql)
