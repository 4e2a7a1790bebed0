"""Messages of one length whose inner lengths are the same too have every field in one place: they have one shape.

    message --shape_of--> Shape, and all messages like it --take--> words --Shape.columns--> Columns

A message is its encapsulation header of four bytes, then its fields one behind the other, each number aligned to its
own size counted from the end of that header; a text or a sequence has its length before it (OMG CDR 1.0; ROS 2 design,
"Serialization"). A shape is worked out once, in plain Python; a compiled loop then takes the numbers from all messages.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from operator import mul

import numpy as np
from numpy.typing import NDArray

from skills.errors import UnreadableRecording
from skills.recordings import _kernels
from skills.recordings.chain import MESSAGE, Bytes, looked_at
from skills.recordings.definitions import Field
from skills.recordings.source import HEAD
from skills.style._arrays import Floats, Ints

SLACK_BYTES = 8
SPARE_BYTES = 7  # some middlewares pad a message to a multiple of 4 or 8

_NANO = 1_000_000_000
_ENCAPSULATION_BYTES = 4
HEAD_BYTES = HEAD.size + MESSAGE.size  # stand before the content of a message
_LOG_AT = 15  # where in them the log time is (MCAP specification, "Message")
_WORD_BYTES = 8
_ORDERS = {0x0000: ">", 0x0001: "<"}  # plain CDR; parameter lists and XCDR 2 lay fields out otherwise


@dataclass(frozen=True, eq=False)
class Columns:
    """Messages as numbers.

    Attributes:
        log_ns: When each was logged, unsigned nanoseconds, shape (N,).
        stamps_ns: From the headers, shape (N,); None where messages have none.
        values: The wanted numbers, shape (N, K).
        labels: The texts that were found, frames or tools, each once.
        label_of: Which of them each message has, shape (N,).
    """

    log_ns: NDArray[np.uint64]
    stamps_ns: Ints | None
    values: Floats
    labels: tuple[str, ...]
    label_of: Ints

    @property
    def labels_in_order(self) -> list[str]:
        """The labels as they come up."""
        if len(self.labels) == 1:
            return list(self.labels)
        _, first = np.unique(self.label_of, return_index=True)
        return [self.labels[self.label_of[k]] for k in sorted(first)]


@dataclass(frozen=True)
class Wanted:
    """What to take from messages of one type: numbers, or the start of a sequence, and a text.

    Attributes:
        numbers: Paths of fields.
        text: Path of the text that messages are told apart by; "" for none.
        first: Of a sequence, its first number only.
    """

    numbers: tuple[str, ...] = ()
    text: str = ""
    first: bool = False


@dataclass(frozen=True, eq=False)
class Shape:
    """Where the fields of some messages are: in words of eight bytes, told by their first byte after the head's first.

    Attributes:
        size: Bytes of a message's content.
        looks: How many words, the first M, are only looked at: they hold a length or the text.
        places: Where these begin, then where those begin that hold the log time and what is wanted, shape (M + W,).
        masks: Which bits of each are the same in every message of this shape, shape (M + W,).
        marked: Those bits, shape (M + W,).
        stamp: Seconds and nanoseconds, nothing where there is no stamp.
        runs: The wanted numbers.
        text: The text in all of them.
    """

    size: int
    looks: int
    places: NDArray[np.uint64]
    masks: NDArray[np.uint64]
    marked: NDArray[np.uint64]
    stamp: tuple["_Run", ...]
    runs: tuple["_Run", ...]
    text: str

    def columns(self, taken: NDArray[np.uint64]) -> Columns:
        """Make stamps and values of words that were taken, shape (N, W)."""
        stamps_ns = None
        if self.stamp:
            seconds, nanoseconds = (run.numbers(taken)[:, 0] for run in self.stamp)
            stamps_ns = np.multiply(seconds, _NANO, dtype=np.int64)
            stamps_ns += nanoseconds
        runs = [run.numbers(taken).astype(np.float64, copy=False) for run in self.runs]
        values = runs[0] if len(runs) == 1 else np.concatenate([np.zeros((len(taken), 0)), *runs], axis=1)
        return Columns(taken[:, 0], stamps_ns, values, (self.text,), np.zeros(len(taken), dtype=np.int64))


@dataclass(frozen=True, eq=False)
class Taken:
    """Words of messages of one shape, shape (N, W)."""

    shape: Shape
    words: NDArray[np.uint64]


@dataclass(frozen=True)
class _Run:
    """Numbers that stand side by side: numpy's code, how many there are, and the first of their words that is taken."""

    code: str
    count: int
    word: int

    def numbers(self, taken: NDArray[np.uint64]) -> NDArray[np.generic]:
        """Show them, shape (N, count)."""
        words = -(-self.count * np.dtype(self.code).itemsize // _WORD_BYTES)
        return taken[:, self.word : self.word + words].view(self.code)[:, : self.count]


def take(
    data: Bytes, messages: Ints, lengths: Ints, kinds: Ints, shapes: Sequence[Shape], counts: Sequence[int]
) -> tuple[NDArray[np.bool_], list[NDArray[np.uint64]]]:
    """Take what is wanted from messages, in one pass over all of them.

    Args:
        data: Bytes that hold them, shape (B,); `SLACK_BYTES` more follow the last message.
        messages: Where the head of each begins, shape (N,).
        lengths: How long the content of each is, shape (N,).
        kinds: Which of the shapes each may have, -1 for none, shape (N,).
        shapes: S of them.
        counts: How many messages may have each.

    Returns:
        Which have their shape, shape (N,), and for every shape the words of those that do, shape (K, W).
    """
    widths = [len(shape.places) - shape.looks for shape in shapes]
    rooms = np.cumsum([0, *map(mul, widths, counts)], dtype=np.uint64)
    words = np.cumsum([0, *(len(shape.places) for shape in shapes)], dtype=np.uint64)
    taken, found = np.empty(rooms[-1], np.uint64), np.zeros(len(shapes), np.uint64)
    fits = np.empty(len(messages), np.bool_)
    _kernels.take_compiled(
        looked_at(data),
        messages,
        lengths,
        kinds,
        np.array([shape.size for shape in shapes]),
        words,
        words[1:] - np.array(widths, np.uint64),
        np.concatenate([shape.places for shape in shapes]),
        np.concatenate([shape.masks for shape in shapes]),
        np.concatenate([shape.marked for shape in shapes]),
        np.zeros(len(shapes), np.uint64),
        rooms,
        taken,
        found,
        fits,
    )
    each = zip(rooms.tolist(), found.tolist(), widths, strict=False)
    return fits, [taken[begin : begin + count * width].reshape(count, width) for begin, count, width in each]


def shape_of(message: bytes, fields: Sequence[Field], wanted: Wanted, topic: str) -> Shape:
    """Walk over the fields of one message."""
    cursor = _Cursor(message, topic)
    found: dict[str, tuple[str, int, int]] = {}
    text = ""
    for field in fields:
        if field.code:
            found[field.path] = cursor.numbers(field.code, field.count)
        elif field.path == wanted.text:
            text = cursor.text(marked=True)
        else:
            for _ in range(cursor.length(4) if field.count is None else field.count):
                cursor.text()
    if len(message) - cursor.at > SPARE_BYTES:
        raise UnreadableRecording(
            f"A message of {topic} is {len(message) - cursor.at} bytes longer than its definition says.", topic=topic
        )
    stamp = [found[path] for path in ("header.stamp.sec", "header.stamp.nanosec") if path in found]
    numbers = [*((code, at, 1) for code, at, _ in stamp), *_merged([found[p] for p in wanted.numbers], wanted.first)]
    ends = [at + count * np.dtype(code).itemsize for code, at, count in numbers]
    mask = np.zeros(-(-len(message) // _WORD_BYTES) * _WORD_BYTES, np.uint8)
    mask[cursor.marks] = 0xFF
    mask[max([*ends, cursor.text_ends, _ENCAPSULATION_BYTES]) :] = 0  # what stands behind is left to each message
    bits, first = mask.view("<u8"), np.frombuffer(message.ljust(len(mask), b"\0"), "<u8")
    looks = np.flatnonzero(bits)
    places, runs = _places(numbers)
    nothing = np.zeros(len(places), np.uint64)
    return Shape(
        size=len(message),
        looks=len(looks),
        places=np.concatenate([HEAD_BYTES + _WORD_BYTES * looks, places]).astype(np.uint64),
        masks=np.concatenate([bits[looks], nothing]),
        marked=np.concatenate([(first & bits)[looks], nothing]),
        stamp=runs[: len(stamp)],
        runs=runs[len(stamp) :],
        text=text,
    )


def _places(runs: Sequence[tuple[str, int, int]]) -> tuple[list[int], tuple[_Run, ...]]:
    """Say which words to take for runs of numbers, given by code, place and count, and where each is among them."""
    places = [_LOG_AT]
    found = []
    for code, at, count in runs:
        found.append(_Run(code, count, len(places)))
        places.extend(range(HEAD_BYTES + at, HEAD_BYTES + at + count * np.dtype(code).itemsize, _WORD_BYTES))
    return places, tuple(found)


def _merged(places: list[tuple[str, int, int]], first: bool) -> tuple[tuple[str, int, int], ...]:
    """Join numbers that stand side by side."""
    merged: list[tuple[str, int, int]] = []
    for code, at, count in places:
        last = merged[-1] if merged else ("", 0, 0)
        if code == last[0] and at == last[1] + last[2] * np.dtype(code).itemsize:
            merged[-1] = (code, last[1], last[2] + count)
        else:
            merged.append((code, at, min(count, 1) if first else count))
    return tuple(merged)


class _Cursor:
    """A place in one message, and the places of what must be the same in every message of its shape."""

    def __init__(self, message: bytes, topic: str) -> None:
        self._message, self._topic = message, topic
        self.at = _ENCAPSULATION_BYTES
        self.marks = [0, 1]
        self.text_ends = 0
        order = _ORDERS.get(int.from_bytes(message[:2], "big")) if len(message) >= self.at else None
        if order is None:
            raise UnreadableRecording(f"A message of {topic} is not plain CDR; record with the default middleware.")
        self._order = order

    def numbers(self, code: str, count: int | None) -> tuple[str, int, int]:
        """Pass numbers by: their code, place and count."""
        size = int(code[1])
        count = self.length(size) if count is None else count
        begin = self._aligned(size) if count else self.at
        self._move(begin + size * count)
        return self._order + code, begin, count

    def text(self, *, marked: bool = False) -> str:
        """Pass a text by, and return it if it is marked."""
        begin = self.at + _padding(self.at, 4) + 4
        length = self.length(1)
        self._move(begin + length)
        if not marked:
            return ""
        self.marks.extend(range(begin, begin + length))
        self.text_ends = begin + length
        try:
            return self._message[begin : begin + max(0, length - 1)].decode()
        except UnicodeDecodeError:
            raise UnreadableRecording(f"A text in {self._topic} is not UTF-8.", topic=self._topic) from None

    def length(self, size: int) -> int:
        """Pass a length by, of things that have at least `size` bytes each."""
        begin = self._aligned(4)
        self._move(begin + 4)
        self.marks.extend(range(begin, begin + 4))
        length: int = struct.unpack_from(f"{self._order}I", self._message, begin)[0]
        if length * size > len(self._message):
            self._end()
        return length

    def _aligned(self, size: int) -> int:
        return self.at + _padding(self.at, size)

    def _move(self, at: int) -> None:
        if at > len(self._message):
            self._end()
        self.at = at

    def _end(self) -> None:
        raise UnreadableRecording(f"A message of {self._topic} ends within a field.", topic=self._topic)


def _padding(at: int, size: int) -> int:
    return -(at - _ENCAPSULATION_BYTES) % size
