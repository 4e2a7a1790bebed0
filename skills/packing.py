"""Values as plain JSON and arrays, and back, without pickle.

    value --flatten--> a tree of plain JSON whose leaves point to arrays --build--> the same value

Both are laid out in one `.npz` archive. What is built back is of the classes that the reader names, no other, and their
constructors check every number again.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import Field, fields, is_dataclass
from typing import IO, Any

import numpy as np

from skills.style.palette import Palette, painted, palette_of

Arrays = list[np.ndarray[Any, Any]]
Known = Mapping[str, type]

_ADDED: set[tuple[type, str]] = set()
_FEW: set[tuple[type, str]] = set()


def known(*classes: type) -> dict[str, type]:
    """Name the classes of values that may be built back."""
    assert all(is_dataclass(one) for one in classes), classes
    return {one.__name__: one for one in classes}


def added_later(value: type, field: str) -> None:
    """Name a field that a class got after values of it had been stored; its default is what all of them had.

    It is left out while it holds that default, so that every value keeps its digest.
    """
    _ADDED.add((value, field))


def few_numbers(value: type, field: str) -> None:
    """Name a field whose array has few different numbers: it is written as their palette, if that can name them all."""
    _FEW.add((value, field))


def sha256(data: bytes) -> str:
    """Compute the SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()


def canonical(data: Any) -> bytes:
    """Write JSON in the one way that digests are taken of: sorted keys, no spaces, no NaN."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


def write(file: IO[bytes], value: Any, classes: Known) -> None:
    """Lay a value out in a file, quickly."""
    arrays: Arrays = []
    tree = flatten(value, arrays, classes)
    np.savez(file, **named(tree, arrays))  # type: ignore[arg-type]


def named(tree: Any, arrays: Arrays) -> dict[str, np.ndarray[Any, Any]]:
    """Name the parts of a flattened value as an archive has them."""
    return {"tree": np.frombuffer(canonical(tree), np.uint8), **{f"a{i}": a for i, a in enumerate(arrays)}}


def read(file: IO[bytes], classes: Known) -> Any:
    """Build the value that was written.

    Raises:
        Exception: Of any class, where the file holds anything else.
    """
    with np.load(file, allow_pickle=False) as archive:
        return assemble(archive, classes)


def assemble(archive: Mapping[str, np.ndarray[Any, Any]], classes: Known) -> Any:
    """Build the value whose parts an archive holds."""
    tree = json.loads(archive["tree"].tobytes())
    return build(tree, [archive[f"a{i}"] for i in range(len(archive) - 1)], classes)


def unfolded_bytes(file: IO[bytes]) -> int:
    """Say how much memory the arrays of an archive would take: a compressed one is smaller than what it holds."""
    with zipfile.ZipFile(file) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    file.seek(0)
    return size


def flatten(value: Any, arrays: Arrays, classes: Known) -> Any:
    """Write a value as plain JSON, its arrays and bytes put into `arrays`."""
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
    """Build the value that was flattened."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "palette" in tree:
        return painted(Palette(arrays[tree["palette"]], arrays[tree["palette"] + 1]))
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
    return (type(value), field.name) not in _ADDED or getattr(value, field.name) != field.default
