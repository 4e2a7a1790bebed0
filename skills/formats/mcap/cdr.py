"""CDR messages as columns: their layout from the definition in the file, and the numbers in them.

    definition --fields_of--> fields
    message --shape_of--> Shape, and all messages of that shape --take--> words --Shape.columns--> Columns

Fields are identified by their names; the name of the message type is not used.

A message is its encapsulation header of four bytes, then its fields in order, each number aligned to its own size,
counted from the end of that header; a string or a sequence is preceded by its length (OMG CDR 1.0; ROS 2 design,
"Serialization"). Messages of the same length, with the same lengths of strings and sequences, have all fields at the
same positions: they have one shape. A shape is determined once, in Python; a compiled loop then copies the numbers from
all messages.

All messages of a channel in some MiB of the file are decoded at once:

    definition --fields_of--> fields --Decoder--> Columns: log times and stamps (N,), values (N, K), labels
"""

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Flags, Floats, Ints
from skills.demonstration.recording import NS_PER_S
from skills.errors import UnreadableRecording
from skills.formats.mcap import _kernels
from skills.formats.mcap.records import HEAD, MESSAGE, Bytes, looked_at

FIELDS_LIMIT = 1000
DEPTH_LIMIT = 20

_CODES = {
    **{"bool": "b1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_TIME = ["int32 sec", "uint32 nanosec"]
_BUILT_IN = {f"builtin_interfaces/{name}": _TIME for name in ("Time", "Duration")}  # some writers omit them
_RULE = re.compile(r"^={3,}\s*$", re.MULTILINE)
_NAME = re.compile(r"^MSG:\s+(\S+)$")
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)")


SLACK_BYTES = 8  # after the data, because the last word of a message may extend beyond it
SPARE_BYTES = 7  # some middleware pads a message to a multiple of 4 or 8
_ENCAPSULATION_BYTES = 4
HEAD_BYTES = HEAD.size + MESSAGE.size  # the header, before the content of a message
_LOG_AT = 15  # position of the log time in it (MCAP specification, "Message")
_WORD_BYTES = 8
_ZSTD = b"\x28\xb5\x2f\xfd"
UNPACK = (
    "Convert the bag with `ros2 bag convert -i BAG -o out.yaml`, where out.yaml has an output bag with `storage_id: "
    "mcap`, `all: true` and no compression; or record with `--compression-mode file`."
)
_ORDERS = {0x0000: ">", 0x0001: "<"}  # plain CDR; parameter lists and XCDR 2 have other layouts
SHAPES_LIMIT = 1000  # ours: messages of an arm do not change their lengths so often; bounds the cache


@dataclass(frozen=True)
class Field:
    """One field of a message; nested messages are flattened.

    Attributes:
        path: Its name, such as "pose.position.x".
        code: numpy's type code of the number, such as "f8"; "" for a string.
        count: The number of elements; None for a sequence, which is preceded by its length.
    """

    path: str
    code: str
    count: int | None = 1


def fields_of(name: str, definition: str) -> tuple[Field, ...]:
    """Parse a ros2msg definition into fields.

    Args:
        name: The message type.
        definition: The message's own definition, then those of nested messages, each after a line of `=`.

    Raises:
        UnreadableRecording: It is incomplete, has arrays of messages or wide strings, or is larger than any message.
    """
    first, *others = _RULE.split(definition)
    parts = _BUILT_IN | {_short(name): _lines(first)}
    for other in others:
        head, *lines = _lines(other) or [""]
        if (said := _NAME.match(head)) is None:
            raise UnreadableRecording(f"The definition of {name} has a part without a name.")
        parts[_short(said[1])] = lines
    fields: list[Field] = []
    _add_fields(fields, parts, _short(name), prefix="", depth=0)
    return tuple(fields)


def _lines(part: str) -> list[str]:
    """Return the nonempty lines without comments."""
    lines = (line.split("#", 1)[0].strip() for line in part.splitlines())
    return [line for line in lines if line]


def _short(name: str) -> str:
    """Normalise "geometry_msgs/msg/Pose" and "geometry_msgs/Pose" to the latter."""
    package, *_, own = name.split("/") if "/" in name else ("", name)
    return f"{package}/{own}"


def _add_fields(fields: list[Field], parts: dict[str, list[str]], name: str, *, prefix: str, depth: int) -> None:
    """Append the fields of a message type, and of those nested in it; raises as `fields_of`."""
    if name not in parts or depth > DEPTH_LIMIT:
        raise UnreadableRecording(f"{name} is not defined in the file, or contains itself.")
    declared = [match for match in map(_FIELD.match, parts[name]) if match is None or not match[4]]
    for match in declared:
        if match is None:
            raise UnreadableRecording(f"The definition of {name} has a line that is not a field.")
        kind, array, path = match[1], match[2], prefix + match[3]
        if kind in _CODES or kind == "string":
            fields.append(Field(path, _CODES.get(kind, ""), _count(array)))
        elif array or kind in ("wstring", "time", "duration"):
            raise UnreadableRecording(f"{name} has a field of type {kind}{array or ''}, which is not supported.")
        else:
            inner = _short(kind if "/" in kind else f"{name.split('/')[0]}/{kind}")
            _add_fields(fields, parts, inner, prefix=f"{path}.", depth=depth + 1)
        if len(fields) > FIELDS_LIMIT:
            raise UnreadableRecording(f"{name} has more than {FIELDS_LIMIT} fields.")
    if not declared:
        fields.append(Field(f"{prefix}structure_needs_at_least_one_member", "u1"))  # ROS 2 design, "IDL mapping"


def _count(array: str | None) -> int | None:
    """Parse "[3]" as 3, a bounded or unbounded sequence as None, and no brackets as 1."""
    if array is None:
        return 1
    inside = array[1:-1]
    return int(inside) if inside.isdigit() else None


@dataclass(frozen=True, eq=False)
class Columns:
    """Messages as arrays.

    Attributes:
        log_ns: Log times, unsigned nanoseconds, shape (N,).
        stamps_ns: Stamps of the headers, shape (N,); None if the messages have none.
        values: The wanted numbers, shape (N, K).
        labels: The distinct texts, such as frames or tools.
        label_of: Index of each message's text in `labels`, shape (N,).
    """

    log_ns: NDArray[np.uint64]
    stamps_ns: Ints | None
    values: Floats
    labels: tuple[str, ...]
    label_of: Ints

    @property
    def known_ns(self) -> NDArray[np.integer]:
        """The stamps, or the log times of messages without."""
        return self.log_ns if self.stamps_ns is None else self.stamps_ns

    @property
    def labels_in_order(self) -> list[str]:
        """The labels in order of first appearance."""
        if len(self.labels) == 1:
            return list(self.labels)
        _, first = np.unique(self.label_of, return_index=True)
        return [self.labels[self.label_of[k]] for k in sorted(first)]


@dataclass(frozen=True)
class Wanted:
    """The fields to take from messages of one type: numbers or a sequence, and a text.

    Attributes:
        numbers: Paths of fields.
        text: Path of the text by which messages are distinguished; "" for none.
        first: Take only the first number of a sequence.
    """

    numbers: tuple[str, ...] = ()
    text: str = ""
    first: bool = False


WANTED_POSE = Wanted(
    tuple(f"pose.position.{axis}" for axis in "xyz") + tuple(f"pose.orientation.{axis}" for axis in "xyzw"),
    "header.frame_id",
)


@dataclass(frozen=True, eq=False)
class Shape:
    """The positions of fields in messages of one shape, in words of eight bytes.

    A position is the offset of a word's first byte from the beginning of the message record, header included.

    Attributes:
        size: Bytes of a message's content.
        compared: M, the number of words, at the beginning, that are only compared: they contain the byte order, a
            length or the text.
        places: Positions of these, then of the W words that contain the log time and the wanted numbers, shape (M +
            W,).
        masks: The bits of each word that are equal in all messages of this shape, shape (M + W,).
        marked: The values of those bits, shape (M + W,).
        stamp: Seconds and nanoseconds; empty if there is no stamp.
        runs: The wanted numbers.
        text: The text, equal in all messages.
    """

    size: int
    compared: int
    places: NDArray[np.uint64]
    masks: NDArray[np.uint64]
    marked: NDArray[np.uint64]
    stamp: tuple["_Run", ...]
    runs: tuple["_Run", ...]
    text: str

    def columns(self, taken: NDArray[np.uint64]) -> Columns:
        """Convert copied words, shape (N, W), to columns."""
        stamps_ns = None
        if self.stamp:
            seconds, nanoseconds = (run.numbers(taken)[:, 0] for run in self.stamp)
            stamps_ns = np.multiply(seconds, NS_PER_S, dtype=np.int64)
            stamps_ns += nanoseconds
        runs = [run.numbers(taken).astype(np.float64, copy=False) for run in self.runs]
        values = runs[0] if len(runs) == 1 else np.concatenate([np.zeros((len(taken), 0)), *runs], axis=1)
        return Columns(taken[:, 0], stamps_ns, values, (self.text,), np.zeros(len(taken), dtype=np.int64))


@dataclass(frozen=True)
class _Run:
    """Adjacent numbers: numpy's type code, their count, and the index of the first of their words."""

    code: str
    count: int
    word: int

    def numbers(self, taken: NDArray[np.uint64]) -> NDArray[np.generic]:
        """Return them as a view, shape (N, count)."""
        words = -(-self.count * np.dtype(self.code).itemsize // _WORD_BYTES)
        return taken[:, self.word : self.word + words].view(self.code)[:, : self.count]


def take(data: Bytes, messages: Ints, lengths: Ints, shape: Shape) -> tuple[Flags, NDArray[np.uint64]]:
    """Copy the wanted words from the messages of a shape.

    Args:
        data: Bytes with the messages, shape (B,); `SLACK_BYTES` more follow the last message.
        messages: Position of each header, shape (N,).
        lengths: Length of each content, shape (N,).
        shape: The shape.

    Returns:
        Which messages have the shape, shape (N,), and the words of these, shape (K, W).
    """
    taken = np.empty((len(messages), len(shape.places) - shape.compared), np.uint64)
    fits = np.empty(len(messages), np.bool_)
    of_shape = (shape.size, shape.compared, shape.places, shape.masks, shape.marked)
    found = _kernels.take_compiled(looked_at(data), messages, lengths, *of_shape, taken, fits)
    return fits, taken[: int(found)]


def shape_of(message: bytes, fields: Sequence[Field], wanted: Wanted, topic: str) -> Shape:
    """Determine the shape of a message from its fields.

    Raises:
        UnreadableRecording: It ends within a field, is longer than its definition, or is not plain CDR.
    """
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
            f"A message of {topic} is {len(message) - cursor.at} bytes longer than its definition.", topic=topic
        )
    stamp = [found[path] for path in ("header.stamp.sec", "header.stamp.nanosec") if path in found]
    numbers = [*((code, at, 1) for code, at, _ in stamp), *_merged([found[p] for p in wanted.numbers], wanted.first)]
    ends = [at + count * np.dtype(code).itemsize for code, at, count in numbers]
    mask = np.zeros(-(-len(message) // _WORD_BYTES) * _WORD_BYTES, np.uint8)
    mask[cursor.marks] = 0xFF
    mask[max([*ends, cursor.text_ends, _ENCAPSULATION_BYTES]) :] = 0  # later bytes may differ between messages
    bits, first = mask.view("<u8"), np.frombuffer(message.ljust(len(mask), b"\0"), "<u8")
    compared = np.flatnonzero(bits)
    places, runs = _places(numbers)
    nothing = np.zeros(len(places), np.uint64)
    return Shape(
        size=len(message),
        compared=len(compared),
        places=np.concatenate([HEAD_BYTES + _WORD_BYTES * compared, places]).astype(np.uint64),
        masks=np.concatenate([bits[compared], nothing]),
        marked=np.concatenate([(first & bits)[compared], nothing]),
        stamp=runs[: len(stamp)],
        runs=runs[len(stamp) :],
        text=text,
    )


def _places(runs: Sequence[tuple[str, int, int]]) -> tuple[list[int], tuple[_Run, ...]]:
    """Return the positions of the words to copy for runs of numbers, and the index of each run's first word.

    Args:
        runs: Type code, position and count of each.
    """
    places = [_LOG_AT]
    found = []
    for code, at, count in runs:
        found.append(_Run(code, count, len(places)))
        places.extend(range(HEAD_BYTES + at, HEAD_BYTES + at + count * np.dtype(code).itemsize, _WORD_BYTES))
    return places, tuple(found)


def _merged(places: list[tuple[str, int, int]], first: bool) -> tuple[tuple[str, int, int], ...]:
    """Merge adjacent numbers of the same type."""
    merged: list[tuple[str, int, int]] = []
    for code, at, count in places:
        last = merged[-1] if merged else ("", 0, 0)
        if code == last[0] and at == last[1] + last[2] * np.dtype(code).itemsize:
            merged[-1] = (code, last[1], last[2] + count)
        else:
            merged.append((code, at, min(count, 1) if first else count))
    return tuple(merged)


class _Cursor:
    """A position in a message, with the positions of the bytes that must be equal in all messages of its shape."""

    def __init__(self, message: bytes, topic: str) -> None:
        self._message, self._topic = message, topic
        self.at = _ENCAPSULATION_BYTES
        self.marks = [0, 1]
        self.text_ends = 0
        order = _ORDERS.get(int.from_bytes(message[:2], "big")) if len(message) >= self.at else None
        if order is None:
            if message.startswith(_ZSTD):
                raise UnreadableRecording(f"Messages of {topic} are compressed one by one, with zstd. {UNPACK}")
            raise UnreadableRecording(f"A message of {topic} is not plain CDR; record with the default middleware.")
        self._order = order

    def numbers(self, code: str, count: int | None) -> tuple[str, int, int]:
        """Skip numbers, and return their type code, position and count."""
        size = int(code[1])
        count = self.length(size) if count is None else count
        begin = self._aligned(size) if count else self.at
        self._move(begin + size * count)
        return self._order + code, begin, count

    def text(self, *, marked: bool = False) -> str:
        """Skip a text, and return it if it is marked, otherwise ""."""
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
        """Skip a length and return it; `size` is the minimum size of an element in bytes."""
        begin = self._aligned(4)
        self._move(begin + 4)
        self.marks.extend(range(begin, begin + 4))
        length: int = struct.unpack_from(f"{self._order}I", self._message, begin)[0]
        if length * size > len(self._message):  # before anything iterates over a wrong length
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


class Decoder:
    """The decoder of one channel's messages; it caches their shapes."""

    def __init__(self, topic: str, fields: Sequence[Field], wanted: Wanted) -> None:
        """Create the decoder.

        Args:
            topic: For error messages.
            fields: Fields of the message type, from `fields_of`.
            wanted: The fields to decode.

        Raises:
            UnreadableRecording: A wanted field does not exist.
        """
        self._topic, self._fields, self._wanted = topic, fields, wanted
        here = {field.path: field for field in fields}
        missing = [path for path in (*wanted.numbers, wanted.text) if path and path not in here]
        if missing:
            raise UnreadableRecording(f"The messages of {topic} have no {missing[0]}.", topic=topic, field=missing[0])
        self._shapes: list[Shape] = []

    def decode(self, data: Bytes, begin: Ints, length: Ints) -> Columns:
        """Decode messages.

        Args:
            data: Bytes with the messages, shape (B,); `SLACK_BYTES` more follow the last message.
            begin: Position of each content, shape (N,), N at least 1; a message's header of 31 bytes precedes it.
            length: Length of each content, shape (N,).

        Raises:
            UnreadableRecording: A message ends within a field, or has another number of values than others.
        """
        parts = list(self._by_shape(data, begin, length))
        if len(parts) == 1:
            return parts[0][1]
        widths = sorted({part.values.shape[1] for _, part in parts})
        if len(widths) > 1:
            raise UnreadableRecording(
                f"{self._topic} has messages with {widths[0]} and {widths[1]} values; record them on separate topics.",
                topic=self._topic,
            )
        order = np.argsort(np.concatenate([which for which, _ in parts]))
        labels = list(dict.fromkeys(part.labels[0] for _, part in parts))
        label_of = [np.full(len(which), labels.index(part.labels[0])) for which, part in parts]
        stamps_ns = [part.stamps_ns for _, part in parts if part.stamps_ns is not None]
        return Columns(
            log_ns=np.concatenate([part.log_ns for _, part in parts])[order],
            stamps_ns=np.concatenate(stamps_ns)[order] if stamps_ns else None,
            values=np.concatenate([part.values for _, part in parts])[order],
            labels=tuple(labels),
            label_of=np.concatenate(label_of)[order],
        )

    def _by_shape(self, data: Bytes, begin: Ints, length: Ints) -> Iterator[tuple[Ints, Columns]]:
        """Yield the messages of each shape together: their indices and columns."""
        which, heads, known = np.arange(len(begin)), begin - HEAD_BYTES, list(self._shapes)
        while len(which):
            size, first = int(length[0]), int(heads[0]) + HEAD_BYTES
            shape = next((one for one in known if one.size == size), None)
            if shape is None:
                shape = self._shape(data[first : first + size].tobytes())
            else:
                known.remove(shape)
            fits, taken = take(data, heads, length, shape)
            if len(taken) == len(which):  # usually, and then nothing is copied
                yield which, shape.columns(taken)
                return
            if len(taken):
                yield which[fits], shape.columns(taken)
            which, heads, length = which[~fits], heads[~fits], length[~fits]

    def _shape(self, message: bytes) -> Shape:
        """Determine the shape of a message, and cache it."""
        if len(self._shapes) == SHAPES_LIMIT:
            raise UnreadableRecording(
                f"The messages of {self._topic} have more than {SHAPES_LIMIT} shapes or texts; this is not the "
                "topic of an arm.",
                topic=self._topic,
            )
        shape = shape_of(message, self._fields, self._wanted, self._topic)
        self._shapes.append(shape)
        return shape
