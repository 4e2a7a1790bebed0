"""Serialisation of values as plain JSON and arrays, without pickle.

    value --flatten--> a tree of plain JSON whose leaves point to arrays --build--> the same value

The tree and the arrays are stored in one `.npz` archive. `build` constructs only the classes that the reader passes,
and their constructors check every number again.

An array with few distinct numbers is stored as a *palette*: the distinct numbers, and for each element the index of its
number. A policy has a hundred thousand Q values or more, of which some 130 are distinct, because a value depends only
on the distance to the next waypoints. As a palette they take an eighth of the bytes, before any compression.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import Field, fields, is_dataclass
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats
from skills.compiled import compiled

MOST_COLOURS = 256  # so that an index is one byte
NONE, ONE = np.uint64(0), np.uint64(1)  # unsigned, because numba makes a float of a uint64 and a Python integer
SCATTER = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio (Knuth 6.4): spreads similar bits over the table
SLOTS_BITS = 10  # 2^10 slots in the hash table, of which at most a quarter are filled


class Palette(NamedTuple):
    """The distinct numbers of an array, (colours,), in order of first appearance, and the index of each element."""

    colours: Floats
    places: NDArray[np.uint8]


def palette_of(values: Floats) -> Palette | None:
    """Return the palette of an array, exact to the bit, also for -0 and NaN; None if it exceeds `MOST_COLOURS`."""
    # Compared as bits, so that -0 and 0 remain different and a NaN equals itself.
    bits = np.require(values, np.float64, ("C", "A")).reshape(-1).view(np.uint64)
    bits.flags.writeable = False  # always the same numba type: see `skills.compiled`
    found, places = np.empty(MOST_COLOURS, np.uint64), np.empty(bits.size, np.uint8)
    slots = np.full(1 << SLOTS_BITS, -1, np.int16)
    colours = distinct_numbers(bits, found, places, slots, np.uint64(64 - SLOTS_BITS))
    if colours < 0:
        return None
    return Palette(found[:colours].view(np.float64).copy(), places.reshape(values.shape))


@compiled
def distinct_numbers(bits: Any, found: Any, places: Any, slots: Any, shift: Any) -> Any:
    """Find the distinct numbers of an array, compared bit by bit, and the index of each element among them.

    Args:
        bits: The bits of the numbers, shape (N,), uint64.
        found: The distinct numbers in order of first appearance, shape (F,), uint64, filled.
        places: Index of each number in `found`, shape (N,), uint8, filled.
        slots: Hash table of indices in `found`, with linear probing: shape (2^k,), int16, more than F and all -1;
            changed in place.
        shift: 64 - k, uint64.

    Returns:
        The number of distinct numbers; -1 if they are more than `found` has room for.
    """
    last_slot = np.uint64(len(slots) - 1)
    count = 0
    which = np.int64(-1)
    before = NONE
    for i in range(len(bits)):
        number = bits[i]
        if number != before or which < 0:  # equal numbers are mostly adjacent, so the table is rarely searched
            before = number
            slot = (number * SCATTER) >> shift
            which = np.int64(slots[slot])
            while which >= 0 and found[which] != number:
                slot = (slot + ONE) & last_slot
                which = np.int64(slots[slot])
            if which < 0:
                if count == len(found):
                    return -1
                which = np.int64(count)
                slots[slot] = which
                found[which] = number
                count += 1
        places[i] = which
    return count


def unpack_palette(palette: Palette) -> Floats:
    """Return the array of a palette.

    Raises:
        ValueError: The arrays are not a palette.
        IndexError: An index has no number.
    """
    colours, places = palette
    if colours.dtype != np.float64 or colours.ndim != 1 or places.dtype != np.uint8:
        raise ValueError("A palette is a row of numbers and the bytes that index them.")
    return colours[places]


Arrays = list[np.ndarray[Any, Any]]
Known = Mapping[str, type]

_ADDED: set[tuple[type, str]] = set()
_FEW: set[tuple[type, str]] = set()


def known(*classes: type) -> dict[str, type]:
    """Return the classes that `build` may construct, by name."""
    assert all(is_dataclass(one) for one in classes), classes
    return {one.__name__: one for one in classes}


def added_later(value: type, field: str) -> None:
    """Register a field that was added to a class after values of it had been stored.

    Its default is the value that all stored ones had. The field is omitted while it has that default, so that every
    value has the same digest as before.
    """
    _ADDED.add((value, field))


def store_as_palette(value: type, field: str) -> None:
    """Register a field whose array has few distinct numbers: it is stored as a palette, if that has room for them."""
    _FEW.add((value, field))


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()


def canonical(data: Any) -> bytes:
    """Serialise JSON in the one form that digests are computed from: sorted keys, no spaces, no NaN."""
    return _canonical(data).encode()


_canonical = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False).encode


def digest_of(tree: Any, arrays: Arrays) -> str:
    """Return the SHA-256 of a flattened value in hex: of its numbers and names, independent of their stored form."""
    shape = [[str(a.dtype), list(a.shape), hashlib.sha256(a.data).hexdigest()] for a in arrays]
    return sha256(canonical([tree, shape]))


def write(file: IO[bytes], value: Any, classes: Known) -> None:
    """Write a value to a file as an archive, uncompressed for speed."""
    arrays: Arrays = []
    tree = flatten(value, arrays, classes)
    np.savez(file, **named(tree, arrays))  # type: ignore[arg-type]


def named(tree: Any, arrays: Arrays) -> dict[str, np.ndarray[Any, Any]]:
    """Return the parts of a flattened value under their names in the archive."""
    return {"tree": np.frombuffer(canonical(tree), np.uint8), **{f"a{i}": a for i, a in enumerate(arrays)}}


def read(file: IO[bytes], classes: Known) -> Any:
    """Read a value that `write` has written.

    Raises:
        Exception: Of any class, if the file contains anything else.
    """
    with np.load(file, allow_pickle=False) as archive:  # a pickle could run code
        return assemble(archive, classes)


def assemble(archive: Mapping[str, np.ndarray[Any, Any]], classes: Known) -> Any:
    """Return the value whose parts are in an archive."""
    tree, arrays = json.loads(archive["tree"].tobytes()), [archive[f"a{i}"] for i in range(len(archive) - 1)]
    for array in arrays:
        array.setflags(write=False)  # so that values need no copy of their own: see `skills.arrays.frozen`
    return build(tree, arrays, classes)


def unfolded_bytes(file: IO[bytes]) -> int:
    """Return the memory in bytes that the arrays of an archive take: more than the size of a compressed archive."""
    with zipfile.ZipFile(file) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    file.seek(0)  # for the reader that follows
    return size


def flatten(value: Any, arrays: Arrays, classes: Known) -> Any:
    """Return a value as plain JSON; its arrays and bytes are appended to `arrays`.

    Args:
        value: A value: numbers, texts, arrays, bytes, tuples, lists, dicts and dataclasses of them.
        arrays: The arrays to which the JSON refers by index.
        classes: The classes of dataclasses that may occur, by name.
    """
    if isinstance(value, np.ndarray):
        arrays.append(np.ascontiguousarray(value))
        return {"array": len(arrays) - 1}
    if isinstance(value, Palette):
        arrays.extend(value)
        return {"palette": len(arrays) - 2}
    if isinstance(value, bytes):
        arrays.append(np.frombuffer(value, np.uint8))
        return {"bytes": len(arrays) - 1}
    if is_dataclass(value) and not isinstance(value, type):
        # A value of another class could be written, but not be read back.
        assert classes.get(type(value).__name__) is type(value), f"{type(value).__name__} is not declared"
        written = {f.name: _part(value, f.name) for f in fields(value) if _is_written(value, f)}
        return {
            "value": type(value).__name__,
            "of": {name: flatten(part, arrays, classes) for name, part in written.items()},
        }
    if isinstance(value, dict):
        return {"dict": [[flatten(k, arrays, classes), flatten(v, arrays, classes)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return {"tuple": [flatten(v, arrays, classes) for v in value]}
    if isinstance(value, np.generic):
        return value.item()
    return value


def build(tree: Any, arrays: Arrays, classes: Known) -> Any:
    """Return the value that was flattened; lists come back as tuples.

    Args:
        tree: The plain JSON.
        arrays: The arrays to which it refers.
        classes: The classes that may be constructed, by name.

    Raises:
        Exception: Of any class, if the tree is not one that `flatten` returned.
    """
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "palette" in tree:
        return unpack_palette(Palette(arrays[tree["palette"]], arrays[tree["palette"] + 1]))
    if "bytes" in tree:
        return arrays[tree["bytes"]].tobytes()
    if "dict" in tree:
        return {build(k, arrays, classes): build(v, arrays, classes) for k, v in tree["dict"]}
    if "tuple" in tree:
        return tuple(build(v, arrays, classes) for v in tree["tuple"])
    return classes[tree["value"]](**{name: build(part, arrays, classes) for name, part in tree["of"].items()})


def _part(value: Any, name: str) -> Any:
    part = getattr(value, name)
    return part if (type(value), name) not in _FEW else palette_of(part) or part


def _is_written(value: Any, field: Field[Any]) -> bool:
    if (type(value), field.name) not in _ADDED:
        return True
    part = getattr(value, field.name)
    return isinstance(part, np.ndarray) or part != field.default
