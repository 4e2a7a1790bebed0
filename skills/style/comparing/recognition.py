"""Whose style a motion is: how near it is to each surgeon's own, as a probability that holds for sessions left out.

Set-up and day go with the surgeon: two demonstrations of one session are alike whoever made them. So a demonstration is
only ever compared with those of other sessions, when the probability is calibrated and when it is validated.

    p(surgeon) ~ exp(-distance / scale)    distance: the mean one to the surgeon's demonstrations

The scale is the one number that is fitted: the one under which what truly was so is likeliest (temperature scaling; Guo
et al., "On Calibration of Modern Neural Networks", ICML 2017). Ours; the paper asks for a database of styles alone.
"""

from dataclasses import dataclass
from math import exp, log, sqrt

import numpy as np
from numpy.typing import NDArray

from skills.errors import BadInput
from skills.style._arrays import Floats, Ints, frozen

NORMAL_95 = 1.959964  # of the standard normal distribution, two-sided
STEPS = 40  # of golden section: the scale is then known to 1e-7
FOLDS = 20  # of sessions that the scale is fitted without: with more sessions some are left out together
WIDEST = 1e3  # the scale is looked for between the median distance over this and times this
GOLDEN = (sqrt(5.0) - 1.0) / 2.0

Flags = NDArray[np.bool_]


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
    def sureness(self) -> float:
        """What it gives its guesses, on average: the accuracy, where its probabilities hold."""
        return float(self.probability.max(axis=1).mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Between what the true share lies at 95 %, if demonstrations were independent (Wilson)."""
        return wilson(self.right, len(self.tested))


def validate(apart: Floats, surgeons: Ints, sessions: Ints) -> Validated:
    """Recognise every demonstration from those of other sessions, and see how often that is right.

    The scale is fitted for each demonstration on others that do not share its session, so that none is judged by a
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
    folds = np.unique(sessions[tested], return_inverse=True)[1] % FOLDS
    for fold in np.unique(folds):
        mine = folds == fold
        probability[mine] = probabilities(away[mine], calibrate(away[~mine], truth[~mine]) if (~mine).any() else None)
    right = int((away.argmin(axis=1) == truth).sum())
    of_truth = probability[np.arange(len(truth)), truth]
    log_loss = float(-np.log(of_truth.clip(np.finfo(float).tiny)).mean())
    return Validated(labels, tested, probability, right, calibrate(away, truth), log_loss)


def recognise(apart: Floats, surgeons: Ints, sessions: Ints, one: int, validated: Validated) -> Floats:
    """Say whose style one of the demonstrations is, from those of other sessions: the probability of each, shape (S,).

    The scale is that of the validation without its session, if it could be tested, else the one that is fitted on all.
    """
    if one in validated.tested:
        return np.asarray(validated.probability[np.flatnonzero(validated.tested == one)[0]])
    away = nearness(apart[[one]], surgeons, validated.surgeons, other=(sessions != sessions[one])[None, :])
    return np.asarray(probabilities(away, validated.scale)[0])


def nearness(apart: Floats, surgeons: Ints, labels: Ints, other: Flags) -> Floats:
    """Average distances, (M, N), over each surgeon's demonstrations that may be asked: (M, S); infinite where none may.

    Args:
        other: Which of the N may be asked about which of the M, shape (M, N), boolean.
    """
    member = (surgeons[:, None] == labels).astype(float)
    count = other @ member
    total = np.where(other, apart, 0.0) @ member
    return np.where(count > 0, total / count.clip(1), np.inf)


def probabilities(away: Floats, scale: float | None) -> Floats:
    """Turn mean distances to each surgeon, (M, S), into probabilities; without a scale all are equally likely."""
    if scale is None:
        known = np.isfinite(away)
        return np.asarray(known / known.sum(axis=1, keepdims=True))
    nearer = np.exp(-(away - away.min(axis=1, keepdims=True)) / scale)
    return np.asarray(nearer / nearer.sum(axis=1, keepdims=True))


def calibrate(away: Floats, truth: Ints) -> float:
    """Fit the scale under which the true surgeons, (M,), are likeliest, given mean distances, (M, S).

    The loss is a convex function of the reciprocal of the scale; golden section finds its minimum, and looks for it by
    the logarithm, so that a small scale is known as well as a large one.
    """
    typical = float(np.median(away[np.isfinite(away)]))
    if not typical > 0:
        raise BadInput("All demonstrations are the same; recognition needs motions that differ.")
    further = away - away.min(axis=1, keepdims=True)
    of_truth = further[np.arange(len(truth)), truth]

    def loss(reciprocal: float) -> float:
        return float((of_truth * reciprocal + np.log(np.exp(-further * reciprocal).sum(axis=1))).mean())

    low, high = -log(typical * WIDEST), log(WIDEST / typical)
    one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_one, at_two = loss(exp(one)), loss(exp(two))
    for _ in range(STEPS):
        if at_one <= at_two:
            high, two, at_two = two, one, at_one
            one = high - GOLDEN * (high - low)
            at_one = loss(exp(one))
        else:
            low, one, at_one = one, two, at_two
            two = low + GOLDEN * (high - low)
            at_two = loss(exp(two))
    return exp(-(low + high) / 2.0)


def wilson(right: int, of: int) -> tuple[float, float]:
    """Bound a share at 95 % (Wilson, "Probable inference", JASA 1927)."""
    z2 = NORMAL_95**2
    centre = (right + z2 / 2) / (of + z2)
    half = NORMAL_95 / (of + z2) * sqrt(right * (of - right) / of + z2 / 4)
    return max(0.0, centre - half), min(1.0, centre + half)
