"""How far a motion lies from a reference, and where: dynamic time warping as in Sec. IV of the paper, told in words.

    Demo, Demo --deviation--> Deviation

Laid on the reference, a motion is moved, turned about the vertical and scaled so that it starts and ends where the
reference does (`skills.style.comparing.shapes`): where and how large the hand-off was says nothing then, and lengths
are mm of the reference. As recorded, both stay where they were; that is what the paper compares, and it means something
only where the set-up was the same. The total is exact; how it divides over the axes depends on the tie-break
(`skills.style.evaluation.TIE_BREAK`). The thresholds of the words are ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats, frozen
from skills.style.comparing.differences import PARTS, Difference, difference
from skills.style.comparing.shapes import TREMOR_S, resampled, shape_of
from skills.style.demo import Demo
from skills.style.evaluation import dtw
from skills.style.movement import smoothed_tip

NEAR_MM = 1.0  # mean distance; a fifth of the paper's cell, and what a held hand drifts in a second
TOLD_SHARE = 0.2  # of the total, in one third along one axis: a ninth is what each has where none stands out
TOLD = 3  # places, at most
ONE_SIDED = 0.5  # of the mean difference at a place: below it the way goes to both sides of the reference's
SIDES = (("behind", "ahead"), ("to the right", "to the left"), ("lower", "higher"))  # of the way; negative, positive
OWN_SIDES = tuple((f"less in {axis}", f"more in {axis}") for axis in "xyz")


@dataclass(frozen=True, eq=False)
class Deviation:
    """How far one way lies from another; both have `STATES` states, equally far apart.

    Attributes:
        total_mm: The Manhattan distance over all pairs of the alignment: exact.
        mean_mm: Mean absolute difference over the pairs, along x, y and z.
        std_mm: Its standard deviation over the pairs, along x, y and z.
        path_mm: The motion's states, shape (T, 3).
        reference_mm: The reference's states, shape (R, 3).
        apart_mm: How far each state of the motion is from those that it is paired with, shape (T,).
        difference: The same by thirds of the reference's way, and axes.
        sides: What it means to lie to either side along each axis.
    """

    total_mm: float
    mean_mm: tuple[float, float, float]
    std_mm: tuple[float, float, float]
    path_mm: Floats
    reference_mm: Floats
    apart_mm: Floats
    difference: Difference
    sides: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        for name, shape in {"path_mm": (None, 3), "reference_mm": (None, 3), "apart_mm": (None,)}.items():
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))

    @property
    def distance_mm(self) -> float:
        """The total for each state of the reference: about by how many mm the two differ at a place."""
        return self.total_mm / len(self.reference_mm)


def laid_on(demo: Demo, reference: Demo) -> Deviation:
    """Compare the shapes of two motions, whatever their place, direction and size.

    Raises:
        BadPath: One of them ends where it began.
    """
    shape_mm, onto_mm = shape_of(demo), shape_of(reference)
    return deviation(laid(shape_mm, onto_mm), onto_mm, SIDES)


def laid(shape_mm: Floats, onto_mm: Floats) -> Floats:
    """Scale a shape, (T, 3) as `shape_of` gives it, to the size of another, so that they end together too."""
    return np.asarray(shape_mm * (onto_mm[-1, 0] / shape_mm[-1, 0]))


def as_recorded(demo: Demo, reference: Demo) -> Deviation | None:
    """Compare two motions where they were recorded; None where arm or frame differ, so that places mean nothing."""
    if (demo.arm, demo.frame) != (reference.arm, reference.frame):
        return None
    path_mm, reference_mm = (
        resampled(smoothed_tip(one.stamps_s, one.tip_mm, TREMOR_S)[1]) for one in (demo, reference)
    )
    return deviation(path_mm, reference_mm, OWN_SIDES)


def deviation(path_mm: Floats, reference_mm: Floats, sides: tuple[tuple[str, str], ...] = OWN_SIDES) -> Deviation:
    """Measure how far a way, (T, 3), lies from another, (R, 3), and where."""
    apart_mm = dtw(path_mm, reference_mm).differences_mm
    return Deviation(
        total_mm=float(apart_mm.sum()),
        mean_mm=_xyz(apart_mm.mean(axis=0)),
        std_mm=_xyz(apart_mm.std(axis=0)),
        path_mm=path_mm,
        reference_mm=reference_mm,
        apart_mm=np.linalg.norm(difference(reference_mm, path_mm).along, axis=1),
        difference=difference(path_mm, reference_mm),
        sides=sides,
    )


def in_words(found: Deviation) -> tuple[str, ...]:
    """Say how far apart two ways are, and where most of it is."""
    mean_mm = float(sum(found.mean_mm))
    if mean_mm <= NEAR_MM:
        return (f"The way is the reference's all along: {mean_mm:.1f} mm from it on average.",)
    far = int(found.apart_mm.argmax())
    percent = round(100 * far / max(1, len(found.apart_mm) - 1))
    first = (
        f"The way lies {mean_mm:.1f} mm from the reference's on average, and is furthest from it, "
        f"{found.apart_mm[far]:.1f} mm, after {percent} % of its length."
    )
    return (first, *_places(found))


def _places(found: Deviation) -> Iterator[str]:
    shares, offsets = found.difference.shares, found.difference.offsets
    states = np.arange(len(found.reference_mm)) * len(PARTS) // len(found.reference_mm)
    for flat in np.argsort(-shares, axis=None, kind="stable")[:TOLD]:
        part, axis = (int(index) for index in np.unravel_index(int(flat), shares.shape))
        if not shares[part, axis] >= TOLD_SHARE:
            return
        typical = float(np.abs(found.difference.along[states == part, axis]).mean())
        offset = float(offsets[part, axis])
        behind, ahead = found.sides[axis]
        if abs(offset) >= ONE_SIDED * typical:
            how = f"{typical:.1f} mm {ahead if offset > 0 else behind} on average"
        else:
            how = f"{typical:.1f} mm off on average, now {behind}, now {ahead}"
        yield f"In the {PARTS[part]} it lies {how}: {100 * shares[part, axis]:.0f} % of the deviation."


def _xyz(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
