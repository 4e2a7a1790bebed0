"""Recordings: raw files, read and checked before any transaction, stored in chunks of 1 MiB; and their content, cached.

    file --Upload--> read_upload, tell_upload --keep--> StoredRecording, chunks --stored_recording--> ParsedContent
    ParsedContent --entry_of--> Entry --put_entry--> rows --cached_content--> ParsedContent

Decoding a bag takes up to a second of processor time per MiB, reading the entry of its content takes a millisecond. The
bytes remain the truth: an entry is used only if `READER_VERSION`, the reading parameters and its SHA-256 agree, and its
values pass the checks of their constructors again. Any other is decoded again and replaced, so a row may be missing,
outdated or deleted at any time. `skills verify` compares entries with their recordings decoded again.

The entry of a recording is visible and erased with it. Backups leave entries out: they are computed from the bytes.
"""

import base64
import hashlib
import io
import logging
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from datetime import timedelta
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from sqlalchemy import delete, select, text, update
from sqlalchemy.orm import Session

from skills import packing
from skills.db import now, rfc3339
from skills.db.models import (
    LooseChunks,
    ParsedChunk,
    ParsedRecording,
    RecordingChunk,
    RecordingSurgeon,
    RecordingUpload,
    StoredRecording,
)
from skills.db.row_visibility import ALL_ROWS
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.demonstration.recording import Recording
from skills.errors import BadInput, Busy, Conflict, Corrupt, UnknownFormat, UnreadableRecording
from skills.fields import as_json
from skills.formats import MEDIA_TYPES, media_type_of, read_recording
from skills.formats.parsed import ParsedContent, parse_recording
from skills.formats.reader_process import KNOWN, READER_VERSION, ConfinedReader
from skills.library.operation import locks
from skills.library.operation.integrity import find_by_digest
from skills.library.people.catalogue import find_surgeon
from skills.packing import canonical
from skills.remedies import Action, Remedy
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import refuse_uncontained
from skills.schemas.recordings import Reading
from skills.settings import Settings

Reader = Callable[..., Recording]  # `read_recording`, or a callable that runs it in another process
Teller = Callable[..., ParsedContent]  # `parse_recording`, or a callable that runs it in another process
BAGS = ("mcap", "rosbag1", "rosbag2")  # formats with checksums; text files have none

CHUNK_BYTES = 1 << 20
# Ours: that many bytes are stored in one transaction, for which others wait: on SQLite some 40 ms.
AT_ONCE_BYTES = 4 * CHUNK_BYTES
DUE_S = 3600.0  # ours: an upload under way stores its next piece within seconds
UNFINISHED = 0  # version of an entry whose chunks are not all stored
# Ours: a larger entry is not kept, so that uploads which compress well cannot fill the disk. Entries of bags, tables
# and JIGSAWS take 0.1 to 1.1 times the bytes of their files, those of parquet files in single precision 1.6 times.
MOST_SHARE = 4
LEAST_BYTES = 256 << 10  # ours: the limit for the smallest files, whose names weigh more than their numbers
TOLERANCE = 1e-6  # ours, in mm, rad and s: another build of numpy may round differently

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Upload:
    """An upload, spooled to a file: its SHA-256, and the reading parameters that the format itself does not contain."""

    file: BinaryIO
    sha256: str
    size_bytes: int
    media_type: str
    vouched: bool = False  # the client sent a Content-Digest, and it matches the bytes
    reading: dict[str, Any] = field(default_factory=lambda: Reading().said)

    def read_as(self, reading: dict[str, Any]) -> "Upload":
        """Return the upload with the reader's arguments."""
        return replace(self, reading=reading)


@dataclass(frozen=True, eq=False)
class Entry:
    """The content of a recording, serialised: columns of `ParsedRecording`, and the data of its chunks."""

    reading: str
    sha256: str
    data: memoryview


def check_digest(header: str | None, of_bytes: str) -> bool:
    """Compare a `Content-Digest` (RFC 9530) with the SHA-256 of the bytes, in hex; return whether one was given.

    Raises:
        UnreadableRecording: It is the digest of other bytes.
        BadInput: It has no SHA-256.
    """
    if header is None:
        return False
    for part in header.split(","):
        name, _, value = part.strip().partition("=")
        if name != "sha-256":
            continue
        wanted = base64.b64encode(bytes.fromhex(of_bytes)).decode()
        if value.strip() != f":{wanted}:":
            raise UnreadableRecording("Content-Digest does not match the bytes received; send them again.")
        return True
    raise BadInput("Content-Digest needs sha-256=:BASE64:, the SHA-256 of the body.")


def read_upload(upload: Upload, read: Reader = read_recording) -> Recording:
    """Read and check a recording.

    Raises:
        BadRecording: It cannot be used, or it has no checksum that would reveal damage.
        UnknownFormat: Its content is not of the media type of the request.
    """
    _check_type(upload)
    recording = read(upload.file, **upload.reading)
    _check_vouched(upload, recording)
    return recording


def tell_upload(upload: Upload, tell: Teller = parse_recording) -> ParsedContent:
    """Read and check a recording, and derive the proposed hand-offs and its description; it raises as `read_upload`."""
    _check_type(upload)
    told = tell(upload.file, **upload.reading)
    _check_vouched(upload, told.recording)
    return told


def _check_type(upload: Upload) -> None:
    right = media_type_of(upload.file)
    if right != upload.media_type:
        raise UnknownFormat(
            f"The content is {MEDIA_TYPES[right]}, which does not match Content-Type; send it as {right}."
        )


def _check_vouched(upload: Upload, recording: Recording) -> None:
    if recording.format in BAGS and recording.integrity == "none" and not upload.vouched:
        raise UnreadableRecording(
            f"The content is {MEDIA_TYPES[upload.media_type]} without checksums, so damage could not be detected; "
            "send it with a Content-Digest header (sha-256=:BASE64:), or record it as MCAP with CRCs."
        )


def store_recording(
    database: Database, upload: Upload, actor: str, read: Teller = parse_recording, surgeon: str | None = None
) -> tuple[StoredRecording, bool]:
    """Store a recording once, under a surgeon if one is named; return the row, and whether it is new."""
    if surgeon is not None:
        with database.reading() as session:  # fails early, before the long reading; looked up again when writing
            find_surgeon(session, surgeon)
    told = tell_upload(upload, read)
    entry = entry_of(upload, told)
    names = [] if surgeon is None else [locks.surgeon(surgeon)]
    ahead = send_ahead(database, upload)
    with database.writing([locks.recording(upload.sha256), *names]) as session:
        stored, new = keep(session, upload, told, entry, actor, ahead)
        if surgeon is not None:
            session.merge(RecordingSurgeon(recording_row=stored.row, surgeon_row=find_surgeon(session, surgeon).row))
    cache_large(database, stored, entry)
    return stored, new


def preview(upload: Upload, read: Teller = parse_recording) -> dict[str, Any]:
    """Return what would be understood of a recording, as JSON; nothing is stored.

    A table without times is counted, one second for each sample, and its durations and rates are null.

    Raises:
        BadRecording, UnknownFormat: As in `read_upload`.
    """
    told = tell_upload(upload, partial(read, untimed=True))
    timed = told.recording.is_timed or upload.reading["rate_hz"] is not None
    about = told.about if timed else _untimed(told.about)
    return {
        "sha256": upload.sha256,
        "size_bytes": upload.size_bytes,
        "media_type": upload.media_type,
        "format": told.recording.format,
        "integrity": "full" if upload.vouched else told.recording.integrity,
        "timed": timed,
        "columns": [as_json(column) for column in told.recording.columns],
        **about,
    }


def _untimed(about: dict[str, Any]) -> dict[str, Any]:
    nothing = {"duration_s": None, "rate_hz": None, "longest_gap_s": None}
    return about | {
        "duration_s": None,
        "quality": [one | nothing for one in about["quality"]],
        "segments": [],
        "counts": about["counts"] | {"segments": 0},
    }


def entry_of(upload: Upload, told: ParsedContent) -> Entry | None:
    """Serialise what was read of an upload for `keep`, before its transaction; None if it is too large to be kept."""
    return packed_content(upload.sha256, upload.size_bytes, upload.reading, told)


def send_ahead(database: Database, upload: Upload) -> int | None:
    """Store the chunks of a large upload before its row, in several short transactions, for which others can wait.

    They belong to nobody until `keep` stores the row; if it does not, they are deleted when they are due
    (`skills.library.operation.sweep`).

    Returns:
        The number of the row to be stored; None if `keep` stores the chunks with the row, because they are few or the
        bytes are stored already.

    Raises:
        Busy: It took longer than `DUE_S`.
    """
    if upload.size_bytes <= AT_ONCE_BYTES:
        return None
    same = select(StoredRecording.row).where(StoredRecording.sha256 == upload.sha256)
    with database.reading() as session:
        if session.scalar(same.execution_options(**ALL_ROWS)) is not None:
            return None
    with database.writing(()) as session:
        row = _reserve(session)
        session.add(LooseChunks(recording_row=row, due_at=now() + timedelta(seconds=DUE_S)))
    upload.file.seek(0)
    number = 0
    while piece := upload.file.read(AT_ONCE_BYTES):
        with database.writing(()) as session:
            _still_loose(session, row)
            number = _add_chunks(session, row, number, piece)
    return row


def _reserve(session: Session) -> int:
    """Return a number that no recording has, had or will get from the database."""
    if session.get_bind().dialect.name == "postgresql":
        return int(session.scalars(text("SELECT nextval(pg_get_serial_sequence('recordings', 'row'))")).one())
    further = "UPDATE sqlite_sequence SET seq = seq + 1 WHERE name = 'recordings' RETURNING seq"
    row = session.scalar(text(further))
    if row is None:  # nothing was ever stored
        session.execute(text("INSERT INTO sqlite_sequence (name, seq) VALUES ('recordings', 0)"))
        row = session.scalar(text(further))
    assert row is not None
    return int(row)


def _still_loose(session: Session, row: int) -> None:
    """Let the chunks of an upload under way be due later.

    Raises:
        Busy: They were due, and are being deleted.
    """
    later = update(LooseChunks).where(LooseChunks.recording_row == row, LooseChunks.due_at > now())
    found = later.values(due_at=now() + timedelta(seconds=DUE_S)).returning(LooseChunks.recording_row)
    if session.execute(found).first() is None:
        raise Busy("The recording took too long to be stored; send it again.")


def _add_chunks(session: Session, row: int, number: int, data: bytes) -> int:
    """Add chunks to a recording; return the number of the next one."""
    for start in range(0, len(data), CHUNK_BYTES):
        session.add(RecordingChunk(recording=row, number=number, data=data[start : start + CHUNK_BYTES]))
        session.flush()
        number += 1
    return number


def keep(
    session: Session, upload: Upload, told: ParsedContent, entry: Entry | None, actor: str, ahead: int | None = None
) -> tuple[StoredRecording, bool]:
    """Write a recording in the caller's transaction, once; return the row, and whether it is new to the actor.

    Bytes that only others have uploaded are reported as new, so that a digest does not reveal their uploads.

    Args:
        session: The caller's transaction.
        upload: The recording's bytes.
        told: What was read of them.
        entry: The same, from `entry_of`; a large one is left to `cache_large`.
        actor: The owner of the caller's key.
        ahead: The number of its row, from `send_ahead`.

    Raises:
        Conflict: The bytes are already stored with other reading parameters.
    """
    same = select(StoredRecording).where(StoredRecording.sha256 == upload.sha256)
    stored = session.scalar(same.execution_options(**ALL_ROWS))
    entry = None if entry is not None and len(entry.data) > AT_ONCE_BYTES else entry
    if stored is not None:
        if ahead is not None:  # another upload of the same bytes was faster
            session.execute(update(LooseChunks).where(LooseChunks.recording_row == ahead).values(due_at=now()))
        if stored.reading != upload.reading:
            if session.get(RecordingUpload, (stored.row, actor)) is None:  # do not reveal another user's parameters
                raise Conflict(
                    "These bytes cannot be stored with these reading parameters; ask the operator of the service."
                )
            before = " and ".join(f"no {name}" if to is None else f"{name} {to}" for name, to in stored.reading.items())
            raise Conflict(
                f"These bytes are stored already, read with {before}; send the same parameters.",
                Remedy(Action.DELETE_FIRST, recording=stored.sha256),
            )
        if entry is not None and not is_cached(session, stored):
            put_entry(session, stored.row, entry)
        return stored, _brought_by(session, stored, actor)
    if ahead is not None:
        _still_loose(session, ahead)
        session.execute(delete(LooseChunks).where(LooseChunks.recording_row == ahead))
    stored = StoredRecording(
        row=ahead,
        sha256=upload.sha256,
        size_bytes=upload.size_bytes,
        media_type=upload.media_type,
        format=told.recording.format,
        integrity="full" if upload.vouched else told.recording.integrity,
        reading=upload.reading,
        about=told.about,
    )
    session.add(stored)
    session.flush()
    if ahead is None:
        upload.file.seek(0)
        number = 0
        # Piece by piece, so that memory stays bounded whatever the size of the recording.
        while data := upload.file.read(AT_ONCE_BYTES):
            number = _add_chunks(session, stored.row, number, data)
    if entry is not None:
        put_entry(session, stored.row, entry)
    return stored, _brought_by(session, stored, actor)


def _brought_by(session: Session, stored: StoredRecording, actor: str) -> bool:
    """Record that an actor uploaded a recording; return whether this is the actor's first upload of it."""
    if session.get(RecordingUpload, (stored.row, actor)) is not None:
        return False
    session.add(RecordingUpload(recording_row=stored.row, actor=actor))
    record_event(session, actor, "add", "recording", stored.sha256)
    session.flush()
    return True


def find_recording(session: Session, recording_sha256: str) -> StoredRecording:
    """Return a recording by the SHA-256 of its bytes."""
    return find_by_digest(session, StoredRecording, recording_sha256, "recording", Remedy(Action.ADD_RECORDING))


def stored_recording(
    database: Database, recording_sha256: str, tell: Teller = parse_recording, *, intact: bool = False
) -> ParsedContent:
    """Return what is read of a stored recording: from the cache, or else decoded again, and cached.

    No transaction is open while it is decoded.

    Args:
        database: The database, restricted to the rows that the caller may see.
        recording_sha256: The SHA-256 of its bytes.
        tell: The reader, possibly in another process.
        intact: Verify the digest of the bytes also where they are not decoded, for a row that will rest on them.

    Raises:
        NotFound: There is no such recording.
        Corrupt: Its bytes were read, and do not match their digest.
        BadRecording: This version does not read it, or not within the limits of the reader.
    """
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            stored = find_recording(session, recording_sha256)
            kept = cached_content(session, stored)
            if kept is not None:
                if intact:
                    deque(recording_bytes(session, stored), maxlen=0)
                return kept
            file.writelines(recording_bytes(session, stored))
        told = tell(file, **stored.reading)
    _remember(database, stored, told)
    return told


def _remember(database: Database, stored: StoredRecording, told: ParsedContent) -> None:
    """Cache what was read of a stored recording, unless the recording was erased meanwhile."""
    entry = packed_content(stored.sha256, stored.size_bytes, stored.reading, told)
    if entry is None:
        return
    if len(entry.data) > AT_ONCE_BYTES:
        cache_large(database, stored, entry)
        return
    try:
        with database.writing([locks.recording(stored.sha256)]) as session:
            if session.get(StoredRecording, stored.row) is not None:
                put_entry(session, stored.row, entry)
    except Busy as error:  # the caller has the recording; the next use decodes it again
        log.info("recordings %d: it was read, but could not be cached (%s).", stored.row, type(error).__name__)


def cache_large(database: Database, stored: StoredRecording, entry: Entry | None) -> None:
    """Cache a large content of a stored recording in several short transactions; its row gets its version in the last.

    Nothing is done for a small content, which `keep` stores, or if the recording is erased meanwhile. Two callers may
    write the same content at once: each adds the chunks that are missing.
    """
    if entry is None or len(entry.data) <= AT_ONCE_BYTES:
        return
    names = [locks.recording(stored.sha256)]
    mine = (ParsedRecording.recording_row == stored.row, ParsedRecording.sha256 == entry.sha256)
    try:
        with database.writing(names) as session:
            if session.get(StoredRecording, stored.row) is None or is_cached(session, stored):
                return
            if session.scalar(select(ParsedRecording.recording_row).where(*mine)) is None:
                session.execute(delete(ParsedRecording).where(ParsedRecording.recording_row == stored.row))
                unfinished = {"version": UNFINISHED, "reading": entry.reading, "sha256": entry.sha256}
                session.add(ParsedRecording(recording_row=stored.row, **unfinished))
        for start in range(0, len(entry.data), AT_ONCE_BYTES):
            with database.writing(names) as session:
                if session.scalar(select(ParsedRecording.recording_row).where(*mine)) is None:
                    return
                _add_missing(session, stored.row, entry, start)
        with database.writing(names) as session:
            session.execute(update(ParsedRecording).where(*mine).values(version=READER_VERSION))
    except Busy as error:
        log.info("recordings %d: it was read, but could not be cached (%s).", stored.row, type(error).__name__)


def _add_missing(session: Session, recording_row: int, entry: Entry, start: int) -> None:
    """Add the chunks of an entry from one byte on, `AT_ONCE_BYTES` of them, that are not stored yet."""
    first, of = start // CHUNK_BYTES, ParsedChunk
    known = select(of.number).where(of.recording_row == recording_row, of.number >= first)
    there = set(session.scalars(known))
    for number in range(first, first + AT_ONCE_BYTES // CHUNK_BYTES):
        piece = bytes(entry.data[number * CHUNK_BYTES : (number + 1) * CHUNK_BYTES])
        if piece and number not in there:
            session.add(ParsedChunk(recording_row=recording_row, number=number, data=piece))
            session.flush()


def recording_bytes(session: Session, stored: StoredRecording) -> Iterator[bytes]:
    """Yield the bytes of a recording chunk by chunk, and verify their SHA-256 at the end.

    For use within the caller's transaction. An HTTP response waits for its client between two chunks and must not hold
    a transaction meanwhile: see `demos.exported_chunk`.

    Raises:
        Corrupt: The digest differs; the last chunk is then withheld.
    """
    seen, held = hashlib.sha256(), b""
    query = select(RecordingChunk.data).where(RecordingChunk.recording == stored.row).order_by(RecordingChunk.number)
    for data in session.scalars(query.execution_options(yield_per=1)):
        # One chunk behind, so that the last one is only yielded after the digest was verified.
        if held:
            yield held
        seen.update(data)
        held = data
    if seen.hexdigest() != stored.sha256:
        raise damaged()
    yield held


def confined_reader(settings: Settings) -> ConfinedReader:
    """Create a reader of recordings in processes of their own, with the resource limits of the settings.

    Raises:
        BadSettings: The settings require containment that this system does not offer.
    """
    if settings.containment == "required":
        refuse_uncontained()
    limits = ProcessLimits(
        memory_bytes=settings.reading_memory_bytes,
        wall_s=settings.reading_wall_s,
        cpu_s=settings.reading_cpu_s,
        file_bytes=settings.reading_file_bytes,
        answer_bytes=settings.reading_answer_bytes,
        threads=False,
    )
    return ConfinedReader(limits, at_once=settings.readers)


def damaged() -> Corrupt:
    """Return the error that the bytes of a stored file do not match its digest."""
    return Corrupt("A stored file does not match its digest; restore it from a backup.")


def recording_json(row: StoredRecording) -> dict[str, Any]:
    """Return a recording's JSON."""
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "size_bytes": row.size_bytes,
        "media_type": row.media_type,
        "format": row.format,
        "integrity": row.integrity,
        **row.about,
        "created_at": rfc3339(row.created_at),
    }


def summary_json(row: StoredRecording, demos: int) -> dict[str, Any]:
    """Return a recording's JSON in a list.

    Args:
        row: The recording.
        demos: Number of its active demonstrations.
    """
    return {
        "id": row.sha256,
        "sha256": row.sha256,
        "size_bytes": row.size_bytes,
        "format": row.format,
        "duration_s": row.about["duration_s"],
        "arms": sorted({motion["arm"] for motion in row.about["motions"]}),
        "segments": len(row.about["segments"]),
        "demos": demos,
        "created_at": rfc3339(row.created_at),
    }


def packed_content(
    recording_sha256: str, size_bytes: int, reading: dict[str, Any], told: ParsedContent
) -> Entry | None:
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


def put_entry(session: Session, recording_row: int, entry: Entry) -> None:
    """Store the entry of a recording, in place of any other."""
    session.execute(delete(ParsedRecording).where(ParsedRecording.recording_row == recording_row))
    kept = {"version": READER_VERSION, "reading": entry.reading, "sha256": entry.sha256}
    session.add(ParsedRecording(recording_row=recording_row, **kept))
    session.flush()
    for number, start in enumerate(range(0, len(entry.data), CHUNK_BYTES)):
        piece = bytes(entry.data[start : start + CHUNK_BYTES])
        session.add(ParsedChunk(recording_row=recording_row, number=number, data=piece))
        session.flush()


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
        told = packing.read(io.BytesIO(data), KNOWN)
        if not isinstance(told, ParsedContent):
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
