"""A backup: every table of ours in one zip file, the same from SQLite and from PostgreSQL.

    manifest.json        the format, the schema's revision, and of every table its columns, rows and SHA-256
    surgeons.rows, ...   a line of JSON for each row; where a column holds bytes the line has their number, and they
                         follow it
    the last 64 bytes    (a zip's comment) the SHA-256 of all that stands before them, in hex

Rows stand in the order of their keys, and tables after those that they refer to. Nothing is compressed: most of it is
already. Whatever is read or written here is held a few mebibytes at a time.
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import IO, Any
from zipfile import ZIP_STORED, ZipFile

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Connection,
    Double,
    Float,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    insert,
    select,
    text,
)
from sqlalchemy.types import NullType, TypeEngine

from skills.db.base import Base, Moment, now, rfc3339
from skills.db.books import Executor, SignIn
from skills.db.packed import Packed
from skills.db.schema import revision_of, revisions, upgrade
from skills.errors import Conflict, Corrupt, UnknownFormat

FORMAT = "suture-skills backup 1"
MANIFEST = "manifest.json"
SEAL_BYTES = 64
CUT_OFF = "its end is missing or damaged, as of a file that was cut off"
PIECE_BYTES = 1 << 20
LEFT_OUT = {Executor.__tablename__, SignIn.__tablename__}  # workers that live and people who are in: elsewhere none
ROWS_AT_ONCE = 500
ROWS_WITH_BYTES_AT_ONCE = 8  # a recording's chunk has a mebibyte

KINDS: dict[str, TypeEngine[Any]] = {
    "bytes": LargeBinary(),
    "json": JSON(none_as_null=True),
    "moment": Moment(),
    "truth": Boolean(),
    "plain": NullType(),  # text and numbers, which every driver and JSON have
}
PLAIN = (String, Integer, BigInteger, Float, Double)


@dataclass(frozen=True)
class Dumped:
    """What a backup says of a table; `counter` is the column that numbers its rows, `last` its highest number ever."""

    name: str
    columns: list[list[str]]  # name and kind of each
    rows: int
    sha256: str
    counter: str | None
    last: int

    @property
    def member(self) -> str:
        """The name of its file in the archive."""
        return f"{self.name}.rows"

    @property
    def table(self) -> Table:
        """The table as it is stored: values stay the bytes that they are packed in."""
        return Table(self.name, MetaData(), *(Column(name, KINDS[kind]) for name, kind in self.columns))


@dataclass(frozen=True)
class Manifest:
    """What a backup says of itself."""

    format: str
    code: str
    schema: str
    database: str
    created_at: str
    tables: list[Dumped]


def tables() -> list[Table]:
    """List the tables that are backed up, each after those that it refers to."""
    return [table for table in Base.metadata.sorted_tables if table.name not in LEFT_OUT]


def kind_of(column: Column[Any]) -> str:
    """Say how a column is written."""
    if isinstance(column.type, Packed | LargeBinary):
        return "bytes"
    for kind, types in (("json", JSON), ("moment", Moment), ("truth", Boolean), ("plain", PLAIN)):
        if isinstance(column.type, types):
            return kind
    raise AssertionError(f"how is {column} backed up?")


# ---- writing -----------------------------------------------------------------------------------------------------


def write(file: IO[bytes], connection: Connection, code: str, told: Callable[[str], None]) -> Manifest:
    """Write all tables into an empty file that can be read and sought, from the caller's one transaction.

    Raises:
        Conflict: The tables are of another version of the code.
    """
    schema = revision_of(connection)
    if schema != revisions()[0]:
        raise Conflict("The tables are of another version; run `skills migrate`, or back up with the code they are of.")
    created_at = rfc3339(now()) or ""
    with ZipFile(file, "w", ZIP_STORED) as archive:
        dumped = []
        for table in tables():
            told(table.name)
            dumped.append(_write_table(archive, connection, table))
        manifest = Manifest(FORMAT, code, schema, connection.dialect.name, created_at, dumped)
        archive.writestr(MANIFEST, json.dumps(asdict(manifest), indent=1))
        archive.comment = b"0" * SEAL_BYTES
    file.seek(-SEAL_BYTES, io.SEEK_END)
    end = file.tell()
    seal = _digest(file, end)
    file.seek(end)
    file.write(seal.encode())
    return manifest


def _write_table(archive: ZipFile, connection: Connection, table: Table) -> Dumped:
    columns = [[column.name, kind_of(column)] for column in table.columns]
    counter = table.autoincrement_column
    last = 0 if counter is None else _last_number(connection, table.name, counter.name)
    raw = Dumped(table.name, columns, 0, "", None if counter is None else counter.name, last)
    holds_bytes = any(kind == "bytes" for _, kind in columns)
    query = select(raw.table).order_by(*(raw.table.c[key.name] for key in table.primary_key))
    query = query.execution_options(yield_per=ROWS_WITH_BYTES_AT_ONCE if holds_bytes else ROWS_AT_ONCE)
    seen, rows = hashlib.sha256(), 0
    with archive.open(raw.member, "w", force_zip64=True) as out:
        for row in connection.execute(query):
            for piece in _lay_out(row, columns):
                seen.update(piece)
                out.write(piece)
            rows += 1
    return Dumped(raw.name, raw.columns, rows, seen.hexdigest(), raw.counter, last)


def _lay_out(row: Sequence[Any], columns: list[list[str]]) -> Iterator[bytes]:
    line: list[Any] = []
    behind: list[bytes] = []
    for value, (_, kind) in zip(row, columns, strict=True):
        if value is None:
            line.append(None)
        elif kind == "bytes":
            line.append(len(value))
            behind.append(value)
        else:
            line.append(value.isoformat() if kind == "moment" else value)
    yield json.dumps(line, separators=(",", ":")).encode() + b"\n"
    yield from behind


# ---- reading -----------------------------------------------------------------------------------------------------


def check(file: IO[bytes]) -> Manifest:
    """Check every byte of a backup, and read its manifest.

    Raises:
        UnknownFormat: It is no backup, or one of another format.
        Corrupt: Something of it is damaged or missing; the message names it.
        Conflict: It was written by a newer version of the code.
    """
    if file.read(4) != b"PK\x03\x04":
        raise UnknownFormat("This is no backup of suture-skills.")
    end = file.seek(0, io.SEEK_END) - SEAL_BYTES
    if end < 0 or _digest(file, end) != file.read(SEAL_BYTES).decode("ascii", "replace"):
        raise Corrupt(f"The backup is damaged: {_damage(file)}. Nothing of it is used; take another one.")
    try:
        with ZipFile(file) as archive:
            manifest = _manifest(archive)
    except (KeyError, TypeError, ValueError) as error:
        raise UnknownFormat("This zip file is no backup of suture-skills that this version reads.") from error
    if manifest.schema not in revisions():
        raise Conflict(f"The backup was written by a newer version ({manifest.code}); restore it with that one.")
    return manifest


def load(file: IO[bytes], manifest: Manifest, connection: Connection, told: Callable[[str], None]) -> None:
    """Make the tables, fill them as they were, and bring them to this version, in the caller's transaction."""
    upgrade(connection, manifest.schema)
    with ZipFile(file) as archive:
        for dumped in manifest.tables:
            told(dumped.name)
            with archive.open(dumped.member) as member:
                for batch in _batches(io.BufferedReader(member, PIECE_BYTES), dumped):  # type: ignore[type-var]
                    connection.execute(insert(dumped.table), batch)
            if dumped.counter is not None and dumped.last:
                _count_on_from(connection, dumped.name, dumped.counter, dumped.last)
    upgrade(connection)


def _batches(file: IO[bytes], dumped: Dumped) -> Iterator[list[dict[str, Any]]]:
    batch: list[dict[str, Any]] = []
    held = 0
    for line in iter(file.readline, b""):
        row = {}
        for value, (name, kind) in zip(json.loads(line), dumped.columns, strict=True):
            if value is not None and kind == "bytes":
                held += value
                value = file.read(value)
            elif value is not None and kind == "moment":
                value = datetime.fromisoformat(value)
            row[name] = value
        batch.append(row)
        if len(batch) == ROWS_AT_ONCE or held > ROWS_WITH_BYTES_AT_ONCE * PIECE_BYTES:
            yield batch
            batch, held = [], 0
    if batch:
        yield batch


def _manifest(archive: ZipFile) -> Manifest:
    said = json.loads(archive.read(MANIFEST))
    if said["format"] != FORMAT:
        raise ValueError(said["format"])
    return Manifest(**said | {"tables": [Dumped(**one) for one in said["tables"]]})


def _damage(file: IO[bytes]) -> str:
    """Name what is damaged in a file that is known to be."""
    try:
        archive = ZipFile(file)
    except Exception:  # whatever a damaged zip makes of the reader
        return CUT_OFF
    with archive:
        if MANIFEST not in archive.namelist():  # it was written last; a packed value's own end was taken for the file's
            return CUT_OFF
        try:
            manifest = _manifest(archive)
        except Exception:
            return f"{MANIFEST} is damaged"
        for dumped in manifest.tables:
            if dumped.member not in archive.namelist():
                return f"{dumped.member} is missing"
            try:
                with archive.open(dumped.member) as member:
                    same = hashlib.file_digest(member, "sha256").hexdigest() == dumped.sha256  # type: ignore[arg-type]
            except Exception:
                same = False
            if not same:
                return f"{dumped.member} is damaged"
    return "its parts are whole, its directory or its last bytes are not"


def _digest(file: IO[bytes], end: int) -> str:
    """Digest a file from its beginning to a place, and stay there."""
    file.seek(0)
    seen = hashlib.sha256()
    while piece := file.read(min(PIECE_BYTES, end - file.tell())):
        seen.update(piece)
    return seen.hexdigest()


# ---- the numbers of rows, which are never used twice -------------------------------------------------------------


def _last_number(connection: Connection, table: str, column: str) -> int:
    query = {
        "sqlite": "SELECT seq FROM sqlite_sequence WHERE name = :table",
        "postgresql": "SELECT pg_sequence_last_value(CAST(pg_get_serial_sequence(:table, :column) AS regclass))",
    }[connection.dialect.name]
    return connection.scalar(text(query), {"table": table, "column": column}) or 0


def _count_on_from(connection: Connection, table: str, column: str, last: int) -> None:
    statements = {
        "sqlite": (
            "DELETE FROM sqlite_sequence WHERE name = :table",
            "INSERT INTO sqlite_sequence (name, seq) VALUES (:table, :last)",
        ),
        "postgresql": ("SELECT setval(CAST(pg_get_serial_sequence(:table, :column) AS regclass), :last)",),
    }[connection.dialect.name]
    for statement in statements:
        connection.execute(text(statement), {"table": table, "column": column, "last": last})
