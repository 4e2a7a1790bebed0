"""What was measured of one demonstration, to be kept: its shape, and how far it is from some others."""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats, Ints, frozen
from skills.style.comparing.shapes import STATES

VERSION = 1  # of all this: raise it when a shape or a distance comes out otherwise, and what is kept is measured again


@dataclass(frozen=True, eq=False)
class Measured:
    """A shape, and its distances from those of other demonstrations.

    Attributes:
        shape_mm: As `shape_of` gives it, shape (STATES, 3); None: the demonstration has no direction.
        others: Numbers that the others are known by, shape (K,).
        apart_mm: How far it is from each, where the size counts, shape (K,).
        apart_scaled: The same in lengths of start to goal, of scaled shapes, shape (K,).
    """

    shape_mm: Floats | None
    others: Ints
    apart_mm: Floats
    apart_scaled: Floats

    def __post_init__(self) -> None:
        count = len(self.others)
        if self.shape_mm is not None:
            object.__setattr__(self, "shape_mm", frozen(self.shape_mm, np.float64, (STATES, 3), "shape_mm"))
        object.__setattr__(self, "others", frozen(self.others, np.int64, (count,), "others"))
        for name in ("apart_mm", "apart_scaled"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, (count,), name))
