"""Arrays of the library's values: validated once, C-ordered, read-only."""

from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import BadInput
from skills.fields import Point, Quaternion

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.int8]
Flags = NDArray[np.bool_]


def frozen(values: ArrayLike, dtype: Any, shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    """Return values as a read-only C-ordered array of the given type and shape, which nobody else can change.

    Values that are such an array already, with memory of its own, are returned as they are; all others are copied.

    Args:
        values: The values.
        dtype: The type of the array.
        shape: The required shape; None stands for any length.
        name: Name of the values, for the message.

    Returns:
        The array.

    Raises:
        BadInput: The shape is another one, or a number is NaN or infinite.
    """
    array = values if _is_frozen(values, dtype) else np.array(values, dtype=dtype, order="C", copy=True)
    if array.dtype.kind == "f" and array.flags.writeable:
        array += 0.0  # -0 is 0, so that equal numbers have equal digests
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("any" if n is None else str(n) for n in shape)
        raise BadInput(f"{name} has shape {array.shape}; give {wanted}.", shape=array.shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise BadInput(f"{name} contains NaN or infinity; every number must be finite.")
    array.setflags(write=False)
    return array


def freeze(value: object, dtype: Any = np.float64, **shapes: tuple[int | None, ...]) -> None:
    """Replace arrays of a frozen dataclass by `frozen` ones, in its constructor; a field that is None stays None.

    Args:
        value: The value that is constructed.
        dtype: The type of these arrays.
        shapes: The required shape of each field, by its name.

    Raises:
        BadInput: As for `frozen`; the message names the field.
    """
    for name, shape in shapes.items():
        if (given := getattr(value, name)) is not None:
            object.__setattr__(value, name, frozen(given, dtype, shape, name))


def _is_frozen(values: ArrayLike, dtype: Any) -> TypeGuard[NDArray[Any]]:
    """Return whether values are an array as `frozen` returns it; a view of another array may change with that."""
    if type(values) is not np.ndarray or values.dtype != dtype:
        return False
    return values.flags.owndata and values.flags.c_contiguous and values.flags.aligned and not values.flags.writeable


def interpolated(at: Floats, stamps: Floats, rows: Floats) -> Floats:
    """Return rows, (T, K), at some places between their ascending stamps, (T,); beyond these the first or the last."""
    return np.stack([np.interp(at, stamps, column) for column in rows.T], axis=1)


def nearest(stamps: NDArray[Any], wanted: NDArray[Any]) -> Ints:
    """Return the indices of those of some ascending stamps that are nearest to others; of two as near the earlier."""
    known = stamps - stamps[:1]  # small, so that sums of nanoseconds are nanoseconds too
    return np.asarray(np.searchsorted(known[:-1] + known[1:], 2 * (wanted - stamps[:1])), np.int64)


def xyz(values: Floats) -> Point:
    """Return three numbers, shape (3,), as Python's own."""
    x, y, z = values.tolist()
    return x, y, z


def xyzw(values: Floats) -> Quaternion:
    """Return four numbers, shape (4,), as Python's own."""
    x, y, z, w = values.tolist()
    return x, y, z, w
