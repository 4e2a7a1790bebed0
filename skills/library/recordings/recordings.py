"""Recordings: raw files, read and checked before any transaction, and stored in chunks of 1 MiB.

Upload --read_upload--> ParsedContent --put_recording--> StoredRecording, chunks --stored_recording--> ParsedContent
"""

import base64
import hashlib
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from functools import partial
from typing import BinaryIO, TypeVar, cast

from sqlalchemy import Select, delete, select, text, update
from sqlalchemy.orm import Session

from skills.db import now
from skills.db.models import (
    AT_ONCE_BYTES,
    CHUNK_BYTES,
    LooseChunks,
    RecordingChunk,
    RecordingSurgeon,
    RecordingUpload,
    StoredRecording,
)
from skills.db.row_visibility import ALL_ROWS
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.demonstration.recording import Recording
from skills.errors import BadInput, Busy, Conflict, Corrupt, SkillsError, TooLarge, UnknownFormat, UnreadableRecording
from skills.formats import MEDIA_TYPES, media_type_of
from skills.formats.parsed import ParsedContent, parse_recording
from skills.formats.reader_process import ConfinedReader
from skills.library.operation import locks
from skills.library.operation.integrity import find_by_digest
from skills.library.people.surgeons import find_surgeon
from skills.library.recordings.content_cache import Entry, cache_content, cached_content, entry_of, is_cached, put_entry
from skills.remedies import Action, Remedy
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import refuse_uncontained
from skills.schemas import recordings as described
from skills.schemas.recordings import TableIn
from skills.settings import Settings

Reader = Callable[..., Recording]  # `read_recording`, or a callable that runs it in another process
Parser = Callable[..., ParsedContent]  # `parse_recording`, or a callable that runs it in another process
T = TypeVar("T")
Content = TypeVar("Content", Recording, ParsedContent)
BAGS = ("mcap", "rosbag1", "rosbag2")  # formats with checksums; text files have none

DUE_S = 3600.0  # ours: an upload under way stores its next piece within seconds


class SharedReading:
    """The outcome of the one reading of equal uploads that are handled at once."""

    def __init__(self) -> None:
        self.outcome: tuple[TableIn, Recording | ParsedContent | SkillsError] | None = None

    def read(self, read: Callable[..., Content], file: BinaryIO, reading: TableIn) -> Content:
        """Read a file unless one with its bytes was read with equal parameters; return the content or raise a refusal.

        That the reader is busy is not an outcome: the next upload tries again.
        """
        if self.outcome is None or self.outcome[0] != reading:
            try:
                self.outcome = reading, read(file, **reading.options)
            except (BadInput, UnknownFormat, TooLarge) as refusal:
                self.outcome = reading, refusal
        _, outcome = self.outcome
        if isinstance(outcome, SkillsError):
            raise outcome
        return cast(Content, outcome)


@dataclass(frozen=True)
class Upload:
    """An upload, spooled to a file: its SHA-256, and the reading parameters that the format itself does not contain."""

    file: BinaryIO
    sha256: str
    size_bytes: int
    media_type: str
    vouched: bool = False  # the client sent a Content-Digest, and it matches the bytes
    reading: TableIn = field(default_factory=TableIn)
    shared: SharedReading = field(default_factory=SharedReading, compare=False)

    def read_as(self, stated: TableIn) -> "Upload":
        """Return the upload with the reading parameters of a request, which may state more than these."""
        return replace(self, reading=TableIn(**stated.model_dump(include={*TableIn.model_fields})))


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


def read_upload(upload: Upload, read: Callable[..., Content]) -> Content:
    """Read an upload and check what is known of it.

    Args:
        upload: The recording's bytes.
        read: `read_recording`, `parse_recording`, or a callable that runs one of them in another process.

    Raises:
        BadRecording: It cannot be used, or it has no checksum that would reveal damage.
        UnknownFormat: Its content is not of the media type of the request.
    """
    right = media_type_of(upload.file)
    if right != upload.media_type:
        raise UnknownFormat(
            f"The content is {MEDIA_TYPES[right]}, which does not match Content-Type; send it as {right}."
        )
    found = upload.shared.read(read, upload.file, upload.reading)
    recording = found.recording if isinstance(found, ParsedContent) else found
    if recording.format in BAGS and recording.integrity == "none" and not upload.vouched:
        raise UnreadableRecording(
            f"The content is {MEDIA_TYPES[right]} without checksums, so damage could not be detected; send it with a "
            "Content-Digest header (sha-256=:BASE64:), or record it as MCAP with CRCs."
        )
    return found


def store_recording(
    database: Database, upload: Upload, actor: str, parse: Parser = parse_recording, surgeon: str | None = None
) -> tuple[StoredRecording, bool]:
    """Store a recording once, under a surgeon if one is named; return the row, and whether it is new."""
    if surgeon is not None:
        with database.reading() as session:  # fails early, before the long reading; looked up again when writing
            find_surgeon(session, surgeon)

    def name_surgeon(session: Session, stored: StoredRecording, new: bool) -> tuple[StoredRecording, bool]:
        if surgeon is not None:
            row = find_surgeon(session, surgeon).row
            session.merge(RecordingSurgeon(recording_row=stored.row, surgeon_row=row))
        return stored, new

    names = [] if surgeon is None else [locks.surgeon(surgeon)]
    return store_upload(database, upload, read_upload(upload, parse), actor, names, name_surgeon)


def store_upload(
    database: Database,
    upload: Upload,
    parsed: ParsedContent,
    actor: str,
    names: Sequence[str],
    then: Callable[[Session, StoredRecording, bool], T],
) -> T:
    """Store a recording and cache its content; return the result of `then`, which joins the transaction.

    Args:
        database: The database.
        upload: The recording's bytes.
        parsed: Their content.
        actor: The owner of the caller's key.
        names: Further names that the transaction locks, see `skills.library.operation.locks`.
        then: Called with the transaction, the row, and whether it is new to the actor.

    Raises:
        Conflict: The bytes are already stored with other reading parameters.
    """
    entry = entry_of(upload, parsed)
    ahead = send_ahead(database, upload)
    with database.writing([locks.recording(upload.sha256), *names]) as session:
        stored, new = put_recording(session, upload, parsed, entry, actor, ahead)
        result = then(session, stored, new)
    if entry is not None and entry.is_large:
        cache_content(database, stored, entry)
    return result


def preview(upload: Upload, parse: Parser = parse_recording) -> described.RecordingPreview:
    """Return what would be understood of a recording; nothing is stored.

    A table without times is counted, one second for each sample, and its durations and rates are null.

    Raises:
        BadRecording, UnknownFormat: As in `read_upload`.
    """
    parsed = read_upload(upload, partial(parse, untimed=True))
    content = vars(parsed.about)
    timed = parsed.recording.is_timed or upload.reading.rate_hz is not None
    if not timed:
        quality = [
            described.PreviewedQuality(one.arm, one.topic, None, None, None, one.extent_mm, one.equal_samples)
            for one in parsed.about.quality
        ]
        counts = replace(parsed.about.counts, segments=0)
        content = content | {"duration_s": None, "quality": quality, "segments": [], "counts": counts}
    return described.RecordingPreview(
        sha256=upload.sha256,
        size_bytes=upload.size_bytes,
        media_type=upload.media_type,
        format=parsed.recording.format,
        integrity="full" if upload.vouched else parsed.recording.integrity,
        timed=timed,
        columns=list(parsed.recording.columns),
        **content,
    )


def send_ahead(database: Database, upload: Upload) -> int | None:
    """Store the chunks of a large upload before its row, in several short transactions, between which others can write.

    They belong to nobody until `put_recording` stores the row; if it does not, they are deleted when they are due
    (`skills.library.operation.sweep`).

    Returns:
        The number of the row to be stored; None if `put_recording` stores the chunks with the row, because they are few
        or the bytes are stored already.

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


def put_recording(
    session: Session, upload: Upload, parsed: ParsedContent, entry: Entry | None, actor: str, ahead: int | None = None
) -> tuple[StoredRecording, bool]:
    """Write a recording in the caller's transaction, once; return the row, and whether it is new to the actor.

    Bytes that only others have uploaded are reported as new, so that a digest does not reveal their uploads.

    Args:
        session: The caller's transaction.
        upload: The recording's bytes.
        parsed: Their content.
        entry: The same, from `entry_of`; a large one is left to `cache_content`.
        actor: The owner of the caller's key.
        ahead: The number of its row, from `send_ahead`.

    Raises:
        Conflict: The bytes are already stored with other reading parameters.
    """
    same = select(StoredRecording).where(StoredRecording.sha256 == upload.sha256)
    stored = session.scalar(same.execution_options(**ALL_ROWS))
    entry = None if entry is not None and entry.is_large else entry
    if stored is not None:
        if ahead is not None:  # another upload of the same bytes was faster
            session.execute(update(LooseChunks).where(LooseChunks.recording_row == ahead).values(due_at=now()))
        if stored.reading != upload.reading:
            if session.get(RecordingUpload, (stored.row, actor)) is None:  # do not reveal another user's parameters
                raise Conflict(
                    "These bytes cannot be stored with these reading parameters; ask the operator of the service."
                )
            options = {"rate_hz": None, "frame": None} | stored.reading.options
            before = " and ".join(f"no {name}" if to is None else f"{name} {to}" for name, to in options.items())
            raise Conflict(
                f"These bytes are stored already, read with {before}; send the same parameters.",
                Remedy(Action.DELETE_FIRST, recording=stored.sha256),
            )
        if entry is not None and not is_cached(session, stored):
            put_entry(session, stored.row, entry)
        return stored, _note_upload(session, stored, actor)
    if ahead is not None:
        _still_loose(session, ahead)
        session.execute(delete(LooseChunks).where(LooseChunks.recording_row == ahead))
    stored = StoredRecording(
        row=ahead,
        sha256=upload.sha256,
        size_bytes=upload.size_bytes,
        media_type=upload.media_type,
        format=parsed.recording.format,
        integrity="full" if upload.vouched else parsed.recording.integrity,
        reading=upload.reading,
        about=parsed.about,
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
    return stored, _note_upload(session, stored, actor)


def _note_upload(session: Session, stored: StoredRecording, actor: str) -> bool:
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
    database: Database, recording_sha256: str, parse: Parser = parse_recording, *, intact: bool = False
) -> ParsedContent:
    """Return the content of a stored recording: from the cache, or else decoded again, and cached.

    No transaction is open while it is decoded.

    Args:
        database: The database, restricted to the rows that the caller may see.
        recording_sha256: The SHA-256 of its bytes.
        parse: The reader, possibly in another process.
        intact: Verify the digest of the bytes also where they are not decoded, for a row that will rest on them.

    Raises:
        NotFound: There is no such recording.
        Corrupt: Its bytes were read, and do not match their digest.
        BadRecording: This version does not read it, or not within the limits of the reader.
    """
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            stored = find_recording(session, recording_sha256)
            cached = cached_content(session, stored)
            if cached is not None:
                if intact:
                    deque(recording_bytes(session, stored), maxlen=0)
                return cached
            damaged = is_cached(session, stored)
            file.writelines(recording_bytes(session, stored))
        parsed = parse(file, **stored.reading.options)
    entry = entry_of(stored, parsed)
    if entry is not None:
        cache_content(database, stored, entry, damaged=damaged)
    return parsed


def recording_bytes(session: Session, stored: StoredRecording) -> Iterator[bytes]:
    """Yield the bytes of a recording chunk by chunk, and verify their SHA-256 at the end.

    For use within the caller's transaction. An HTTP response waits for its client between two chunks and must not hold
    a transaction meanwhile: see `demos.exported_chunk`.

    Raises:
        Corrupt: The digest differs; the last chunk is then withheld.
    """
    hasher, held = hashlib.sha256(), b""
    for data in session.scalars(chunks_of(stored.row).execution_options(yield_per=1)):
        # One chunk behind, so that the last one is only yielded after the digest was verified.
        if held:
            yield held
        hasher.update(data)
        held = data
    if hasher.hexdigest() != stored.sha256:
        raise damaged()
    yield held


def chunks_of(recording_row: int) -> Select[bytes]:
    """Return the query of the chunks of a recording, in their order."""
    of = RecordingChunk
    return select(of.data).where(of.recording == recording_row).order_by(of.number)


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


def describe_recording(row: StoredRecording) -> described.Recording:
    """Return a recording as it is sent to clients."""
    identity = {name: getattr(row, name) for name in described.Described.model_fields}
    return described.Recording(id=row.sha256, created_at=row.created_at, **identity, **vars(row.about))


def summarise_recording(row: StoredRecording, demos: int) -> described.RecordingSummary:
    """Return a recording as it is sent in a list.

    Args:
        row: The recording.
        demos: Number of its active demonstrations.
    """
    return described.RecordingSummary(
        id=row.sha256,
        sha256=row.sha256,
        size_bytes=row.size_bytes,
        format=row.format,
        duration_s=row.about.duration_s,
        arms=sorted({motion.arm for motion in row.about.motions}),
        segments=row.about.counts.segments,
        demos=demos,
        created_at=row.created_at,
    )
