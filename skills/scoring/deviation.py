"""Deviation of a motion from a reference by dynamic time warping (Sec. IV), and differences from an expert in words.

    Demo, Demo --laid_on or as_recorded--> Deviation

`laid_on` moves, turns and scales a motion, its upper side up, so that it starts and ends where the reference does
(`skills.comparison.distances`): place and size of the hand-off then have no influence, and lengths are mm of the
reference. `as_recorded` leaves both where they were; that is the paper's comparison, and it is meaningful only if the
set-up was the same. The total is exact; its division over the axes depends on the tie-break
(`skills.learning.evaluation.TIE_BREAK`). The thresholds of the words are ours.

    Demo, the expert's Demos --differences--> Differences: at most three, or none beyond the expert's own spread

A difference says where along the way, how much, and what the expert does. All motions are laid on a reference of the
expert and aligned with its states by dynamic time warping, with the share of the path's length as one coordinate, so
that a deeper place is not aligned with another deep one. At each state five numbers are compared: how far the tip is to
the left and how high, the angle of the wrist in the frame of the hand-off, the time in motion, and the time at rest. An
expert's motions differ too. So a difference counts in standard deviations of the expert's own motions there, and is
named only if it exceeds `LEAST` of them, and the largest number of them by which one of the expert's motions differs
from the others in anything. With few motions the spread is mostly an assumed one (`DifferenceKind.usual`).

All of this is ours, and so are the numbers. It says that motions differ, not which is better.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from skills.arrays import Flags, Floats, interpolated, xyz
from skills.comparison.distances import PARTS, STATES, TREMOR_S, Difference, difference, own_axes, resampled, shape_of
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs, smoothed_tip, spans_of
from skills.fields import Point, percent, schema
from skills.kinematics import quaternion_of
from skills.learning.evaluation import dtw
from skills.quaternions import INVERSE, angle_of, mean_rotation, multiplied, unit

NEAR_MM = 1.0  # mean distance; a fifth of the paper's cell, and the drift of a held hand in a second
NAMED_SHARE = 0.2  # of the total, in one third along one axis; each has a ninth if none stands out
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
        words=_describe(found, sum(mean_mm), apart_mm, sides),
        path_mm=tuple(map(xyz, path_mm)),
        reference_mm=tuple(map(xyz, reference_mm)),
        apart_mm=tuple(apart_mm.tolist()),
    )


def _describe(found: Difference, mean_mm: float, apart_mm: Floats, sides: Sides) -> tuple[str, ...]:
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
    """Yield a sentence for each third and axis with a large share of the deviation."""
    shares, offsets = found.shares, found.offsets
    states = np.arange(len(found.along)) * len(PARTS) // len(found.along)
    for flat in np.argsort(-shares, axis=None, kind="stable")[:NAMED]:
        part, axis = (int(index) for index in np.unravel_index(int(flat), shares.shape))
        if not shares[part, axis] >= NAMED_SHARE:
            return
        typical = float(np.abs(found.along[states == part, axis]).mean())
        offset = float(offsets[part, axis])
        behind, ahead = sides[axis]
        if abs(offset) >= ONE_SIDED * typical:
            how = f"{typical:.1f} mm {ahead if offset > 0 else behind} on average"
        else:
            how = f"{typical:.1f} mm off on average, partly {behind}, partly {ahead}"
        yield f"In the {PARTS[part]} it is {how}: {percent(shares[part, axis])} % of the deviation."


def _thirds(values: Floats) -> Thirds:
    first, middle, last = map(xyz, values)
    return first, middle, last


NAMED = 3  # at most
LEAST = 3.2  # standard deviations of the expert's own motions
ASSUMED = 1.5  # motions that the assumed spread counts for
AROUND = 5  # states before and after one whose times belong to it
PHASE = 2.0  # of the reference's length: weight of the share of the path
WIDE = 8  # states over which a spread is averaged
REGION = 0.5  # of the largest difference: as far as it stays above, it is one difference
REST_MM_S, REST_S = 2.0, 0.35  # a slower tip rests, if it does so for this long
LEAST_S = 0.25  # of a difference in time: a shorter one cannot be noticed
LEAST_TIME_S = 0.02  # added before a logarithm


@dataclass(frozen=True)
class DifferenceKind:
    """One of the compared numbers: its name, its unit, and its usual spread in one expert's motions."""

    name: str
    unit: str
    usual: float


KINDS = (
    DifferenceKind("to the side", "mm", 1.5),
    DifferenceKind("height", "mm", 1.5),
    DifferenceKind("wrist", "degrees", 4.0),
    DifferenceKind("time in motion", "s", 0.15),  # of its logarithm
    DifferenceKind("pause", "s", 0.25),
)


@schema
@dataclass(frozen=True)
class NamedDifference:
    """One difference of a motion from the expert's.

    Attributes:
        kind: `to the side`, `height`, `wrist`, `time in motion` or `pause`.
        unit: mm, degrees or s.
        start: Where it begins, as a share of the reference's path, 0 to 1.
        end: Where it ends.
        start_s: When the motion reaches its beginning, in seconds since the motion's first sample.
        end_s: When it reaches its end.
        amount: The largest difference there, positive to the left, higher or turned; of a time that of the whole part,
            positive if longer.
        expert: The expert's mean there: mm to the left of the straight line to the goal or above it, degrees since the
            start, or seconds.
        spreads: The difference, in standard deviations of the expert's own motions.
        words: All of it in a sentence.
    """

    kind: str
    unit: str
    start: float
    end: float
    start_s: float
    end_s: float
    amount: float
    expert: float
    spreads: float
    words: str


@schema
@dataclass(frozen=True)
class Differences:
    """The largest differences of a motion from an expert's motions.

    Attributes:
        expert_demos: Number of the expert's motions that the spread is of.
        named: At most three, the largest first.
        words: A sentence for each; or that there is none beyond the expert's own spread.
    """

    expert_demos: int
    named: tuple[NamedDifference, ...]
    words: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Traced:
    """A motion at the states of a reference: places in mm, clocks in s, rotations in the hand-off's frame."""

    shape_mm: Floats  # (STATES, 3)
    moving_s: Floats  # (STATES,), cumulated
    resting_s: Floats  # (STATES,), cumulated
    turns_xyzw: Floats | None  # (STATES, 4), unit quaternions

    def numbers(self) -> Floats:
        """Return the compared numbers that need no mean, shape (4, STATES): to the side, height, time, pause."""
        moving, resting = (_around(clock) for clock in (self.moving_s, self.resting_s))
        return np.stack([self.shape_mm[:, 1], self.shape_mm[:, 2], np.log(moving + LEAST_TIME_S), resting])


def differences(demo: Demo, expert: Sequence[Demo], reference: Demo) -> Differences:
    """Name the largest differences of a motion from an expert's motions.

    Args:
        demo: The motion.
        expert: Motions of one expert, at least one, without the compared one.
        reference: The motion that all are laid on, of the same expert.

    Raises:
        BadPath: One of them ends where it began.
    """
    onto_mm = shape_of(reference)
    mine, theirs = traced(demo, onto_mm), [traced(one, onto_mm) for one in expert]
    deviations = _deviations(mine, theirs)
    least = max(LEAST, *_own_spread(theirs))
    found = []
    for kind, (signed, spread) in enumerate(deviations):
        if signed is not None:
            found += [(kind, *one) for one in _regions(np.abs(signed) / spread, least)]
    ranked = sorted(found, key=lambda one: -one[2])
    said = (_named(mine, theirs, deviations[kind][0], kind, where, spreads) for kind, where, spreads in ranked)
    named = [one for one in said if one is not None][:NAMED]
    return Differences(len(theirs), tuple(named), tuple(one.words for one in named) or (_none(len(theirs)),))


def _none(demos: int) -> str:
    """Return the sentence that there is no difference."""
    if demos == 1:
        return (
            "There is no difference beyond what surgeons usually differ from themselves; the expert's own spread is "
            "not known from one demonstration."
        )
    return f"There is no difference beyond the expert's own spread, in {demos} demonstrations."


def traced(demo: Demo, onto_mm: Floats) -> Traced:
    """Lay a motion on a reference and return it at the reference's states.

    Args:
        demo: The motion.
        onto_mm: The shape of the reference, (STATES, 3).
    """
    seconds, tip_mm = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
    steps_mm = np.linalg.norm(np.diff(tip_mm, axis=0), axis=1)
    along_mm = np.append(0.0, np.cumsum(steps_mm))
    speed = np.append(steps_mm, steps_mm[-1]) / (seconds[1] - seconds[0])
    resting = _at_rest(seconds, speed)
    step_s = np.append(0.0, np.diff(seconds))
    at_mm = np.linspace(0.0, along_mm[-1], STATES)
    clocks_s = interpolated(at_mm, along_mm, np.cumsum(step_s[:, None] * np.stack([~resting, resting], axis=1), axis=0))
    shape_mm = laid(shape_of(demo), onto_mm)
    aligned = dtw(_by_phase(shape_mm, onto_mm), _by_phase(onto_mm, onto_mm))

    def mean(values: Floats) -> Floats:
        return aligned.at_reference(values[aligned.pairs[:, 0]])

    turns = None
    if demo.rotation_xyzw is not None:
        turned = smoothed_tip(demo.stamps_s, same_signs(demo.rotation_xyzw), TREMOR_S)[1]
        there = mean(interpolated(at_mm, along_mm, turned))
        turns = multiplied(quaternion_of(own_axes(resampled(tip_mm))[None])[0], unit(there))
    moving_s, resting_s = mean(clocks_s).T
    return Traced(mean(shape_mm), moving_s, resting_s, turns)


def _by_phase(shape_mm: Floats, onto_mm: Floats) -> Floats:
    """Return a path with the share of its length in place of x, so that the same places are aligned, not any alike."""
    length_mm = np.linalg.norm(np.diff(onto_mm, axis=0), axis=1).sum()
    return np.column_stack([np.linspace(0.0, PHASE * length_mm, len(shape_mm)), shape_mm[:, 1:]])


def _at_rest(seconds: Floats, speed_mm_s: Floats) -> Flags:
    """Return for each sample whether the tip rests for `REST_S` or longer, shape (N,)."""
    resting = np.zeros(len(seconds), bool)
    for start, end in spans_of(seconds, speed_mm_s < REST_MM_S):
        if end - start >= REST_S:
            resting |= (seconds >= start) & (seconds <= end)
    return resting


def _around(clock_s: Floats) -> Floats:
    """Return the time from `AROUND` states before each state to as many after it, in proportion at the ends."""
    first, last = (np.arange(STATES) + by for by in (-AROUND, AROUND))
    first, last = first.clip(0), last.clip(max=STATES - 1)
    return np.asarray((clock_s[last] - clock_s[first]) * (2 * AROUND / (last - first)))


# ---- the expert's spread --------------------------------------------------------------------------------------------

_Apart = tuple[Floats | None, Floats]  # of one kind, at each state: signed, and the spread


def _deviations(mine: Traced, theirs: Sequence[Traced]) -> list[_Apart]:
    """Return the difference of a motion from the mean of others, and their spread, for each of `KINDS`."""
    numbers = np.array([one.numbers() for one in theirs])
    mean = numbers.mean(axis=0)
    found: list[_Apart] = [
        (signed, _spread(apart, kind.usual))
        for signed, apart, kind in zip(
            mine.numbers() - mean, (numbers - mean).transpose(1, 0, 2), (KINDS[0], KINDS[1], *KINDS[3:]), strict=True
        )
    ]
    turns = [one.turns_xyzw for one in theirs if one.turns_xyzw is not None]
    if mine.turns_xyzw is None or len(turns) < len(theirs):
        found.insert(2, (None, np.ones(STATES)))
    else:
        middle = mean_rotation(np.array(turns), np.ones(len(turns)))
        apart = np.array([_angles_deg(middle, one) for one in turns])
        found.insert(2, (_angles_deg(middle, mine.turns_xyzw), _spread(apart, KINDS[2].usual)))
    return found


def _spread(apart: Floats, usual: float) -> Floats:
    """Return the standard deviation at each state from deviations, (N, STATES), and the usual one; for a new motion."""
    squared = np.pad((apart**2).sum(axis=0), WIDE, mode="edge")
    smooth = np.convolve(squared, np.full(2 * WIDE + 1, 1.0 / (2 * WIDE + 1)), mode="valid")
    smooth = np.maximum(smooth, np.median(smooth) / 2.0)
    variance = (smooth + ASSUMED * usual**2) / (len(apart) - 1 + ASSUMED)
    return np.asarray(np.sqrt(variance * (1.0 + 1.0 / len(apart))))


def _own_spread(theirs: Sequence[Traced]) -> list[float]:
    """Return, for each kind, the largest difference of one of the expert's motions from the others, in spreads."""
    largest = [0.0] * len(KINDS)
    for one in range(len(theirs) if len(theirs) > 2 else 0):
        others = [*theirs[:one], *theirs[one + 1 :]]
        for kind, (signed, spread) in enumerate(_deviations(theirs[one], others)):
            if signed is not None:
                largest[kind] = max(largest[kind], float((np.abs(signed) / spread).max()))
    return largest


def _angles_deg(turns: Floats, others: Floats) -> Floats:
    """Return the angle between two orientations at each state, in degrees."""
    return np.degrees(angle_of(multiplied(turns * INVERSE, others)))


# ---- places and sentences ------------------------------------------------------------------------------------------

Region = tuple[int, int]  # first and last state


def _regions(spreads: Floats, least: float) -> Iterator[tuple[Region, float]]:
    """Yield the regions of the largest differences above a least one, and the largest in each."""
    left = spreads.copy()
    for _ in range(NAMED):
        most = int(left.argmax())
        if not left[most] > least:
            return
        yield _around_it(left > REGION * left[most], most), float(left[most])
        first, last = _around_it(left > REGION * least, most)  # its slopes are of the same difference
        left[first : last + 1] = 0.0


def _around_it(above: Flags, at: int) -> Region:
    """Return the first and the last of the states around one that are set without a gap."""
    first = last = at
    while first > 0 and above[first - 1]:
        first -= 1
    while last < STATES - 1 and above[last + 1]:
        last += 1
    return first, last


def _named(
    mine: Traced, theirs: Sequence[Traced], signed: Floats | None, kind: int, where: Region, spreads: float
) -> NamedDifference | None:
    """Return a difference with its words; None if its time is too short to notice."""
    assert signed is not None
    first, last = where
    clock_s = mine.moving_s + mine.resting_s
    if KINDS[kind].unit == "s":
        clocks = [one.moving_s if KINDS[kind].name == "time in motion" else one.resting_s for one in (mine, *theirs)]
        before, after = max(first - AROUND, 0), min(last + AROUND, STATES - 1)
        if KINDS[kind].name == "time in motion":
            before, after = first, last
        mine_s, *their_s = (float(clock[after] - clock[before]) for clock in clocks)
        expert, amount = float(np.mean(their_s)), mine_s - float(np.mean(their_s))
        if abs(amount) < LEAST_S:
            return None
    else:
        at = first + int(np.abs(signed[first : last + 1]).argmax())
        amount = float(signed[at])
        expert = _expert_at(theirs, kind, at)
    start, end = first / (STATES - 1), last / (STATES - 1)
    there = f"From {100 * start:.0f} to {100 * end:.0f} % of the way"
    words = f"{there} {_words(kind, amount, expert, _speed(theirs, where))}"
    start_s, end_s = float(clock_s[first]), float(clock_s[last])
    return NamedDifference(
        KINDS[kind].name, KINDS[kind].unit, start, end, start_s, end_s, amount, expert, spreads, words
    )


def _expert_at(theirs: Sequence[Traced], kind: int, at: int) -> float:
    """Return the expert's mean at a state: mm beside or above the straight line, or degrees since the start."""
    if KINDS[kind].name == "wrist":
        turns = [one.turns_xyzw for one in theirs if one.turns_xyzw is not None]
        return float(np.mean([_angles_deg(one[0], one[at]) for one in turns]))
    return float(np.mean([one.shape_mm[at, 1 + kind] for one in theirs]))


def _speed(theirs: Sequence[Traced], where: Region) -> float:
    """Return the expert's mean speed in a region, in mm/s of the reference."""
    first, last = max(where[0] - 1, 0), min(where[1] + 1, STATES - 1)
    ways = [np.linalg.norm(np.diff(one.shape_mm[first : last + 1], axis=0), axis=1).sum() for one in theirs]
    times = [one.moving_s[last] - one.moving_s[first] for one in theirs]
    return float(np.sum(ways) / max(np.sum(times), 1e-3))


def _words(kind: int, amount: float, expert: float, speed_mm_s: float) -> str:
    """Return a difference in words; `amount` and `expert` as in `NamedDifference`."""
    name = KINDS[kind].name
    if name == "wrist":
        return (
            f"the wrist is turned by up to {amount:.0f} degrees from the expert's; the expert has turned it there by "
            f"{expert:.0f} degrees since the start."
        )
    if name == "pause":
        more = "longer" if amount > 0 else "shorter"
        rests = f"rests {expert:.1f} s" if expert >= REST_S else f"moves on at {speed_mm_s:.0f} mm/s"
        return f"the motion pauses {abs(amount):.1f} s {more} than the expert's, who {rests} there."
    if name == "time in motion":
        slower = "slower" if amount > 0 else "faster"
        return (
            f"the motion is {slower}: it takes {expert + amount:.1f} s, where the expert takes {expert:.1f} s at "
            f"{speed_mm_s:.0f} mm/s."
        )
    sides = (("to the right of", "to the left of"), ("lower than", "higher than"))[kind]
    line = (("right of", "left of"), ("below", "above"))[kind]
    return (
        f"the tip is up to {abs(amount):.1f} mm {sides[int(amount > 0)]} the expert's, which is there "
        f"{abs(expert):.1f} mm {line[int(expert > 0)]} the straight line to the goal."
    )
