"""The bytes and the records of an MCAP file, read within bounds.

The bytes are accessed in sequence (MCAP specification, "Serialization"). Numbers are little-endian; strings, byte
arrays and maps are preceded by their length.

Chunks are decompressed to no more than their claimed size.

    bytes --Chain.follow--> for each message its position, length and channel

The end of a record is known only from its header, so records are followed one by one from the first byte: messages by a
compiled loop, all other records in Python.
"""

import struct
from functools import cached_property
from typing import BinaryIO, Final

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from numpy.typing import NDArray

from skills.arrays import Ints
from skills.errors import UnreadableRecording
from skills.formats.mcap import _kernels

RECOVER = "`mcap recover FILE -o NEW` writes the recoverable messages to a new file."
HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content

_BLOCK_BYTES = 2**16


RECORD_LIMIT = 300_000  # besides messages: 5,600 chunks with 50 indexes each, as rosbag2 writes, are 286,000
MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time; then the content
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
PRIVATE = 0x80  # opcodes from here on are application extensions (specification, "Opcodes")


class ByteSource:
    """A file that is read sequentially, with a running checksum."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._data = b""
        self._at = 0
        self._summed = 0
        self._checksum = 0
        self.position = 0

    def peek(self, size: int) -> memoryview:
        """Return the next bytes, at least `size` of them, without consuming them.

        Raises:
            UnreadableRecording: The file has fewer.
        """
        if len(self._data) - self._at < size:
            self.checksum()  # of the consumed bytes, before they are dropped
            rest = self._data[self._at :]
            pieces, missing = [rest], size - len(rest)
            while missing > 0:  # in blocks: a wrong length must not allocate more memory than the file has bytes
                piece = self._file.read(_BLOCK_BYTES)
                if not piece:
                    raise UnreadableRecording(f"The MCAP file is truncated: it ends within a record. {RECOVER}")
                pieces.append(piece)
                missing -= len(piece)
            self._data, self._at, self._summed = b"".join(pieces), 0, 0
        return memoryview(self._data)[self._at :]

    def take(self, size: int) -> memoryview:
        """Consume and return the next bytes."""
        taken = self.peek(size)[:size]
        self._at += size
        self.position += size
        return taken

    def skip(self, size: int) -> None:
        """Skip the next bytes, block by block."""
        while size > 0:
            size -= len(self.take(min(size, _BLOCK_BYTES)))

    def head(self) -> tuple[int, int]:
        """Consume a record's opcode and length."""
        opcode, length = HEAD.unpack(self.take(HEAD.size))
        return opcode, length

    def next_opcode(self) -> int:
        """Return the opcode of the next record without consuming it."""
        return self.peek(HEAD.size)[0]

    def checksum(self) -> int:
        """Return the CRC-32 of all bytes consumed since the beginning, or since `begin_checksum`."""
        self._checksum = crc32(memoryview(self._data)[self._summed : self._at], self._checksum)
        self._summed = self._at
        return self._checksum

    def begin_checksum(self) -> None:
        """Restart the CRC-32 at the current position."""
        self._checksum, self._summed = 0, self._at

    def rest(self) -> bytes:
        """Return some of the remaining bytes; empty at the end of the file."""
        return self._data[self._at :] or self._file.read(1)


class Fields:
    """Sequential access to the fields of one record."""

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
        """Read an unsigned integer of `size` bytes."""
        return int.from_bytes(self._next(size), "little")

    def bytes(self) -> bytes:
        """Read a byte array."""
        return bytes(self._next(self.number(4)))

    def text(self) -> str:
        """Read a string."""
        try:
            return self.bytes().decode()
        except UnicodeDecodeError:
            raise UnreadableRecording(f"A name in the file is not UTF-8. {RECOVER}") from None

    def texts(self) -> dict[str, str]:
        """Read a map of strings."""
        inner = Fields(self._next(self.number(4)))
        said = {}
        while inner._at < len(inner._content):
            name = inner.text()
            said[name] = inner.text()
        return said

    def long_bytes(self) -> memoryview:
        """Read a byte array with a length of eight bytes, which must be the last field."""
        stored = self._next(self.number(8))
        if self._at != len(self._content):
            raise UnreadableRecording(f"A chunk is longer than its fields. {RECOVER}")
        return stored


def unpack(stored: memoryview, compression: str, size: int) -> bytes:
    """Decompress a chunk to exactly the size that it claims, and never to more.

    A size in the compressed frame itself is not trusted.

    Raises:
        UnreadableRecording: The result has another size, data follow it, or it is damaged or of an unsupported
            compression.
    """
    try:
        if compression == "zstd":
            data = _unpack_zstd(stored, size)
        elif compression == "lz4":
            data = _unpack_lz4(stored, size)
        elif compression == "":
            data = bytes(stored)
        else:
            raise UnreadableRecording(
                f"A chunk is compressed with {compression!r}; only zstd, lz4 and none are supported."
            )
    except (zstandard.ZstdError, RuntimeError) as error:
        raise UnreadableRecording(f"A chunk does not unpack to its declared {size} bytes. {RECOVER}") from error
    if len(data) != size:
        raise UnreadableRecording(f"A chunk does not unpack to its declared {size} bytes. {RECOVER}", bytes=size)
    return data


def _unpack_zstd(stored: memoryview, size: int) -> bytes:
    frame = zstandard.get_frame_parameters(stored)
    if frame.content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise zstandard.ZstdError("the frame declares another size")
    return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size, allow_extra_data=False)


def _unpack_lz4(stored: memoryview, size: int) -> bytes:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    data: bytes = unpacker.decompress(stored, max_length=size + 1)  # one more, so that a larger frame is found
    if not unpacker.eof or unpacker.unused_data:
        raise RuntimeError("the frame does not end where the chunk does")
    return data


Bytes = NDArray[np.uint8]


class Chain:
    """Consecutive records, found incrementally from the first byte on.

    Attributes:
        others: Opcode, and beginning and end of the content, for every record that is not a message.
        end: The end of the last complete record.
    """

    def __init__(self, data: Bytes) -> None:
        """Start at the beginning of the data.

        Args:
            data: Starts with a record's header, shape (B,). The bytes may be written later, before `follow` reads them.
        """
        self.others: list[tuple[int, int, int]] = []
        self.end = 0
        self._data = looked_at(data)
        self._count = 0
        most = len(data) // (HEAD.size + MESSAGE.size)
        self._messages, self._lengths = np.empty(most, np.int64), np.empty(most, np.int64)
        self._channels = np.empty(most, np.uint16)

    def follow(self, to: int) -> None:
        """Find further records up to a byte.

        It stops before at the first record that is incomplete or is not a message, a definition or a private record.

        Args:
            to: The byte.

        Raises:
            UnreadableRecording: More other records than any recorder writes.
        """
        data = self._data[:to]
        view, found = data.data, (self._messages, self._lengths, self._channels)
        while True:
            self._count, self.end = map(int, _kernels.follow_compiled(data, self.end, self._count, *found))
            before = len(self.others)
            while (other := _other(view, self.end)) is not None:
                self.others.append(other)
                check_records(len(self.others))
                self.end = other[2]
            if len(self.others) == before:
                break

    @property
    def messages(self) -> Ints:
        """The position of each message's header, shape (N,)."""
        return self._messages[: self._count]

    @property
    def lengths(self) -> Ints:
        """The length of each message's content, shape (N,)."""
        return self._lengths[: self._count]

    @property
    def channels(self) -> NDArray[np.uint16]:
        """The channel number of each message, shape (N,)."""
        return self._channels[: self._count]

    @cached_property
    def counts(self) -> Ints:
        """The number of messages by channel number; cached, so read it only after the last `follow`."""
        return np.bincount(self.channels)

    def of(self, number: int) -> Ints:
        """Return the indices of the messages of a channel, in the order of the file; the channel must have some."""
        end = int(self._ends[number])
        return self._by_channel[end - int(self.counts[number]) : end]

    @cached_property
    def _by_channel(self) -> Ints:
        return np.argsort(self.channels, kind="stable")

    @cached_property
    def _ends(self) -> Ints:
        return np.cumsum(self.counts)


def looked_at(data: Bytes) -> Bytes:
    """Return a read-only view, as the compiled loops expect: read-only is part of an array's type in numba."""
    shown = data.view()
    shown.setflags(write=False)
    return shown


def check_records(count: int) -> None:
    """Refuse a file with more records besides its messages than any recorder writes."""
    if count > RECORD_LIMIT:
        raise UnreadableRecording(
            f"The file has more than {RECORD_LIMIT} records besides its messages. Record with larger chunks.",
            records=count,
        )


def _other(data: memoryview, at: int) -> tuple[int, int, int] | None:
    """Return opcode, beginning and end of a complete record other than a message; None where there is none."""
    begin = at + HEAD.size
    if begin > len(data):
        return None
    opcode, length = HEAD.unpack_from(data, at)
    if length > len(data) - begin or not (opcode in DEFINITIONS or opcode >= PRIVATE):
        return None
    return opcode, begin, begin + length
