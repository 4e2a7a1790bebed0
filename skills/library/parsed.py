"""Parsed recordings: the content of stored recordings as it was read, cached beside their bytes.

    Told --entry_of--> Entry --put--> rows --find--> Told

Decoding a bag takes up to a second of processor time per MiB, reading its entry takes a millisecond. The bytes remain
the truth: an entry is used only if `READER_VERSION`, the reading parameters and its SHA-256 agree, and its values pass
the checks of their constructors again. Any other is decoded again and replaced, so a row may be missing, outdated or
deleted at any time. `skills verify` compares entries with their recordings decoded again.

The entry of a recording is visible and erased with it. Backups leave entries out: they are computed from the bytes.
"""

import hashlib
import io
import logging
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from skills import packing
from skills.db.models import ParsedChunk, ParsedRecording, StoredRecording
from skills.db.packed import load_arrays
from skills.db.row_visibility import EVERYBODYS
from skills.errors import Corrupt
from skills.formats.reader_process import KNOWN, READER_VERSION, Told
from skills.packing import canonical

CHUNK_BYTES = 1 << 20
# Ours: a larger entry is not kept, so that uploads which compress well cannot fill the disk. Entries of bags, tables
# and JIGSAWS take 0.1 to 1.1 times the bytes of their files, those of parquet files in single precision 1.6 times.
MOST_SHARE = 4
LEAST_BYTES = 256 << 10  # ours: the limit for the smallest files, whose names weigh more than their numbers
TOLERANCE = 1e-6  # ours, in mm, rad and s: another build of numpy may round differently

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Entry:
    """The content of a recording, serialised: columns of `ParsedRecording`, and the data of its chunks."""

    reading: str
    sha256: str
    data: memoryview


def entry_of(recording_sha256: str, size_bytes: int, reading: dict[str, Any], told: Told) -> Entry | None:
    """Serialise the content of a recording; None if it takes more bytes than are kept of one.

    It is called before the transaction, for which others wait.

    Args:
        recording_sha256: The SHA-256 of the recording's bytes.
        size_bytes: Their number.
        reading: The reading parameters.
        told: What was read.
    """
    out = io.BytesIO()
    packing.write(out, told, KNOWN)
    data = out.getbuffer()
    if len(data) > max(LEAST_BYTES, MOST_SHARE * size_bytes):
        return None
    parameters = _digest_of(reading)
    return Entry(parameters, _seal(recording_sha256, parameters, data), data)


def put(session: Session, recording_row: int, entry: Entry) -> None:
    """Store the entry of a recording, in place of any other."""
    session.execute(delete(ParsedRecording).where(ParsedRecording.recording_row == recording_row))
    kept = {"version": READER_VERSION, "reading": entry.reading, "sha256": entry.sha256}
    session.add(ParsedRecording(recording_row=recording_row, **kept))
    session.flush()
    for number, start in enumerate(range(0, len(entry.data), CHUNK_BYTES)):
        piece = bytes(entry.data[start : start + CHUNK_BYTES])
        session.add(ParsedChunk(recording_row=recording_row, number=number, data=piece))
        session.flush()


def is_current(session: Session, stored: StoredRecording) -> bool:
    """Return whether a recording has an entry of this version and of its reading parameters."""
    row = session.get(ParsedRecording, stored.row, execution_options=EVERYBODYS)
    return row is not None and (row.version, row.reading) == (READER_VERSION, _digest_of(stored.reading))


def find(session: Session, stored: StoredRecording) -> Told | None:
    """Return the content of a recording from its entry; None if there is none that may be used."""
    if not is_current(session, stored):
        return None
    try:
        return read_entry(session, stored)
    except Corrupt as error:
        log.warning("parsed_recordings %d: %s", stored.row, error.message)
        return None


def read_entry(session: Session, stored: StoredRecording) -> Told:
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
        told = packing.assemble(load_arrays(data), KNOWN)
        if not isinstance(told, Told):
            raise TypeError(type(told).__name__)
    except Exception as error:  # of any class: its values are refused, or their form is unknown
        raise Corrupt("The entry cannot be read and is not used; the recording's bytes are decoded instead.") from error
    return told


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


def _digest_of(reading: dict[str, Any]) -> str:
    return packing.sha256(canonical(reading))


def _seal(recording_sha256: str, parameters: str, data: bytes | memoryview) -> str:
    """Return the digest of an entry with the recording to which it belongs: moved to another one, it does not match."""
    seen = hashlib.sha256(canonical([recording_sha256, parameters, READER_VERSION]))
    seen.update(data)
    return seen.hexdigest()
