"""The reader's loops: ordinary Python first, compiled where they are called `*_compiled`.

Arrays and numbers in, nothing allocated, nothing raised. The plain function and the compiled one agree to the last
bit; a test says so. Whatever the bytes say, neither looks beyond an array: a compiled loop would not be stopped.

A message is told by what stands before its content (MCAP specification, "Records"): its opcode, one byte; the length of
what follows, eight; its channel, two; its number, four; when it was logged and published, eight each.
"""

from typing import Any

import numpy as np

from skills.compiled import compiled, inner

# Whole numbers without a sign; one of these and a number of Python's would give a float. The second line are shifts.
ONE, TWO, THREE, FOUR, FIVE, SIX, SEVEN, EIGHT = (np.uint64(n) for n in range(1, 9))
BY_1, BY_2, BY_3, BY_4, BY_5, BY_6, BY_7 = (np.uint64(8 * n) for n in range(1, 8))
MESSAGE, HEAD, TIMES, LEAST = (np.uint64(n) for n in (5, 9, 22, 31))  # an opcode, and bytes
LENGTH_AT, CHANNEL_AT, LOG_AT = (np.uint64(n) for n in (1, 9, 15))


@inner
def word(data: Any, at: Any) -> Any:
    """Read eight bytes as a little-endian uint64; numba makes one step of it."""
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
    begin: int,  # the byte where the first record begins
    count: int,  # of the messages that were found before, and stay
    messages: Any,  # (N,) int64, filled: where each message begins
    lengths: Any,  # (N,) int64, filled: of its content alone
    channels: Any,  # (N,) uint16, filled
    log_ns: Any,  # (N,) uint64, filled
) -> Any:
    """Follow messages up to the first that is none, is not whole, or finds no place: how many now, and where they end.

    A length is compared with what is left and only then added, so that none is too large.
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
    messages: Any,  # (N,) int64: where each message begins
    lengths: Any,  # (N,) int64: of its content
    kinds: Any,  # (N,) int64: the shape that each may have, of S; -1 for none
    sizes: Any,  # (S,) int64: the length of the content in each shape
    words: Any,  # (S + 1,) uint64: which words to read, those of shape k from words[k] to words[k + 1]
    gets: Any,  # (S,) uint64: the first of them to take; those before are only looked at
    places: Any,  # (W,) uint64: where each word is in a message, in bytes
    masks: Any,  # (W,) uint64: which of its bits tell the shape
    marked: Any,  # (W,) uint64: what these are
    reach: Any,  # (S,) uint64, at first 0, filled: how many bytes of a message hold all its words
    rooms: Any,  # (S + 1,) uint64: where in `taken` there is room for each shape, as above
    taken: Any,  # (T,) uint64, filled: the words, of each shape one message behind the other
    found: Any,  # (S,) uint64, at first 0, filled: how many messages have each shape
    fits: Any,  # (N,) bool, filled: whether each message has its shape
) -> None:
    """Take words from every message that has the length and the marked bits of its shape."""
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
