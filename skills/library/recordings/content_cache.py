"""The parsed content of recordings, cached.

    ParsedContent --entry_of--> Entry --put_entry--> rows --cached_content--> ParsedContent

Decoding a bag takes up to a second of processor time per MiB, reading the entry of its content takes a millisecond. The
bytes remain the truth: an entry is used only if `READER_VERSION`, the reading parameters and its SHA-256 agree, and its
values pass the checks of their constructors again. Any other is decoded again and replaced, so a row may be missing,
outdated or deleted at any time. `skills verify` compares entries with their recordings decoded again.

The entry of a recording is visible and erased with it. Backups leave entries out: they are computed from the bytes.
"""

import hashlib
import io
import logging
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Protocol

import numpy as np
from sqlalchemy import delete, insert, select, update
from sqlalchemy.orm import Session

from skills import packing
from skills.db.models import AT_ONCE_BYTES, CHUNK_BYTES, ParsedChunk, ParsedRecording, StoredRecording
from skills.db.row_visibility import ALL_ROWS
from skills.db.session import Database
from skills.errors import Busy, Corrupt
from skills.formats.parsed import ParsedContent
from skills.formats.reader_process import KNOWN, READER_VERSION
from skills.library.operation import locks
from skills.packing import canonical
from skills.schemas.recordings import TableIn

UNFINISHED = 0  # version of an entry whose chunks are not all stored
# Ours: a larger entry is not stored, so that uploads which compress well cannot fill the disk. Entries of bags, tables
# and JIGSAWS take 0.1 to 1.1 times the bytes of their files, those of parquet files in single precision 1.6 times.
MOST_SHARE = 4
LEAST_BYTES = 256 << 10  # ours: the limit for the smallest files, whose names weigh more than their numbers
TOLERANCE = 1e-6  # ours, in mm, rad and s: another build of numpy may round differently

log = logging.getLogger(__name__)


class Source(Protocol):
    """A recording's bytes: an upload, or a row."""

    @property
    def sha256(self) -> str:
        """The SHA-256 of the bytes."""

    @property
    def size_bytes(self) -> int:
        """Their number."""

    @property
    def reading(self) -> TableIn:
        """The reading parameters."""


@dataclass(frozen=True, eq=False)
class Entry:
    """The content of a recording, serialised: columns of `ParsedRecording`, and the data of its chunks."""

    reading: str
    sha256: str
    data: memoryview

    @property
    def is_large(self) -> bool:
        """True if it takes more than one transaction to store it."""
        return len(self.data) > AT_ONCE_BYTES

    def chunks(self, start: int) -> Iterator[tuple[int, bytes]]:
        """Yield `AT_ONCE_BYTES` of chunks from a byte on, with their numbers."""
        for at in range(start, min(start + AT_ONCE_BYTES, len(self.data)), CHUNK_BYTES):
            yield at // CHUNK_BYTES, bytes(self.data[at : at + CHUNK_BYTES])


def entry_of(source: Source, parsed: ParsedContent) -> Entry | None:
    """Serialise the content of a recording, before any transaction; None if it takes too many bytes to be stored."""
    out = io.BytesIO()
    packing.write(out, parsed, KNOWN)
    data = out.getbuffer()
    if len(data) > max(LEAST_BYTES, MOST_SHARE * source.size_bytes):
        return None
    parameters = _digest_of(source.reading)
    return Entry(parameters, _seal(source.sha256, parameters, data), data)


def put_entry(session: Session, recording_row: int, entry: Entry) -> None:
    """Store the entry of a recording, unless it is large, in place of any other."""
    _replace(session, recording_row, entry, READER_VERSION)
    _add_missing(session, recording_row, entry, 0)


def _replace(session: Session, recording_row: int, entry: Entry, version: int) -> None:
    # Both, because the sqlite3 program deletes an entry without its chunks.
    for table in (ParsedChunk, ParsedRecording):
        session.execute(delete(table).where(table.recording_row == recording_row))
    about = {"version": version, "reading": entry.reading, "sha256": entry.sha256}
    session.execute(insert(ParsedRecording), {"recording_row": recording_row, **about})


def cache_content(database: Database, stored: StoredRecording, entry: Entry, *, damaged: bool = False) -> None:
    """Store the entry of a stored recording, unless one that is not `damaged` is there, or the recording was erased.

    A large one is stored in several short transactions; its row gets its version in the last. Two callers may write the
    same content at once: each adds the chunks that are missing.
    """
    names = [locks.recording(stored.sha256)]
    mine = (ParsedRecording.recording_row == stored.row, ParsedRecording.sha256 == entry.sha256)
    try:
        with database.writing(names) as session:
            if session.get(StoredRecording, stored.row) is None:
                return
            if not entry.is_large:
                put_entry(session, stored.row, entry)
                return
            if not damaged and is_cached(session, stored):
                return
            if damaged or session.scalar(select(ParsedRecording.recording_row).where(*mine)) is None:
                _replace(session, stored.row, entry, UNFINISHED)
        for start in range(0, len(entry.data), AT_ONCE_BYTES):
            with database.writing(names) as session:
                if session.scalar(select(ParsedRecording.recording_row).where(*mine)) is None:
                    return
                _add_missing(session, stored.row, entry, start)
        with database.writing(names) as session:
            session.execute(update(ParsedRecording).where(*mine).values(version=READER_VERSION))
    except Busy as error:  # the caller has the content; the next use decodes the bytes again
        log.info("recordings %d: it was read, but could not be cached (%s).", stored.row, type(error).__name__)


def _add_missing(session: Session, recording_row: int, entry: Entry, start: int) -> None:
    """Add the chunks of an entry from one byte on, `AT_ONCE_BYTES` of them, that are not stored yet."""
    of = ParsedChunk
    known = select(of.number).where(of.recording_row == recording_row, of.number >= start // CHUNK_BYTES)
    there = set(session.scalars(known))
    for number, piece in entry.chunks(start):
        if number not in there:
            session.execute(insert(of), {"recording_row": recording_row, "number": number, "data": piece})


def is_cached(session: Session, stored: StoredRecording) -> bool:
    """Return whether a recording has an entry of this version and of its reading parameters."""
    row = session.get(ParsedRecording, stored.row, execution_options=ALL_ROWS)
    return row is not None and (row.version, row.reading) == (READER_VERSION, _digest_of(stored.reading))


def cached_content(session: Session, stored: StoredRecording) -> ParsedContent | None:
    """Return the content of a recording from its entry; None if there is none that may be used."""
    if not is_cached(session, stored):
        return None
    try:
        return read_entry(session, stored)
    except Corrupt as error:
        log.warning("parsed_recordings %d: %s", stored.row, error.message)
        return None


def read_entry(session: Session, stored: StoredRecording) -> ParsedContent:
    """Return the content of a recording from its entry, of this version.

    Raises:
        Corrupt: The entry does not match its digest, or is not one that this version wrote.
    """
    row = session.get_one(ParsedRecording, stored.row)
    query = select(ParsedChunk.data).where(ParsedChunk.recording_row == stored.row).order_by(ParsedChunk.number)
    data = b"".join(session.scalars(query.execution_options(yield_per=1)))
    if _seal(stored.sha256, row.reading, data) != row.sha256:
        raise Corrupt("The entry does not match its digest and is not used; the recording's bytes are decoded instead.")
    try:
        parsed = packing.read(io.BytesIO(data), KNOWN)
        if not isinstance(parsed, ParsedContent):
            raise TypeError(type(parsed).__name__)
    except Exception as error:  # of any class: its values are refused, or their form is unknown
        raise Corrupt("The entry cannot be read and is not used; the recording's bytes are decoded instead.") from error
    return parsed


def alike(one: Any, other: Any) -> bool:
    """Return whether two values are equal, their floating-point numbers within `TOLERANCE`."""
    if type(one) is not type(other):
        return False
    if is_dataclass(one):
        return all(alike(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, np.ndarray):
        same_kind = (one.shape, one.dtype) == (other.shape, other.dtype)
        return same_kind and bool((np.abs(one - other) <= TOLERANCE).all())
    return bool(abs(one - other) <= TOLERANCE) if isinstance(one, float) else bool(one == other)


def _digest_of(reading: TableIn) -> str:
    return packing.sha256(canonical(reading.model_dump()))


def _seal(recording_sha256: str, parameters: str, data: bytes | memoryview) -> str:
    """Return the digest of an entry with the recording to which it belongs: moved to another one, it does not match."""
    hasher = hashlib.sha256(canonical([recording_sha256, parameters, READER_VERSION]))
    hasher.update(data)
    return hasher.hexdigest()
