"""The bytes of a file from front to back, and the fields of its records (MCAP specification, "Serialization").

A number is little-endian; a text has its length before it, as bytes and maps of texts have.
"""

import struct
from typing import BinaryIO, Final

from isal.isal_zlib import crc32

from skills.errors import UnreadableRecording

RECOVER = "`mcap recover FILE -o NEW` writes what can be saved into a new file."
HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content

_BLOCK_BYTES = 2**16


class Source:
    """A file that is read from front to back."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._data = b""
        self._at = 0
        self._summed = 0
        self._checksum = 0
        self.position = 0

    def peek(self, size: int) -> memoryview:
        """Show what comes next, at least so many bytes of it.

        Raises:
            UnreadableRecording: The file ends before.
        """
        if len(self._data) - self._at < size:
            self.checksum()
            rest = self._data[self._at :]
            pieces, missing = [rest], size - len(rest)
            while missing > 0:  # piece by piece: a length that lies must not cost more memory than the file has bytes
                piece = self._file.read(_BLOCK_BYTES)
                if not piece:
                    raise UnreadableRecording(f"The MCAP file is truncated: it ends within a record. {RECOVER}")
                pieces.append(piece)
                missing -= len(piece)
            self._data, self._at, self._summed = b"".join(pieces), 0, 0
        return memoryview(self._data)[self._at :]

    def take(self, size: int) -> memoryview:
        """Take the next bytes."""
        taken = self.peek(size)[:size]
        self._at += size
        self.position += size
        return taken

    def skip(self, size: int) -> None:
        """Pass the next bytes by, a block at a time."""
        while size > 0:
            size -= len(self.take(min(size, _BLOCK_BYTES)))

    def head(self) -> tuple[int, int]:
        """Take a record's opcode and length."""
        opcode, length = HEAD.unpack(self.take(HEAD.size))
        return opcode, length

    def next_opcode(self) -> int:
        """Show the opcode of the next record."""
        return self.peek(HEAD.size)[0]

    def checksum(self) -> int:
        """Compute the CRC-32 of all that was taken since the beginning, or since it was begun anew."""
        self._checksum = crc32(memoryview(self._data)[self._summed : self._at], self._checksum)
        self._summed = self._at
        return self._checksum

    def begin_checksum(self) -> None:
        """Compute the CRC-32 of what is taken from here on."""
        self._checksum, self._summed = 0, self._at

    def rest(self) -> bytes:
        """Show whether anything is left."""
        return self._data[self._at :] or self._file.read(1)


class Fields:
    """The fields of one record, one after the other."""

    def __init__(self, content: bytes | memoryview) -> None:
        self._content = memoryview(content)
        self._at = 0

    def _next(self, size: int) -> memoryview:
        begin = self._at
        self._at += size
        if self._at > len(self._content):
            raise UnreadableRecording(f"A record is shorter than its fields. {RECOVER}")
        return self._content[begin : self._at]

    def number(self, size: int) -> int:
        """Read a number of so many bytes."""
        return int.from_bytes(self._next(size), "little")

    def bytes(self) -> bytes:
        """Read bytes."""
        return bytes(self._next(self.number(4)))

    def text(self) -> str:
        """Read a text."""
        try:
            return self.bytes().decode()
        except UnicodeDecodeError:
            raise UnreadableRecording(f"A name in the file is not UTF-8. {RECOVER}") from None

    def texts(self) -> dict[str, str]:
        """Read a map of texts."""
        inner = Fields(self._next(self.number(4)))
        said = {}
        while inner._at < len(inner._content):
            name = inner.text()
            said[name] = inner.text()
        return said

    def long_bytes(self) -> memoryview:
        """Read bytes with a long length, which must be all that is left."""
        stored = self._next(self.number(8))
        if self._at != len(self._content):
            raise UnreadableRecording(f"A chunk is longer than its fields. {RECOVER}")
        return stored
