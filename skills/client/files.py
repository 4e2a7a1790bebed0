"""Files that the client sends and saves, in chunks and with their digest; a download is complete or not there."""

import base64
import hashlib
import io
import re
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

from skills.errors import Corrupt

Progress = Callable[[int, int], None]  # called with the bytes transferred so far and the total

ETAG = re.compile(r'(?:W/)?"([0-9a-f]{64})"')  # a proxy that compresses makes it weak; the decoded bytes are the same
CHUNK_BYTES = 1 << 20


@dataclass(frozen=True)
class FileUpload:
    """A file to upload: path or bytes, size, media type, and SHA-256 in base64."""

    content: Path | bytes
    size_bytes: int
    media_type: str
    digest: str

    @classmethod
    def of(cls, content: Path | bytes, media_type: str | None) -> Self:
        """Read a file once for its size and digest; without `media_type`, its content determines it.

        Raises:
            UnknownFormat: The service does not read such a file.
            UnreadableRecording: It is empty.
        """
        from skills.formats import media_type_of  # slow to import

        seen, size = hashlib.sha256(), 0
        with _opened(content) as file:
            kind = media_type or media_type_of(file)
            file.seek(0)
            while data := file.read(CHUNK_BYTES):
                seen.update(data)
                size += len(data)
        return cls(content, size, kind, base64.b64encode(seen.digest()).decode())

    @property
    def headers(self) -> dict[str, str]:
        """Return the headers that describe the body."""
        return {
            "Content-Type": self.media_type,
            "Content-Length": str(self.size_bytes),
            "Content-Digest": f"sha-256=:{self.digest}:",
        }

    def chunks(self) -> Iterator[bytes]:
        """Yield the file in chunks from its start."""
        with _opened(self.content) as file:
            while data := file.read(CHUNK_BYTES):
                yield data


def _opened(content: Path | bytes) -> BinaryIO:
    return io.BytesIO(content) if isinstance(content, bytes) else content.open("rb")


class Download:
    """A file being downloaded to a temporary name; it gets its own name when it is complete and has its digest."""

    def __init__(self, to: Path, sha256: str) -> None:
        self.to, self.sha256 = to, sha256
        self.size_bytes = 0
        self._seen = hashlib.sha256()
        self._part = to.parent / f".{to.name}.{secrets.token_hex(8)}"
        try:
            self._file = self._part.open("xb")
        except OSError as error:
            error.filename = str(to)  # not the temporary name, which means nothing to the user
            raise

    def write(self, data: bytes) -> None:
        """Write the next chunk."""
        self._seen.update(data)
        self._file.write(data)
        self.size_bytes += len(data)

    def finish(self) -> None:
        """Check the digest, and move the file to its name.

        Raises:
            Corrupt: The digest differs; a file that had the name before is unchanged.
        """
        self._file.close()
        check_digest(self._seen.hexdigest(), self.sha256)
        self._part.replace(self.to)

    def discard(self) -> None:
        """Close and delete the temporary file; after `finish` there is none."""
        self._file.close()
        self._part.unlink(missing_ok=True)


def write_file(data: bytes, to: Path) -> None:
    """Write bytes to a file atomically."""
    file = Download(to, hashlib.sha256(data).hexdigest())
    try:
        file.write(data)
        file.finish()
    finally:
        file.discard()


def check_digest(found: str, expected: str) -> None:
    """Compare two digests.

    Raises:
        Corrupt: They differ.
    """
    if found != expected:
        raise Corrupt(
            "The received data does not match the digest in the response (SHA-256). Nothing was stored; fetch it again."
        )


def digest_of_etag(etag: str) -> str:
    """Return the SHA-256 in an ETag of the service.

    Raises:
        Corrupt: It does not contain one.
    """
    found = ETAG.fullmatch(etag)
    if found is None:
        raise Corrupt(
            "The response has no ETag with a digest, so its content cannot be verified; check the proxies in between."
        )
    return found[1]
