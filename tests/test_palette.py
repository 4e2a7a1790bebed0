"""Palettes: every bit of every number is preserved, and invalid palettes are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from skills.packing import MOST_COLOURS, Palette, distinct_numbers, palette_of, unpack_palette

SHAPES = some.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9)
ANY_BITS = some.arrays(np.uint64, SHAPES, elements=st.integers(0, 2**64 - 1)).map(lambda bits: bits.view(np.float64))
FEW = some.arrays(np.float64, SHAPES, elements=st.sampled_from([0.0, -0.0, 0.1, np.nan, -np.nan, np.inf, 5e-324]))


def test_a_palette_by_hand():
    values = np.array([[2.0, 2.0, -0.0], [0.0, 2.0, 7.0]])
    colours, places = palette_of(values)
    assert repr(colours.tolist()) == "[2.0, -0.0, 0.0, 7.0]"
    assert places.tolist() == [[0, 0, 1], [2, 0, 3]]


@settings(deadline=None)
@given(ANY_BITS | FEW)
def test_every_bit_comes_back(values):
    palette = palette_of(values)
    if palette is None:
        assert len(set(values.view(np.uint64).ravel().tolist())) > MOST_COLOURS
        return
    back = unpack_palette(palette)
    assert (back.dtype, back.shape, back.tobytes()) == (values.dtype, values.shape, values.tobytes())


@settings(deadline=None)
@given(ANY_BITS | FEW)
def test_equal_arrays_have_one_palette_however_they_lie_in_memory(values):
    palette = palette_of(values)
    unaligned = np.frombuffer(b"\0" + values.tobytes(), np.float64, offset=1).reshape(values.shape)
    for other in (np.asfortranarray(values), np.repeat(values, 2, axis=0)[::2], unaligned):
        again = palette_of(other)
        assert (again is None) == (palette is None)
        if palette is not None:
            assert [part.tobytes() for part in again] == [part.tobytes() for part in palette]


@pytest.mark.parametrize("seed", range(5))
def test_as_many_as_a_byte_can_name_have_a_palette_and_one_more_has_none(seed):
    rng = np.random.default_rng(seed)
    most = rng.random(MOST_COLOURS)
    values = rng.permutation(np.concatenate([most, rng.choice(most, 1000)]))
    palette = palette_of(values)
    assert sorted(palette.colours) == sorted(most)
    assert np.array_equal(unpack_palette(palette), values)
    assert palette_of(np.append(values, 2.0)) is None


@pytest.mark.parametrize(
    "palette",
    [
        Palette(np.zeros(2), np.array([0, 1, 2], np.uint8)),
        Palette(np.zeros(0), np.zeros(1, np.uint8)),
        Palette(np.zeros(2), np.array([0, -1], np.int8)),
        Palette(np.zeros(2), np.array([True, False])),
        Palette(np.zeros(2, np.float32), np.zeros(1, np.uint8)),
        Palette(np.zeros((2, 27)), np.zeros(1, np.uint8)),
    ],
    ids=["a number too many", "no numbers", "from the end", "a mask", "other numbers", "rows"],
)
def test_what_is_no_palette_is_refused(palette):
    with pytest.raises((ValueError, IndexError)):
        unpack_palette(palette)


@settings(deadline=None)
@given(some.arrays(float, st.integers(0, 300), elements=st.sampled_from([0.0, -0.0, 1.0, 0.1, np.nan, np.inf, 5e-324])))
def test_the_compiled_palette_and_the_plain_one_agree(values):
    bits, found = values.view(np.uint64), []
    for tell_apart in (distinct_numbers.plain, distinct_numbers):
        read_only = bits.copy()
        read_only.flags.writeable = False
        colours, places, slots = np.zeros(4, np.uint64), np.zeros(len(bits), np.uint8), np.full(8, -1, np.int16)
        with np.errstate(over="ignore"):  # the product's upper bits are meant to be lost
            count = tell_apart(read_only, colours, places, slots, np.uint64(61))
        found.append((count, colours.tobytes(), places.tobytes(), slots.tobytes()))
    assert found[0] == found[1]
