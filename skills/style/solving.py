"""The joints of a whole motion: the first pose out of reach is named, and no joint leaps, however the jaw is turned.

Within the limits a pose leaves one free choice: the roll may be a whole turn further, for it has 520 degrees. `inverse`
chooses pose by pose, and after many turns in one direction it would have to spring back by a turn. Here the choice is
made once, for all samples: the turn that keeps the roll nearest the middle of its range.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from skills.errors import Unreachable
from skills.style._arrays import Bytes, Floats, Ints
from skills.style.kinematics import JOINTS, ROLL, instrument_of, inverse
from skills.style.moves import PHASES, Poses


@dataclass(frozen=True, eq=False)
class Ticks:
    """What is done at each tick of a motion: the pass, from 0, shape (T,), and its phase, shape (T,)."""

    pass_index: Ints
    phase: Bytes


def solve(poses: Poses, ticks: Ticks, instrument: str, arm: str = "") -> Floats:
    """Solve the joints of an arm for a whole motion, shape (T, 6), rad and mm.

    Args:
        poses: The tip in the arm's own base frame; from one tick to the next nothing rolls by half a turn.
        ticks: What each pose belongs to.
        instrument: Number of the instrument.
        arm: Named in what is refused; the planned arm itself needs no name.

    Raises:
        Unreachable: The first pose out of reach; `numbers` names pass, phase, sample in the pass, joint, value, limit.
    """
    ends = np.append(np.flatnonzero(np.diff(ticks.pass_index)) + 1, len(poses))
    first, solved = 0, []
    for end in ends.tolist():
        try:
            solved.append(inverse(poses.tip_mm[first:end], poses.rotation[first:end], instrument))
        except Unreachable as error:
            raise _named(error, first, ticks, arm) from None
        first = end
    try:
        return _wound(np.concatenate(solved), instrument)
    except Unreachable as error:
        raise _named(error, 0, ticks, arm) from None


def _wound(joints: Floats, instrument: str) -> Floats:
    """Wind the roll so that it never leaps.

    Raises:
        Unreachable: The jaw winds by more than the roll's range.
    """
    tool = instrument_of(instrument)
    lower, upper = float(tool.lower[ROLL]), float(tool.upper[ROLL])
    unwound = np.unwrap(joints[:, ROLL])
    roll = unwound - 2 * pi * np.round((unwound.max() + unwound.min()) / (4 * pi))
    if _first_beyond(roll, lower, upper) < len(roll):  # then the turn that goes furthest is told
        turns = np.round(unwound[0] / (2 * pi)) + np.array([0, 1, -1])
        roll = max((unwound - 2 * pi * turn for turn in turns), key=lambda r: _first_beyond(r, lower, upper))
        sample = _first_beyond(roll, lower, upper)
        value, limit = float(roll[sample]), upper if roll[sample] > upper else lower
        raise Unreachable(
            f"the jaw winds up to roll {value:.5g} rad, beyond the limit {limit:.4g} of the {tool.arm.name}; turn the "
            "suture points less, or make two plans.",
            sample=sample,
            joint=JOINTS[ROLL],
            value=value,
            limit=limit,
        )
    return np.concatenate([joints[:, :ROLL], roll[:, None], joints[:, ROLL + 1 :]], axis=1)


def _first_beyond(roll: Floats, lower: float, upper: float) -> int:
    """Find the first sample beyond the limits; as many as there are where none is."""
    inside = (roll >= lower - 1e-9) & (roll <= upper + 1e-9)
    return len(roll) if inside.all() else int(np.argmin(inside))


def _named(error: Unreachable, first: int, ticks: Ticks, arm: str) -> Unreachable:
    """Say in which pass and phase a sample is out of reach that was counted from the tick `first`."""
    at = first + int(str(error.numbers["sample"]))
    number, phase = int(ticks.pass_index[at]), int(ticks.phase[at])
    numbers = {**error.numbers, "sample": at - int(np.argmax(ticks.pass_index == number))}
    where = f"Pass {number}, {PHASES[phase]}{arm and ', ' + arm}"
    named = {"pass": number, "phase": phase, **({"arm": arm} if arm else {}), **numbers}
    return Unreachable(f"{where}: {error}", **named)
