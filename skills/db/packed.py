"""One column type for any frozen value: whole, without pickle, and refused if a single bit of it has changed.

A value's tree and arrays (`skills.packing`) are stored as one compressed `.npz`, behind a format number and the SHA-256
of what follows. The value's *digest* is over the tree and the arrays themselves, so it does not depend on how they were
compressed.
"""

import hashlib
import io
from dataclasses import is_dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from sqlalchemy import Dialect, LargeBinary
from sqlalchemy.types import TypeDecorator

from skills import packing
from skills.db import npz
from skills.errors import Corrupt
from skills.packing import Arrays, canonical, sha256

FORMAT = b"SKILLS01"
T = TypeVar("T")

_VALUES: dict[str, type] = {}


def stored(*values: type) -> None:
    """Name the value classes that may be read back; no other is ever built from stored bytes."""
    for value in values:
        assert is_dataclass(value) and _VALUES.get(value.__name__, value) is value, value
        _VALUES[value.__name__] = value


class Sealed(NamedTuple):
    """A value as it is stored, and the digest that it is known by."""

    packed: bytes
    digest: str


def seal(value: Any) -> Sealed:
    """Lay a value out as bytes, and compute its digest: for less than both cost alone."""
    flat = _flat(value)
    return Sealed(_packed(*flat), _digest(*flat))


def digest(value: Any) -> str:
    """Compute the SHA-256 of a value, in hex: over its numbers and names, however they are stored."""
    return _digest(*_flat(value))


def pack(value: Any) -> bytes:
    """Lay a value out as bytes."""
    return _packed(*_flat(value))


def _flat(value: Any) -> tuple[Any, Arrays]:
    arrays: Arrays = []
    return packing.flatten(value, arrays, _VALUES), arrays


def _digest(tree: Any, arrays: Arrays) -> str:
    shape = [[str(a.dtype), list(a.shape), hashlib.sha256(a.data).hexdigest()] for a in arrays]
    return sha256(canonical([tree, shape]))


def _packed(tree: Any, arrays: Arrays) -> bytes:
    out = io.BytesIO()
    npz.save(out, **packing.named(tree, arrays))
    body = out.getvalue()
    return FORMAT + hashlib.sha256(body).digest() + body


def unpack(data: bytes) -> Any:
    """Build the value that was packed.

    Raises:
        Corrupt: A byte differs from what was stored, or the format is unknown to this version.
    """
    head, checksum, body = data[:8], data[8:40], data[40:]
    if head != FORMAT or hashlib.sha256(body).digest() != checksum:
        raise Corrupt("A stored value is not what was stored; restore it from a backup, nothing of it is used.")
    try:
        return packing.assemble(npz.load(body), _VALUES)
    except Exception as error:  # whole, but of a class unknown here, or of numbers that its class refuses
        raise Corrupt(
            "A stored value is none that this version knows; update the code, nothing of it is used."
        ) from error


def unpack_as(kind: type[T], data: bytes) -> T:
    """Build the value of one class that was packed.

    Raises:
        Corrupt: As for `unpack`, or it is of another class.
    """
    built = unpack(data)
    if not isinstance(built, kind):
        raise Corrupt(f"A stored value is a {type(built).__name__} where a {kind.__name__} should be.")
    return built


class Packed(TypeDecorator[T], Generic[T]):
    """A column that holds a whole value of one class; it may be given packed, so that no transaction waits for that."""

    impl = LargeBinary
    cache_ok = True

    def __init__(self, value: type[T]) -> None:
        super().__init__()
        self.value = value
        stored(value)

    def process_bind_param(self, value: T | bytes | None, dialect: Dialect) -> bytes | None:
        """Pack."""
        if isinstance(value, bytes) and value.startswith(FORMAT):
            return value
        assert value is None or isinstance(value, self.value)
        return None if value is None else pack(value)

    def process_result_value(self, value: bytes | None, dialect: Dialect) -> T | None:
        """Unpack, and refuse what has changed."""
        return None if value is None else unpack_as(self.value, value)
