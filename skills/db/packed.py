"""One column type for any frozen value: whole, without pickle, and refused if a single bit of it has changed.

A value is laid out as a tree of plain JSON whose leaves point to its arrays; the tree and the arrays are stored as one
compressed `.npz`, behind a format number and the SHA-256 of what follows. The value's *digest* is over the tree and
the arrays themselves, so it does not depend on how they were compressed.
"""

import hashlib
import io
import json
from dataclasses import Field, fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from sqlalchemy import Dialect, LargeBinary
from sqlalchemy.types import TypeDecorator

from skills.errors import Corrupt

FORMAT = b"SKILLS01"
T = TypeVar("T")

_VALUES: dict[str, type] = {}
_ADDED: set[tuple[type, str]] = set()


def stored(*values: type) -> None:
    """Name the value classes that may be read back; no other is ever built from stored bytes."""
    for value in values:
        assert is_dataclass(value) and _VALUES.get(value.__name__, value) is value, value
        _VALUES[value.__name__] = value


def added_later(value: type, field: str) -> None:
    """Name a field that a class got after values of it had been stored; its default is what all of them had.

    It is left out while it holds that default, so that every value keeps its digest.
    """
    _ADDED.add((value, field))


def digest(value: Any) -> str:
    """Compute the SHA-256 of a value, in hex: over its numbers and names, however they are stored."""
    arrays: list[np.ndarray[Any, Any]] = []
    tree = _flatten(value, arrays)
    shape = [[str(a.dtype), list(a.shape), sha256(a.tobytes())] for a in arrays]
    return sha256(canonical([tree, shape]))


def sha256(data: bytes) -> str:
    """Compute the SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()


def canonical(data: Any) -> bytes:
    """Write JSON in the one way that digests are taken of: sorted keys, no spaces, no NaN."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


def pack(value: Any) -> bytes:
    """Lay a value out as bytes."""
    arrays: list[np.ndarray[Any, Any]] = []
    tree = np.frombuffer(canonical(_flatten(value, arrays)), np.uint8)
    out = io.BytesIO()
    np.savez_compressed(out, tree=tree, **{f"a{i}": a for i, a in enumerate(arrays)})  # type: ignore[arg-type]
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
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            tree = json.loads(archive["tree"].tobytes())
            return _build(tree, [archive[f"a{i}"] for i in range(len(archive.files) - 1)])
    except Exception as error:  # whole, but of a class unknown here, or of numbers that its class refuses
        raise Corrupt(
            "A stored value is none that this version knows; update the code, nothing of it is used."
        ) from error


def _flatten(value: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    if isinstance(value, np.ndarray):
        arrays.append(np.ascontiguousarray(value))
        return {"array": len(arrays) - 1}
    if isinstance(value, bytes):
        arrays.append(np.frombuffer(value, np.uint8))
        return {"bytes": len(arrays) - 1}
    if is_dataclass(value) and not isinstance(value, type):
        assert type(value).__name__ in _VALUES, f"{type(value).__name__} is not declared as stored"
        return {
            "value": type(value).__name__,
            "of": {f.name: _flatten(getattr(value, f.name), arrays) for f in fields(value) if _is_written(value, f)},
        }
    if isinstance(value, dict):
        return {"dict": [[_flatten(k, arrays), _flatten(v, arrays)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return {"tuple": [_flatten(v, arrays) for v in value]}
    if isinstance(value, np.generic):
        return value.item()
    return value


def _is_written(value: Any, field: Field[Any]) -> bool:
    return (type(value), field.name) not in _ADDED or getattr(value, field.name) != field.default


def _build(tree: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "bytes" in tree:
        return arrays[tree["bytes"]].tobytes()
    if "dict" in tree:
        return {_build(k, arrays): _build(v, arrays) for k, v in tree["dict"]}
    if "tuple" in tree:
        return tuple(_build(v, arrays) for v in tree["tuple"])
    return _VALUES[tree["value"]](**{name: _build(part, arrays) for name, part in tree["of"].items()})


class Packed(TypeDecorator[T], Generic[T]):
    """A column that holds a whole value of one class."""

    impl = LargeBinary
    cache_ok = True

    def __init__(self, value: type[T]) -> None:
        super().__init__()
        self.value = value
        stored(value)

    def process_bind_param(self, value: T | None, dialect: Dialect) -> bytes | None:
        """Pack."""
        assert value is None or isinstance(value, self.value)
        return None if value is None else pack(value)

    def process_result_value(self, value: bytes | None, dialect: Dialect) -> T | None:
        """Unpack, and refuse what has changed."""
        if value is None:
            return None
        built = unpack(value)
        if not isinstance(built, self.value):
            raise Corrupt(f"A stored value is a {type(built).__name__} where a {self.value.__name__} should be.")
        return built
