"""Files on their way out and in: sent in pieces with their digest, kept only when whole."""

import base64
import hashlib
import io
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

from skills.client.transport import PIECE_BYTES
from skills.errors import Corrupt

Progress = Callable[[int, int], None]  # is told how many bytes went, and of how many in all

ETAG = re.compile(r'(?:W/)?"([0-9a-f]{64})"')  # a proxy that compresses on the way makes it weak; the bytes stay


@dataclass(frozen=True)
class Upload:
    """A file that is to be sent: where it is, how long, what it is, and its SHA-256 in base64."""

    content: Path | bytes
    size_bytes: int
    media_type: str
    digest: str

    @classmethod
    def of(cls, content: Path | bytes, media_type: str | None) -> Self:
        """Look at a file from beginning to end; what it is, if nobody says, is told by its content.

        Raises:
            UnknownFormat: It is nothing that the service reads.
            UnreadableRecording: It is empty.
        """
        from skills.recordings import media_type_of  # slow to import

        seen, size = hashlib.sha256(), 0
        with _opened(content) as file:
            kind = media_type or media_type_of(file)
            file.seek(0)
            while data := file.read(PIECE_BYTES):
                seen.update(data)
                size += len(data)
        return cls(content, size, kind, base64.b64encode(seen.digest()).decode())

    @property
    def headers(self) -> dict[str, str]:
        """What a request says of its body."""
        return {
            "Content-Type": self.media_type,
            "Content-Length": str(self.size_bytes),
            "Content-Digest": f"sha-256=:{self.digest}:",
        }

    def pieces(self) -> Iterator[bytes]:
        """Read it from the beginning."""
        with _opened(self.content) as file:
            while data := file.read(PIECE_BYTES):
                yield data

    def told(self, progress: Progress | None) -> Callable[[bytes], None]:
        """Count what goes out, from nothing on, and tell of it."""
        went = 0

        def tell(data: bytes) -> None:
            nonlocal went
            went += len(data)
            if progress is not None:
                progress(went, self.size_bytes)

        return tell


def _opened(content: Path | bytes) -> BinaryIO:
    return io.BytesIO(content) if isinstance(content, bytes) else content.open("rb")


class Arriving:
    """A file that is being fetched: it stands under its name only when it is whole, and is what it was said to be."""

    def __init__(self, to: Path, sha256: str) -> None:
        self.to, self.sha256 = to, sha256
        self.size_bytes = 0
        self._seen = hashlib.sha256()
        handle, name = tempfile.mkstemp(prefix=f".{to.name}.", dir=to.parent)
        self._part, self._file = Path(name), os.fdopen(handle, "wb")

    def write(self, data: bytes) -> None:
        """Take the next piece."""
        self._seen.update(data)
        self._file.write(data)
        self.size_bytes += len(data)

    def finish(self) -> None:
        """Give it its name.

        Raises:
            Corrupt: It is not what it was said to be; nothing stands under the name that did not before.
        """
        self._file.close()
        check(self._seen.hexdigest(), self.sha256)
        self._part.chmod(0o666 & ~_umask())
        self._part.replace(self.to)

    def forget(self) -> None:
        """Leave nothing behind, where it was not finished."""
        self._file.close()
        self._part.unlink(missing_ok=True)


def keep(data: bytes, to: Path) -> None:
    """Write bytes to a file that is there only when it is whole."""
    file = Arriving(to, hashlib.sha256(data).hexdigest())
    try:
        file.write(data)
        file.finish()
    finally:
        file.forget()


def check(found: str, named: str) -> None:
    """Compare digests.

    Raises:
        Corrupt: They differ.
    """
    if found != named:
        raise Corrupt("What came is not what the service names: its SHA-256 differs. Nothing was kept; fetch it again.")


def named_by(etag: str) -> str:
    """Read the SHA-256 that an ETag of the service is.

    Raises:
        Corrupt: It is none.
    """
    said = ETAG.fullmatch(etag)
    if said is None:
        raise Corrupt("The answer does not name its content, so it cannot be checked; look at what stands between.")
    return said[1]


def _umask() -> int:
    """Read the mask of new files, which a temporary file does not follow."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
