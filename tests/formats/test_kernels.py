"""The reader's compiled loops, compared with the same loops as plain Python on arbitrary bytes."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.formats import write_mcap
from skills.formats.mcap import _kernels, read_mcap
from tests.by_day import examples
from tests.formats import bags, hostile, large
from tests.formats.records import message

GUARD = 64  # entries before and behind every array that a loop writes to
LENGTHS = [0, 21, 22, 23, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**63 + 22, *(2**64 - k for k in (1, 9, 22, 31, 32, 100))]


def guarded(count, dtype, value=0):
    """Return an array of ones, and a part in its middle for the loop."""
    whole = np.full(count + 2 * GUARD, 1, dtype)
    inside = whole[GUARD : GUARD + count]
    inside[:] = value
    return whole, inside


def seen(data: bytes):
    """Return bytes as the loops get them; the memory behind them would be a message."""
    return np.frombuffer(data + 3 * message(9, 9, b""), np.uint8)[: len(data)]


def both(loop, arguments, written):
    """Run a loop compiled and plain; return its result and all written arrays, which must agree."""
    told = []
    for run in (getattr(_kernels, loop), getattr(_kernels, f"{loop}_compiled")):
        wholes, insides = zip(*(guarded(*one) for one in written), strict=True)
        answer = run(*arguments, *insides)
        for whole in wholes:
            assert (whole[:GUARD] == 1).all() and (whole[-GUARD:] == 1).all()
        told.append((answer and tuple(map(int, answer)), [whole.tobytes() for whole in wholes], insides))
    assert told[0][:2] == told[1][:2]
    return told[1][0], told[1][2]


def followed(data: bytes, begin=0, count=0, room=None):
    room = len(data) // 31 if room is None else room
    columns = [(room, np.int64), (room, np.int64), (room, np.uint16)]
    return both("follow", (seen(data), begin, count), columns)


# ---- following


@examples(200)
@given(st.binary(max_size=200), st.integers(0, 300))
def test_any_bytes_are_followed_alike_and_never_beyond_their_end(data, begin):
    (_, end), _ = followed(data, begin)
    assert end == begin or begin < end <= len(data)


@examples(200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=20), st.data())
def test_messages_with_some_bytes_changed_are_followed_alike(contents, data):
    said = bytearray(b"".join(message(k, k, content) for k, content in enumerate(contents)))
    for _ in range(data.draw(st.integers(0, 3))):
        said[data.draw(st.integers(0, len(said) - 1))] = data.draw(st.integers(0, 255))
    (count, end), (messages, lengths, *_) = followed(bytes(said[: data.draw(st.integers(0, len(said)))]))
    ends = messages[:count] + 31 + lengths[:count]
    assert messages[:count].tolist() == [0, *ends.tolist()][:count]
    assert end == (ends[-1] if count else 0)


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("behind", [0, 1, 22, 23, 100])
def test_a_length_near_the_largest_is_only_compared(length, behind):
    whole = message(1, 5, b"abc")
    (count, end), _ = followed(whole + struct.pack("<BQ", 5, length) + bytes(behind))
    fits = 22 <= length <= behind
    assert (count, end) == ((2, len(whole) + 9 + length) if fits else (1, len(whole)))


@pytest.mark.parametrize("size", range(1, 32))
def test_bytes_that_end_within_a_head_are_no_message(size):
    whole = message(1, 5, b"abc")
    assert followed(whole + message(2, 6, b"")[:size])[0] == ((1, len(whole)) if size < 31 else (2, len(whole) + 31))


def test_no_more_are_found_than_find_a_place():
    whole = message(1, 5, b"abc")
    assert followed(5 * whole, room=3)[0] == (3, 3 * len(whole))
    assert followed(5 * whole, room=3, count=2)[0] == (3, len(whole))


# ---- taking

U64 = st.integers(0, 2**64 - 1)


@examples(300)
@given(st.data())
def test_both_kernels_take_the_same_words_and_never_read_past_the_end(data):
    said = data.draw(st.binary(max_size=120))
    near = st.one_of(st.integers(-3, 130), st.sampled_from([-(2**63), 2**63 - 1, 2**63 - 8]))
    messages = np.array(data.draw(st.lists(near, max_size=8)), np.int64)
    count = len(messages)
    lengths = np.array(data.draw(st.lists(st.integers(0, 2), min_size=count, max_size=count)), np.int64)
    size, looks, width = (data.draw(st.integers(0, most)) for most in (2, 2, 3))
    total = looks + width
    places = np.array(data.draw(st.lists(st.integers(0, 60), min_size=total, max_size=total)), np.uint64)
    masks = np.array(data.draw(st.lists(st.sampled_from([0, 1, 2**63]), min_size=total, max_size=total)), np.uint64)
    shape = (size, looks, places, masks, np.zeros(total, np.uint64))
    (found,), (_, fits) = taken_by(said, messages, lengths, shape)
    last = max(places.astype(int).tolist(), default=-8)
    for n in np.flatnonzero(fits):
        assert lengths[n] == size
        assert 0 <= messages[n] <= len(said) - last - 8
    assert found == fits.sum()


def taken_by(said: bytes, messages, lengths, shape):
    """Return the number of messages of a shape, the words of all messages as one array, and which have the shape."""
    width = len(shape[2]) - shape[1]
    plain = _kernels.take, _kernels.take_compiled

    def in_rows(take):
        return lambda *given: (take(*given[:-2], given[-2].reshape(len(messages), width), given[-1]),)

    with pytest.MonkeyPatch.context() as patch:
        for name, take in zip(("take", "take_compiled"), plain, strict=True):
            patch.setattr(_kernels, name, in_rows(take))
        written = [(len(messages) * width, np.uint64), (len(messages), np.bool_)]
        return both("take", (seen(said), messages, lengths, *shape), written)


def test_words_by_hand():
    """The first eight bytes are taken if byte 3 is a 3; so a message needs 11 bytes."""
    said = bytes(range(50)) + bytes(range(11))
    messages = np.array([0, 10, 50, 51, -1], np.int64)
    places, masks, marked = (np.array(numbers, np.uint64) for numbers in ([3, 0], [0xFF, 0], [3, 0]))
    shape = (0, 1, places, masks, marked)
    (found,), (taken, fits) = taken_by(said, messages, np.zeros(len(messages), np.int64), shape)
    assert fits.tolist() == [True, False, True, False, False]
    assert found == 2
    assert taken[:2].tolist() == 2 * [int.from_bytes(bytes(range(8)), "little")]


# ---- whole files


def test_real_bytes_are_read_alike_by_both(monkeypatch):
    files = [write_mcap(bags.recording(40)), large.four_arms(0.2), bags.unchunked(bags.straight(30), checksum=True)]
    files += list(hostile.mutations(files[0], 60, seed=5))
    compiled = [outcome(data) for data in files]
    for loop in ("follow", "take"):
        monkeypatch.setattr(_kernels, f"{loop}_compiled", getattr(_kernels, loop))
    assert [outcome(data) for data in files] == compiled


def outcome(data: bytes):
    """Read a file: every number of every motion, or the refusal."""
    try:
        recording = read_mcap(io.BytesIO(data))
    except Exception as error:
        return type(error).__name__, str(error)
    return [(m.topic, m.stamps_ns.tobytes(), m.tip_mm.tobytes(), m.rotation_xyzw.tobytes()) for m in recording.motions]
