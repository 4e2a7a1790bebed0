"""Whose style a motion is: how near it is to each surgeon's own, as a probability that holds for sessions left out.

Set-up and day go with the surgeon: two demonstrations of one session are alike whoever made them. So a demonstration is
only ever compared with those of other sessions, when the probability is calibrated and when it is validated.

    p(surgeon) ~ exp(-distance / scale)    distance: the mean one to the surgeon's demonstrations

The scale is the one number that is fitted: the one under which what truly was so is likeliest (temperature scaling; Guo
et al., "On Calibration of Modern Neural Networks", ICML 2017). Ours; the paper asks for a database of styles alone.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from skills.errors import BadInput
from skills.style._arrays import Floats, Ints, frozen

NORMAL_95 = 1.959964  # of the standard normal distribution, two-sided
STEPS = 80  # of golden section: the scale is then known to 1e-15 of where it was looked for
WIDEST = 1e3  # the scale is looked for between the median distance over this and times this
GOLDEN = (sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, eq=False)
class Validated:
    """How well recognition does on demonstrations whose session it has not seen.

    Attributes:
        surgeons: The labels, in the order of the columns, shape (S,).
        tested: The demonstrations that could be tested: their surgeon has another session. Shape (T,), of rows.
        probability: Of each surgeon for each of them, shape (T, S).
        right: How many were recognised.
        scale: The fitted scale, in the distances' unit.
        log_loss: Mean of -log p of the truth, in nat.
    """

    surgeons: Ints
    tested: Ints
    probability: Floats
    right: int
    scale: float
    log_loss: float

    def __post_init__(self) -> None:
        shape = (len(self.tested), len(self.surgeons))
        object.__setattr__(self, "probability", frozen(self.probability, np.float64, shape, "probability"))

    @property
    def accuracy(self) -> float:
        """The share that was recognised."""
        return self.right / len(self.tested)

    @property
    def chance(self) -> float:
        """The share that guessing recognises."""
        return 1.0 / len(self.surgeons)

    @property
    def interval(self) -> tuple[float, float]:
        """Between what the true share lies at 95 %, if demonstrations were independent (Wilson)."""
        return wilson(self.right, len(self.tested))


def validate(apart: Floats, surgeons: Ints, sessions: Ints) -> Validated:
    """Recognise every demonstration from those of other sessions, and see how often that is right.

    The scale is fitted for each demonstration on all others that do not share its session, so that none is judged by a
    calibration that has seen it; the one given back is fitted on all.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        surgeons: Whose each is, shape (N,), any numbers.
        sessions: In which session each was recorded, shape (N,), numbers that no two surgeons share unless they were
            recorded together.

    Raises:
        BadInput: There are not two surgeons with two sessions each.
    """
    labels = np.unique(surgeons)
    away = nearness(apart, surgeons, labels, other=sessions[:, None] != sessions[None, :])
    truth = np.searchsorted(labels, surgeons)
    tested = np.flatnonzero(np.isfinite(away[np.arange(len(truth)), truth]))
    if len(np.unique(truth[tested])) < 2:
        raise BadInput("Recognition needs at least two surgeons who have two sessions each; record more.")
    away, truth = away[tested], truth[tested]
    probability = np.empty_like(away)
    for session in np.unique(sessions[tested]):
        mine = sessions[tested] == session
        probability[mine] = probabilities(away[mine], calibrate(away[~mine], truth[~mine]) if (~mine).any() else None)
    right = int((away.argmin(axis=1) == truth).sum())
    of_truth = probability[np.arange(len(truth)), truth]
    log_loss = float(-np.log(of_truth.clip(np.finfo(float).tiny)).mean())
    return Validated(labels, tested, probability, right, calibrate(away, truth), log_loss)


def nearness(apart: Floats, surgeons: Ints, labels: Ints, other: Floats) -> Floats:
    """Average distances, (M, N), over each surgeon's demonstrations that may be asked: (M, S); infinite where none may.

    Args:
        other: Which of the N may be asked about which of the M, shape (M, N), boolean.
    """
    columns = []
    for label in labels:
        asked = other & (surgeons == label)
        count = asked.sum(axis=1)
        total = np.where(asked, apart, 0.0).sum(axis=1)
        columns.append(np.where(count > 0, total / count.clip(1), np.inf))
    return np.stack(columns, axis=1)


def probabilities(away: Floats, scale: float | None) -> Floats:
    """Turn mean distances to each surgeon, (M, S), into probabilities; without a scale all are equally likely."""
    if scale is None:
        known = np.isfinite(away)
        return np.asarray(known / known.sum(axis=1, keepdims=True))
    nearer = np.exp(-(away - away.min(axis=1, keepdims=True)) / scale)
    return np.asarray(nearer / nearer.sum(axis=1, keepdims=True))


def calibrate(away: Floats, truth: Ints) -> float:
    """Fit the scale under which the true surgeons, (M,), are likeliest, given mean distances, (M, S).

    The loss has one minimum in the reciprocal of the scale, of which it is a convex function; golden section finds it.
    """
    typical = float(np.median(away[np.isfinite(away)]))
    if not typical > 0:
        raise BadInput("All demonstrations are the same; recognition needs motions that differ.")
    low, high = 1.0 / (typical * WIDEST), WIDEST / typical

    def loss(reciprocal: float) -> float:
        sure = probabilities(away, 1.0 / reciprocal)[np.arange(len(truth)), truth]
        return float(-np.log(sure.clip(np.finfo(float).tiny)).mean())

    for _ in range(STEPS):
        one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        low, high = (low, two) if loss(one) <= loss(two) else (one, high)
    return 2.0 / (low + high)


def wilson(right: int, of: int) -> tuple[float, float]:
    """Bound a share at 95 % (Wilson, "Probable inference", JASA 1927)."""
    z2 = NORMAL_95**2
    centre = (right + z2 / 2) / (of + z2)
    half = NORMAL_95 / (of + z2) * sqrt(right * (of - right) / of + z2 / 4)
    return max(0.0, centre - half), min(1.0, centre + half)
