"""Joints of an arm over all samples of a motion, without jumps of the roll.

    Poses, Ticks --solve--> joints of every tick

Within the joint limits a pose leaves one choice free: the roll may differ by a full turn, because its range is 520
degrees. `skills.kinematics.inverse` chooses pose by pose, so after many turns in one direction it would have to jump
back by a full turn. Here the choice is made once for all samples: the turn that keeps the roll nearest to the middle of
its range. The first pose out of reach is named in the error.
"""

from dataclasses import dataclass
from math import pi

import numpy as np

from skills.arrays import Bytes, Floats, Ints
from skills.errors import Unreachable
from skills.kinematics import JOINTS, ROLL, instrument_of, inverse
from skills.planning.motion_laws import PHASES, Poses


@dataclass(frozen=True, eq=False)
class Ticks:
    """The pass, from 0, and the phase of each tick of a motion, both of shape (T,)."""

    pass_index: Ints
    phase: Bytes


def solve(poses: Poses, ticks: Ticks, instrument: str, arm: str = "") -> Floats:
    """Solve the joints of an arm for a complete motion.

    Args:
        poses: The tip in the arm's base frame, T ticks; between neighbouring ticks the jaw rolls by less than half a
            turn.
        ticks: The pass and the phase of each pose.
        instrument: Number of the instrument.
        arm: Name of the arm for error messages; the planned arm itself needs none.

    Returns:
        Joints, rad and mm, shape (T, 6).

    Raises:
        Unreachable: The first pose out of reach; `numbers` has the pass, phase, sample in the pass, joint, value and
            limit.
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
    """Choose the turns of the roll so that it never jumps, and return the joints, shape (T, 6).

    Raises:
        Unreachable: The jaw turns by more than the roll's range.
    """
    tool = instrument_of(instrument)
    lower, upper = float(tool.lower[ROLL]), float(tool.upper[ROLL])
    unwound = np.unwrap(joints[:, ROLL])
    roll = unwound - 2 * pi * np.round((unwound.max() + unwound.min()) / (4 * pi))
    # No choice of the turn fits: report the one that gets furthest before it exceeds a limit.
    if _first_beyond(roll, lower, upper) < len(roll):
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
    """Return the index of the first sample beyond the limits, or the number of samples if there is none."""
    inside = (roll >= lower - 1e-9) & (roll <= upper + 1e-9)
    return len(roll) if inside.all() else int(np.argmin(inside))


def _named(error: Unreachable, first: int, ticks: Ticks, arm: str) -> Unreachable:
    """Return the error with its pass and phase added; `first` is the tick from which its sample was counted."""
    at = first + int(str(error.numbers["sample"]))
    number, phase = int(ticks.pass_index[at]), int(ticks.phase[at])
    numbers = {**error.numbers, "sample": at - int(np.argmax(ticks.pass_index == number))}
    where = f"Pass {number}, {PHASES[phase]}{arm and ', ' + arm}"
    named = {"pass": number, "phase": phase, **({"arm": arm} if arm else {}), **numbers}
    return Unreachable(f"{where}: {error.message}", *error.remedies, **named)
