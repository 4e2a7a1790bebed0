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
LENGTH_AT, CHANNEL_AT, LOG_AT = (np.uint64(n) for n in (1, 9, 15))


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
    log_ns: Any,  # (N,) uint64, output
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
        log_ns[count] = word(data, at + LOG_AT)
        at += HEAD + length
        count += 1
    return count, at


def take(
    data: Any,  # (B,) uint8
    messages: Any,  # (N,) int64: the byte at which each message begins
    lengths: Any,  # (N,) int64: of its content
    kinds: Any,  # (N,) int64: the shape, of S, to test each message for; -1 for none
    sizes: Any,  # (S,) int64: the length of the content in each shape
    words: Any,  # (S + 1,) uint64: shape k reads the words from words[k] to words[k + 1]
    gets: Any,  # (S,) uint64: the first of them to copy; those before are only compared
    places: Any,  # (W,) uint64: offset of each word in a message, in bytes
    masks: Any,  # (W,) uint64: its bits that identify the shape
    marked: Any,  # (W,) uint64: the values of these bits
    reach: Any,  # (S,) uint64, initially 0, output: the number of bytes of a message that contain all its words
    rooms: Any,  # (S + 1,) uint64: the slice of `taken` for each shape, as above
    taken: Any,  # (T,) uint64, output: the words, for each shape one message after the other
    found: Any,  # (S,) uint64, initially 0, output: the number of messages of each shape
    fits: Any,  # (N,) bool, output: whether each message has its shape
) -> None:
    """Copy words from every message that has the length and the marked bits of its shape."""
    end = np.uint64(len(data))
    for kind in range(len(sizes)):
        for k in range(words[kind], words[kind + 1]):
            reach[kind] = max(reach[kind], places[k] + EIGHT)
    for n in range(len(messages)):
        fits[n] = False
        if kinds[n] < 0 or kinds[n] >= len(sizes) or lengths[n] != sizes[kinds[n]]:
            continue
        own, first = np.uint64(kinds[n]), np.uint64(messages[n])
        get, stop = gets[own], words[own + ONE]
        to = rooms[own] + found[own] * (stop - get)
        if first > end or end - first < reach[own] or to + (stop - get) > rooms[own + ONE]:
            continue
        same = True
        for k in range(words[own], get):
            if word(data, first + places[k]) & masks[k] != marked[k]:
                same = False
                break
        if same:
            for k in range(get, stop):
                taken[to] = word(data, first + places[k])
                to += ONE
            found[own] += ONE
            fits[n] = True


follow_compiled = compiled(follow)
take_compiled = compiled(take)
