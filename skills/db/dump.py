"""Backups: every table of ours in one zip file, in the same format for SQLite and PostgreSQL.

    manifest.json        the format, the schema's revision, and for every table its columns, number of rows and SHA-256
    surgeons.rows, ...   a line of JSON for each row; for a column of bytes the line has their number, and the bytes
                         follow the line
    the last 64 bytes    (the zip's comment) the SHA-256 of all bytes before them, in hex

Rows are in the order of their keys, and tables after those that they refer to. Nothing is compressed, because most of
the data is already. Reading and writing hold a few MiB in memory at a time.
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from typing import IO, Any, Final, Literal
from zipfile import ZIP_STORED, ZipFile

from pydantic import BaseModel
from sqlalchemy import Connection, Table, insert, select, text

from skills.db import Base, now, rfc3339
from skills.db.logged_rows import kind_of, raw_table
from skills.db.models import ParsedChunk, ParsedRecording
from skills.db.revisions import revision_of, revisions, upgrade
from skills.db.service_tables import Executor, SignIn
from skills.db.tiles import Tile
from skills.errors import Conflict, Corrupt, UnknownFormat
from skills.remedies import Action, Remedy

FORMAT: Final = "suture-skills backup 1"
MANIFEST = "manifest.json"
SEAL_BYTES = 64
CUT_OFF = "its end is missing or damaged, as in a truncated file"
PIECE_BYTES = 1 << 20
LEFT_OUT = {
    *(Executor.__tablename__, SignIn.__tablename__),  # running workers and browser sessions: gone after a restore
    Tile.__tablename__,  # computed again from the leaves of the history
    *(ParsedRecording.__tablename__, ParsedChunk.__tablename__),  # a cache: decoded again from the recordings' bytes
}
ROWS_AT_ONCE = 500
ROWS_WITH_BYTES_AT_ONCE = 8  # a recording's chunk has 1 MiB


class Dumped(BaseModel):
    """The manifest's entry of a table; `counter` is its autoincrement column, `last` the highest number ever used."""

    name: str
    columns: list[tuple[str, str]]  # name and kind of each
    rows: int
    sha256: str
    counter: str | None
    last: int


class Manifest(BaseModel):
    """The contents of manifest.json."""

    format: Literal["suture-skills backup 1"] = FORMAT
    code: str
    revision: str  # of the schema
    database: str
    created_at: str
    tables: list[Dumped]


def member_of(table: str) -> str:
    """Return the name of a table's file in the archive."""
    return f"{table}.rows"


def tables() -> list[Table]:
    """Return the tables that are backed up, each after those that it refers to."""
    return [table for table in Base.metadata.sorted_tables if table.name not in LEFT_OUT]


# ---- writing -----------------------------------------------------------------------------------------------------


def write(file: IO[bytes], connection: Connection, code: str, progress: Callable[[str], None]) -> Manifest:
    """Write all tables into an empty file, from the caller's single transaction.

    Args:
        file: Empty; readable and seekable, because the digest is computed from it at the end.
        connection: In the transaction whose state is backed up.
        code: Version of the code, for the manifest.
        progress: Progress callback, called with the name of each table.

    Raises:
        Conflict: The tables are of another version of the code.
    """
    schema = revision_of(connection)
    if schema != revisions()[0]:
        raise Conflict(
            "The tables are of another version; back up with the code of that version.", Remedy(Action.MIGRATE)
        )
    with ZipFile(file, "w", ZIP_STORED) as archive:
        dumped = []
        for table in tables():
            progress(table.name)
            dumped.append(_write_table(archive, connection, table))
        database = connection.dialect.name
        manifest = Manifest(
            code=code, revision=schema, database=database, created_at=rfc3339(now()) or "", tables=dumped
        )
        archive.writestr(MANIFEST, manifest.model_dump_json(indent=1))
        archive.comment = b"0" * SEAL_BYTES  # replaced below: the digest covers the finished archive
    file.seek(-SEAL_BYTES, io.SEEK_END)
    end = file.tell()
    seal = _digest(file, end)
    file.seek(end)
    file.write(seal.encode())
    return manifest


def _write_table(archive: ZipFile, connection: Connection, table: Table) -> Dumped:
    columns = [(column.name, kind_of(column)) for column in table.columns]
    counter = None if (column := table.autoincrement_column) is None else column.name
    last = 0 if counter is None else _last_number(connection, table.name, counter)
    raw, holds_bytes = raw_table(table.name, columns), any(kind == "bytes" for _, kind in columns)
    query = select(raw).order_by(*(raw.c[key.name] for key in table.primary_key))
    query = query.execution_options(yield_per=ROWS_WITH_BYTES_AT_ONCE if holds_bytes else ROWS_AT_ONCE)
    hasher, rows = hashlib.sha256(), 0
    with archive.open(member_of(table.name), "w", force_zip64=True) as out:
        for row in connection.execute(query):
            for piece in _lay_out(row, columns):
                hasher.update(piece)
                out.write(piece)
            rows += 1
    return Dumped(name=table.name, columns=columns, rows=rows, sha256=hasher.hexdigest(), counter=counter, last=last)


def _lay_out(row: Sequence[Any], columns: Sequence[tuple[str, str]]) -> Iterator[bytes]:
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
    """Verify every byte of a backup, and return its manifest.

    Raises:
        UnknownFormat: It is not a backup, or one of another format.
        Corrupt: A part is damaged or missing; the message names it.
        Conflict: It was written by a newer version of the code.
    """
    if file.read(4) != b"PK\x03\x04":
        raise UnknownFormat("This is not a backup of suture-skills.", "Name a file that was written as a backup.")
    end = file.seek(0, io.SEEK_END) - SEAL_BYTES
    if end < 0 or _digest(file, end) != file.read(SEAL_BYTES).decode("ascii", "replace"):
        raise Corrupt(f"The backup is damaged: {_damage(file)}. Nothing of it was restored; use another one.")
    try:
        with ZipFile(file) as archive:
            manifest = _manifest(archive)
    except (KeyError, ValueError) as error:
        raise UnknownFormat("This zip file is not a backup of suture-skills that this version can read.") from error
    if manifest.revision not in revisions():
        raise Conflict(
            f"The backup was written by another version ({manifest.code}, its tables are at {manifest.revision}); "
            "restore it with that one."
        )
    return manifest


def load(file: IO[bytes], manifest: Manifest, connection: Connection, progress: Callable[[str], None]) -> None:
    """Create the tables, insert the rows of a backup, and migrate them to this version, in the caller's transaction.

    Args:
        file: The backup.
        manifest: Its manifest, from `check`.
        connection: In the transaction; the database is empty.
        progress: Progress callback, called with the name of each table.
    """
    upgrade(connection, manifest.revision)
    with ZipFile(file) as archive:
        for dumped in manifest.tables:
            progress(dumped.name)
            with archive.open(member_of(dumped.name)) as member:
                for batch in _batches(io.BufferedReader(member, PIECE_BYTES), dumped):  # type: ignore[type-var]
                    connection.execute(insert(raw_table(dumped.name, dumped.columns)), batch)
            if dumped.counter is not None and dumped.last:
                _count_on_from(connection, dumped.name, dumped.counter, dumped.last)
    upgrade(connection)


def _batches(file: IO[bytes], dumped: Dumped) -> Iterator[list[dict[str, object]]]:
    batch: list[dict[str, object]] = []
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
    return Manifest.model_validate_json(archive.read(MANIFEST))


def _damage(file: IO[bytes]) -> str:
    """Return which part of a damaged file is damaged, in words."""
    try:
        archive = ZipFile(file)
    except Exception:  # a damaged zip makes the reader raise anything
        return CUT_OFF
    with archive:
        if MANIFEST not in archive.namelist():  # written last: a value's end was mistaken for the zip's
            return CUT_OFF
        try:
            manifest = _manifest(archive)
        except Exception:
            return f"{MANIFEST} is damaged"
        for dumped in manifest.tables:
            if member_of(dumped.name) not in archive.namelist():
                return f"{member_of(dumped.name)} is missing"
            try:
                with archive.open(member_of(dumped.name)) as member:
                    same = hashlib.file_digest(member, "sha256").hexdigest() == dumped.sha256  # type: ignore[arg-type]
            except Exception:
                same = False
            if not same:
                return f"{member_of(dumped.name)} is damaged"
    return "its members are intact, its directory or its last bytes are damaged"


def _digest(file: IO[bytes], end: int) -> str:
    """Return the SHA-256 of the file's first `end` bytes; the position is `end` afterwards."""
    file.seek(0)
    hasher = hashlib.sha256()
    while piece := file.read(min(PIECE_BYTES, end - file.tell())):
        hasher.update(piece)
    return hasher.hexdigest()


# ---- row numbers, which are never reused ------------------------------------------------------------------------


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
