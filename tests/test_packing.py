"""Palettes: the distinct numbers of an array, found compiled and plain."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skills.packing import distinct_numbers


@settings(deadline=None)
@given(arrays(float, st.integers(0, 300), elements=st.sampled_from([0.0, -0.0, 1.0, 0.1, np.nan, np.inf, 5e-324])))
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
