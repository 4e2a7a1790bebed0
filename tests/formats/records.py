"""MCAP files assembled record by record, so that a test can make files that no writer would write.

A record is its opcode, the length of its content and the content; text is preceded by its length (MCAP specification,
"Records"). All numbers are little-endian.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(0x01, 0x07)
MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS = range(0x07, 0x0C)
METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0C, 0x10)


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """Put the head before a content; `length` may be wrong."""
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(value: str) -> bytes:
    encoded = value.encode()
    return struct.pack("<I", len(encoded)) + encoded


def header(profile: str = "ros2") -> bytes:
    return record(HEADER, text(profile) + text("by hand"))


def schema(number: int, name: str, definition: str, encoding: str = "ros2msg") -> bytes:
    return record(SCHEMA, struct.pack("<H", number) + text(name) + text(encoding) + text(definition))


def channel(number: int, schema_number: int, topic: str, encoding: str = "cdr") -> bytes:
    return record(CHANNEL, struct.pack("<HH", number, schema_number) + text(topic) + text(encoding) + bytes(4))


def message(channel_number: int, log_ns: int, data: bytes, sequence: int = 0) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", channel_number, sequence, log_ns, log_ns) + data)


def packed(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=1).compress(data)
    return lz4.frame.compress(data) if compression == "lz4" else data


def chunk(
    data: bytes,
    *,
    compression: str = "zstd",
    size: int | None = None,
    crc: int | None = None,
    stored: bytes | None = None,
    times: tuple[int, int] = (0, 0),
) -> bytes:
    """Pack records into a chunk; its stated size, its checksum and its stored bytes may be wrong."""
    stored = packed(data, compression) if stored is None else stored
    claimed = len(data) if size is None else size
    checksum = zlib.crc32(data) if crc is None else crc
    head = struct.pack("<QQQI", *times, claimed, checksum) + text(compression)
    return record(CHUNK, head + struct.pack("<Q", len(stored)) + stored)


def whole(body: bytes, *, checksum: bool = False, profile: str = "ros2") -> bytes:
    """Add beginning and end to the records of a data section; there is no summary."""
    begun = MAGIC + header(profile) + body
    ended = record(DATA_END, struct.pack("<I", zlib.crc32(begun) if checksum else 0))
    return begun + ended + record(FOOTER, bytes(20)) + MAGIC


@dataclass(frozen=True)
class Part:
    """One record of a file; `length` is the length in its head if that is not the content's."""

    opcode: int
    content: bytes
    length: int | None = None

    @property
    def data(self) -> bytes:
        return record(self.opcode, self.content, self.length)


def split(data: bytes) -> list[Part]:
    """Split bytes of complete records into the records."""
    parts, at = [], 0
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        parts.append(Part(opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return parts


def joined(parts: Sequence[Part]) -> bytes:
    return b"".join(part.data for part in parts)


def parts_of(data: bytes) -> list[Part]:
    """Return the records of a complete file."""
    return split(data[len(MAGIC) : -len(MAGIC)])


def boundaries(data: bytes) -> Iterator[int]:
    """Yield the offset of each record of a complete file, and of the magic at its end."""
    at = len(MAGIC)
    for part in parts_of(data):
        yield at
        at += 9 + len(part.content)
    yield at


@dataclass(frozen=True)
class Unpacked:
    """An unpacked chunk."""

    head: bytes
    compression: str
    data: bytes


def unpacked(part: Part) -> Unpacked:
    size, _, length = struct.unpack_from("<QII", part.content, 16)
    compression = part.content[32 : 32 + length].decode()
    stored = part.content[32 + length + 8 :]
    if compression == "zstd":
        data = zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    else:
        data = lz4.frame.decompress(stored) if compression == "lz4" else stored
    return Unpacked(part.content[:16], compression, data)


def repacked(head: bytes, compression: str, data: bytes) -> Part:
    """Pack a chunk again, with the correct size and checksum."""
    times = struct.unpack("<QQ", head)
    return split(chunk(data, compression=compression, times=times))[0]


def resealed(parts: Sequence[Part]) -> bytes:
    """Assemble a file from records, with correct derived values: counts, offsets and checksums."""
    parts = [part for part in parts if part.opcode not in (CHUNK_INDEX, SUMMARY_OFFSET)]
    end = next((k for k, part in enumerate(parts) if part.opcode == DATA_END), len(parts))
    body = MAGIC + joined(parts[:end])
    summary = joined([_counted(part, parts[:end]) for part in parts[end + 1 :] if part.opcode != FOOTER])
    ended = body + record(DATA_END, struct.pack("<I", zlib.crc32(body)))
    begins = len(ended) if summary else 0
    footer = struct.pack("<BQQQ", FOOTER, 20, begins, 0)
    return ended + summary + footer + struct.pack("<I", zlib.crc32(summary + footer)) + MAGIC


def _counted(part: Part, body: Sequence[Part]) -> Part:
    """Recompute the counts of the statistics; an unreadable chunk counts nothing."""
    if part.opcode != STATISTICS:
        return part
    every: list[Part] = []
    for one in body:
        try:
            every += split(unpacked(one).data) if one.opcode == CHUNK else [one]
        except Exception:  # noqa: BLE001, PERF203, RUF100 - a chunk that was damaged on purpose raises anything
            continue
    messages = [one for one in every if one.opcode == MESSAGE and len(one.content) >= 22]
    times = [struct.unpack_from("<Q", one.content, 6)[0] for one in messages] or [0]
    per_channel: dict[int, int] = {}
    for one in messages:
        number = struct.unpack_from("<H", one.content)[0]
        per_channel[number] = per_channel.get(number, 0) + 1
    counted = struct.pack(
        "<QHIIIIQQI",
        len(messages),
        len({one.content[:2] for one in every if one.opcode == SCHEMA}),
        len({one.content[:2] for one in every if one.opcode == CHANNEL}),
        sum(one.opcode == ATTACHMENT for one in body),
        sum(one.opcode == METADATA for one in body),
        sum(one.opcode == CHUNK for one in body),
        min(times),
        max(times),
        10 * len(per_channel),
    )
    return Part(STATISTICS, counted + b"".join(struct.pack("<HQ", *pair) for pair in per_channel.items()))
