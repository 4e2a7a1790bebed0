"""Walk over the records of an MCAP file once, from front to back, and believe nothing that it says of itself.

    file --Walker.stretches--> Stretch: the messages of one channel in some MiB of the file

Every record must end where its head says, every checksum that is there must be right, the data section and the summary
must each end as they should, and the file's own statistics must agree with what was found. Indexes are passed by:
nothing is looked up through them. What is kept does not grow with the file: the definitions, and a count per channel.

A chunk is unpacked into no more than it claims, and must come to exactly that. The limits below hold for what is
claimed before anything is unpacked; a recorder is far from all of them (MCAP specification, "Records").
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import BinaryIO, Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from skills.errors import UnreadableRecording
from skills.recordings.chain import (
    DEFINITIONS,
    MESSAGE,
    PRIVATE,
    SMALL_BYTES,
    Bytes,
    Chain,
    check_records,
    follow,
    numbers_at,
)
from skills.recordings.source import HEAD, RECOVER, Fields, Source
from skills.recordings.unpack import unpack
from skills.style._arrays import Ints
from skills.style.recording import Integrity

__all__ = ["MAGIC", "NOTES", "Channel", "Schema", "Stretch", "Walker"]

MAGIC = b"\x89MCAP0\r\n"

CHUNK_LIMIT_BYTES = 64 * 2**20  # recorders write chunks of 1 to 4 MiB
TOTAL_LIMIT_BYTES = 4 * 2**30
RATIO_LIMIT = 100  # poses of an arm at rest pack 15 to 1
CHANNEL_LIMIT = 4096
MESSAGE_LIMIT = 10_000_000
DEFINED_LIMIT_BYTES = 16 * 2**20  # of all definitions
NOTES_LIMIT_BYTES = 2**16

NOTES = "suture-skills"  # the metadata record in which our own writer says what a file was made from


_CHUNK: Final = struct.Struct("<QQQI")  # first and last time, size, checksum; then its compression and its bytes
_STATISTICS: Final = struct.Struct("<QHIIIIQQI")
_PART_BYTES = 4 * 2**20  # small enough for a processor's cache, large enough for numpy to pay
_FOOTER_BYTES = HEAD.size + 16  # up to its checksum
_SLACK = bytes(8)
_SUMMARY = (
    *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET),
    *(Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX),
)
_PASSED_BY = (Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX)


@dataclass(frozen=True)
class Schema:
    """A message type and its definition."""

    name: str
    encoding: str
    definition: bytes


@dataclass(frozen=True)
class Channel:
    """A topic as one publisher filled it; `schema` is 0 where the messages have no type."""

    number: int
    schema: int
    topic: str
    encoding: str


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some messages of one channel, in the order of the file.

    Attributes:
        channel: Whose they are.
        data: Bytes of the file, unpacked, shape (B,); 8 bytes that are none of the file's stand behind them.
        log_ns: When each was logged, unsigned nanoseconds, shape (N,).
        begin: Where the content of each begins in `data`, shape (N,); a message's head of 31 bytes stands before it.
        length: How many bytes each has, shape (N,).
    """

    channel: Channel
    data: Bytes
    log_ns: NDArray[np.uint64]
    begin: Ints
    length: Ints


@dataclass(frozen=True, eq=False)
class _Part:
    """Some MiB of records, and whether checksums of their chunks cover them; `_SLACK` stands behind the data."""

    data: Bytes
    chain: Chain
    has_checksum: bool


class Walker:
    """One walk over one file.

    Attributes:
        schemas: By number, as far as the walk has come.
        channels: By number.
        counts: How many messages each channel has had.
        notes: What our own writer noted in the file.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.notes: dict[str, str] = {}
        self._source = Source(file)
        self._records = 0
        self._chunks = 0
        self._unpacked_bytes = 0
        self._defined_bytes = 0
        self._with_checksum = 0
        self._passed_by = False
        self._whole_checksum = False
        self._statistics = False

    @property
    def integrity(self) -> Integrity:
        """Say how much of the messages a checksum covers, after the walk.

        A record of an unknown kind could be a damaged chunk: only the statistics show that none is missing.
        """
        every = self._with_checksum == self.counts.total()
        if self._whole_checksum or (every and (self._statistics or not self._passed_by)):
            return "full"
        return "partial" if self._with_checksum else "none"

    def stretches(self) -> Iterator[Stretch]:
        """Walk: give the messages, channel by channel, of one part of the file after the other.

        Raises:
            UnreadableRecording: Truncated, corrupt, not whole, or over a limit.
        """
        self._begin()
        for part in self._parts():
            yield from self._taken(part)
        self._read_summary()

    def _parts(self) -> Iterator["_Part"]:
        """Give the records of the data section some MiB at a time."""
        waiting: list[bytes] = []
        size, of_checksum = 0, False
        for data, has_checksum in self._data_section():
            if waiting and (has_checksum != of_checksum or size + len(data) > _PART_BYTES):
                yield self._part(waiting, of_checksum)
                waiting, size = [], 0
            waiting.append(data)
            size += len(data)
            of_checksum = has_checksum
        if waiting:
            yield self._part(waiting, of_checksum)

    def _part(self, pieces: list[bytes], has_checksum: bool) -> "_Part":
        data = np.frombuffer(b"".join([*pieces, _SLACK]), np.uint8)
        chain = follow(data[: -len(_SLACK)])
        _check_ends(chain, pieces)
        self._count(len(chain.others))
        return _Part(data, chain, has_checksum)

    # ---- the file's records

    def _begin(self) -> None:
        if self._source.take(len(MAGIC)) != MAGIC:
            raise UnreadableRecording("This is no MCAP file: its first bytes are others.")
        opcode, length = self._source.head()
        if opcode != Opcode.HEADER:
            raise UnreadableRecording(f"An MCAP file begins with one header; this one does not. {RECOVER}")
        header = Fields(self._definition(opcode, length))
        header.text()
        header.text()

    def _data_section(self) -> Iterator[tuple[bytes, bool]]:
        """Give bytes that hold whole records, and whether a checksum of their own covers them."""
        while True:
            ends = self._source.position
            if self._source.next_opcode() in (*DEFINITIONS, Opcode.MESSAGE):
                yield self._run(), False
                continue
            opcode, length = self._source.head()
            if opcode == Opcode.DATA_END:
                self._check_data_end(self._source.take(length), ends)
                return
            if opcode == Opcode.CHUNK:
                yield self._chunk(length)
            elif opcode == Opcode.METADATA:
                self._metadata(length)
            elif opcode in _PASSED_BY or opcode >= PRIVATE:
                self._passed_by |= opcode >= PRIVATE
                self._count()
                self._source.skip(length)
            else:
                raise UnreadableRecording(f"A record of kind {opcode:#x} stands among the messages. {RECOVER}")

    def _run(self) -> bytes:
        """Take definitions and messages that stand outside of chunks, as many as come at once."""
        _, length = HEAD.unpack_from(self._source.peek(HEAD.size))
        if length > CHUNK_LIMIT_BYTES:
            raise UnreadableRecording(f"A message or definition of {length} bytes is over the limit. {RECOVER}")
        block = np.frombuffer(self._source.peek(HEAD.size + length), np.uint8)
        size = max(HEAD.size + length, SMALL_BYTES)
        while (end := follow(block[:size]).end) > size // 2 and size < len(block):
            size *= 4  # so that a look ahead costs no more than what it finds
        if end == 0:
            raise UnreadableRecording(f"A message is shorter than its own times. {RECOVER}")
        return bytes(self._source.take(end))

    def _chunk(self, length: int) -> tuple[bytes, bool]:
        self._count()
        self._chunks += 1
        if not _CHUNK.size <= length <= 2 * CHUNK_LIMIT_BYTES:
            raise UnreadableRecording(f"Chunk {self._chunks} of {length} bytes is none, or too large. {RECOVER}")
        content = self._source.take(length)
        *_, size, checksum = _CHUNK.unpack_from(content)
        fields = Fields(content[_CHUNK.size :])
        compression, stored = fields.text(), fields.long_bytes()
        self._check_size(size)
        data = unpack(stored, compression, size)
        if checksum and zlib.crc32(data) != checksum:
            raise UnreadableRecording(f"The checksum (CRC) of chunk {self._chunks} is wrong. {RECOVER}")
        return data, checksum != 0

    def _check_size(self, size: int) -> None:
        self._unpacked_bytes += size
        allowed = min(TOTAL_LIMIT_BYTES, CHUNK_LIMIT_BYTES + RATIO_LIMIT * self._source.position)
        if size > CHUNK_LIMIT_BYTES or self._unpacked_bytes > allowed:
            raise UnreadableRecording(
                f"Chunk {self._chunks} unpacks to {size} bytes, {self._unpacked_bytes} in all; the limits are "
                f"{CHUNK_LIMIT_BYTES}, {TOTAL_LIMIT_BYTES} in all and {RATIO_LIMIT} times the file. Record with "
                "smaller chunks.",
                chunk_bytes=size,
                total_bytes=self._unpacked_bytes,
            )

    def _metadata(self, length: int) -> None:
        self._count()
        if length > NOTES_LIMIT_BYTES:
            self._source.skip(length)
            return
        fields = Fields(self._source.take(length))
        if fields.text() == NOTES and not self.notes:
            self.notes.update(fields.texts())

    def _check_data_end(self, content: memoryview, ends: int) -> None:
        said = Fields(content).number(4)
        if said and said != self._source.checksum_of(0, ends):
            raise UnreadableRecording(f"The checksum (CRC) of the data section is wrong. {RECOVER}")
        self._whole_checksum = said != 0

    def _read_summary(self) -> None:
        """Check what follows the messages: its own checksum, the counts in it, and that nothing comes after it."""
        begins = self._source.position
        while True:
            opcode, length = self._source.head()
            if opcode == Opcode.FOOTER:
                break
            if opcode not in _SUMMARY and opcode < PRIVATE:
                raise UnreadableRecording(f"A record of kind {opcode:#x} follows the end of the messages. {RECOVER}")
            self._count()
            if opcode == Opcode.STATISTICS:
                self._check_statistics(self._definition(opcode, length))
            elif opcode in DEFINITIONS:
                self._define(opcode, self._definition(opcode, length))
            else:
                self._source.skip(length)
        self._check_footer(self._source.take(length), begins)

    def _check_footer(self, content: memoryview, begins: int) -> None:
        """Check where the summary is said to begin, and its checksum, which covers the footer up to itself."""
        fields = Fields(content)
        said_begins, _, said = fields.number(8), fields.number(8), fields.number(4)
        ends = self._source.position - 4
        there = begins if ends - begins > _FOOTER_BYTES else 0
        checksum = self._source.checksum_of(begins, ends) if said else 0
        if len(content) != 20 or said_begins not in (0, there) or said != checksum:
            raise UnreadableRecording(f"The summary at the end of the file is damaged. {RECOVER}")
        if self._source.take(len(MAGIC)) != MAGIC or self._source.rest():
            raise UnreadableRecording("Bytes follow the end of the MCAP file; give one file, not several joined.")

    def _check_statistics(self, content: memoryview) -> None:
        """Compare what was read with the file's own statistics: a chunk that was skipped over shows here."""
        if len(content) < _STATISTICS.size:
            raise UnreadableRecording(f"The statistics of the file are damaged. {RECOVER}")
        messages, _, _, _, _, chunks, *_ = _STATISTICS.unpack_from(content)
        if (messages, chunks) != (self.counts.total(), self._chunks):
            raise UnreadableRecording(
                f"The MCAP file says {messages} messages in {chunks} chunks, but holds {self.counts.total()} in "
                f"{self._chunks}. {RECOVER}",
                said=messages,
                found=self.counts.total(),
            )
        self._statistics = True

    def _definition(self, opcode: int, length: int) -> memoryview:
        if length > DEFINED_LIMIT_BYTES:
            raise UnreadableRecording(f"A record of kind {opcode:#x} has {length} bytes, over the limit. {RECOVER}")
        return self._source.take(length)

    def _count(self, more: int = 1) -> None:
        self._records += more
        check_records(self._records)

    # ---- records of messages, from a chunk or between chunks

    def _taken(self, part: "_Part") -> Iterator[Stretch]:
        """Take in what a part defines, and give its messages by channel."""
        data, chain = part.data, part.chain
        defined_at = self._take_definitions(data, chain.others)
        numbers = numbers_at(data, chain.messages + HEAD.size, "<u2")
        order = np.argsort(numbers, kind="stable")
        numbers, heads, lengths = numbers[order], chain.messages[order], chain.lengths[order]
        log_ns = numbers_at(data, heads + HEAD.size + 6, "<u8")
        edges = [0, *(np.flatnonzero(numbers[1:] != numbers[:-1]) + 1).tolist(), len(numbers)]
        for begin, end in pairwise(edges):
            if begin == end:
                break
            number, here = int(numbers[begin]), slice(begin, end)
            if number not in self.channels or heads[begin] < defined_at.get(number, 0):
                raise UnreadableRecording(f"A message belongs to channel {number}, which is not defined. {RECOVER}")
            self.counts[number] += end - begin
            contents = heads[here] + HEAD.size + MESSAGE.size
            yield Stretch(self.channels[number], data, log_ns[here], contents, lengths[here] - MESSAGE.size)
        self._with_checksum += len(numbers) if part.has_checksum else 0
        if self.counts.total() > MESSAGE_LIMIT:
            raise UnreadableRecording(
                f"The file has more than {MESSAGE_LIMIT} messages; give it in parts.", messages=self.counts.total()
            )

    def _take_definitions(self, data: Bytes, others: list[tuple[int, int, int]]) -> dict[int, int]:
        """Take in schemas and channels; return where the channels that are new begin."""
        defined_at: dict[int, int] = {}
        for opcode, begin, end in others:
            if opcode in DEFINITIONS:
                before = len(self.channels)
                number = self._define(opcode, data.data[begin:end])
                if len(self.channels) > before:
                    defined_at[number] = begin
            elif opcode < PRIVATE:
                raise UnreadableRecording(f"A record of kind {opcode:#x} stands in a chunk. {RECOVER}")
        return defined_at

    def _define(self, opcode: int, content: memoryview) -> int:
        """Keep a schema or a channel; a second one of the same number must say the same."""
        fields = Fields(content)
        number = fields.number(2)
        known = self.schemas if opcode == Opcode.SCHEMA else self.channels
        is_new = number not in known
        self._defined_bytes += is_new * len(content)
        if self._defined_bytes > DEFINED_LIMIT_BYTES or len(known) + is_new > CHANNEL_LIMIT:
            raise UnreadableRecording(
                f"The file defines {len(known) + is_new} types or topics in {self._defined_bytes} bytes; the limits "
                f"are {CHANNEL_LIMIT} and {DEFINED_LIMIT_BYTES}. This is no recording of an arm.",
            )
        if opcode == Opcode.SCHEMA:
            schema = Schema(fields.text(), fields.text(), fields.bytes())
            same = number != 0 and self.schemas.setdefault(number, schema) == schema
        else:
            channel = Channel(number, fields.number(2), fields.text(), fields.text())
            fields.texts()
            same = self.channels.setdefault(number, channel) == channel
            if channel.schema and channel.schema not in self.schemas:
                raise UnreadableRecording(f"{channel.topic!r} is of a type that is not defined before it. {RECOVER}")
        if not same:
            what = "schemas" if opcode == Opcode.SCHEMA else "channels"
            raise UnreadableRecording(f"Two {what} have the number {number}. {RECOVER}")
        return number


def _check_ends(chain: Chain, pieces: list[bytes]) -> None:
    """Every piece must hold whole records and nothing else."""
    *begins, size = accumulate(len(piece) for piece in pieces)
    others = {begin - HEAD.size for _, begin, _ in chain.others}
    heads = set(chain.messages[np.searchsorted(chain.messages[:-1], begins)].tolist() if len(chain.messages) else [])
    if chain.end != size or not set(begins) <= heads | others | {size}:
        raise UnreadableRecording(f"A chunk holds something else than whole messages and definitions. {RECOVER}")
