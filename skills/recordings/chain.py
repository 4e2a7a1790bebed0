"""Find the records in bytes that hold one behind the other.

    bytes --follow--> Chain: where each message begins and how long it is

A record's end is known from its head only, so a chain is followed link by link; but where all the bytes that could be
a message's opcode are looked at together, nearly every link is found at once.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from skills.errors import UnreadableRecording
from skills.recordings.source import HEAD
from skills.style._arrays import Ints

RECORD_LIMIT = 300_000  # of all records but messages: 5,600 chunks with 50 indexes each, as rosbag2 writes, are 286,000
SMALL_BYTES = 4096  # so few are followed one by one

MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time; then the content
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
PRIVATE = 0x80  # opcodes from here on are nobody's business (specification, "Opcodes")

Bytes = NDArray[np.uint8]

_RUNS = 1000  # beyond it records are followed one by one
_ROUNDS = 3
_NONE: Final = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Chain:
    """Records that stand one behind the other.

    Attributes:
        messages: Where the heads of messages begin, shape (N,).
        lengths: The length of each message's content, its times included, shape (N,).
        others: Opcode, beginning and end of the content of every other record.
        end: Where the last whole record ends.
    """

    messages: Ints
    lengths: Ints
    others: list[tuple[int, int, int]]
    end: int


def follow(data: Bytes) -> Chain:
    """Follow records that stand one behind the other, up to the first that is not whole or no message or definition.

    Every place that could be a message's head is looked at at once; where one ends at the next, nothing is to be done.

    Args:
        data: Bytes that begin with a record's head, shape (B,).
    """
    if len(data) <= SMALL_BYTES:
        return follow_one_by_one(data)
    found = np.flatnonzero(data[: max(0, len(data) - HEAD.size + 1)] == int(Opcode.MESSAGE))
    said = numbers_at(data, found + 1, "<u8")
    fits = (said >= MESSAGE.size) & (said <= (len(data) - HEAD.size - found).astype(np.uint64))
    found, lengths, ends = _without_inner(found[fits], said[fits].astype(np.int64))
    runs: list[slice] = []
    others: list[tuple[int, int, int]] = []
    at = 0
    while at < len(data):
        first = int(np.searchsorted(found, at))
        if first < len(found) and found[first] == at:
            run = int(np.searchsorted(ends, first))
            last = int(ends[run]) if run < len(ends) else len(found) - 1
            runs.append(slice(first, last + 1))
            at = int(found[last] + HEAD.size + lengths[last])
        elif (other := _other(data.data, at)) is not None:
            others.append(other)
            at = other[2]
        elif _is_message(data.data, at):
            return follow_one_by_one(data)
        else:
            break
        if len(runs) + len(others) > _RUNS:
            return follow_one_by_one(data)
    return Chain(_along(found, runs), _along(lengths, runs), others, at)


def _without_inner(found: Ints, lengths: Ints) -> tuple[Ints, Ints, Ints]:
    """Leave out what only looks like a head and stands inside a message; also say after which the next does not follow.

    It goes by the message before it, which may be none either: whoever misses a message must look for himself.
    """
    for _ in range(_ROUNDS):
        after = found + HEAD.size + lengths
        ends = np.flatnonzero(after[:-1] != found[1:])
        inner = ends[ends + 2 < len(found)]
        inner = inner[after[inner] == found[inner + 2]] + 1
        if not len(inner):
            break
        found, lengths = np.delete(found, inner), np.delete(lengths, inner)
    return found, lengths, np.flatnonzero((found + HEAD.size + lengths)[:-1] != found[1:])


def _along(column: Ints, runs: list[slice]) -> Ints:
    return column[runs[0]] if len(runs) == 1 else np.concatenate([_NONE, *(column[run] for run in runs)])


def follow_one_by_one(data: Bytes) -> Chain:
    """Follow records as `follow` does, one after the other."""
    messages: list[int] = []
    lengths: list[int] = []
    others: list[tuple[int, int, int]] = []
    at, size, view, unpack_head = 0, len(data), data.data, HEAD.unpack_from
    while at + HEAD.size <= size:
        _, length = unpack_head(view, at)
        if _is_message(view, at):
            messages.append(at)
            lengths.append(length)
            at += HEAD.size + length
        elif (other := _other(view, at)) is not None:
            others.append(other)
            at = other[2]
            check_records(len(others))
        else:
            break
    return Chain(np.array(messages, dtype=np.int64), np.array(lengths, dtype=np.int64), others, at)


def numbers_at(data: Bytes, places: Ints, kind: str) -> NDArray[np.uint64]:
    """Read a number at each place, aligned or not."""
    size = np.dtype(kind).itemsize
    return np.ndarray((max(0, len(data) - size + 1),), kind, data, 0, (1,))[places]


def check_records(count: int) -> None:
    """Refuse more records beside the messages than any recorder writes."""
    if count > RECORD_LIMIT:
        raise UnreadableRecording(
            f"The file has more than {RECORD_LIMIT} records beside its messages. Record with larger chunks.",
            records=count,
        )


def _is_message(data: memoryview, at: int) -> bool:
    """Say whether a whole message begins here."""
    begin = at + HEAD.size
    if begin > len(data) or data[at] != Opcode.MESSAGE:
        return False
    _, length = HEAD.unpack_from(data, at)
    return bool(MESSAGE.size <= length <= len(data) - begin)


def _other(data: memoryview, at: int) -> tuple[int, int, int] | None:
    """Return a whole record that is no message, None where there is none."""
    begin = at + HEAD.size
    if begin > len(data):
        return None
    opcode, length = HEAD.unpack_from(data, at)
    if length > len(data) - begin or not (opcode in DEFINITIONS or opcode >= PRIVATE):
        return None
    return opcode, begin, begin + length
