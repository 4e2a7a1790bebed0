"""Deviation of a motion from a reference: dynamic time warping as in Sec. IV of the paper, with a description in words.

    Demo, Demo --laid_on or as_recorded--> Deviation

`laid_on` moves, turns and scales a motion, its upper side up, so that it starts and ends where the reference does
(`skills.comparison.distances`): place and size of the hand-off then have no influence, and lengths are mm of the
reference. `as_recorded` leaves both where they were; that is the paper's comparison, and it is meaningful only if the
set-up was the same. The total is exact; its division over the axes depends on the tie-break
(`skills.learning.evaluation.TIE_BREAK`). The thresholds of the words are ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skills.arrays import Floats, xyz
from skills.comparison.distances import PARTS, TREMOR_S, Difference, difference, resampled, shape_of
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import smoothed_tip
from skills.fields import Point, schema
from skills.learning.evaluation import dtw

NEAR_MM = 1.0  # mean distance; a fifth of the paper's cell, and the drift of a held hand in a second
TOLD_SHARE = 0.2  # of the total, in one third along one axis; each has a ninth if none stands out
TOLD = 3  # places at most
ONE_SIDED = 0.5  # part of the mean difference at a place: below it the path goes to both sides of the reference's
Sides = tuple[tuple[str, str], ...]
SIDES = (("behind", "ahead"), ("to the right", "to the left"), ("lower", "higher"))  # of the path; negative, positive
OWN_SIDES = tuple((f"less in {axis}", f"more in {axis}") for axis in "xyz")


Thirds = tuple[Point, Point, Point]


@schema
@dataclass(frozen=True)
class Deviation:
    """The deviation of a motion from the reference, by dynamic time warping.

    Both have 100 states, equally far apart.

    Attributes:
        total_mm: Manhattan distance over all pairs of the alignment: exact.
        distance_mm: The total per state of the reference: about the mm by which the two differ at a place.
        dtw_mean_mm: Mean absolute difference over the pairs along each axis; it depends on the stated tie-break.
        dtw_std_mm: Standard deviation of the absolute differences along each axis.
        shares: Share of the total, for each third of the reference's path and each axis.
        offsets_mm: Mean signed offset from the reference, for each third of its path and each axis.
        words: One sentence on the distance, and one for each place with a large part of it.
        path_mm: The states of the motion.
        reference_mm: The states of the reference.
        apart_mm: Distance of each state of `path_mm` from the states that it is paired with.
    """

    total_mm: float
    distance_mm: float
    dtw_mean_mm: Point
    dtw_std_mm: Point
    shares: Thirds
    offsets_mm: Thirds
    words: tuple[str, ...]
    path_mm: tuple[Point, ...]
    reference_mm: tuple[Point, ...]
    apart_mm: tuple[float, ...]


def laid_on(demo: Demo, reference: Demo) -> Deviation:
    """Compare the shapes of two motions, regardless of their place, direction and size.

    Args:
        demo: The motion.
        reference: The reference, which gives the size.

    Raises:
        BadPath: One of them ends where it began.
    """
    shape_mm, onto_mm = shape_of(demo), shape_of(reference)
    return deviation(laid(shape_mm, onto_mm), onto_mm, SIDES)


def laid(shape_mm: Floats, onto_mm: Floats) -> Floats:
    """Scale a shape to the size of another, so that they end together too.

    Args:
        shape_mm: The shape, (T, 3), as `shape_of` returns it.
        onto_mm: The other shape, (R, 3).
    """
    return np.asarray(shape_mm * (onto_mm[-1, 0] / shape_mm[-1, 0]))


def as_recorded(demo: Demo, reference: Demo) -> Deviation | None:
    """Compare two motions at the places where they were recorded.

    Args:
        demo: The motion.
        reference: The reference.

    Returns:
        The deviation; None if arm or frame differ, so that places are not comparable.
    """
    if (demo.arm, demo.frame) != (reference.arm, reference.frame):
        return None
    path_mm, reference_mm = (
        resampled(smoothed_tip(one.stamps_s, one.tip_mm, TREMOR_S)[1]) for one in (demo, reference)
    )
    return deviation(path_mm, reference_mm, OWN_SIDES)


def deviation(path_mm: Floats, reference_mm: Floats, sides: Sides = OWN_SIDES) -> Deviation:
    """Compute the deviation of one path from another.

    Args:
        path_mm: The path, shape (T, 3).
        reference_mm: The reference, in the same frame, shape (R, 3).
        sides: Words for the negative and the positive side along each axis.
    """
    pairs_mm = dtw(path_mm, reference_mm).differences_mm
    found = difference(path_mm, reference_mm)
    apart_mm = np.linalg.norm(difference(reference_mm, path_mm).along, axis=1)
    total_mm, mean_mm = float(pairs_mm.sum()), xyz(pairs_mm.mean(axis=0))
    return Deviation(
        total_mm=total_mm,
        distance_mm=total_mm / len(reference_mm),
        dtw_mean_mm=mean_mm,
        dtw_std_mm=xyz(pairs_mm.std(axis=0)),
        shares=_thirds(found.shares),
        offsets_mm=_thirds(found.offsets),
        words=_in_words(found, sum(mean_mm), apart_mm, sides),
        path_mm=tuple(map(xyz, path_mm)),
        reference_mm=tuple(map(xyz, reference_mm)),
        apart_mm=tuple(apart_mm.tolist()),
    )


def _in_words(found: Difference, mean_mm: float, apart_mm: Floats, sides: Sides) -> tuple[str, ...]:
    """Describe a deviation; `mean_mm` is the mean Manhattan distance of the pairs."""
    if mean_mm <= NEAR_MM:
        return (f"The path follows the reference all along: {mean_mm:.1f} mm from it on average.",)
    far = int(apart_mm.argmax())
    percent = round(100 * far / max(1, len(apart_mm) - 1))
    first = (
        f"The path is {mean_mm:.1f} mm from the reference on average; the largest distance is "
        f"{apart_mm[far]:.1f} mm, after {percent} % of its length."
    )
    return (first, *_places(found, sides))


def _places(found: Difference, sides: Sides) -> Iterator[str]:
    shares, offsets = found.shares, found.offsets
    states = np.arange(len(found.along)) * len(PARTS) // len(found.along)
    for flat in np.argsort(-shares, axis=None, kind="stable")[:TOLD]:
        part, axis = (int(index) for index in np.unravel_index(int(flat), shares.shape))
        if not shares[part, axis] >= TOLD_SHARE:
            return
        typical = float(np.abs(found.along[states == part, axis]).mean())
        offset = float(offsets[part, axis])
        behind, ahead = sides[axis]
        if abs(offset) >= ONE_SIDED * typical:
            how = f"{typical:.1f} mm {ahead if offset > 0 else behind} on average"
        else:
            how = f"{typical:.1f} mm off on average, partly {behind}, partly {ahead}"
        yield f"In the {PARTS[part]} it is {how}: {100 * shares[part, axis]:.0f} % of the deviation."


def _thirds(values: Floats) -> Thirds:
    first, middle, last = map(xyz, values)
    return first, middle, last
