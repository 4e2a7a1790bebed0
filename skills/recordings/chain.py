"""Find the records in bytes that hold one behind the other.

    bytes --Chain.follow--> where each message begins, how long it is, whose it is and when it was logged

A record's end is known from its head only, so a chain is followed link by link from the first byte on: through messages
by a compiled loop, and over every other record by hand.
"""

import struct
from functools import cached_property
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from skills.errors import UnreadableRecording
from skills.recordings import _kernels
from skills.recordings.source import HEAD
from skills.style._arrays import Ints

RECORD_LIMIT = 300_000  # of all records but messages: 5,600 chunks with 50 indexes each, as rosbag2 writes, are 286,000

MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time; then the content
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
PRIVATE = 0x80  # opcodes from here on are nobody's business (specification, "Opcodes")

Bytes = NDArray[np.uint8]


class Chain:
    """Records that stand one behind the other, followed from the first byte on, piece by piece.

    Attributes:
        others: Opcode, beginning and end of the content of every record that is no message.
        end: Where the last whole record ends.
    """

    def __init__(self, data: Bytes) -> None:
        """Begin with bytes that begin with a record's head, shape (B,); what they are may be written piece by piece."""
        self.others: list[tuple[int, int, int]] = []
        self.end = 0
        self._data = looked_at(data)
        self._count = 0
        most = len(data) // (HEAD.size + MESSAGE.size)
        self._messages, self._lengths = np.empty(most, np.int64), np.empty(most, np.int64)
        self._channels, self._log_ns = np.empty(most, np.uint16), np.empty(most, np.uint64)

    def follow(self, to: int) -> None:
        """Follow on, up to a byte or the first record that is not whole before it or no message or definition.

        Raises:
            UnreadableRecording: More other records than any recorder writes.
        """
        data = self._data[:to]
        view, found = data.data, (self._messages, self._lengths, self._channels, self._log_ns)
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
        """Where the heads of messages begin, shape (N,)."""
        return self._messages[: self._count]

    @property
    def lengths(self) -> Ints:
        """The length of each message's content, shape (N,)."""
        return self._lengths[: self._count]

    @property
    def channels(self) -> NDArray[np.uint16]:
        """The number of each message's channel, shape (N,)."""
        return self._channels[: self._count]

    @property
    def log_ns(self) -> NDArray[np.uint64]:
        """When each was logged, unsigned nanoseconds, shape (N,)."""
        return self._log_ns[: self._count]

    @cached_property
    def counts(self) -> Ints:
        """How many messages each channel has, by its number; ask when all is followed."""
        return np.bincount(self.channels)

    def of(self, number: int) -> Ints:
        """Say which messages are of one channel that has some, in the order of the file."""
        end = int(self._ends[number])
        return self._by_channel[end - int(self.counts[number]) : end]

    @cached_property
    def _by_channel(self) -> Ints:
        return np.argsort(self.channels, kind="stable")

    @cached_property
    def _ends(self) -> Ints:
        return np.cumsum(self.counts)


def follow(data: Bytes) -> Chain:
    """Follow records that stand one behind the other, up to the first that is not whole or no message or definition.

    Args:
        data: Bytes that begin with a record's head, shape (B,).

    Raises:
        UnreadableRecording: More other records than any recorder writes.
    """
    chain = Chain(data)
    chain.follow(len(data))
    return chain


def looked_at(data: Bytes) -> Bytes:
    """Show bytes that cannot be written to: what the compiled loops are compiled for."""
    shown = data.view()
    shown.setflags(write=False)
    return shown


def check_records(count: int) -> None:
    """Refuse more records beside the messages than any recorder writes."""
    if count > RECORD_LIMIT:
        raise UnreadableRecording(
            f"The file has more than {RECORD_LIMIT} records beside its messages. Record with larger chunks.",
            records=count,
        )


def _other(data: memoryview, at: int) -> tuple[int, int, int] | None:
    """Return a whole record that is no message, None where there is none."""
    begin = at + HEAD.size
    if begin > len(data):
        return None
    opcode, length = HEAD.unpack_from(data, at)
    if length > len(data) - begin or not (opcode in DEFINITIONS or opcode >= PRIVATE):
        return None
    return opcode, begin, begin + length
