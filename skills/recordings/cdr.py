"""Turn CDR messages into columns of numbers, all messages of a topic at once.

    definition --fields_of--> fields --Decoder--> Columns: stamps (N,), values (N, K), labels

A message is its encapsulation header of four bytes, then its fields one behind the other, each number aligned to its
own size counted from the end of that header; a text or a sequence has its length before it (OMG CDR 1.0; ROS 2 design,
"Serialization"). So messages of one length, whose inner lengths are the same too, have every field in the same place:
such a shape is worked out once, in plain Python, and the numbers are then taken from all of its messages by stride.

Fields are found by their names in the definition that the file carries; what a message is called decides nothing.
"""

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skills.errors import UnreadableRecording
from skills.style._arrays import Floats, Ints

SHAPES_LIMIT = 1000  # ours: a topic whose every message has other lengths is no arm's
FIELDS_LIMIT = 1000
DEPTH_LIMIT = 20
SLACK_BYTES = 8
SPARE_BYTES = 7  # some middlewares pad a message to a multiple of 4 or 8

_NANO = 1_000_000_000
_ENCAPSULATION_BYTES = 4
_ORDERS = {0x0000: ">", 0x0001: "<"}  # plain CDR; parameter lists and XCDR 2 lay fields out otherwise
_CODES = {
    **{"bool": "b1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_TIME = ["int32 sec", "uint32 nanosec"]
_BUILT_IN = {f"builtin_interfaces/{name}": _TIME for name in ("Time", "Duration")}  # some writers leave them out
_RULE = re.compile(r"^={3,}\s*$", re.MULTILINE)
_NAME = re.compile(r"^MSG:\s+(\S+)$")
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)")

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Field:
    """One field of a message, those of the messages in it included.

    Attributes:
        path: Its name, such as "pose.position.x".
        code: numpy's code of the number, such as "f8"; "" for a text.
        count: How many there are; None for a sequence, whose length stands before it.
    """

    path: str
    code: str
    count: int | None = 1


def fields_of(name: str, definition: str) -> tuple[Field, ...]:
    """Read a ros2msg definition: the message's own part, then those of the messages in it, each below a rule of `=`.

    Raises:
        UnreadableRecording: It is incomplete, holds arrays of messages or wide text, or is larger than any message.
    """
    first, *others = _RULE.split(definition)
    parts = _BUILT_IN | {_short(name): _lines(first)}
    for other in others:
        head, *lines = _lines(other) or [""]
        if (said := _NAME.match(head)) is None:
            raise UnreadableRecording(f"The definition of {name} has a part without a name.")
        parts[_short(said[1])] = lines
    return tuple(_flat(parts, _short(name)))


@dataclass(frozen=True, eq=False)
class Columns:
    """Messages as numbers.

    Attributes:
        stamps_ns: From the headers, shape (N,); None where messages have none.
        values: The wanted numbers, shape (N, K).
        labels: The texts that were found, frames or tools, each once.
        label_of: Which of them each message has, shape (N,).
    """

    stamps_ns: Ints | None
    values: Floats
    labels: tuple[str, ...]
    label_of: Ints

    @property
    def labels_in_order(self) -> list[str]:
        """The labels as they come up."""
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


class Decoder:
    """Decodes the messages of one channel; what it learns of their shapes it keeps."""

    def __init__(self, topic: str, fields: Sequence[Field], wanted: Wanted) -> None:
        """Say what is wanted.

        Raises:
            UnreadableRecording: It is not among the fields.
        """
        self._topic, self._fields, self._wanted = topic, fields, wanted
        here = {field.path: field for field in fields}
        missing = [path for path in (*wanted.numbers, wanted.text) if path and path not in here]
        if missing:
            raise UnreadableRecording(f"The messages of {topic} have no {missing[0]}.", topic=topic, field=missing[0])
        self._stamped = "header.stamp.sec" in here and "header.stamp.nanosec" in here
        self._shapes: list[_Shape] = []

    def decode(self, data: Bytes, begin: Ints, length: Ints) -> Columns:
        """Decode messages.

        Args:
            data: Bytes that hold them, shape (B,); `SLACK_BYTES` more follow the last message.
            begin: Where each begins, shape (N,), N at least 1.
            length: How long each is, shape (N,).

        Raises:
            UnreadableRecording: A message that ends within a field, or one with another number of values than others.
        """
        parts = list(self._by_shape(data, begin, length))
        if len(parts) == 1:
            return parts[0][1]
        widths = sorted({part.values.shape[1] for _, part in parts})
        if len(widths) > 1:
            raise UnreadableRecording(
                f"{self._topic} has messages with {widths[0]} and with {widths[1]} values; record them apart.",
                topic=self._topic,
            )
        order = np.argsort(np.concatenate([which for which, _ in parts]))
        labels = list(dict.fromkeys(part.labels[0] for _, part in parts))
        label_of = [np.full(len(which), labels.index(part.labels[0])) for which, part in parts]
        stamps_ns = [part.stamps_ns for _, part in parts if part.stamps_ns is not None]
        return Columns(
            stamps_ns=np.concatenate(stamps_ns)[order] if stamps_ns else None,
            values=np.concatenate([part.values for _, part in parts])[order],
            labels=tuple(labels),
            label_of=np.concatenate(label_of)[order],
        )

    def _by_shape(self, data: Bytes, begin: Ints, length: Ints) -> Iterator[tuple[Ints, Columns]]:
        """Give messages of the same shape together: which they are, and what they say."""
        sizes = length[:1] if (length == length[0]).all() else np.unique(length)
        for size in sizes.tolist():
            left = np.flatnonzero(length == size) if len(sizes) > 1 else np.arange(len(length))
            known = [shape for shape in self._shapes if shape.size == size]
            while len(left):
                first = int(begin[left[0]])
                shape = known.pop(0) if known else self._shape(data[first : first + size].tobytes())
                rows = _rows(data, begin[left], shape.width)
                if (same := shape.fits(rows)) is None:
                    yield left, shape.columns(rows)
                    break
                if same.any():
                    yield left[same], shape.columns(rows[same])
                left = left[~same]

    def _shape(self, message: bytes) -> "_Shape":
        """Work out the shape of a message and keep it."""
        if len(self._shapes) == SHAPES_LIMIT:
            raise UnreadableRecording(
                f"The messages of {self._topic} have more than {SHAPES_LIMIT} shapes or texts; this is no arm's topic.",
                topic=self._topic,
            )
        shape = _shape_of(message, self._fields, self._wanted, self._topic)
        self._shapes.append(shape)
        return shape


@dataclass(frozen=True, eq=False)
class _Shape:
    """Where the fields of some messages are.

    Attributes:
        size: Bytes of a message.
        width: How many of them are needed, rounded up to whole words of 8 bytes.
        words: Which words hold a length or the text, shape (M,).
        mask: Which bits of these words do, shape (M,).
        marked: Those bits, the same in every message of this shape, shape (M,).
        places: The wanted numbers: numpy's code, place and count of each run of them.
        stamp: numpy's codes and places of seconds and nanoseconds, empty where there is no stamp.
        text: The text in all of them.
    """

    size: int
    width: int
    words: Ints
    mask: NDArray[np.uint64]
    marked: NDArray[np.uint64]
    places: tuple[tuple[str, int, int], ...]
    stamp: tuple[tuple[str, int], ...]
    text: str

    def fits(self, rows: Bytes) -> NDArray[np.bool_] | None:
        """Say which messages have this shape, shape (N,); None where all have."""
        others = (rows.view(np.uint64)[:, self.words] & self.mask) != self.marked
        return ~others.any(axis=1) if others.any() else None

    def columns(self, rows: Bytes) -> Columns:
        """Take stamps and wanted numbers out of messages of this shape."""
        stamps_ns = None
        if self.stamp:
            seconds, nanoseconds = (_numbers(rows, code, at, 1)[:, 0].astype(np.int64) for code, at in self.stamp)
            stamps_ns = seconds * _NANO + nanoseconds
        runs = [_numbers(rows, code, at, count).astype(np.float64) for code, at, count in self.places]
        values = runs[0] if len(runs) == 1 else np.concatenate([np.zeros((len(rows), 0)), *runs], axis=1)
        return Columns(stamps_ns, values, (self.text,), np.zeros(len(rows), dtype=np.int64))


def _rows(data: Bytes, begin: Ints, width: int) -> Bytes:
    """Copy the first bytes of messages under each other, shape (N, width)."""
    items = np.ndarray((len(data) - width + 1,), f"V{width}", data, 0, (1,))
    return items[begin].view(np.uint8).reshape(len(begin), width)


def _numbers(rows: Bytes, code: str, at: int, count: int) -> NDArray[np.generic]:
    """Show numbers that stand side by side in every row, shape (N, count)."""
    return np.ndarray((len(rows), count), code, rows.data, at, (rows.shape[1], np.dtype(code).itemsize))


def _shape_of(message: bytes, fields: Sequence[Field], wanted: Wanted, topic: str) -> _Shape:
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
    stamp = [found[path][:2] for path in ("header.stamp.sec", "header.stamp.nanosec") if path in found]
    places = _merged([found[path] for path in wanted.numbers], first=wanted.first)
    ends = [at + count * np.dtype(code).itemsize for code, at, count in [*places, *((*place, 1) for place in stamp)]]
    width = _words(max([*ends, cursor.text_ends, _ENCAPSULATION_BYTES]))
    mask = np.zeros(_words(len(message)), np.uint8)
    mask[cursor.marks] = 0xFF  # what stands behind the last wanted number is left to each message
    bits, first = (np.frombuffer(data[:width], np.uint64) for data in (mask.tobytes(), message.ljust(len(mask), b"\0")))
    words = np.flatnonzero(bits)
    return _Shape(len(message), width, words, bits[words], (first & bits)[words], places, tuple(stamp), text)


def _words(size: int) -> int:
    """Round up to whole words of 8 bytes."""
    return -(-size // 8) * 8


def _merged(places: list[tuple[str, int, int]], *, first: bool) -> tuple[tuple[str, int, int], ...]:
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


def _lines(part: str) -> list[str]:
    """Return the lines that say something, without comments."""
    lines = (line.split("#", 1)[0].strip() for line in part.splitlines())
    return [line for line in lines if line]


def _short(name: str) -> str:
    """Write "geometry_msgs/msg/Pose" and "geometry_msgs/Pose" as the second."""
    package, *_, own = name.split("/") if "/" in name else ("", name)
    return f"{package}/{own}"


def _flat(parts: dict[str, list[str]], name: str) -> list[Field]:
    """List the fields of a message in their order, those of messages within it in their place."""
    fields: list[Field] = []
    _add_fields(fields, parts, name, prefix="", depth=0)
    return fields


def _add_fields(fields: list[Field], parts: dict[str, list[str]], name: str, *, prefix: str, depth: int) -> None:
    if name not in parts or depth > DEPTH_LIMIT:
        raise UnreadableRecording(f"{name} is not defined in the file, or holds itself.")
    declared = [match for match in map(_FIELD.match, parts[name]) if match is None or not match[4]]
    for match in declared:
        if match is None:
            raise UnreadableRecording(f"The definition of {name} has a line that is no field.")
        kind, array, path = match[1], match[2], prefix + match[3]
        if kind in _CODES or kind == "string":
            fields.append(Field(path, _CODES.get(kind, ""), _count(array)))
        elif array or kind in ("wstring", "time", "duration"):
            raise UnreadableRecording(f"{name} has a field of type {kind}{array or ''}, which is not read here.")
        else:
            inner = _short(kind if "/" in kind else f"{name.split('/')[0]}/{kind}")
            _add_fields(fields, parts, inner, prefix=f"{path}.", depth=depth + 1)
        if len(fields) > FIELDS_LIMIT:
            raise UnreadableRecording(f"{name} has more than {FIELDS_LIMIT} fields.")
    if not declared:
        fields.append(Field(f"{prefix}structure_needs_at_least_one_member", "u1"))  # ROS 2 design, "IDL mapping"


def _count(array: str | None) -> int | None:
    """Read "[3]" as 3; a sequence, bounded or not, as None; nothing as 1."""
    if array is None:
        return 1
    inside = array[1:-1]
    return int(inside) if inside.isdigit() else None
