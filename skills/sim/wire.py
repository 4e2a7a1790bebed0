"""Named arrays as bytes and back, without pickle: what goes between us and the simulator's process."""

import io
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import SimulationFailed

MAX_BYTES = 512 << 20


def pack(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Write arrays, numbers and text as one `.npz`."""
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})
    return out.getvalue()


def unpack(message: bytes) -> dict[str, NDArray[Any]]:
    """Read what `pack` wrote.

    Raises:
        SimulationFailed: It is something else, or would unfold into more than `MAX_BYTES`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(message)) as archive:
            unfolded = sum(entry.file_size for entry in archive.infolist())
        if unfolded > MAX_BYTES:
            raise ValueError(f"{unfolded} bytes")
        with np.load(io.BytesIO(message), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise SimulationFailed(
            "The simulator answered nonsense, not arrays; play it again.", cause="nonsense"
        ) from error
