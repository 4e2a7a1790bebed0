"""The arrays inside our values: checked once, of one layout, read-only."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import BadInput

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.int8]


def frozen(values: ArrayLike, dtype: Any, shape: tuple[int | None, ...], name: str) -> NDArray[Any]:
    """Copy values into a read-only C-ordered array of the given type and shape (None: any length).

    Raises:
        BadInput: The shape is another one, or a number is NaN or infinite.
    """
    array = np.array(values, dtype=dtype, order="C", copy=True)
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("any" if n is None else str(n) for n in shape)
        raise BadInput(f"{name} has shape {array.shape}; give {wanted}.", shape=array.shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise BadInput(f"{name} has NaN or infinity in it; every number must be finite.")
    array.setflags(write=False)
    return array
