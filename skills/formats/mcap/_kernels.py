"""Compiled loops of the MCAP reader; each is an ordinary Python function with a compiled version named `*_compiled`.

They take arrays and numbers, allocate nothing and raise nothing. The plain and the compiled function agree to the last
bit, which a test verifies. For any input bytes, neither accesses an array out of bounds: numba does not check bounds.

A message's content follows a header of 31 bytes (MCAP specification, "Records"): opcode, 1 byte; length of the rest of
the record, 8; channel, 2; sequence number, 4; log time and publish time, 8 each.
"""

from typing import Any

import numpy as np

from skills.compiled import compiled, inner

# uint64 constants, because numba makes a float of a uint64 and a Python integer. The second line has bit shifts.
ONE, TWO, THREE, FOUR, FIVE, SIX, SEVEN, EIGHT = (np.uint64(n) for n in range(1, 9))
BY_1, BY_2, BY_3, BY_4, BY_5, BY_6, BY_7 = (np.uint64(8 * n) for n in range(1, 8))
MESSAGE, HEAD, TIMES, LEAST = (np.uint64(n) for n in (5, 9, 22, 31))  # an opcode, and bytes
LENGTH_AT, CHANNEL_AT = (np.uint64(n) for n in (1, 9))


@inner
def word(data: Any, at: Any) -> Any:
    """Return eight bytes as a little-endian uint64; numba compiles this to a single load."""
    return (
        np.uint64(data[at])
        | np.uint64(data[at + ONE]) << BY_1
        | np.uint64(data[at + TWO]) << BY_2
        | np.uint64(data[at + THREE]) << BY_3
        | np.uint64(data[at + FOUR]) << BY_4
        | np.uint64(data[at + FIVE]) << BY_5
        | np.uint64(data[at + SIX]) << BY_6
        | np.uint64(data[at + SEVEN]) << BY_7
    )


def follow(
    data: Any,  # (B,) uint8
    begin: int,  # the byte at which the first record begins
    count: int,  # of messages found by earlier calls, which keep their places
    messages: Any,  # (N,) int64, output: the byte at which each message begins
    lengths: Any,  # (N,) int64, output: of its content, without the header
    channels: Any,  # (N,) uint16, output
) -> Any:
    """Find messages up to the first record that is not a message, is incomplete, or does not fit into the arrays.

    A length is compared with the remaining bytes before it is added, so that no addition overflows.

    Returns:
        The number of messages found, including earlier ones, and the byte at which the last one ends.
    """
    at, end = np.uint64(begin), np.uint64(len(data))
    while count < len(messages) and at <= end and end - at >= LEAST:
        length = word(data, at + LENGTH_AT)
        if data[at] != MESSAGE or length < TIMES or length > end - at - HEAD:
            break
        messages[count] = at
        lengths[count] = length - TIMES
        channels[count] = np.uint64(data[at + CHANNEL_AT]) | np.uint64(data[at + CHANNEL_AT + ONE]) << BY_1
        at += HEAD + length
        count += 1
    return count, at


def take(
    data: Any,  # (B,) uint8
    messages: Any,  # (N,) int64: the byte at which each message begins
    lengths: Any,  # (N,) int64: of its content
    size: int,  # the length of the content in this shape
    compared: int,  # the number of words, the first ones, that are only compared
    places: Any,  # (M,) uint64: offset of each word in a message, in bytes
    masks: Any,  # (M,) uint64: its bits that identify the shape
    marked: Any,  # (M,) uint64: the values of these bits
    taken: Any,  # (N, M - compared) uint64, output: the other words of each message that has the shape
    fits: Any,  # (N,) bool, output: whether each message has the shape
) -> Any:
    """Copy words from every message that has the length and the marked bits of a shape; return how many have."""
    end, reach, found = np.uint64(len(data)), np.uint64(0), 0
    for k in range(len(places)):
        reach = max(reach, places[k] + EIGHT)
    for n in range(len(messages)):
        first = np.uint64(messages[n])
        same = lengths[n] == size and first <= end and end - first >= reach
        k = 0
        while same and k < compared:
            same = word(data, first + places[k]) & masks[k] == marked[k]
            k += 1
        fits[n] = same
        if same:
            for k in range(compared, len(places)):
                taken[found, k - compared] = word(data, first + places[k])
            found += 1
    return found


follow_compiled = compiled(follow)
take_compiled = compiled(take)
