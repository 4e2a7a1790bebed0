"""Few numbers, many times: a palette of those that differ, and for each place which of them stands there.

A policy's Q values are a hundred thousand or more, and some 130 of them differ: a place is worth what its distance to
the next waypoints makes it. As a palette they are an eighth of the bytes, before any compression.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skills.style._arrays import Floats
from skills.style.learning import _kernels

MOST_COLOURS = 256  # so that one byte names each
SLOTS_BITS = 10  # of the table that they are looked up in, a quarter full at most


class Palette(NamedTuple):
    """The numbers that differ, (colours,), in the order in which they come first, and which one stands where, (...)."""

    colours: Floats
    places: NDArray[np.uint8]


def palette_of(values: Floats) -> Palette | None:
    """Find the palette of numbers, every bit kept, of -0 and NaN too; None where more differ than one byte can name."""
    bits = np.require(values, np.float64, ("C", "A")).reshape(-1).view(np.uint64)
    bits.flags.writeable = False  # always of one type: see `skills.compiled`
    found, places = np.empty(MOST_COLOURS, np.uint64), np.empty(bits.size, np.uint8)
    slots = np.full(1 << SLOTS_BITS, -1, np.int16)
    colours = _kernels.tell_apart_compiled(bits, found, places, slots, np.uint64(64 - SLOTS_BITS))
    if colours < 0:
        return None
    return Palette(found[:colours].view(np.float64).copy(), places.reshape(values.shape))


def painted(palette: Palette) -> Floats:
    """Put the numbers where they stand.

    Raises:
        ValueError: The palette is none.
        IndexError: A place names a number that is not there.
    """
    colours, places = palette
    if colours.dtype != np.float64 or colours.ndim != 1 or places.dtype != np.uint8:
        raise ValueError("A palette is a row of numbers and bytes that name them.")
    return colours[places]
