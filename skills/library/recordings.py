"""Recordings: raw files, read and checked before any transaction, and stored whole in pieces of a mebibyte."""

import base64
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import RecordingChunk, RecordingUpload, StoredRecording
from skills.db.seen import EVERYBODYS
from skills.db.session import Database
from skills.errors import BadInput, Conflict, Corrupt, NotFound, UnknownFormat, UnreadableRecording
from skills.library.about import about_recording
from skills.library.events import record
from skills.recordings import MEDIA_TYPES, media_type_of, read_recording
from skills.style.demo import Recording

CHUNK_BYTES = 1 << 20
Reader = Callable[..., Recording]  # `read_recording`, or what calls it somewhere else
BAGS = ("mcap", "rosbag1", "rosbag2")  # of a text's checksums nobody expects any


@dataclass(frozen=True)
class Upload:
    """Bytes on their way in, spooled to a file: their SHA-256, and how to read what they do not say themselves."""

    file: BinaryIO
    sha256: str
    size_bytes: int
    media_type: str
    rate_hz: float | None = None
    frame: str | None = None
    vouched: bool = False  # the sender gave a digest of its own, and it agrees

    @property
    def reading(self) -> dict[str, Any]:
        """The reader's arguments."""
        return {"rate_hz": self.rate_hz, "frame": self.frame}


def check_digest(header: str | None, of_bytes: str) -> bool:
    """Compare a `Content-Digest` (RFC 9530) with the SHA-256 of the bytes, in hex: whether one was given.

    Raises:
        BadInput: It names other bytes, or is none.
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
        BadRecording: It cannot be used, or nothing vouches for its bytes.
        UnknownFormat: It is not of the media type that it was sent as.
    """
    right = media_type_of(upload.file)
    if right != upload.media_type:
        raise UnknownFormat(f"The content is {MEDIA_TYPES[right]}, not what Content-Type says; send it as {right}.")
    recording = read(upload.file, **upload.reading)
    if recording.format in BAGS and recording.integrity == "none" and not upload.vouched:
        raise UnreadableRecording(
            f"The content is {MEDIA_TYPES[right]} without checksums, so damage would go unseen; send it with a "
            "Content-Digest header (sha-256=:BASE64:), or record it as MCAP with CRCs."
        )
    return recording


def store_recording(
    database: Database, upload: Upload, actor: str, read: Reader = read_recording
) -> tuple[StoredRecording, bool]:
    """Store the bytes once: (the row, whether it is new)."""
    recording = read_upload(upload, read)
    with database.writing() as session:
        return keep(session, upload, recording, actor)


def keep(session: Session, upload: Upload, recording: Recording, actor: str) -> tuple[StoredRecording, bool]:
    """Write a recording and its bytes into the caller's transaction, once: (the row, whether it is new to who sent it).

    Bytes that somebody else has sent are told as new, so that nobody learns from a digest what others have.

    Raises:
        Conflict: The bytes are stored already, read in another way.
    """
    same = select(StoredRecording).where(StoredRecording.sha256 == upload.sha256)
    stored = session.scalar(same.execution_options(**EVERYBODYS))
    if stored is not None:
        if stored.reading != upload.reading:
            raise Conflict(f"These bytes are stored already, read with {stored.reading}; send the same.")
        return stored, _brought_by(session, stored, actor)
    stored = StoredRecording(
        sha256=upload.sha256,
        size_bytes=upload.size_bytes,
        media_type=upload.media_type,
        format=recording.format,
        integrity="full" if upload.vouched else recording.integrity,
        reading=upload.reading,
        about=about_recording(recording),
    )
    session.add(stored)
    session.flush()
    upload.file.seek(0)
    number = 0
    while data := upload.file.read(CHUNK_BYTES):
        session.add(RecordingChunk(recording=stored.row, number=number, data=data))
        session.flush()
        number += 1
    return stored, _brought_by(session, stored, actor)


def _brought_by(session: Session, stored: StoredRecording, actor: str) -> bool:
    """Write down that somebody brought a recording; whether that is new."""
    if session.get(RecordingUpload, (stored.row, actor)) is not None:
        return False
    session.add(RecordingUpload(recording_row=stored.row, actor=actor))
    record(session, actor, "add", "recording", stored.sha256)
    session.flush()
    return True


def find_recording(session: Session, recording_sha256: str) -> StoredRecording:
    """Find a recording by the SHA-256 of its bytes."""
    stored = session.scalar(select(StoredRecording).where(StoredRecording.sha256 == recording_sha256))
    if stored is None:
        raise NotFound("There is no such recording; POST /recordings stores one.")
    return stored


def recording_bytes(session: Session, stored: StoredRecording) -> Iterator[bytes]:
    """Give a recording back, piece by piece, and check at the end that it is what was stored.

    Raises:
        Corrupt: It is not; the last piece is then withheld.
    """
    seen, held = hashlib.sha256(), b""
    query = select(RecordingChunk.data).where(RecordingChunk.recording == stored.row).order_by(RecordingChunk.number)
    for data in session.scalars(query.execution_options(yield_per=1)):
        if held:
            yield held
        seen.update(data)
        held = data
    if seen.hexdigest() != stored.sha256:
        raise Corrupt("A recording is not what was stored; restore it from a backup.")
    yield held
