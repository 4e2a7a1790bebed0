"""Recordings that are truncated, bit-flipped, inflated or misassembled. The same seed gives the same files.

truncations    cut at random places
boundary_cuts  cut at every record's beginning, one byte before it and one after it
flips          one bit flipped
mutations      records swapped, doubled, dropped, edited, with lengths, numbers and checksums corrected or not
BOMBS          small files that would cost much time or memory, and LARGE_BOMBS
"""

import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace

import lz4.frame
import numpy as np

from skills.formats import topics
from skills.formats.bag_writer import DEFINITIONS
from tests.formats import records
from tests.formats.records import Part

EDGES = (0, 1, 0xFF, 0xFFFF, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


def truncations(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Cut a file at random places, so that neither part is empty."""
    for length in np.random.default_rng(seed).integers(1, len(data), count).tolist():
        yield data[:length]


def boundary_cuts(data: bytes) -> Iterator[bytes]:
    """Cut a file at every record's beginning, one byte before it and one after it."""
    for at in records.boundaries(data):
        yield from (data[:length] for length in (at - 1, at, at + 1))


def flips(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Flip one bit of a file."""
    for bit in np.random.default_rng(seed).integers(0, 8 * len(data), count).tolist():
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        yield bytes(flipped)


# ---- misassembled records ---------------------------------------------------------------------------------------


def mutations(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """Change one to three records of a file; half of the files then get correct counts, offsets and checksums."""
    rng = random.Random(seed)
    parts = records.parts_of(data)
    for _ in range(count):
        changed = list(parts)
        for _ in range(rng.randint(1, 3)):
            rng.choice(_CHANGES)(changed, rng)
        if rng.random() < 0.5:
            yield records.resealed(changed)
        else:
            yield records.MAGIC + records.joined(changed) + records.MAGIC


def _drop(parts: list[Part], rng: random.Random) -> None:
    if len(parts) > 1:
        parts.pop(rng.randrange(len(parts)))


def _double(parts: list[Part], rng: random.Random) -> None:
    parts.insert(rng.randrange(len(parts)), rng.choice(parts))


def _swap(parts: list[Part], rng: random.Random) -> None:
    one, other = rng.randrange(len(parts)), rng.randrange(len(parts))
    parts[one], parts[other] = parts[other], parts[one]


def _shuffle(parts: list[Part], rng: random.Random) -> None:
    rng.shuffle(parts)


def _lie_about_length(parts: list[Part], rng: random.Random) -> None:
    at = rng.randrange(len(parts))
    true = len(parts[at].content)
    parts[at] = replace(parts[at], length=rng.choice([*EDGES, max(0, true - 1), true + 1]))


def _rename(parts: list[Part], rng: random.Random) -> None:
    at = rng.randrange(len(parts))
    parts[at] = replace(parts[at], opcode=rng.choice([*range(17), 0x7F, 0x80, 0xFF]))


def _cut_content(parts: list[Part], rng: random.Random) -> None:
    at = rng.randrange(len(parts))
    parts[at] = replace(parts[at], content=parts[at].content[: rng.randint(0, len(parts[at].content))])


def _lengthen(parts: list[Part], rng: random.Random) -> None:
    at = rng.randrange(len(parts))
    parts[at] = replace(parts[at], content=parts[at].content + rng.randbytes(rng.randint(1, 40)))


def _edit(parts: list[Part], rng: random.Random) -> None:
    """Write a boundary value, or random bytes, somewhere into a record."""
    at = rng.randrange(len(parts))
    content = bytearray(parts[at].content)
    if len(content) < 8:
        return
    place, width = rng.randrange(len(content) - 7), rng.choice([1, 2, 4, 8])
    value = rng.choice([*EDGES, rng.getrandbits(64)]) % 256**width
    content[place : place + width] = value.to_bytes(width, "little")
    parts[at] = replace(parts[at], content=bytes(content))


def _edit_number(parts: list[Part], rng: random.Random) -> None:
    """Give a schema, channel or message another number."""
    numbered = [k for k, part in enumerate(parts) if part.opcode in (3, 4, 5, 7) and len(part.content) >= 2]
    if numbered:
        at = rng.choice(numbered)
        number = struct.pack("<H", rng.choice([0, 1, 2, 3, 4, 0xFFFF]))
        parts[at] = replace(parts[at], content=number + parts[at].content[2:])


def _insert(parts: list[Part], rng: random.Random) -> None:
    content = rng.randbytes(rng.randint(0, 60))
    parts.insert(rng.randrange(len(parts) + 1), Part(rng.choice([*range(17), 0x80, 0xFF]), content))


def _inside_a_chunk(parts: list[Part], rng: random.Random) -> None:
    """Change the records of a chunk and compress them again, correctly."""
    chunks = [k for k, part in enumerate(parts) if part.opcode == records.CHUNK]
    if not chunks:
        return
    at = rng.choice(chunks)
    try:
        chunk = records.unpacked(parts[at])
        inner = records.split(chunk.data)
        compression = rng.choice([chunk.compression, "zstd", "lz4", ""])
        for _ in range(rng.randint(1, 3)):
            rng.choice(_SIMPLE)(inner, rng)
        parts[at] = records.repacked(chunk.head, compression, records.joined(inner))
    except Exception:  # noqa: BLE001, RUF100 - a chunk that an earlier change spoilt stays as it is
        return


def _change_compression(parts: list[Part], rng: random.Random) -> None:
    chunks = [k for k, part in enumerate(parts) if part.opcode == records.CHUNK]
    if chunks:
        at = rng.choice(chunks)
        name = rng.choice([b"zstd", b"lz4", b"", b"gzip", b"\xff\xfe", bytes(4)])
        head, rest = parts[at].content[:28], parts[at].content[36:]
        parts[at] = replace(parts[at], content=head + struct.pack("<I", len(name)) + name + rest)


_SIMPLE: list[Callable[[list[Part], random.Random], None]] = [
    *(_drop, _double, _swap, _shuffle, _lie_about_length, _rename),
    *(_cut_content, _lengthen, _edit, _edit, _edit_number, _insert),
]
_CHANGES = [*_SIMPLE, *[_inside_a_chunk] * 8, _change_compression]


# ---- bombs ------------------------------------------------------------------------------------------------------


_SMALL_CHUNK = records.packed(bytes(100), "zstd")
BOMBS: dict[str, Callable[[], bytes]] = {  # each makes one file; most are below 1 MB
    "zstd of 1 GiB that claims 100 bytes": lambda: _stored(zstd_of(1 << 30), 100),
    "zstd of 1 GiB that claims 64 MiB": lambda: _stored(zstd_of(1 << 30), 64 << 20),
    "zstd of 1 GiB without its size in the frame": lambda: _stored(zstd_of(1 << 30, told=False), 64 << 20),
    "zstd of 1 GiB that says so": lambda: _stored(zstd_of(1 << 30), 1 << 30),
    "zstd of 100 bytes that claims 64 MiB": lambda: _stored(_SMALL_CHUNK, 64 << 20),
    "zstd of 100 bytes that claims 2^63": lambda: _stored(_SMALL_CHUNK, 2**63),
    "lz4 of 256 MiB that claims 100 bytes": lambda: _stored(lz4_of(256 << 20), 100, "lz4"),
    "lz4 of 256 MiB that claims 64 MiB": lambda: _stored(lz4_of(256 << 20), 64 << 20, "lz4"),
    "64 MiB of empty records, zstd": lambda: records.whole(empty_records("zstd")),
    "64 MiB of empty records, lz4": lambda: records.whole(empty_records("lz4")),
    "64 MiB of empty messages": lambda: records.whole(POSES_DEFINED + empty_messages(64 << 20)),
    "100 chunks of 64 MiB": lambda: records.whole(
        100 * records.chunk(b"", stored=zstd_of(64 << 20), size=64 << 20, crc=0)
    ),
    "chunks in chunks": lambda: records.whole(nested_chunks(200)),
    "an array of 2^32 joints": lambda: records.whole(JOINTS_DEFINED + records.message(2, 1, ENDLESS_JOINTS)),
    "a record of 2^63 bytes": lambda: records.MAGIC + records.header() + records.record(0x80, bytes(64), 2**63),
    "a message of 2^63 bytes": lambda: records.whole(POSES_DEFINED + records.record(records.MESSAGE, bytes(64), 2**63)),
    "a definition of 2^40 fields": lambda: records.whole(records.schema(1, topics.POSE, doubling(40)) + ONE_POSE),
    "a definition that holds itself": lambda: records.whole(records.schema(1, topics.POSE, doubling(0)) + ONE_POSE),
}
LARGE_BOMBS: dict[str, Callable[[], bytes]] = {  # from 16 to 60 MB
    "a million tiny chunks": lambda: records.whole(1_000_000 * records.chunk(b"", compression="")),
    "a million empty metadata records": lambda: records.whole(1_000_000 * records.record(records.METADATA, bytes(8))),
    "65,535 channels, each 20 times": lambda: records.whole(20 * many_channels()),
}


def _stored(data: bytes, claimed: int, compression: str = "zstd") -> bytes:
    """Return a file of one chunk, as it is stored and with the size that it claims."""
    return records.whole(records.chunk(b"", compression=compression, stored=data, size=claimed, crc=0))


def nested_chunks(levels: int) -> bytes:
    nested = POSES
    for _ in range(levels):
        nested = records.chunk(nested)
    return nested


def many_channels() -> bytes:
    return b"".join(records.channel(number, 0, f"/{number}") for number in range(1, 65536))


def zstd_of(size: int, *, told: bool = True) -> bytes:
    """Return a zstd frame of zeros from run-length blocks; `size` is a number of whole MiB."""
    block = 128 << 10
    last = size // block - 1
    head = struct.pack("<IBQ", 0xFD2FB528, 0xE0, size) if told else struct.pack("<IBB", 0xFD2FB528, 0x00, 0x80)
    blocks = [struct.pack("<I", (block << 3) | 2 | (k == last))[:3] + b"\0" for k in (0, last)]
    return head + blocks[0] * last + blocks[1]


def lz4_of(size: int) -> bytes:
    """Return an lz4 frame of zeros from one block of 4 MiB, repeated."""
    block = 4 << 20
    compressor = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB, block_linked=False)
    head = compressor.begin()
    body = compressor.compress(bytes(block)) + compressor.flush()
    return head + body[:-4] * (size // block) + body[-4:]


def empty_records(compression: str) -> bytes:
    """Fill a chunk with empty records of an unknown kind."""
    return records.chunk(((64 << 20) // 9) * records.record(0x80, b""), compression=compression)


def empty_messages(size: int) -> bytes:
    """Fill a chunk with empty messages."""
    one = records.message(1, 1, b"")
    return records.chunk((size // len(one)) * one)


def doubling(levels: int) -> str:
    """Define a message by two of another, that by two of the next and so on; 0 levels give one that contains itself."""
    rule = "=" * 80
    if levels == 0:
        return f"a/A0 x\n{rule}\nMSG: a/A0\na/A0 x\n"
    parts = [f"a/A{k + 1} x\na/A{k + 1} y\n{rule}\nMSG: a/A{k + 1}\n" for k in range(levels)]
    return "".join(parts) + "float64 x\n"


LOCAL = "/PSM2/local/measured_cp"
ONE_POSE = records.channel(1, 1, LOCAL) + records.message(1, 1, b"\0\1\0\0" + bytes(80))
POSES_DEFINED = records.schema(1, topics.POSE, DEFINITIONS[topics.POSE]) + records.channel(1, 1, LOCAL)
POSES = POSES_DEFINED + records.message(1, 1, b"\0\1\0\0" + bytes(80))
JOINTS_DEFINED = records.schema(2, topics.JOINT_STATE, DEFINITIONS[topics.JOINT_STATE]) + records.channel(
    2, 2, "/PSM2/measured_js"
)
ENDLESS_JOINTS = b"\0\1\0\0" + struct.pack("<iIIBxxxII", 1, 0, 1, 0, 0, 2**32 - 1) + bytes(64)
