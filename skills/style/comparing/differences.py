"""Which axis and which part of the way sets two shapes apart, for words and pictures."""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats, frozen
from skills.style.evaluation import dtw

AXES = ("along the way", "sideways", "upwards")  # of a shape's own frame: x, y and z
FURTHER = (("less far along", "further along"), ("further right", "further left"), ("lower", "higher"))  # by its sign
PARTS = ("first third", "middle third", "last third")


@dataclass(frozen=True, eq=False)
class Difference:
    """How one shape differs from another.

    Attributes:
        total: The warping distance, in the shapes' unit.
        offsets: By how much the one lies further than the other, on average over the states of each third of the
            other's way, shape (3 parts, 3 axes), signed.
        nets: The same on average over what is paired there, as `shares` are: a stretch that has no like counts as long
            as it is.
        sizes: The same as `nets`, without signs.
        shares: Which part of the total each third and axis holds, shape (3 parts, 3 axes); they sum to 1, or are all 0.
        along: Where the one differs from each state of the other, on average, shape (R, 3), signed.
    """

    total: float
    offsets: Floats
    nets: Floats
    sizes: Floats
    shares: Floats
    along: Floats

    def __post_init__(self) -> None:
        for name, shape in {
            "offsets": (3, 3),
            "nets": (3, 3),
            "sizes": (3, 3),
            "shares": (3, 3),
            "along": (None, 3),
        }.items():
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))

    @property
    def where(self) -> tuple[str, str]:
        """Name the part and the axis that hold most of the distance."""
        part, axis = self._most
        return PARTS[part], AXES[axis]

    @property
    def most(self) -> tuple[float, float, float]:
        """The share of the distance that is there, its net and its size."""
        return float(self.shares[self._most]), float(self.nets[self._most]), float(self.sizes[self._most])

    @property
    def direction(self) -> str | None:
        """Say in which direction the one lies further there; None where they cross, and neither does."""
        _, net, size = self.most
        return FURTHER[self._most[1]][int(net > 0)] if abs(net) > size / 2 else None

    @property
    def _most(self) -> tuple[int, int]:
        part, axis = np.unravel_index(int(self.shares.argmax()), self.shares.shape)
        return int(part), int(axis)


def difference(shape: Floats, reference: Floats) -> Difference:
    """Tell how a shape, (T, 3), differs from another, (R, 3), both in frames of their own.

    Raises:
        EmptyPath: One of them has no state.
    """
    aligned = dtw(shape, reference)
    states = aligned.pairs[:, 1]
    signed = shape[aligned.pairs[:, 0]] - reference[states]
    paired = np.bincount(states, minlength=len(reference))[:, None]
    along = np.stack([np.bincount(states, axis, len(reference)) for axis in signed.T], axis=1) / paired
    third = np.arange(len(reference)) * len(PARTS) // len(reference)
    offsets = np.stack(
        [along[third == part].mean(axis=0) if (third == part).any() else np.zeros(3) for part in range(len(PARTS))]
    )
    inside = third[states] == np.arange(len(PARTS))[:, None]  # which pairs are in which third
    pairs = inside.sum(axis=1, keepdims=True).clip(1)
    apart = inside @ aligned.differences_mm
    shares = apart / (aligned.total_mm or 1.0)
    return Difference(aligned.total_mm, offsets, inside @ signed / pairs, apart / pairs, shares, along)
