"""Transfers: where the jaws of one arm give a needle to those of another, found in both jaws and both tips.

    Recording --find_transfers--> Transfers: who gives and who takes, when the jaws close and open, and a confidence

A jaw holds something from where it closes to where it opens; its opening has a lower and an upper threshold, so that a
jaw that trembles on one of them neither grips nor releases. In a transfer the taker's jaw closes while the giver's is
closed, and stays closed while the giver's opens. Between the two both hold one needle, which is rigid, so that their
tips keep their distance: a grip elsewhere, on tissue or on nothing, does not bind them. Before its jaw closes again the
giver moves away: one that stays has only taken a new grip. And in one recording all transfers are made at about the
same distance between the tips, which need not be the true one: the frames of the two arms may be registered badly, or
not at all, and then only the lengths of their movements are compared.

The confidence is the logistic function of a sum over these observations. Its weights were fitted to synthetic
sessions with known transfers (`tests/demonstration/test_transfers.py`), and not to surgeons. All of this is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp

import numpy as np

from skills.arrays import Flags, Floats
from skills.demonstration.movement import Span, spans_of
from skills.demonstration.partner import partner_along
from skills.demonstration.recording import BaseFrame, Recording, Signal

JAW_RANGE_RAD = 0.2  # a jaw that moves less never opened
CLOSED_SHARE, OPEN_SHARE = 0.3, 0.45  # of the jaw's range: closed below the first, open above the second
EXTREME = 0.02  # quantiles at the ends of the range, so that one value far outside does not stretch it
REGRIP_S = 0.3  # a shorter opening of the jaw is a new grip, not a release
HOLD_S = 0.4  # the giver's jaw was closed at least so long before the taker's, and the taker's stays closed so long
BOTH_S = 5.0  # longest time in which both hold the needle
LATE_S = 0.15  # the taker's jaw may close so much later: it holds before it is counted as closed
LOOKS = 20  # samples of the time in which both hold, and of the time after it
AFTER_S = 3.0  # time after the release in which the giver moves away
PARTED_MM = 15.0  # further away proves no more
CLEAR_SLIP_MM, CLEAR_PARTED_MM = 2.0, 8.0  # of the transfers that show the usual distance

# Weights of the confidence, see above: of a constant, of each mm of slip, of each mm that the giver moves away, and of
# each mm between the distance and the usual one. Fitted, then the last one almost halved: real transfers vary more.
WEIGHTS = (-0.8, -1.1, 0.7, -0.6)
WITHOUT_FRAME = (-3.4, -0.3, 0.4, 0.0)  # if the poses of the two arms share no frame
LIKELY = 0.5
ODDS = 30.0  # beyond these the exponential is of no use


@dataclass(frozen=True)
class Transfer:
    """One transfer of a needle; times are in seconds since the recording's `origin_ns`.

    Attributes:
        giver: The arm that held the needle.
        taker: The arm that takes it.
        held_s: The giver's jaw closed.
        taken_s: The taker's jaw closes.
        released_s: The giver's jaw opens.
        slip_mm: Change of the distance between the two tips while both hold.
        confidence: Probability that it is one, 0 to 1.
    """

    giver: str
    taker: str
    held_s: float
    taken_s: float
    released_s: float
    slip_mm: float
    confidence: float


def closed_jaw(recording: Recording, arm: str) -> list[Span] | None:
    """Return the intervals in which the jaw of an arm is closed, in s; None if it was not recorded or never moved.

    Args:
        recording: The recording.
        arm: Name of the arm.
    """
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0:
        return None
    least, most = np.quantile(jaw.values, (EXTREME, 1.0 - EXTREME)).tolist()
    if most - least < JAW_RANGE_RAD:
        return None
    spans = spans_of(recording.seconds(jaw.stamps_ns), _closed(jaw, least, most))
    joined: list[Span] = []
    for start, end in spans:
        if joined and start - joined[-1][1] < REGRIP_S:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined


def _closed(jaw: Signal, least: float, most: float) -> Flags:
    """Return for each sample whether the jaw is closed; between the two thresholds it is as it was before."""
    share = (jaw.values - least) / (most - least)
    decided = np.flatnonzero((share < CLOSED_SHARE) | (share > OPEN_SHARE))
    last = np.searchsorted(decided, np.arange(len(share)), side="right") - 1
    return np.asarray((share < CLOSED_SHARE)[decided[np.maximum(last, 0)]])


def find_transfers(
    recording: Recording, closed: Mapping[str, Sequence[Span] | None], bases: Sequence[BaseFrame]
) -> tuple[Transfer, ...]:
    """Find the transfers between any two arms of a recording.

    Args:
        recording: The recording.
        closed: The result of `closed_jaw` for each arm.
        bases: The result of `base_frames` for the recording.

    Returns:
        The transfers with a confidence of at least `LIKELY`, in the order of their releases; each release is of one.
    """
    found = []
    for giver in recording.arms:
        for taker in recording.arms:
            holds, grips = closed[giver], closed[taker]
            if giver != taker and holds and grips:
                found += _overlaps(giver, taker, holds, grips)
    seen = [_observed(recording, one, bases) for one in found]
    usual_mm = {pair: _usual_mm([one for one in seen if one.pair == pair]) for pair in {one.pair for one in seen}}
    likely: dict[tuple[str, float], Transfer] = {}
    for one in seen:
        transfer = one.judged(usual_mm[one.pair])
        key = transfer.giver, transfer.released_s
        if transfer.confidence >= max(LIKELY, likely[key].confidence if key in likely else 0.0):
            likely[key] = transfer
    return tuple(sorted(likely.values(), key=lambda one: one.released_s))


@dataclass(frozen=True)
class _Overlap:
    giver: str
    taker: str
    held_s: float
    taken_s: float
    released_s: float
    until_s: float  # the giver's jaw closes again, or the taker's opens


@dataclass(frozen=True)
class _Observed:
    overlap: _Overlap
    slip_mm: float
    parted_mm: float
    apart_mm: float | None

    @property
    def pair(self) -> tuple[str, ...]:
        return tuple(sorted((self.overlap.giver, self.overlap.taker)))

    def judged(self, usual_mm: float | None) -> Transfer:
        one = self.overlap
        deviation_mm = 0.0 if self.apart_mm is None or usual_mm is None else abs(self.apart_mm - usual_mm)
        seen = (1.0, self.slip_mm, min(self.parted_mm, PARTED_MM), deviation_mm)
        odds = float(np.dot(WITHOUT_FRAME if self.apart_mm is None else WEIGHTS, seen))
        confidence = 1.0 / (1.0 + exp(-max(odds, -ODDS)))
        return Transfer(one.giver, one.taker, one.held_s, one.taken_s, one.released_s, self.slip_mm, confidence)


def _overlaps(giver: str, taker: str, holds: Sequence[Span], grips: Sequence[Span]) -> list[_Overlap]:
    """Find where the taker's jaw closes within a hold of the giver's, and outlasts it."""
    starts = np.array([start for start, _ in grips])
    found = []
    for number, (held_s, released_s) in enumerate(holds):
        again_s = holds[number + 1][0] if number + 1 < len(holds) else np.inf
        first, last = np.searchsorted(starts, (max(held_s + HOLD_S, released_s - BOTH_S), released_s + LATE_S))
        for taken_s, until_s in grips[first:last]:
            if until_s > released_s + HOLD_S:
                found.append(_Overlap(giver, taker, held_s, taken_s, released_s, min(again_s, until_s)))
    return found


def _observed(recording: Recording, one: _Overlap, bases: Sequence[BaseFrame]) -> _Observed:
    """Observe the two tips while both arms hold, and after the release."""
    both_s = np.linspace(min(one.taken_s, one.released_s), max(one.taken_s, one.released_s), LOOKS)
    after_s = np.linspace(one.released_s, min(one.until_s, one.released_s + AFTER_S), LOOKS)
    giver, taker = (recording.motion_of(arm=arm) for arm in (one.giver, one.taker))
    seconds = np.concatenate([both_s, after_s])
    here_mm = _at(recording.seconds(giver.stamps_ns), giver.tip_mm, seconds)
    parted_mm = float(np.linalg.norm(here_mm[LOOKS:] - here_mm[LOOKS], axis=1).max())
    other = partner_along(recording, giver, both_s, bases, one.taker)
    if other is not None:
        apart_mm = np.linalg.norm(other.tip_mm - here_mm[:LOOKS], axis=1)
        return _Observed(one, float(np.ptp(apart_mm)), parted_mm, float(apart_mm.mean()))
    there_mm = _at(recording.seconds(taker.stamps_ns), taker.tip_mm, both_s)
    ways_mm = [np.linalg.norm(tip_mm - tip_mm[0], axis=1) for tip_mm in (here_mm[:LOOKS], there_mm)]
    return _Observed(one, float(np.abs(ways_mm[0] - ways_mm[1]).max()), parted_mm, None)


def _usual_mm(seen: Sequence[_Observed]) -> float | None:
    """Return the median distance of the tips over the clearest transfers of two arms; None if there is none."""
    clear = [one.apart_mm for one in seen if one.slip_mm < CLEAR_SLIP_MM and one.parted_mm > CLEAR_PARTED_MM]
    known = [apart_mm for apart_mm in clear if apart_mm is not None]
    return float(np.median(known)) if known else None


def _at(stamps_s: Floats, tip_mm: Floats, seconds: Floats) -> Floats:
    return np.stack([np.interp(seconds, stamps_s, axis) for axis in tip_mm.T], axis=1)
