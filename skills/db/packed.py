"""A column type for frozen values: serialised without pickle, and verified by a SHA-256 at every read.

A value's tree and arrays (`skills.packing`) are stored as one compressed `.npz`, preceded by a format number and the
SHA-256 of the archive. The value's *digest* is computed from the tree and the arrays themselves, so it does not depend
on their compression.

The archives are as written by `np.savez_compressed`, but with Intel's deflate: a tenth of the time for twice the size.
A policy's Q values are two megabytes; compressing them with numpy takes as long as learning them did (measured in
`tests/bench/batches.py`). Any zip reader can read the archives, and `load_arrays` reads archives of any writer.
"""

import hashlib
import io
import re
import struct
from dataclasses import is_dataclass
from typing import IO, Any, Generic, NamedTuple, TypeVar

import numpy as np
from isal import isal_zlib
from sqlalchemy import Dialect, LargeBinary
from sqlalchemy.types import TypeDecorator

from skills import packing
from skills.errors import Corrupt
from skills.packing import Arrays, digest_of

FORMAT = b"SKILLS01"
T = TypeVar("T")

_VALUES: dict[str, type] = {}


def stored(*values: type) -> None:
    """Register the value classes that may be deserialised; no other class is ever built from stored bytes."""
    for value in values:
        assert is_dataclass(value) and _VALUES.get(value.__name__, value) is value, value
        _VALUES[value.__name__] = value


class Sealed(NamedTuple):
    """A serialised value and its digest."""

    packed: bytes
    digest: str


def seal(value: Any) -> Sealed:
    """Serialise a value and compute its digest; cheaper than both separately, because it is flattened only once."""
    flat = _flat(value)
    return Sealed(_packed(*flat), digest_of(*flat))


def digest(value: Any) -> str:
    """Return the SHA-256 of a value in hex: of its numbers and names, independent of their stored form."""
    return digest_of(*_flat(value))


def pack(value: Any) -> bytes:
    """Serialise a value."""
    return _packed(*_flat(value))


def _flat(value: Any) -> tuple[Any, Arrays]:
    arrays: Arrays = []
    return packing.flatten(value, arrays, _VALUES), arrays


def _packed(tree: Any, arrays: Arrays) -> bytes:
    out = io.BytesIO()
    save_arrays(out, **packing.named(tree, arrays))
    body = out.getvalue()
    return FORMAT + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> Any:
    """Deserialise a value.

    Raises:
        Corrupt: A byte differs from the stored ones, or the format is unknown to this version.
    """
    head, checksum, body = data[:8], data[8:40], data[40:]  # format number, SHA-256, archive
    if head != FORMAT or hashlib.sha256(body).digest() != checksum:
        raise Corrupt("A stored value does not match its checksum and was not used; restore it from a backup.")
    try:
        return packing.assemble(load_arrays(body), _VALUES)
    except Exception as error:  # intact, but of an unknown class, or its constructor refuses the numbers
        raise Corrupt(
            "A stored value has a format that this version does not know and was not used; update the code."
        ) from error


def unpack_as(kind: type[T], data: bytes) -> T:
    """Deserialise a value of one class.

    Raises:
        Corrupt: As for `unpack`, or it is of another class.
    """
    built = unpack(data)
    if not isinstance(built, kind):
        raise Corrupt(f"A stored value is a {type(built).__name__} where a {kind.__name__} should be.")
    return built


class Packed(TypeDecorator[T], Generic[T]):
    """A column that stores values of one class, serialised.

    It also accepts a value that is serialised already, so that a transaction does not have to wait for the
    serialisation.
    """

    impl = LargeBinary
    cache_ok = True

    def __init__(self, value: type[T]) -> None:
        super().__init__()
        self.value = value
        stored(value)

    def process_bind_param(self, value: T | bytes | None, dialect: Dialect) -> bytes | None:
        """Serialise."""
        if isinstance(value, bytes) and value.startswith(FORMAT):
            return value
        assert value is None or isinstance(value, self.value)
        return None if value is None else pack(value)

    def process_result_value(self, value: bytes | None, dialect: Dialect) -> T | None:
        """Deserialise; refuse data that has changed since it was stored."""
        return None if value is None else unpack_as(self.value, value)


# ---- archives --------------------------------------------------------------------------------------------------------

LEVEL = 1  # level 2 is no smaller, level 3 takes three times as long for 10 % less
RAW = -15  # raw deflate as in zip files, without a zlib header
MAX_BYTES = 2**31  # larger archives are left to numpy, which writes zip64 where it is needed
STORED, DEFLATED, NEEDED, NO_DATE = 0, 8, 20, 0x21
LOCAL, CENTRAL, END = b"PK\3\4", b"PK\1\2", b"PK\5\6"
LOCAL_BYTES, CENTRAL_BYTES, END_BYTES = 30, 46, 22

Archive = dict[str, np.ndarray[Any, Any]]
# The header of a plain array in numpy's format: magic and version 1.0, the header's length, and a dictionary.
HEAD = re.compile(
    rb"\x93NUMPY\x01\x00[\x00-\xff]{2}"
    rb"\{'descr': '([<|][fiub]\d)', 'fortran_order': False, 'shape': \(([\d, ]*)\), \} *\n"
)


def save_arrays(file: IO[bytes], **arrays: np.ndarray[Any, Any]) -> None:
    """Write arrays into an empty file, each under its name."""
    if sum(array.nbytes for array in arrays.values()) > MAX_BYTES:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        return
    directory, at = [], 0
    for name, array in arrays.items():
        array = np.asarray(array, order="C")
        head, member = _head(array), f"{name}.npy".encode()
        data = array.reshape(-1).view(np.uint8).data
        squeezer = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, RAW)
        parts = [squeezer.compress(head), squeezer.compress(data), squeezer.flush()]
        crc, stored, whole = _crc(head, data), sum(map(len, parts)), len(head) + len(data)
        said = struct.pack("<4H3L2H", 0, DEFLATED, 0, NO_DATE, crc, stored, whole, len(member), 0)
        file.writelines([LOCAL, struct.pack("<H", NEEDED), said, member, *parts])
        directory += [CENTRAL, struct.pack("<2H", NEEDED, NEEDED), said, struct.pack("<3H2L", 0, 0, 0, 0, at), member]
        at += LOCAL_BYTES + len(member) + stored
    size = sum(map(len, directory))
    file.writelines([*directory, END, struct.pack("<4H2LH", 0, 0, len(arrays), len(arrays), size, at, 0)])


def load_arrays(data: bytes) -> Archive:
    """Return all arrays of an archive whose integrity was verified before.

    Archives, or arrays in them, that are not in the form `save_arrays` or numpy normally write are read by numpy.

    Raises:
        Exception: Of any class, if it is not such an archive.
    """
    try:
        return dict(_members(data))
    except _Unusual:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


class _Unusual(Exception):
    """An archive or an array in a form that `save_arrays` and numpy do not normally write."""


def _members(data: bytes) -> list[tuple[str, np.ndarray[Any, Any]]]:
    if data[-END_BYTES : 4 - END_BYTES] != END:
        raise _Unusual
    count, size, at = struct.unpack_from("<H2L", data, len(data) - END_BYTES + 10)
    if at + size + END_BYTES != len(data):
        raise _Unusual
    found = []
    for _ in range(count):
        method, crc, stored, whole, name, extra, comment, start = struct.unpack_from("<10xH4xLLLHHH8xL", data, at)
        member = data[at + CENTRAL_BYTES : at + CENTRAL_BYTES + name].decode()
        at += CENTRAL_BYTES + name + extra + comment
        begin = start + LOCAL_BYTES + sum(struct.unpack_from("<2H", data, start + LOCAL_BYTES - 4))
        raw = memoryview(data)[begin : begin + stored]
        if method not in (STORED, DEFLATED) or not member.endswith(".npy"):
            raise _Unusual
        content = isal_zlib.decompress(raw, RAW, whole) if method == DEFLATED else raw
        if len(content) != whole or isal_zlib.crc32(content) != crc:
            raise _Unusual
        found.append((member.removesuffix(".npy"), _array(content)))
    return found


def _array(content: bytes | memoryview) -> np.ndarray[Any, Any]:
    """Return an array as a read-only view of the bytes, without a copy."""
    head = HEAD.match(content)
    if head is None:
        raise _Unusual
    shape = [int(side) for side in head[2].split(b",") if side.strip()]
    return np.frombuffer(content, np.dtype(head[1].decode()), offset=head.end()).reshape(shape)


def _head(array: np.ndarray[Any, Any]) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, np.lib.format.header_data_from_array_1_0(array))
    return out.getvalue()


def _crc(head: bytes, data: memoryview) -> int:
    return isal_zlib.crc32(data, isal_zlib.crc32(head))
