"""A column type for frozen values: serialised without pickle, and verified by a SHA-256 at every read.

A value's tree and arrays (`skills.packing`) are stored as the bytes of one safetensors file, compressed, and preceded
by a format number and the SHA-256 of the compressed bytes. The value's *digest* is computed from the tree and the
arrays themselves, so it does not depend on their compression.

The compression is Intel's deflate, a tenth of the time of zlib's for twice the size: a policy's Q values are two
megabytes, and zlib takes as long to compress them as they took to learn (measured in `tests/bench/batches.py`).
"""

import hashlib
from dataclasses import is_dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from isal import isal_zlib
from safetensors.numpy import load, save
from sqlalchemy import Dialect, LargeBinary
from sqlalchemy.types import TypeDecorator

from skills import packing
from skills.errors import Corrupt
from skills.packing import Arrays, digest_of

FORMAT = b"SKILLS01"
LEVEL = 1  # level 2 is no smaller, level 3 takes three times as long for 10 % less
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
    body = isal_zlib.compress(save(packing.named(tree, arrays)), LEVEL)
    return FORMAT + hashlib.sha256(body).digest() + body


def unpack_as(kind: type[T], data: bytes) -> T:
    """Deserialise a value of one class.

    Raises:
        Corrupt: A byte differs from the stored ones, the format is unknown to this version, or it is of another class.
    """
    head, checksum, body = data[:8], data[8:40], data[40:]  # format number, SHA-256, compressed file
    if head != FORMAT or hashlib.sha256(body).digest() != checksum:
        raise Corrupt("A stored value does not match its checksum and was not used; restore it from a backup.")
    try:
        built = packing.assemble(load(isal_zlib.decompress(body)), _VALUES)
    except Exception as error:  # intact, but of an unknown class, or its constructor refuses the numbers
        raise Corrupt(
            "A stored value has a format that this version does not know and was not used; update the code."
        ) from error
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
