"""Recognition of a surgeon: the probability of each for a demonstration of one arm, and that it is none of them.

    Demo --signature_of--> signature
    signatures --fit--> Metric --away--> squared distance from each surgeon
    p(surgeon) ~ exp(-distance / temperature)

A signature is compared in a metric that is learnt from the surgeons' own repetitions:
a number in which they repeat themselves counts much, one in which they vary counts little, and what varies together
counts once (Fisher's discriminant; the covariance within surgeons is shrunk towards a multiple of the identity, as by
Friedman, "Regularized Discriminant Analysis", JASA 1989). The distance is that from the surgeon's mean, less the more
uncertain that mean is.

Set-up and day correlate with the surgeon: two demonstrations of one session are alike whichever surgeon made them. So
everything is tested on sessions that are left out. Which families of a signature are used, how much the covariance is
shrunk, and the temperature (Guo et al., "On Calibration of Modern Neural Networks", ICML 2017) are chosen by the log
loss of sessions left out of the training sessions alone: validation is nested.

*None of these*: the demonstrations of a surgeon who is left out are further from the nearest demonstration of all
others than those of a known surgeon's new session. A logistic function of the logarithm of that distance, averaged over
the demonstrations of one recording, is fitted to both, with the prior that a stranger is as likely as any one surgeon;
it is tested on surgeons left out of its fit.

A *vote* of several demonstrations of one recording multiplies their probabilities. They are not independent, so a vote
names a surgeon and has no probability of its own.

All of this is ours; the paper only asks for a database of styles.

A *signature* is a demonstration as numbers by which its surgeon may be recognised, in families.

A curve over the phase (time from 0 at the start to 1 at the end) is described by its first cosine coefficients: its
mean, and its slow changes. Lengths, speeds and durations enter as logarithms. All is computed on the path without
tremor, on evenly spaced times, so it depends little on the recorder's sampling rate.

    shape        the path in the hand-off's own frame, along the path (`skills.comparison.distances.shape_of`)
    tempo        duration, path length, speeds, rests, peaks and smoothness
    jaw          the angle of the jaw: its quantiles, its changes, its curve
    turning      the rotation since the start, in the tool's own axes, and the angular speed
    orientation  the tool's direction in the frame of the poses
    place        the position in the frame of the poses

The last two depend on the set-up: on where arm and tissue stand. The last identifies it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np

from skills.arithmetic import wilson
from skills.arrays import Flags, Floats, Ints, freeze, interpolated
from skills.comparison.distances import STATES, TREMOR_S, placed, resampled
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import same_signs, smoothed_tip
from skills.errors import BadInput, BadPath
from skills.kinematics import matrix_of, quaternion_of
from skills.quaternions import vector_of

PHASES = 16  # of a curve
RESTING_MM_S = 5.0  # a slow hand, rather than one at rest
LEAST_MM, LEAST_MM_S, LEAST_RAD_S, LEAST_RAD = 1.0, 1.0, 0.01, 0.01  # added before a logarithm

_SIZES = {"shape": 15, "tempo": 11, "jaw": 13, "turning": 15, "orientation": 24, "place": 12}
_ENDS = np.cumsum([0, *_SIZES.values()]).tolist()
FAMILIES = {name: slice(*_ENDS[at : at + 2]) for at, name in enumerate(_SIZES)}
FRAMED = ("orientation", "place")  # comparable only within one frame of the poses
NUMBERS = _ENDS[-1]


def signature_of(demo: Demo) -> Floats:
    """Return the signature of a demonstration, shape (NUMBERS,); NaN in the families that it does not have.

    `jaw`, `turning` and `orientation` need a recorded jaw or orientation, `shape` a direction.

    Args:
        demo: The demonstration.
    """
    seconds, tip_mm = smoothed_tip(demo.stamps_s, demo.tip_mm, TREMOR_S)
    found = {
        "shape": _shape(tip_mm),
        "tempo": _tempo(seconds, tip_mm),
        "jaw": None if demo.jaw_rad is None else _jaw(demo.stamps_s, demo.jaw_rad),
        "place": _coefficients(_at_phases(seconds, tip_mm), 4),
    }
    if demo.rotation_xyzw is not None:
        turned = smoothed_tip(demo.stamps_s, same_signs(demo.rotation_xyzw), TREMOR_S)[1]
        found |= _turning(seconds, turned / np.linalg.norm(turned, axis=1, keepdims=True).clip(1e-12), tip_mm)
    numbers = np.full(NUMBERS, np.nan)
    for name, values in found.items():
        if values is not None:
            numbers[FAMILIES[name]] = values
    numbers.setflags(write=False)
    return numbers


def _shape(tip_mm: Floats) -> Floats | None:
    """Return the numbers of `shape`, (15,); None for a path without a direction."""
    try:
        shape_mm = placed(resampled(tip_mm))
    except BadPath:
        return None
    return _coefficients(_at_phases(np.arange(float(STATES)), shape_mm), 5)


def _tempo(seconds: Floats, tip_mm: Floats) -> Floats:
    """Return the numbers of `tempo`, (11,), of a smoothed path, (N, 3), at even times, (N,)."""
    duration_s, step_s = float(seconds[-1]), float(seconds[1] - seconds[0])
    velocity = np.gradient(tip_mm, step_s, axis=0)
    acceleration = np.gradient(velocity, step_s, axis=0)
    jerk = np.gradient(acceleration, step_s, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    length_mm = float(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1).sum())
    way_mm = float(np.linalg.norm(tip_mm[-1] - tip_mm[0]))
    peaks = int(((speed[1:-1] > speed[:-2]) & (speed[1:-1] >= speed[2:])).sum())
    mean, strongest = float(speed.mean()) + LEAST_MM_S, float(speed.max()) + LEAST_MM_S
    jerkiness = float(np.sqrt((jerk**2).sum(axis=1).mean())) + LEAST_MM_S
    return np.array(
        [
            np.log(duration_s),
            np.log(length_mm + LEAST_MM),
            np.log(way_mm + LEAST_MM),
            np.log((length_mm + LEAST_MM) / (way_mm + LEAST_MM)),
            np.log(mean),
            np.log(np.quantile(speed, 0.95) + LEAST_MM_S),
            np.log((speed.std() + LEAST_MM_S) / mean),
            (speed < RESTING_MM_S).mean(),
            np.log((peaks + 1) / duration_s),
            np.log(jerkiness / mean),
            np.log(jerkiness * duration_s**2 / strongest),
        ]
    )


def _jaw(stamps_s: Floats, jaw_rad: Floats) -> Floats:
    """Return the numbers of `jaw`, (13,), of angles in rad, (T,), at stamps in s, (T,)."""
    seconds, smooth = smoothed_tip(stamps_s, jaw_rad[:, None], TREMOR_S)
    angle = smooth[:, 0]
    changes = float(np.abs(np.diff(angle)).sum()) / float(seconds[-1])
    quantiles = np.quantile(angle, [0.0, 0.1, 0.5, 0.9, 1.0])
    curve = _coefficients(_at_phases(seconds, smooth), 5)
    return np.array([*quantiles, angle.mean(), angle.std(), np.log(changes + LEAST_RAD_S), *curve])


def _turning(seconds: Floats, rotation_xyzw: Floats, tip_mm: Floats) -> dict[str, Floats]:
    """Return the numbers of `turning` and of `orientation`."""
    steps = np.linalg.norm(np.diff(rotation_xyzw, axis=0), axis=1) * 2.0  # rad, for the small angles of 10 ms
    rate = steps / float(seconds[1] - seconds[0])
    length_mm = float(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1).sum())
    speeds = np.log(np.array([rate.mean(), np.quantile(rate, 0.95)]) + LEAST_RAD_S)
    ratio = np.log((steps.sum() + LEAST_RAD) / (length_mm + LEAST_MM))
    at = _at_phases(seconds, rotation_xyzw)
    at = at / np.linalg.norm(at, axis=1, keepdims=True).clip(1e-12)
    matrices = matrix_of(at)
    since = vector_of(quaternion_of(matrices[0].T @ matrices))
    return {
        "turning": np.concatenate([_coefficients(since, 4), speeds, [ratio]]),
        "orientation": _coefficients(matrices[:, :, :2].reshape(-1, 6), 4),
    }


_PHASE = np.linspace(0.0, 1.0, PHASES)
_COSINES = np.cos(np.pi * np.arange(5)[:, None] * (np.arange(PHASES) + 0.5) / PHASES) / PHASES


def _at_phases(seconds: Floats, values: Floats) -> Floats:
    """Return the rows of a curve at even phases, shape (PHASES, K)."""
    return interpolated(_PHASE * seconds[-1], seconds, values)


def _coefficients(curve: Floats, count: int) -> Floats:
    """Return the first cosine coefficients of each column of a curve, (PHASES, K): shape (count * K,)."""
    return np.asarray(_COSINES[:count] @ curve).ravel()


EXACT = 1e-7  # of the temperature, relative
FOLDS, INNER_FOLDS = 20, 5  # groups of sessions left out; with fewer sessions, each is left out alone
WIDEST = 1e3  # the temperature is searched between the median distance divided by this and multiplied by this
SHRINKAGES = (0.1, 0.3, 0.6)  # 0 keeps the covariance of the training data, 1 ignores it
SETS = (
    ("shape",),
    ("shape", "tempo", "jaw", "turning"),
    ("tempo", "jaw", "orientation"),
    ("shape", "tempo", "jaw", "turning", "orientation"),
)
COPIES = (
    "The median distance between demonstrations of different sessions is 0: at least half of these distances are of "
    "copies; withdraw the copies, or record motions that differ."
)
LEAST_VOTE = 1e-3  # probability: no single hand-off decides a vote by ruling a surgeon out
LEAST = float(np.finfo(float).tiny)
# A surgeon's own repetitions are several standard deviations apart. A copy's distance is the rounding of a difference,
# from 0 to 1e-12 by the processor, and its logarithm would outweigh all others.
NEAREST = 1.0


@dataclass(frozen=True)
class MetricSettings:
    """Chosen settings: the families of the signature that are compared, and the share of shrinkage."""

    families: tuple[str, ...]
    shrinkage: float

    @property
    def columns(self) -> Ints:
        """The numbers of a signature that are compared."""
        return np.concatenate([np.arange(FAMILIES[name].start, FAMILIES[name].stop) for name in self.families])


@dataclass(frozen=True, eq=False)
class Metric:
    """A learnt metric, with the mean of each surgeon in it.

    Attributes:
        settings: How it was learnt.
        centre: Mean of the compared numbers, shape (F,).
        into: Matrix that turns deviations from the mean into coordinates of the metric, shape (F, F).
        means: Mean of each surgeon in these coordinates, shape (S, F).
        counts: Number of demonstrations of each surgeon, shape (S,); a surgeon without any is infinitely far.
        learnt: The demonstrations that it was learnt from, in these coordinates, shape (N, F).
    """

    settings: MetricSettings
    centre: Floats
    into: Floats
    means: Floats
    counts: Ints
    learnt: Floats

    def away(self, signatures: Floats) -> Floats:
        """Return the squared distance of signatures, (M, NUMBERS), from each surgeon, shape (M, S)."""
        # The mean of few deviates from the true one: by 1 / count of the variance within a surgeon.
        squared = self._from(signatures, self.means) * (self.counts / (self.counts + 1.0))
        return np.where(self.counts > 0, squared, np.inf)

    def nearest(self, signatures: Floats) -> Floats:
        """Return the squared distance of signatures, (M, NUMBERS), from the nearest demonstration, shape (M,)."""
        return np.asarray(self._from(signatures, self.learnt).min(axis=1))

    def _from(self, signatures: Floats, points: Floats) -> Floats:
        """Return the squared distance of signatures, (M, NUMBERS), from points in the metric, (K, F): shape (M, K)."""
        there = (signatures[:, self.settings.columns] - self.centre) @ self.into
        squared = (there**2).sum(axis=1)[:, None] - 2.0 * there @ points.T + (points**2).sum(axis=1)
        return np.asarray(squared.clip(0.0))


def fit(signatures: Floats, truth: Ints, surgeons: int, settings: MetricSettings) -> Metric:
    """Learn a metric.

    Args:
        signatures: Shape (N, NUMBERS), finite in the families of the settings.
        truth: The surgeon of each, from 0, shape (N,).
        surgeons: Their number, S; some may have no demonstration.
        settings: The settings.
    """
    numbers = signatures[:, settings.columns]
    centre, scale = numbers.mean(axis=0), numbers.std(axis=0)
    # A number that never varies tells nothing: its deviations are 0.
    scale = np.where(scale > 1e-9 * (1.0 + np.abs(centre)), scale, np.inf)
    standard = (numbers - centre) / scale
    member = (truth[:, None] == np.arange(surgeons)).astype(float)
    counts = member.sum(axis=0).astype(np.int64)
    means = (member.T @ standard) / counts.clip(1)[:, None]
    apart = standard - means[truth]
    within = apart.T @ apart / max(1, len(apart) - int((counts > 0).sum()))
    typical = max(float(np.trace(within)) / len(within), 1e-12)
    shrunk = (1.0 - settings.shrinkage) * within + settings.shrinkage * typical * np.eye(len(within))
    root = np.linalg.inv(np.linalg.cholesky(shrunk)).T
    return Metric(settings, centre, root / scale[:, None], means @ root, counts, standard @ root)


@dataclass(frozen=True, eq=False)
class Validated:
    """The quality of recognition on demonstrations of unseen sessions.

    Attributes:
        surgeons: The labels, in the order of the columns, shape (S,).
        tested: Indices of the demonstrations that could be tested, because their surgeon has another session, shape
            (T,).
        truth: The column of the true surgeon of each of them, shape (T,).
        probability: Probability of each surgeon for each of them, shape (T, S).
        stranger: Probability that each is of none of the surgeons, shape (T,).
        unknown: The same for each demonstration, tested with its surgeon left out, shape (N,).
        right: Number of demonstrations that were recognised.
        settings: The settings chosen on all demonstrations.
        temperature: That of all demonstrations.
        stranger_fit: Two numbers of the logistic function of the logarithm of the distance that tells strangers.
        log_loss: Mean of -log p of the true surgeon, in nat.
    """

    surgeons: Ints
    tested: Ints
    truth: Ints
    probability: Floats
    stranger: Floats
    unknown: Floats
    right: int
    settings: MetricSettings
    temperature: float
    stranger_fit: Floats
    log_loss: float

    def __post_init__(self) -> None:
        freeze(self, probability=(len(self.tested), len(self.surgeons)))

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

    def curve(self, bins: int) -> list[tuple[int, float, float]]:
        """Return the calibration curve: of equally large groups with increasing probability of the guess, how many
        there are, the mean probability, and the share that is right.
        """
        guessed = self.probability.max(axis=1)
        was = self.probability.argmax(axis=1) == self.truth
        parts = np.array_split(np.argsort(guessed, kind="stable"), min(bins, len(guessed)))
        return [(len(part), float(guessed[part].mean()), float(was[part].mean())) for part in parts]

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the true share at 95 %, if demonstrations were independent (Wilson)."""
        return wilson(self.right, len(self.tested))


def usable(signatures: Floats, *, place: bool = False, one_frame: bool = True) -> list[tuple[str, ...]]:
    """Return the sets of families to choose from: of each set, those that all demonstrations have.

    Args:
        signatures: Shape (N, NUMBERS).
        place: Whether the position in the frame of the poses is compared too, in every set.
        one_frame: Whether all poses are in one frame; otherwise orientation and place cannot be compared.
    """
    there = [name for name, part in FAMILIES.items() if np.isfinite(signatures[:, part]).all()]
    there = [name for name in there if one_frame or name not in FRAMED]
    more = ("place",) if place else ()
    sets = [tuple(name for name in (*names, *more) if name in there) for names in SETS]
    return list(dict.fromkeys(names for names in sets if names))


def validate(
    signatures: Floats,
    surgeons: Ints,
    sessions: Ints,
    recordings: Ints,
    sets: Sequence[tuple[str, ...]] | None = None,
) -> Validated:
    """Recognise every demonstration from those of other sessions, and count the correct results.

    Settings, metric and temperature are fitted without the session of the tested demonstration.

    Args:
        signatures: One of each demonstration of one arm, shape (N, NUMBERS).
        surgeons: The surgeon of each, shape (N,), any numbers.
        sessions: The session in which each was recorded, shape (N,), numbers that no two surgeons share unless they
            were recorded together.
        recordings: The recording from which each was cut, shape (N,): all of one are by one surgeon.
        sets: The sets of families to choose from; None: those of `usable`.

    Raises:
        BadInput: There are not two surgeons with two sessions each, or the median distance is 0.
    """
    labels, truth = np.unique(surgeons, return_inverse=True)
    sets = usable(signatures) if sets is None else sets
    fold = folds_of(sessions, truth, FOLDS)
    # A surgeon whose sessions were all left out together cannot be tested.
    elsewhere = (truth[:, None] == truth) & (fold[:, None] != fold)
    tested = np.flatnonzero(elsewhere.any(axis=1))
    if len(np.unique(truth[tested])) < 2:
        raise BadInput("Recognition needs at least two surgeons with two sessions each; record more.")
    settings, temperature = _choose(signatures, truth, sessions, len(labels), sets)
    if temperature is None:
        raise BadInput(COPIES)
    probability = np.zeros((len(truth), len(labels)))
    for out in _left_out(fold):
        kept = signatures[~out], truth[~out]
        chosen, its_temperature = _choose(*kept, sessions[~out], len(labels), sets)
        away = fit(*kept, len(labels), chosen).away(signatures[out])
        probability[out] = probabilities(away, its_temperature)
    of_truth = probability[tested, truth[tested]]
    known, unknown, stranger_fit = _fit_strangers(signatures, truth, sessions, recordings, tested, settings)
    return Validated(
        surgeons=labels,
        tested=tested,
        truth=truth[tested],
        probability=probability[tested],
        stranger=known,
        unknown=unknown,
        right=int((probability[tested].argmax(axis=1) == truth[tested]).sum()),
        settings=settings,
        temperature=temperature,
        stranger_fit=stranger_fit,
        log_loss=float(-np.log(of_truth.clip(LEAST)).mean()),
    )


def _left_out(fold: Ints) -> Iterator[Flags]:
    """Yield the demonstrations of each group, as flags; of a single group, none, for nothing is left to learn from."""
    groups = np.unique(fold)
    yield from (fold == one for one in groups if len(groups) > 1)


def recognise(
    signatures: Floats, surgeons: Ints, sessions: Ints, recordings: Ints, one: int, validated: Validated
) -> tuple[Floats, float]:
    """Return the probability of each surgeon for one of the demonstrations, shape (S,), and that it is of none of them.

    The first sum to 1: they hold if it is of one of the surgeons. All is as it was validated without its session; if it
    could not be tested, with the settings and the temperature of all others.

    Args:
        signatures: Shape (N, NUMBERS).
        surgeons: The surgeon of each, shape (N,).
        sessions: The session of each, shape (N,), as for `validate`.
        recordings: The recording of each, shape (N,).
        one: Index of the demonstration to recognise.
        validated: The result of `validate` for the same demonstrations.
    """
    if one in validated.tested:
        at = int(np.flatnonzero(validated.tested == one)[0])
        return np.asarray(validated.probability[at]), float(validated.stranger[at])
    other = sessions != sessions[one]
    truth = np.searchsorted(validated.surgeons, surgeons[other])
    metric = fit(signatures[other], truth, len(validated.surgeons), validated.settings)
    near = np.log(metric.nearest(signatures[recordings == recordings[one]]).clip(NEAREST)).mean()
    probability = probabilities(metric.away(signatures[[one]]), validated.temperature)[0]
    return np.asarray(probability), float(_logistic(validated.stranger_fit, near))


def vote(probability: Floats) -> Floats:
    """Return the sum of the logarithms of several demonstrations' probabilities.

    Args:
        probability: The probability of each of S surgeons for each of M demonstrations, shape (M, S); one below
            `LEAST_VOTE` counts as that.

    Returns:
        The sum for each surgeon, shape (S,); the largest wins.
    """
    return np.asarray(np.log(probability.clip(LEAST_VOTE)).sum(axis=0))


# ---- strangers -----------------------------------------------------------------------------------------------------


def _fit_strangers(
    signatures: Floats, truth: Ints, sessions: Ints, recordings: Ints, tested: Ints, settings: MetricSettings
) -> tuple[Floats, Floats, Floats]:
    """Return the probability of being a stranger of the tested demonstrations, of all as strangers, and the function.

    Returns:
        Shape (T,); shape (N,), each with its surgeon left out; and the two numbers of the logistic function.
    """
    surgeons = int(truth.max()) + 1
    near, strange = np.empty(len(truth)), np.empty(len(truth))
    for out in _left_out(folds_of(sessions, truth, FOLDS)):
        near[out] = fit(signatures[~out], truth[~out], surgeons, settings).nearest(signatures[out])
    for one in range(surgeons):
        mine = truth == one
        other = ~mine & ~np.isin(sessions, sessions[mine])  # as for a known surgeon, not even another's of that session
        other = other if other.any() else ~mine
        strange[mine] = fit(signatures[other], truth[other], surgeons, settings).nearest(signatures[mine])
    near = _means(np.log(near[tested].clip(NEAREST)), recordings[tested])
    strange = _means(np.log(strange.clip(NEAREST)), recordings)
    known, unknown = np.empty(len(near)), np.empty(len(strange))
    for one in range(surgeons):
        of_known, of_unknown = truth[tested] == one, truth == one
        stranger_fit = _fit_logistic(near[~of_known], strange[~of_unknown], surgeons)
        known[of_known] = _logistic(stranger_fit, near[of_known])
        unknown[of_unknown] = _logistic(stranger_fit, strange[of_unknown])
    return known, unknown, _fit_logistic(near, strange, surgeons)


def _means(values: Floats, groups: Ints) -> Floats:
    """Return for each value the mean of its group, shape (N,)."""
    group = np.unique(groups, return_inverse=True)[1]
    return np.asarray((np.bincount(group, values) / np.bincount(group))[group])


RIDGE = 1e-3  # on the slope, so that two groups that a threshold separates have a finite one
NEWTON_STEPS = 30


def _fit_logistic(known: Floats, unknown: Floats, surgeons: int) -> Floats:
    """Fit the probability of being unknown to two groups, with the prior 1 / (surgeons + 1), by Newton's method."""
    x = np.concatenate([known, unknown])
    if not len(known) or not len(unknown):
        return np.array([-log(surgeons), 0.0])
    y = np.concatenate([np.zeros(len(known)), np.ones(len(unknown))])
    weight = np.where(y == 1.0, 1.0 / (surgeons + 1) / len(unknown), surgeons / (surgeons + 1) / len(known))
    middle = float(x @ weight)
    columns = np.stack([np.ones(len(x)), x - middle], axis=1)
    found = np.array([-log(surgeons), 0.0])
    for _ in range(NEWTON_STEPS):
        p = _logistic(found, x - middle)
        slope = columns.T @ (weight * (p - y)) + [0.0, RIDGE * found[1]]
        curvature = (columns * (weight * p * (1.0 - p))[:, None]).T @ columns + np.diag([1e-12, RIDGE])
        step = np.linalg.solve(curvature, slope)
        found = found - step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
    if not found[1] > 0:  # strangers are not further away: the distance tells nothing
        return np.array([-log(surgeons), 0.0])
    return np.array([found[0] - found[1] * middle, found[1]])


def _logistic(stranger_fit: Floats, x: Floats | float) -> Floats:
    """Return the probability of being a stranger at logarithms of the distance, of any shape."""
    return np.asarray(1.0 / (1.0 + np.exp(-(stranger_fit[0] + stranger_fit[1] * x))))


# ---- choice of the settings ----------------------------------------------------------------------------------------


def folds_of(sessions: Ints, truth: Ints, folds: int) -> Ints:
    """Divide the sessions into at most `folds` groups, so that those of one surgeon are in as many as possible.

    Args:
        sessions: The session of each demonstration, shape (N,).
        truth: The surgeon of each, from 0, shape (N,).
        folds: Number of groups.

    Returns:
        The group of each demonstration, from 0, shape (N,).
    """
    names, session = np.unique(sessions, return_inverse=True)
    folds = min(folds, len(names))
    surgeons_of = np.zeros((len(names), int(truth.max()) + 1))
    surgeons_of[session, truth] = 1.0
    there = np.zeros((folds, surgeons_of.shape[1]))  # sessions of each surgeon in each group
    of = np.empty(len(names), np.int64)
    for one, mine in enumerate(surgeons_of):
        of[one] = np.lexsort((there.sum(axis=1), there @ mine))[0]
        there[of[one]] += mine
    return of[session]


def _choose(
    signatures: Floats, truth: Ints, sessions: Ints, surgeons: int, sets: Sequence[tuple[str, ...]]
) -> tuple[MetricSettings, float | None]:
    """Choose settings and temperature by the log loss of sessions left out; None if that cannot be measured."""
    fold = folds_of(sessions, truth, INNER_FOLDS)
    best = np.inf
    chosen: tuple[MetricSettings, float | None] = (MetricSettings(sets[-1], SHRINKAGES[-1]), None)
    for settings in [MetricSettings(names, shrinkage) for names in sets for shrinkage in SHRINKAGES]:
        away = np.full((len(truth), surgeons), np.inf)
        for out in _left_out(fold):
            away[out] = fit(signatures[~out], truth[~out], surgeons, settings).away(signatures[out])
        known = np.isfinite(away[np.arange(len(truth)), truth])
        if not known.any() or not np.median(away[np.isfinite(away)]) > 0:
            continue
        temperature, loss = calibrate(away[known], truth[known])
        if loss < best:
            best, chosen = loss, (settings, temperature)
    return chosen


def probabilities(away: Floats, temperature: float | None) -> Floats:
    """Return the probabilities of the surgeons, shape (M, S).

    Args:
        away: Distances from each surgeon, shape (M, S); infinite if there is none.
        temperature: In the distances' unit; None makes all surgeons with a distance equally likely.
    """
    if temperature is None:
        known = np.isfinite(away)
        return np.asarray(known / known.sum(axis=1, keepdims=True))
    # Relative to the nearest surgeon, so that not all exponentials underflow to 0.
    nearer = np.exp(-(away - away.min(axis=1, keepdims=True)) / temperature)
    return np.asarray(nearer / nearer.sum(axis=1, keepdims=True))


def calibrate(away: Floats, truth: Ints) -> tuple[float, float]:
    """Return the temperature that makes the true surgeons likeliest, and their log loss.

    The loss is a convex function of the reciprocal of the temperature. Its minimum is found on the logarithm, so that a
    small temperature is as exact as a large one.

    Args:
        away: Distances from each surgeon, shape (M, S).
        truth: The column of the true surgeon, shape (M,).

    Raises:
        BadInput: The median distance is 0.
    """
    typical = float(np.median(away[np.isfinite(away)]))
    if not typical > 0:
        raise BadInput(COPIES)
    further = away - away.min(axis=1, keepdims=True)
    of_truth = further[np.arange(len(truth)), truth]

    def loss(reciprocal: float) -> float:
        """Return the mean of -log p of the true surgeon with a reciprocal of the temperature."""
        return float((of_truth * reciprocal + np.log(np.exp(-further * reciprocal).sum(axis=1))).mean())

    from scipy.optimize import minimize_scalar  # here, because it is slow to import

    bounds = -log(typical * WIDEST), log(WIDEST / typical)
    found = minimize_scalar(lambda at: loss(exp(at)), bounds=bounds, method="bounded", options={"xatol": EXACT})
    return exp(-found.x), float(found.fun)
