"""Turn CDR messages into columns of numbers, all messages of a topic at once.

    definition --fields_of--> fields --Decoder--> Columns: log times and stamps (N,), values (N, K), labels

A recorder's messages of one channel hardly ever change their shape, so those of all channels are decoded in one pass
over the file's bytes, as they lie there; a channel whose messages do is decoded by itself.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import groupby

import numpy as np

from skills.errors import UnreadableRecording
from skills.recordings.chain import Bytes, Chain
from skills.recordings.definitions import Field, fields_of
from skills.recordings.shapes import HEAD_BYTES, SLACK_BYTES, Columns, Shape, Taken, Wanted, shape_of, take
from skills.style._arrays import Ints

__all__ = [
    "SHAPES_LIMIT",
    "SLACK_BYTES",
    "Columns",
    "Decoder",
    "Field",
    "Taken",
    "Wanted",
    "decode_together",
    "fields_of",
    "joined",
]

SHAPES_LIMIT = 1000  # ours: a topic whose every message has other lengths is no arm's


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
        self._shapes: list[Shape] = []

    def decode(self, data: Bytes, begin: Ints, length: Ints) -> Columns:
        """Decode messages.

        Args:
            data: Bytes that hold them, shape (B,); `SLACK_BYTES` more follow the last message.
            begin: Where each begins, shape (N,), N at least 1; a message's head of 31 bytes stands before it.
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
            log_ns=np.concatenate([part.log_ns for _, part in parts])[order],
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
                kinds = np.zeros(len(left), np.int64)
                fits, (taken,) = take(data, begin[left] - HEAD_BYTES, length[left], kinds, [shape], [len(left)])
                if len(taken):
                    yield left[fits], shape.columns(taken)
                left = left[~fits]

    def expected(self, data: Bytes, chain: Chain, number: int) -> Shape | None:
        """Say what shape messages of the channel most likely have: the last that was learnt, else that of the first."""
        if not self._shapes:
            which = int(np.argmax(chain.channels == number))
            begin = int(chain.messages[which]) + HEAD_BYTES
            with suppress(UnreadableRecording):  # it is said when the channel is decoded by itself
                self._shape(data[begin : begin + int(chain.lengths[which])].tobytes())
        return self._shapes[-1] if self._shapes else None

    def _shape(self, message: bytes) -> Shape:
        """Work out the shape of a message and keep it."""
        if len(self._shapes) == SHAPES_LIMIT:
            raise UnreadableRecording(
                f"The messages of {self._topic} have more than {SHAPES_LIMIT} shapes or texts; this is no arm's topic.",
                topic=self._topic,
            )
        shape = shape_of(message, self._fields, self._wanted, self._topic)
        self._shapes.append(shape)
        return shape


def decode_together(decoders: Mapping[int, Decoder], data: Bytes, chain: Chain) -> dict[int, Taken]:
    """Take what is wanted from all messages of the channels whose messages all have the shape that is expected.

    Args:
        decoders: By the number of the channel; each has messages here.
        data: Bytes that hold a chain of messages, shape (B,); `SLACK_BYTES` more follow the last one.
        chain: Where they are.

    Returns:
        By the number of the channel; one that is not there is to be decoded by itself.
    """
    kinds = np.full(len(chain.counts), -1)
    shapes: dict[int, Shape] = {}
    left = len(data)
    for number, decoder in decoders.items():
        shape = decoder.expected(data, chain, number)
        if shape is not None and (size := int(chain.counts[number]) * shape.size) <= left:
            kinds[number] = len(shapes)
            shapes[number] = shape
            left -= size  # so that what is taken is never much more than the data, whatever lengths are there
    if not shapes:
        return {}
    counts = chain.counts[list(shapes)].tolist()
    _, taken = take(data, chain.messages, chain.lengths, kinds[chain.channels], list(shapes.values()), counts)
    each = zip(shapes.items(), taken, counts, strict=True)
    return {number: Taken(shape, words) for (number, shape), words, count in each if len(words) == count}


def joined(parts: Sequence[Columns | Taken]) -> list[Columns]:
    """Make columns of what was taken, as few as there can be, in the same order."""
    columns: list[Columns] = []
    for shape, some in groupby(parts, key=lambda part: part.shape if isinstance(part, Taken) else None):
        if shape is None:
            columns += [part for part in some if isinstance(part, Columns)]
        else:
            columns.append(shape.columns(np.concatenate([part.words for part in some if isinstance(part, Taken)])))
    return columns
