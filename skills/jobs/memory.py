"""Memory that a worker keeps between styles, instead of giving it back and asking for it again.

A policy's arrays have a few megabytes. The C library gives such pieces back to the system when they are freed, and the
next style pays for every page again: a sixth of the time of a batch (`tests/bench/batches.py`).
"""

import ctypes

TRIM, MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h
KEPT_BYTES = 64 << 20  # what may lie unused
PIECE_BYTES = 32 << 20  # larger pieces still go back at once; the C library allows no more


def keep_freed_memory() -> bool:
    """Ask the C library to keep what is freed, up to `KEPT_BYTES`; tell whether it is one that does (glibc is)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(TRIM, KEPT_BYTES) and mallopt(MMAP, PIECE_BYTES))
