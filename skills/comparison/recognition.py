"""Recognition of a surgeon's style: the probability of each surgeon for a motion, calibrated on sessions left out.

    p(surgeon) ~ exp(-distance / scale)    distance: the mean one to the surgeon's demonstrations

Set-up and day correlate with the surgeon: two demonstrations of one session are alike whichever surgeon made them. So a
demonstration is compared only with those of other sessions, both when the probability is calibrated and when it is
validated.

The scale is the only fitted number: the one with the greatest likelihood of the true surgeons (temperature scaling; Guo
et al., "On Calibration of Modern Neural Networks", ICML 2017). This is ours; the paper only asks for a database of
styles.
"""

from dataclasses import dataclass
from math import exp, log, sqrt

import numpy as np

from skills.arrays import Flags, Floats, Ints, frozen
from skills.errors import BadInput
from skills.learning.slip import wilson

STEPS = 40  # of golden section: the scale is then known to 1e-7
FOLDS = 20  # groups of sessions left out of a fit: with more sessions than this, several are left out together
WIDEST = 1e3  # the scale is searched between the median distance divided by this and multiplied by this
GOLDEN = (sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, eq=False)
class Validated:
    """The quality of recognition on demonstrations of unseen sessions.

    Attributes:
        surgeons: The labels, in the order of the columns, shape (S,).
        tested: Indices of the demonstrations that could be tested, because their surgeon has another session, shape
            (T,).
        probability: Probability of each surgeon for each of them, shape (T, S).
        right: Number of demonstrations that were recognised.
        scale: The fitted scale, in the distances' unit.
        log_loss: Mean of -log p of the true surgeon, in nat.
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
        """The share of demonstrations that were recognised."""
        return self.right / len(self.tested)

    @property
    def chance(self) -> float:
        """The share that guessing recognises."""
        return 1.0 / len(self.surgeons)

    @property
    def sureness(self) -> float:
        """The mean probability of the guesses: equal to the accuracy if the probabilities are right."""
        return float(self.probability.max(axis=1).mean())

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the true share at 95 %, if demonstrations were independent (Wilson)."""
        return wilson(self.right, len(self.tested))


def validate(apart: Floats, surgeons: Ints, sessions: Ints) -> Validated:
    """Recognise every demonstration from those of other sessions, and count the correct results.

    The scale is fitted for each demonstration on others that do not share its session, so that none is judged by a
    calibration that has seen it; the scale in the result is fitted on all.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        surgeons: The surgeon of each, shape (N,), any numbers.
        sessions: The session in which each was recorded, shape (N,), numbers that no two surgeons share unless they
            were recorded together.

    Raises:
        BadInput: There are not two surgeons with two sessions each, or the median distance is 0.
    """
    labels = np.unique(surgeons)
    away = nearness(apart, surgeons, labels, other=sessions[:, None] != sessions[None, :])
    truth = np.searchsorted(labels, surgeons)
    tested = np.flatnonzero(np.isfinite(away[np.arange(len(truth)), truth]))
    if len(np.unique(truth[tested])) < 2:
        raise BadInput("Recognition needs at least two surgeons with two sessions each; record more.")
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
    """Return the probability of each surgeon for one of the demonstrations, from those of other sessions, shape (S,).

    The scale is that of the validation without its session if it could be tested, else the one fitted on all.

    Args:
        apart: Distances between all demonstrations, shape (N, N).
        surgeons: The surgeon of each, shape (N,).
        sessions: The session of each, shape (N,), as for `validate`.
        one: Index of the demonstration to recognise.
        validated: The result of `validate` for the same demonstrations.
    """
    if one in validated.tested:
        return np.asarray(validated.probability[np.flatnonzero(validated.tested == one)[0]])
    away = nearness(apart[[one]], surgeons, validated.surgeons, other=(sessions != sessions[one])[None, :])
    return np.asarray(probabilities(away, validated.scale)[0])


def nearness(apart: Floats, surgeons: Ints, labels: Ints, other: Flags) -> Floats:
    """Return the mean distance to each surgeon's permitted demonstrations, (M, S); infinite if none is permitted.

    Args:
        apart: Distances of M demonstrations from N others, shape (M, N).
        surgeons: The surgeon of each of the N, shape (N,).
        labels: The surgeons, in the order of the columns, shape (S,).
        other: True for the pairs that may be compared, shape (M, N).
    """
    member = (surgeons[:, None] == labels).astype(float)
    count = other @ member
    total = np.where(other, apart, 0.0) @ member
    return np.where(count > 0, total / count.clip(1), np.inf)


def probabilities(away: Floats, scale: float | None) -> Floats:
    """Return the probabilities of the surgeons, shape (M, S).

    Args:
        away: Mean distances to each surgeon, shape (M, S); infinite if there is none.
        scale: The fitted scale, in the distances' unit; None makes all surgeons with a distance equally likely.
    """
    if scale is None:
        known = np.isfinite(away)
        return np.asarray(known / known.sum(axis=1, keepdims=True))
    # Relative to the nearest surgeon, so that not all exponentials underflow to 0.
    nearer = np.exp(-(away - away.min(axis=1, keepdims=True)) / scale)
    return np.asarray(nearer / nearer.sum(axis=1, keepdims=True))


def calibrate(away: Floats, truth: Ints) -> float:
    """Return the scale that makes the true surgeons likeliest, in the distances' unit.

    The loss is a convex function of the reciprocal of the scale. Golden section finds its minimum on the logarithm, so
    that a small scale is as exact as a large one.

    Args:
        away: Mean distances to each surgeon, shape (M, S).
        truth: The column of the true surgeon, shape (M,).

    Raises:
        BadInput: The median distance is 0.
    """
    typical = float(np.median(away[np.isfinite(away)]))
    if not typical > 0:
        raise BadInput(
            "The median distance between demonstrations of different sessions is 0: at least half of these distances "
            "are of copies; withdraw the copies, or record motions that differ."
        )
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
