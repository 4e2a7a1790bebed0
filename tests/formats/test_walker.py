"""The walk over records: the records it follows, its counts, and its refusals."""

import io
import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import UnreadableRecording
from skills.formats import topics
from skills.formats.mcap import reader
from skills.formats.mcap import records as mcap_records
from skills.formats.mcap.reader import Walker
from skills.formats.mcap.records import Chain, unpack
from tests.by_day import examples, some
from tests.formats import records
from tests.formats.definitions import DEFINITIONS
from tests.formats.records import Part, channel, chunk, message, record, schema, whole

TYPE = schema(1, topics.BOOL, DEFINITIONS[topics.BOOL])
DEFINED = TYPE + channel(1, 1, "/a")
ONE = message(1, 5, b"\0\1\0\0\1")


def log_ns_of(data, begin):
    """Return the log time in the header of a message, which ends with it and the publish time."""
    return int.from_bytes(data[begin - 16 : begin - 8].tobytes(), "little")


def walked(data: bytes):
    """Walk over a complete file: the walker, and channel, log time and content of every message."""
    walk = Walker(io.BytesIO(data))
    said = [
        (walk.channels[number].topic, log_ns_of(part.data, begin), bytes(part.data[begin : begin + length]))
        for part in walk.parts()
        for number in part.numbers
        for begin, length in zip(*part.of(number), strict=True)
    ]
    return walk, said


def refused(data: bytes, match: str):
    with pytest.raises(UnreadableRecording, match=match):
        walked(data)


# ---- consecutive records ----------------------------------------------------------------------------------------

HEADS = st.sampled_from([b"\5", b"\5\x16\0\0\0\0\0\0\0", b"\5\x1f\0\0\0\0\0\0\0\0", b"\0", b"\5\0\0\0\0\0\0\0\0", b"x"])
CONTENTS = st.lists(HEADS, max_size=12).map(b"".join)
ENDS = st.sampled_from(
    [b"", b"\5", b"\5\x16\0\0\0\0\0\0\0", b"\5\xff\0\0\0\0\0\0\0" + bytes(40), b"\6" + bytes(8), b"\3"]
)


def followed(data: bytes):
    chain = Chain(np.frombuffer(data, np.uint8))
    chain.follow(len(data))
    return chain


@examples(200)
@given(st.lists(st.tuples(st.sampled_from([5, 5, 3, 4, 0x80, 0xFF]), CONTENTS), max_size=40), ENDS)
def test_what_was_put_one_behind_the_other_is_found_and_nothing_else(said, end):
    pieces = [
        message(k, 7 * k, content) if kind == 5 else record(kind, content) for k, (kind, content) in enumerate(said)
    ]
    found, begins = followed(b"".join(pieces) + end), np.cumsum([0, *map(len, pieces)]).tolist()
    expected = [(begins[k], len(content), k) for k, (kind, content) in enumerate(said) if kind == 5]
    told = (found.messages, found.lengths, found.channels)
    assert list(zip(*(column.tolist() for column in told), strict=True)) == expected
    others = [(kind, begins[k] + 9, begins[k + 1]) for k, (kind, _) in enumerate(said) if kind != 5]
    assert (found.others, found.end) == (others, begins[-1])


def test_whole_heads_in_every_content_are_no_messages():
    inner = b"".join(message(7, 9, bytes(20)) for _ in range(20))
    assert set(followed(1000 * (ONE + message(1, 5, inner))).channels.tolist()) == {1}


@pytest.mark.parametrize("byte", range(1, 9))
def test_a_length_that_lies_ends_the_chain(byte):
    data = bytearray(200 * ONE)
    data[100 * len(ONE) + byte] = 0xFF
    before = followed(bytes(data[: 101 * len(ONE)]))
    assert (before.end, len(before.messages)) == (100 * len(ONE), 100)


def test_a_chain_is_followed_in_pieces_that_end_with_their_last_record():
    data = np.frombuffer(3 * ONE + record(0x80, b"abc") + ONE, np.uint8)
    chain = Chain(data)
    ends = []
    for to in (len(ONE), 2 * len(ONE) + 5, 3 * len(ONE), len(data) - len(ONE) - 1, len(data)):
        chain.follow(to)
        ends.append(chain.end)
    assert ends == [len(ONE), 2 * len(ONE), 3 * len(ONE), 3 * len(ONE), len(data)]
    assert chain.messages.tolist() == followed(data.tobytes()).messages.tolist()
    assert chain.others == followed(data.tobytes()).others


def test_many_other_records_cost_little():
    began = time.process_time()
    assert len(followed(100_000 * (ONE + record(0x80, b""))).others) == 100_000
    assert time.process_time() - began < 3.0


# ---- complete files ---------------------------------------------------------------------------------------------


def test_messages_come_in_chunks_between_them_or_without_any():
    loose, packed = DEFINED + ONE + ONE, chunk(DEFINED + ONE + ONE)
    for body in (loose, packed, chunk(DEFINED) + ONE + chunk(ONE), loose[: len(DEFINED + ONE)] + chunk(ONE)):
        walk, said = walked(whole(body))
        assert said == [("/a", 5, b"\0\1\0\0\1")] * 2
        assert walk.counts == {1: 2}


def test_a_file_without_messages_is_whole():
    assert walked(whole(b""))[1] == []
    assert walked(whole(chunk(b"", compression="")))[1] == []
    assert walked(whole(chunk(b"", compression="lz4")))[1] == []


def test_a_definition_may_be_said_again_but_not_otherwise():
    assert len(walked(whole(chunk(DEFINED + ONE) + chunk(DEFINED + ONE)))[1]) == 2
    refused(whole(DEFINED + channel(1, 1, "/b") + ONE), "Two channels have the number 1")
    refused(whole(DEFINED + schema(1, topics.BOOL, "bool other\n") + ONE), "Two schemas have the number 1")
    refused(whole(schema(0, topics.BOOL, "bool data\n")), "number 0")


def test_what_a_message_needs_must_stand_before_it():
    refused(whole(ONE), "channel 1, which is not defined")
    refused(whole(chunk(TYPE + ONE + channel(1, 1, "/a"))), "channel 1, which is not defined")
    refused(whole(channel(1, 1, "/a") + TYPE), "not defined before it")


def test_records_of_other_kinds_are_passed_by():
    other = record(0x90, b"private") + record(records.ATTACHMENT, bytes(100)) + record(records.MESSAGE_INDEX, bytes(6))
    metadata = record(records.METADATA, records.text("name") + bytes(4))
    assert len(walked(whole(other + DEFINED + metadata + ONE + other))[1]) == 1


@pytest.mark.parametrize("kind", [0, 1, 2, 6, 7, 9, 0x0F, 0x10, 0x7F])
def test_a_chunk_holds_messages_and_definitions_only(kind):
    refused(whole(chunk(DEFINED + ONE + record(kind, bytes(40)))), "complete messages and definitions")


@pytest.mark.parametrize("kind", [0, 1, 2, 0x0B, 0x10, 0x7F])
def test_a_record_of_an_impossible_kind_among_the_messages_is_refused(kind):
    refused(whole(DEFINED + record(kind, bytes(40)) + ONE), f"{kind:#x} is among")


def test_a_chunk_ends_where_its_last_record_ends():
    body = DEFINED + ONE
    refused(whole(chunk(body[:-1]) + chunk(ONE)), "complete messages")
    refused(whole(chunk(body + ONE[:20]) + chunk(ONE[20:])), "complete messages")


def test_a_message_shorter_than_its_own_times_is_refused():
    short = record(records.MESSAGE, bytes(21))
    refused(whole(DEFINED + short), "too short for its time stamps")
    refused(whole(chunk(DEFINED + short)), "complete messages")


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_chunk_unpacks_to_exactly_what_it_claims(compression):
    body = DEFINED + ONE
    for size in (len(body) - 1, len(body) + 1):
        refused(whole(chunk(body, compression=compression, size=size)), f"to its declared {size} bytes")
    stored = records.packed(body, compression)
    refused(whole(chunk(body, compression=compression, stored=stored + b"x")), "to its declared")


def test_a_second_frame_behind_the_first_is_refused():
    body = DEFINED + ONE
    for compression in ("zstd", "lz4"):
        twice = 2 * records.packed(body, compression)
        for size in (len(body), 2 * len(body)):
            refused(whole(chunk(b"", compression=compression, stored=twice, size=size, crc=0)), "to its declared")


def test_an_unknown_compression_is_named():
    refused(whole(chunk(DEFINED, compression="gzip")), "'gzip'")
    with pytest.raises(UnreadableRecording, match="'gzip'"):
        unpack(memoryview(b""), "gzip", 0)


def test_every_checksum_is_checked():
    body = DEFINED + ONE
    refused(whole(chunk(body, crc=zlib.crc32(body) ^ 1)), "CRC.* of chunk 1 is wrong")
    data = bytearray(whole(body, checksum=True))
    data[30] ^= 1
    refused(bytes(data), "CRC|UTF-8|begins")
    sealed = records.resealed([*records.parts_of(whole(chunk(body)))[:-1], Part(records.STATISTICS, b"")])
    assert walked(sealed)[0].integrity == "full"
    for back in (9, 12, 60):  # the checksum of the summary, and its content
        damaged = bytearray(sealed)
        damaged[-8 - back] ^= 1
        with pytest.raises(UnreadableRecording):
            walked(bytes(damaged))


@pytest.mark.parametrize("block", some([1000, 16, 2**16], 3))
def test_a_checksum_covers_a_file_that_is_read_in_many_blocks(block, monkeypatch):
    monkeypatch.setattr(mcap_records, "_BLOCK_BYTES", block)
    attachment = record(records.ATTACHMENT, bytes(50_000))
    data = whole(attachment + DEFINED + 2000 * ONE + attachment + chunk(2000 * ONE), checksum=True)
    assert walked(data)[0].integrity == "full"
    for at in np.random.default_rng(4).integers(60, 150_000, 20).tolist():
        flipped = bytearray(data)
        flipped[at] ^= 4
        with pytest.raises(UnreadableRecording):
            walked(bytes(flipped))


def test_integrity_says_what_checksums_cover():
    body = DEFINED + ONE
    sealed = [*records.parts_of(whole(chunk(body)))[:-1], Part(records.STATISTICS, b"")]
    assert walked(whole(chunk(body)))[0].integrity == "full"
    assert walked(whole(chunk(body) + chunk(ONE, crc=0)))[0].integrity == "partial"
    assert walked(whole(chunk(body, crc=0)))[0].integrity == "none"
    assert walked(whole(body))[0].integrity == "none"
    assert walked(whole(body, checksum=True))[0].integrity == "full"
    assert walked(records.resealed(sealed))[0].integrity == "full"


def test_a_record_that_could_have_been_a_chunk_leaves_no_full_integrity():
    assert walked(whole(chunk(DEFINED + ONE) + record(0x86, chunk(ONE)[9:])))[0].integrity == "partial"


def test_the_statistics_count_what_is_there():
    counts = struct.pack("<QHIIIIQQI", 1, 1, 1, 0, 0, 1, 0, 0, 0)
    parts = records.parts_of(whole(chunk(DEFINED + ONE)))
    good = records.joined([*parts[:-1], Part(records.STATISTICS, counts), parts[-1]])
    assert len(walked(records.MAGIC + good + records.MAGIC)[1]) == 1
    for wrong in (struct.pack("<Q", 2) + counts[8:], counts[:22] + struct.pack("<I", 2) + counts[26:]):
        bad = records.joined([*parts[:-1], Part(records.STATISTICS, wrong), parts[-1]])
        refused(records.MAGIC + bad + records.MAGIC, "declares . messages in . chunks")


def test_nothing_stands_before_the_beginning_or_behind_the_end():
    good = whole(DEFINED + ONE)
    refused(good + b"x", "bytes after the end")
    refused(good + good, "bytes after the end")
    refused(b"x" + good, "first bytes")
    refused(records.MAGIC + good, "one header|within a record")
    refused(whole(DEFINED + records.header() + ONE), "0x1 is among")


def test_messages_in_the_summary_are_refused():
    parts = records.parts_of(whole(DEFINED))
    refused(records.MAGIC + records.joined([*parts[:-1], Part(5, ONE[9:]), parts[-1]]) + records.MAGIC, "0x5 follows")


def test_what_our_own_writer_noted_is_read_and_what_others_noted_is_not():
    noted = records.text("made from") + records.text("abc")
    for name, expected in ((reader.NOTES, {"made from": "abc"}), ("other", {})):
        metadata = record(records.METADATA, records.text(name) + struct.pack("<I", len(noted)) + noted)
        assert walked(whole(metadata))[0].notes == expected


# ---- indexes ----------------------------------------------------------------------------------------------------


def index(offsets, number=1):
    """Write the index of a chunk's messages of one channel, as writers do behind the chunk."""
    entries = b"".join(struct.pack("<QQ", 5, offset) for offset in offsets)
    return record(records.MESSAGE_INDEX, struct.pack("<HI", number, len(entries)) + entries)


BODY = DEFINED + 3 * ONE
OFFSETS = [len(DEFINED), len(DEFINED + ONE), len(DEFINED + 2 * ONE)]


@pytest.mark.parametrize(
    "indexed",
    [
        index(OFFSETS),
        index(OFFSETS[:2]),
        index([*OFFSETS, OFFSETS[0]]),
        index([OFFSETS[0], OFFSETS[0] + 1]),
        index([len(BODY), 2**64 - 1]),
        index(OFFSETS, number=2),
        index([]),
        record(records.MESSAGE_INDEX, b""),
    ],
    ids=["right", "one missing", "one twice", "overlapping", "beyond the end", "other channel", "empty", "none"],
)
def test_what_an_index_says_changes_nothing(indexed):
    bare = whole(chunk(BODY) + chunk(3 * ONE))
    assert walked(whole(chunk(BODY) + indexed + chunk(3 * ONE) + indexed))[1] == walked(bare)[1]


@examples(50)
@given(st.binary(max_size=60), st.integers(0, 2))
def test_no_bytes_of_an_index_change_anything(said, before):
    parts = [chunk(BODY), chunk(3 * ONE), chunk(ONE)]
    parts.insert(before + 1, record(records.MESSAGE_INDEX, said))
    assert walked(whole(b"".join(parts)))[1] == [("/a", 5, b"\0\1\0\0\1")] * 7


# ---- limits -----------------------------------------------------------------------------------------------------


def test_channels_records_and_messages_are_limited(monkeypatch):
    monkeypatch.setattr(mcap_records, "RECORD_LIMIT", 5)
    refused(whole(6 * chunk(b"", compression="")), "more than 5 records")
    refused(whole(chunk(6 * record(0x80, b""))), "more than 5 records")
    monkeypatch.setattr(reader, "MESSAGE_LIMIT", 2)
    refused(whole(DEFINED + 3 * ONE), "more than 2 messages")
    monkeypatch.setattr(reader, "CHANNEL_LIMIT", 1)
    refused(whole(DEFINED + channel(2, 1, "/b")), "are 1 and")


def test_definitions_are_limited_by_their_bytes_too():
    large = b"".join(schema(number, "a/B", f"string<=5 x{' ' * (5 << 20)}") for number in (1, 2, 3, 4))
    refused(whole(chunk(large)), "the limits")
    assert len(walked(whole(chunk(large[: len(large) // 2])))[0].schemas) == 2


def test_messages_among_other_records_cost_no_look_at_all_that_follows():
    data = whole(DEFINED + 20_000 * (ONE + record(records.METADATA, records.text("a") + bytes(4))))
    began = time.process_time()
    assert len(walked(data)[1]) == 20_000
    assert time.process_time() - began < 2.0


def test_a_long_attachment_is_read_a_block_at_a_time():
    class Counted(io.BytesIO):
        largest = 0

        def read(self, size=-1):
            Counted.largest = max(Counted.largest, size)
            return super().read(size)

    file = Counted(whole(record(records.ATTACHMENT, bytes(5 << 20)) + DEFINED + ONE))
    assert sum(len(part.chain.messages) for part in Walker(file).parts()) == 1
    assert 0 < Counted.largest <= 1 << 20
