"""The MCAP reader: one sequential pass over the records of a file, which trusts none of the file's claims about itself.

    file --Walker.parts--> Part: some MiB of the file --of--> the messages of one channel

Every record must end where its header says, every checksum present must be correct, the data section and the summary
must be complete, and the file's statistics must agree with the records found. Indexes are skipped and never used.
Memory does not grow with the file: only the definitions and a count per channel are stored.

A chunk is decompressed to no more than its claimed size, and must have exactly that size. The limits below apply to the
claimed sizes, before anything is decompressed; recorders stay far below all of them (MCAP specification, "Records").
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO, Final

import numpy as np
from isal.isal_zlib import crc32
from mcap.opcode import Opcode

from skills.arrays import Ints
from skills.demonstration.recording import Integrity
from skills.errors import UnreadableRecording
from skills.formats.mcap.cdr import SLACK_BYTES
from skills.formats.mcap.records import (
    DEFINITIONS,
    HEAD,
    MESSAGE,
    PRIVATE,
    RECOVER,
    Bytes,
    ByteSource,
    Chain,
    Fields,
    check_records,
    unpack,
)

MAGIC = b"\x89MCAP0\r\n"

CHUNK_LIMIT_BYTES = 64 * 2**20  # recorders write chunks of 1 to 4 MiB
TOTAL_LIMIT_BYTES = 4 * 2**30
RATIO_LIMIT = 100  # poses of an arm at rest are compressed 15 to 1
CHANNEL_LIMIT = 4096
MESSAGE_LIMIT = 10_000_000
DEFINED_LIMIT_BYTES = 16 * 2**20  # of all definitions together
NOTES_LIMIT_BYTES = 2**16

NOTES = "suture-skills"  # the metadata record in which our own writer notes a file's origin

_CHUNK: Final = struct.Struct("<QQQI")  # first and last time, size, checksum; compression and data follow
_STATISTICS: Final = struct.Struct("<QHIIIIQQI")
_PART_BYTES = 4 * 2**20  # fits a processor's cache, and is large enough for numpy to be efficient
_FOOTER: Final = struct.Struct("<QQ")  # positions of the summary and of its offsets; a checksum follows
_SUMMARY = (
    *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.SUMMARY_OFFSET),
    *(Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX),
)
_PASSED_BY = (Opcode.ATTACHMENT, Opcode.MESSAGE_INDEX)


@dataclass(frozen=True)
class MessageSchema:
    """A message type and its definition."""

    name: str
    encoding: str
    definition: bytes


@dataclass(frozen=True)
class Channel:
    """A topic of one publisher; `schema` is 0 if its messages have no type.

    `publisher` is the name of its node, which only bags of ROS 1 have, and otherwise ""; `qos` the text of the profiles
    that were offered.
    """

    number: int
    schema: int
    topic: str
    encoding: str
    publisher: str = ""
    qos: str = ""


@dataclass(frozen=True, eq=False)
class Part:
    """Some MiB of records; its bytes are valid until the walk continues.

    Attributes:
        data: Decompressed bytes of the file, shape (B,), followed by 8 bytes that are not from the file.
        chain: Positions of the records.
        has_checksum: Whether checksums of their chunks cover them.
    """

    data: Bytes
    chain: Chain
    has_checksum: bool

    @property
    def numbers(self) -> list[int]:
        """The channels that have messages here, ascending."""
        numbers: list[int] = np.flatnonzero(self.chain.counts).tolist()
        return numbers

    def of(self, number: int) -> tuple[Ints, Ints]:
        """Return the messages of a channel that has some here, in the order of the file.

        Returns:
            Position of each content in `data`, shape (N,), which a header of 31 bytes precedes, and its length in
            bytes, shape (N,).
        """
        which = self.chain.of(number)
        return self.chain.messages[which] + (HEAD.size + MESSAGE.size), self.chain.lengths[which]


class Walker:
    """A sequential pass over one file; it can be used once.

    Attributes:
        schemas: By number; those read so far.
        channels: By number; those read so far.
        counts: The number of messages of each channel so far.
        notes: The metadata record of our own writer.
    """

    def __init__(self, file: BinaryIO) -> None:
        self.schemas: dict[int, MessageSchema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.notes: dict[str, str] = {}
        self._source = ByteSource(file)
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
        """The extent to which checksums cover the messages; valid after the walk.

        A record of unknown type could be a damaged chunk: only the statistics prove that no chunk is missing.
        """
        every = self._with_checksum == self.counts.total()
        if self._whole_checksum or (every and (self._statistics or not self._passed_by)):
            return "full"
        return "partial" if self._with_checksum else "none"

    def parts(self) -> Iterator[Part]:
        """Walk over the file, and yield its parts.

        Raises:
            UnreadableRecording: Truncated, corrupt, incomplete, or over a limit.
        """
        self._begin()
        for part in self._parts():
            self._take(part)
            yield part
        self._read_summary()

    def _parts(self) -> Iterator[Part]:
        """Yield the records of the data section some MiB at a time, in a buffer that is reused."""
        space, end, covered = np.empty(_PART_BYTES + SLACK_BYTES, np.uint8), 0, False
        chain = Chain(space)
        for data, has_checksum in self._data_section():
            if end and (has_checksum != covered or end + len(data) > _PART_BYTES):
                yield Part(space[: end + SLACK_BYTES], chain, covered)
                chain, end = Chain(space), 0
            if len(data) + SLACK_BYTES > len(space):  # a chunk larger than the buffer, which is empty here
                space = np.empty(len(data) + SLACK_BYTES, np.uint8)
                chain = Chain(space)
            space[end : end + len(data)] = np.frombuffer(data, np.uint8)
            end += len(data)
            covered = has_checksum
            chain.follow(end)
            if chain.end != end:
                raise UnreadableRecording(
                    f"A chunk contains other data than complete messages and definitions. {RECOVER}"
                )
        if end:
            yield Part(space[: end + SLACK_BYTES], chain, covered)

    # ---- the file's records

    def _begin(self) -> None:
        """Read the magic bytes and the header."""
        if self._source.take(len(MAGIC)) != MAGIC:
            raise UnreadableRecording("This is not an MCAP file: its first bytes differ.")
        opcode, length = self._source.head()
        if opcode != Opcode.HEADER:
            raise UnreadableRecording(f"An MCAP file begins with one header; this one does not. {RECOVER}")
        header = Fields(self._definition(opcode, length))
        header.text()
        header.text()

    def _data_section(self) -> Iterator[tuple[bytes, bool]]:
        """Yield bytes with complete records, and whether a chunk's checksum covers them."""
        while True:
            opcode = self._source.next_opcode()
            if opcode == Opcode.DATA_END:
                self._check_data_end(self._source.checksum())
                return
            if opcode in (*DEFINITIONS, Opcode.MESSAGE):
                yield self._run(), False
                continue
            opcode, length = self._source.head()
            if opcode == Opcode.CHUNK:
                yield self._chunk(length)
            elif opcode == Opcode.METADATA:
                self._metadata(length)
            elif opcode in _PASSED_BY or opcode >= PRIVATE:
                self._passed_by |= opcode >= PRIVATE  # it may be a chunk with a damaged opcode; see `integrity`
                self._count()
                self._source.skip(length)
            else:
                raise UnreadableRecording(f"A record of kind {opcode:#x} is among the messages. {RECOVER}")

    def _run(self) -> bytes:
        """Consume consecutive definitions and messages outside of chunks, as many as are in the buffer."""
        _, length = HEAD.unpack_from(self._source.peek(HEAD.size))
        if length > CHUNK_LIMIT_BYTES:
            raise UnreadableRecording(f"A message or definition of {length} bytes is over the limit. {RECOVER}")
        data = np.frombuffer(self._source.peek(HEAD.size + length), np.uint8)
        chain = Chain(data)
        chain.follow(len(data))
        if chain.end == 0:
            raise UnreadableRecording(f"A message is too short for its time stamps. {RECOVER}")
        return bytes(self._source.take(chain.end))

    def _chunk(self, length: int) -> tuple[bytes, bool]:
        """Return the records of a chunk, and whether a checksum covers them."""
        self._count()
        self._chunks += 1
        if not _CHUNK.size <= length <= 2 * CHUNK_LIMIT_BYTES:
            raise UnreadableRecording(f"Chunk {self._chunks} of {length} bytes is not a chunk, or too large. {RECOVER}")
        content = self._source.take(length)
        *_, size, checksum = _CHUNK.unpack_from(content)
        fields = Fields(content[_CHUNK.size :])
        compression, stored = fields.text(), fields.long_bytes()
        self._check_size(size)
        data = unpack(stored, compression, size)
        if checksum and crc32(data) != checksum:
            raise UnreadableRecording(f"The checksum (CRC) of chunk {self._chunks} is wrong. {RECOVER}")
        return data, checksum != 0

    def _check_size(self, size: int) -> None:
        """Refuse a chunk that would unpack to too much, by itself or with those before."""
        self._unpacked_bytes += size
        allowed = min(TOTAL_LIMIT_BYTES, CHUNK_LIMIT_BYTES + RATIO_LIMIT * self._source.position)
        if size > CHUNK_LIMIT_BYTES or self._unpacked_bytes > allowed:
            raise UnreadableRecording(
                f"Chunk {self._chunks} unpacks to {size} bytes, {self._unpacked_bytes} in total; the limits are "
                f"{CHUNK_LIMIT_BYTES}, {TOTAL_LIMIT_BYTES} in total and {RATIO_LIMIT} times the file. Record with "
                "smaller chunks.",
                chunk_bytes=size,
                total_bytes=self._unpacked_bytes,
            )

    def _metadata(self, length: int) -> None:
        """Keep the notes of our own writer, and skip any other metadata."""
        self._count()
        if length > NOTES_LIMIT_BYTES:
            self._source.skip(length)
            return
        fields = Fields(self._source.take(length))
        if fields.text() == NOTES and not self.notes:
            self.notes.update(fields.texts())

    def _check_data_end(self, checksum: int) -> None:
        """Compare the checksum of the data section with the one in its last record."""
        _, length = self._source.head()
        said = Fields(self._source.take(length)).number(4)
        if said and said != checksum:
            raise UnreadableRecording(f"The checksum (CRC) of the data section is wrong. {RECOVER}")
        self._whole_checksum = said != 0

    def _read_summary(self) -> None:
        """Check the summary: its checksum, the counts in it, and that the file ends after it."""
        begins = self._source.position
        self._source.begin_checksum()
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
        self._check_footer(length, begins)

    def _check_footer(self, length: int, begins: int) -> None:
        """Check the claimed position of the summary, and its checksum, which covers the footer up to itself."""
        said_begins, _ = _FOOTER.unpack(self._source.take(_FOOTER.size))
        there = begins if self._source.position - begins > HEAD.size + _FOOTER.size else 0
        checksum = self._source.checksum()
        said = Fields(self._source.take(4)).number(4)
        if length != _FOOTER.size + 4 or said_begins not in (0, there) or said not in (0, checksum):
            raise UnreadableRecording(f"The summary at the end of the file is damaged. {RECOVER}")
        if self._source.take(len(MAGIC)) != MAGIC or self._source.rest():
            raise UnreadableRecording(
                "There are bytes after the end of the MCAP file; send one file, not several joined ones."
            )

    def _check_statistics(self, content: memoryview) -> None:
        """Compare the records found with the file's statistics, which reveals a chunk that was skipped."""
        if len(content) < _STATISTICS.size:
            raise UnreadableRecording(f"The statistics of the file are damaged. {RECOVER}")
        messages, _, _, _, _, chunks, *_ = _STATISTICS.unpack_from(content)
        if (messages, chunks) != (self.counts.total(), self._chunks):
            raise UnreadableRecording(
                f"The MCAP file declares {messages} messages in {chunks} chunks, but has {self.counts.total()} in "
                f"{self._chunks}. {RECOVER}",
                said=messages,
                found=self.counts.total(),
            )
        self._statistics = True

    def _definition(self, opcode: int, length: int) -> memoryview:
        """Return the content of a record that is kept in memory, if it is not too long."""
        if length > DEFINED_LIMIT_BYTES:
            raise UnreadableRecording(f"A record of kind {opcode:#x} has {length} bytes, over the limit. {RECOVER}")
        return self._source.take(length)

    def _count(self, more: int = 1) -> None:
        self._records += more
        check_records(self._records)

    # ---- records of messages, from a chunk or between chunks

    def _take(self, part: Part) -> None:
        """Process the definitions of a part, and count its messages."""
        chain = part.chain
        self._count(len(chain.others))
        defined_at = self._take_definitions(part.data, chain.others)
        for number in part.numbers:
            known = number in self.channels
            if not known or (number in defined_at and chain.messages[chain.of(number)[0]] < defined_at[number]):
                raise UnreadableRecording(f"A message belongs to channel {number}, which is not defined. {RECOVER}")
            self.counts[number] += int(chain.counts[number])
        self._with_checksum += len(chain.messages) if part.has_checksum else 0
        if self.counts.total() > MESSAGE_LIMIT:
            raise UnreadableRecording(
                f"The file has more than {MESSAGE_LIMIT} messages; send it in parts.", messages=self.counts.total()
            )

    def _take_definitions(self, data: Bytes, others: list[tuple[int, int, int]]) -> dict[int, int]:
        """Process schemas and channels; return the positions of new channels by number."""
        defined_at: dict[int, int] = {}
        for opcode, begin, end in others:
            if opcode in DEFINITIONS:
                before = len(self.channels)
                number = self._define(opcode, data.data[begin:end])
                if len(self.channels) > before:
                    defined_at[number] = begin
            elif opcode < PRIVATE:
                raise UnreadableRecording(f"A record of kind {opcode:#x} is in a chunk. {RECOVER}")
        return defined_at

    def _define(self, opcode: int, content: memoryview) -> int:
        """Store a schema or a channel; a duplicate of the same number must be equal."""
        fields = Fields(content)
        number = fields.number(2)
        known = self.schemas if opcode == Opcode.SCHEMA else self.channels
        is_new = number not in known
        self._defined_bytes += is_new * len(content)
        if self._defined_bytes > DEFINED_LIMIT_BYTES or len(known) + is_new > CHANNEL_LIMIT:
            raise UnreadableRecording(
                f"The file defines {len(known) + is_new} types or topics in {self._defined_bytes} bytes; the "
                f"limits are {CHANNEL_LIMIT} and {DEFINED_LIMIT_BYTES}. This is not a recording of an arm.",
            )
        if opcode == Opcode.SCHEMA:
            schema = MessageSchema(fields.text(), fields.text(), fields.bytes())
            same = number != 0 and self.schemas.setdefault(number, schema) == schema
        else:
            channel = Channel(number, fields.number(2), fields.text(), fields.text())
            about = fields.texts()
            qos = about.get("offered_qos_profiles", "")
            channel = replace(channel, publisher=about.get("callerid", "")[:80], qos=qos)
            same = self.channels.setdefault(number, channel) == channel
            if channel.schema and channel.schema not in self.schemas:
                raise UnreadableRecording(f"{channel.topic!r} has a type that is not defined before it. {RECOVER}")
        if not same:
            what = "schemas" if opcode == Opcode.SCHEMA else "channels"
            raise UnreadableRecording(f"Two {what} have the number {number}. {RECOVER}")
        return number
