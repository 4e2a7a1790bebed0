"""Calibration: a readable model of skill, fitted to rated trials and judged on surgeons left out.

    Cohort --calibrate--> SkillModel;   Cohort --validate--> Validated;   SkillModel, Numbers --rate--> Skill

The model predicts a rating and a level as sums of a few figures, each with its weight:

    rating    = mean + sum of weight * (figure - its mean) / its standard deviation
    p(level)  ~ exp(the same sum with weights for that level)

So a weight is the number of points by which the rating changes when a figure changes by one standard deviation of the
cohort. A figure outside the range of the calibration is reported, because a sum means nothing there.

The fit is ridge regression for the rating and logistic regression for the level, on standardised figures, both from
scikit-learn and with one fixed strength each: a cohort of eight surgeons is too small to choose it by. A trial with
several motions has the same weight as any other, and is judged by their mean.

Trials of one surgeon are alike, so a model is judged on surgeons all of whose trials are left out. Leaving out has a
bias: without a good trial the mean of the others is lower, so that predictions of nothing but the mean fall as the
truth rises, and rank correlation is below 0 where there is nothing to predict. Chance is therefore measured and not
assumed: the same is repeated with the surgeons' ratings permuted among the surgeons.

The model competes with trivial rivals on the same surgeons left out (`RIVALS`). The bias also lowers rivals that are
fitted, a weak one most of all, so the duration competes without a fit too: the shorter the trial, the better.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from skills.arrays import Flags, Floats, Ints, frozen
from skills.errors import BadInput
from skills.fields import Fraction, Sha256, schema
from skills.learning.slip import wilson
from skills.scoring.features import KIND_OF, MODELLED, Numbers, modelled

Level = Literal["novice", "intermediate", "expert"]
LEVELS: tuple[Level, ...] = get_args(Level)
LEAST_RATING, MOST_RATING = 6.0, 30.0  # range of the global rating score: six parts of one to five points


@dataclass(frozen=True, eq=False)
class SkillModel:
    """The fitted model, of F figures and L levels.

    Attributes:
        figures: The names of the figures.
        centre: Their means, shape (F,).
        scale: Their standard deviations, 1 if a figure never varied, shape (F,).
        lowest: The smallest value of each in the cohort, shape (F,).
        highest: The greatest, shape (F,).
        rating: The rating at the means.
        rating_weights: Points per standard deviation, shape (F,).
        rating_margin: The error that 90 % of the ratings of unseen surgeons did not exceed, in points.
        levels: The levels in the cohort.
        level_offsets: Log odds at the means, shape (L,).
        level_weights: Log odds per standard deviation, shape (L, F).
    """

    figures: tuple[str, ...]
    centre: Floats
    scale: Floats
    lowest: Floats
    highest: Floats
    rating: float
    rating_weights: Floats
    rating_margin: float
    levels: tuple[Level, ...]
    level_offsets: Floats
    level_weights: Floats

    def __post_init__(self) -> None:
        count, levels = len(self.figures), len(self.levels)
        shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("centre", "scale", "lowest", "highest", "rating_weights"), (count,)),
            "level_offsets": (levels,),
            "level_weights": (levels, count),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, shape, name))

    def ratings(self, values: Floats) -> Floats:
        """Return the predicted ratings of motions, (N, F) to (N,), clipped to the range of a rating."""
        sums = self.rating + self._standard(values) @ self.rating_weights
        return np.asarray(sums.clip(LEAST_RATING, MOST_RATING))

    def probabilities(self, values: Floats) -> Floats:
        """Return the probability of each level, (N, F) to (N, L)."""
        odds = self.level_offsets + self._standard(values) @ self.level_weights.T
        likely = np.exp(odds - odds.max(axis=1, keepdims=True))
        return np.asarray(likely / likely.sum(axis=1, keepdims=True))

    def _standard(self, values: Floats) -> Floats:
        return np.asarray((values - self.centre) / self.scale)


@schema
@dataclass(frozen=True)
class Skill:
    """The rating of a motion by the calibrated model; null without a model, or without a figure that it needs.

    Attributes:
        calibrated: Whether there is a rating.
        calibration: Digest of the calibration.
        words: The cohort of the calibration, the quality of the model there, and the rating; or why there is none.
        rating: The global rating score, 6 to 30.
        interval: Its interval at 90 %, as far as the motion is like those of the calibration.
        levels: Probability of each skill level; null if the model is not better at levels than chance and duration.
        terms: Contribution of each figure to the rating, in points from the mean's.
        outside: Sentences on the figures outside the range of the calibration; with any, do not rely on the rating.
    """

    calibrated: bool
    calibration: Sha256 | None
    words: tuple[str, ...]
    rating: float | None = None
    interval: tuple[float, float] | None = None
    levels: dict[str, Fraction] | None = None
    terms: dict[str, float] | None = None
    outside: tuple[str, ...] = ()


def unrated(why: str) -> Skill:
    """Return the result for a motion that no model rates, with the reason."""
    return Skill(calibrated=False, calibration=None, words=(why,))


def rate(
    model: SkillModel,
    numbers: Numbers,
    calibration: str,
    about: Mapping[str, Any],
    levels_refused: Sequence[str] = (),
) -> Skill:
    """Predict rating and level of a motion from its figures.

    Args:
        model: The fitted model.
        numbers: The motion's figures, as `skills.scoring.features.measure` returns them.
        calibration: Digest of the calibration that the model is part of.
        about: The calibration: its cohort as `data`, and `Validated` as the mapping `validated`.
        levels_refused: Why the model's levels are not given, see `level_refusals`; if empty, they are.

    Returns:
        The rating; without one if a figure of the model was not recorded.
    """
    values = modelled(numbers, model.figures)
    if values is None:
        missing = ", ".join(KIND_OF[name].label for name in model.figures if numbers[name] is None)
        return unrated(f"Not rated: the calibrated model needs figures that were not recorded ({missing}).")
    rating = float(model.ratings(values[None])[0])
    low, high = np.clip([rating - model.rating_margin, rating + model.rating_margin], LEAST_RATING, MOST_RATING)
    terms = (values - model.centre) / model.scale * model.rating_weights
    levels = dict(zip(model.levels, model.probabilities(values[None])[0].tolist(), strict=True))
    likely = max(levels, key=levels.__getitem__)
    outside = tuple(_outside(model, values))
    words = [
        _quality_in_words(about),
        f"It would rate this motion {rating:.1f} of 30 (90 %: {low:.1f} to {high:.1f})"
        + (
            f", and predicts {likely} with a probability of {100 * levels[likely]:.0f} %."
            if not levels_refused
            else "."
        ),
    ]
    if levels_refused:
        words.append(f"It gives no skill level. {' '.join(levels_refused)}")
    if outside:
        words.append(
            "This motion is unlike what it was calibrated on, so do not rely on this rating: " + " ".join(outside)
        )
    return Skill(
        calibrated=True,
        calibration=calibration,
        words=tuple(words),
        rating=rating,
        interval=(float(low), float(high)),
        levels=None if levels_refused else levels,
        terms=dict(zip(model.figures, terms.tolist(), strict=True)),
        outside=outside,
    )


def _quality_in_words(about: Mapping[str, Any]) -> str:
    data, judged = about["data"], about["validated"]
    rho, chance = judged["all_figures"], judged["chance"]
    low, high = rho["rho_interval"]
    return (
        f"Calibrated on {data['trials']} rated trials ({data['task']}, each {data['of']}) of {data['surgeons']} "
        "surgeons. For a surgeon left out of the fit, it orders trials with a rank correlation of "
        f"{rho['rho']:.2f} ({low:.2f} to {high:.2f}; the duration alone: {judged['duration_only']['rho']:.2f}, "
        f"chance: {chance['rho']:.2f}) and is right about the level in {100 * rho['accuracy']:.0f} % of them "
        f"(chance: {100 * chance['accuracy']:.0f} %)."
    )


def _outside(model: SkillModel, values: Floats) -> Sequence[str]:
    said = []
    for name, value, low, high in zip(model.figures, values, model.lowest, model.highest, strict=True):
        if not low <= value <= high:
            kind = KIND_OF[name]
            unit = f" {kind.unit}" if kind.unit else ""
            said.append(f"{kind.label} is {value:.3g}{unit}; the calibration data has {low:.3g} to {high:.3g}{unit}.")
    return said


def as_numbers(model: SkillModel) -> dict[str, Any]:
    """Return a model as plain numbers for JSON, without loss.

    Args:
        model: The fitted model.
    """
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(model).items()}


def from_numbers(numbers: Mapping[str, Any]) -> SkillModel:
    """Return the model that `as_numbers` wrote.

    Args:
        numbers: The result of `as_numbers`.

    Raises:
        BadInput: An array has the wrong shape, or a number is NaN or infinite.
    """
    named = {name: tuple(numbers[name]) for name in ("figures", "levels")}
    return SkillModel(**{**numbers, **named})


RIDGE = 1.0  # penalty on squared weights, ours: of the order of one trial's share, so it stabilises with little bias
LOGISTIC = 1.0  # inverse of the same penalty, scikit-learn's default
LEAST_SURGEONS = 3  # with two, the model would be fitted to a single one when the other is left out
WITHIN = 0.90  # share of the ratings of unseen surgeons that are within the margin
BOOTSTRAPS = 2000
DRAWN_AT_ONCE = 100_000  # trials, whose ranks take some 10 MB
PERMUTATIONS = 200
ACCEPTED_P = 0.05  # ours: greatest p-value of an accepted model against chance
LEAST_PERMUTATIONS = 19  # p is at least 1 / (permutations + 1): of fewer, it is above `ACCEPTED_P` for every model
WHOLE = ("duration_s", "path_length_mm", "gestures")  # trivial figures of a complete trial
RIVALS = {
    "motion_duration": "duration of each motion",
    "trial_duration": "duration of the trial",
    "shorter_first": "shorter trials first, not fitted",
    "path_length": "path length of the trial",
    "gestures": "number of gestures",
    "mean": "mean, and most frequent level",
}
DURATIONS = ("motion_duration", "trial_duration", "shorter_first")
UNKNOWN = (np.nan, np.nan)
NOTHING: Callable[[float], None] = lambda share: None  # noqa: E731


@dataclass(frozen=True, eq=False)
class Cohort:
    """Rated trials of several surgeons: N motions of T trials.

    Attributes:
        values: The figures `MODELLED` of each motion, shape (N, F).
        trials: Index of the trial of each motion, shape (N,).
        surgeons: Number of the surgeon of each trial, shape (T,).
        ratings: The global rating score of each trial, shape (T,).
        levels: Index in `LEVELS` of the surgeon's level in each trial, shape (T,).
        whole: The figures `WHOLE` of each complete trial, shape (T, 3); by default durations and path lengths are the
            sums over its motions, and gestures their number.
    """

    values: Floats
    trials: Ints
    surgeons: Ints
    ratings: Floats
    levels: Ints
    whole: Floats = field(default_factory=lambda: np.empty((0, len(WHOLE))))

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, np.float64, (None, len(MODELLED)), "values"))
        object.__setattr__(self, "trials", frozen(self.trials, np.int64, (len(self.values),), "trials"))
        whole = self.whole if len(self.whole) else self._sums()
        object.__setattr__(self, "whole", frozen(whole, np.float64, (len(self.surgeons), len(WHOLE)), "whole"))
        for name, dtype in (("surgeons", np.int64), ("ratings", np.float64), ("levels", np.int64)):
            object.__setattr__(self, name, frozen(getattr(self, name), dtype, (len(self.surgeons),), name))
        count = len(np.unique(self.surgeons))
        if count < LEAST_SURGEONS:
            raise BadInput(
                f"There {'is 1 surgeon' if count == 1 else f'are {count} surgeons'}; at least {LEAST_SURGEONS} "
                "are needed, because one is left out.",
                surgeons=count,
            )
        if len(np.unique(self.levels)) < 2:
            raise BadInput("All surgeons are of one skill level; at least two levels are needed to distinguish them.")
        if len(np.unique(self.ratings)) < 2:
            raise BadInput("All trials have the same rating; ratings that differ are needed.")

    def _sums(self) -> Floats:
        counts = np.bincount(self.trials, minlength=len(self.surgeons))
        figures = [self.values[:, MODELLED.index(name)] for name in WHOLE[:2]]
        return np.stack([*(np.bincount(self.trials, one, len(counts)) for one in figures), counts], axis=1)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The predictions for each trial by a model that has not seen its surgeon.

    Attributes:
        ratings: The predicted ratings, shape (T,).
        levels: The likeliest of `LEVELS`, shape (T,).
        off: Error of the rating of each motion, predicted minus true, shape (N,).
    """

    ratings: Floats
    levels: Ints
    off: Floats


@dataclass(frozen=True)
class Judged:
    """The quality of predictions for unseen surgeons.

    Attributes:
        rho: Spearman's rank correlation between predicted and true ratings.
        rho_interval: Its interval at 95 %: a bootstrap over surgeons.
        right: Number of trials with the correct level.
        accuracy: Their share.
        accuracy_interval: Its interval at 95 % (Wilson), if trials were independent, which they are not quite.
    """

    rho: float
    rho_interval: tuple[float, float]
    right: int
    accuracy: float
    accuracy_interval: tuple[float, float]


@dataclass(frozen=True)
class Chance:
    """The quality of predictions when there is nothing to predict: ratings and levels permuted among the surgeons.

    Attributes:
        permutations: Number of permutations.
        rho: The mean rank correlation.
        rho_95: The rank correlation below which 95 % of them are.
        rho_p: Share of permutations at least as good as the model, with the model counted as one of them.
        accuracy: The mean share of correct levels.
        accuracy_95: The share below which 95 % of them are.
        accuracy_p: Share of permutations at least as good as the model, with the model counted as one of them.
        commonest: The share of correct levels if the commonest level is always predicted.
    """

    permutations: int
    rho: float
    rho_95: float
    rho_p: float
    accuracy: float
    accuracy_95: float
    accuracy_p: float
    commonest: float


@dataclass(frozen=True)
class Validation:
    """A model judged on surgeons left out, with the same for trivial rivals and for chance.

    Attributes:
        all_figures: The model.
        duration_only: The best that the duration alone achieves, in any of `DURATIONS`, for the order and for levels.
        chance: Permuted ratings and levels.
        over_duration: Interval at 95 % of the model's rho minus the greatest of `DURATIONS`: a bootstrap over surgeons,
            all on the same draws.
        rivals: The predictions of trivial rivals, by the names of `RIVALS`.
    """

    all_figures: Judged
    duration_only: Judged
    chance: Chance
    over_duration: tuple[float, float]
    rivals: dict[str, Judged]


def calibrate(cohort: Cohort, *, columns: tuple[int, ...] | None = None) -> SkillModel:
    """Fit the model to a complete cohort.

    Args:
        cohort: The rated trials.
        columns: Indices of the figures that it may use, by default all.

    Returns:
        The model, with the margin of its ratings from surgeons left out.
    """
    off = np.sort(np.abs(held_out(cohort, columns=columns).off))
    level = min(1.0, WITHIN * (len(off) + 1) / len(off))  # the quantile of conformal prediction
    return _fitted(cohort, np.ones(len(cohort.surgeons), bool), columns, margin=float(np.quantile(off, level)))


def validate(
    cohort: Cohort, *, seed: int = 0, permutations: int = PERMUTATIONS, told: Callable[[float], None] = NOTHING
) -> Validation:
    """Judge the model on surgeons left out.

    Args:
        cohort: The rated trials.
        seed: Seed of the bootstrap and the permutations.
        permutations: Number of permutations for chance.
        told: Progress callback, called with the finished share, 0 to 1.

    Returns:
        The quality of the model, of its trivial rivals, and of chance.

    Raises:
        BadInput: As in `check_permutations`.
    """
    check_permutations(permutations)
    found = {"": held_out(cohort), **rival_predictions(cohort)}
    judged, rhos = _judge(cohort, found, np.random.default_rng(seed))
    ours = judged.pop("")
    by_order, by_level = (
        max((judged[name] for name in DURATIONS), key=key) for key in (lambda of: of.rho, lambda of: of.accuracy)
    )
    more = rhos[""] - np.max([rhos[name] for name in DURATIONS], axis=0)
    low, high = np.quantile(more, (0.025, 0.975)).tolist()
    return Validation(
        all_figures=ours,
        duration_only=replace(by_level, rho=by_order.rho, rho_interval=by_order.rho_interval),
        chance=_chance(cohort, ours, np.random.default_rng([seed, 1]), permutations, told),
        over_duration=(low, high),
        rivals=judged,
    )


def rival_predictions(cohort: Cohort) -> dict[str, HeldOut]:
    """Predict every trial by each of `RIVALS`, fitted without its surgeon except for `shorter_first`.

    Args:
        cohort: The rated trials.

    Returns:
        The predictions, by the names of `RIVALS`. `shorter_first` has no model: its "ratings" are the negative
        durations, in s, and its levels are those of `trial_duration`.
    """
    duration_s, path_mm, gestures = cohort.whole.T
    by_duration = _predict_by(cohort, duration_s)
    return {
        "motion_duration": held_out(cohort, columns=(MODELLED.index("duration_s"),)),
        "trial_duration": by_duration,
        "shorter_first": replace(by_duration, ratings=-duration_s),
        "path_length": _predict_by(cohort, path_mm),
        "gestures": _predict_by(cohort, gestures),
        "mean": _predict_by(cohort, np.zeros_like(duration_s)),
    }


def _predict_by(cohort: Cohort, figure: Floats) -> HeldOut:
    """Predict every trial from one number of it, (T,), by a model of the same kind."""
    values = np.zeros((len(figure), len(MODELLED)))
    values[:, 0] = figure
    alone = Cohort(values, np.arange(len(figure)), cohort.surgeons, cohort.ratings, cohort.levels)
    return held_out(alone, columns=(0,))


def check_permutations(permutations: int) -> None:
    """Refuse a number of permutations with which no model could be accepted.

    Raises:
        BadInput: There are fewer than `LEAST_PERMUTATIONS`.
    """
    if permutations < LEAST_PERMUTATIONS:
        raise BadInput(
            f"{permutations} permutations can accept no model: p is at least 1 of {permutations + 1}, and at most "
            f"{ACCEPTED_P} is accepted. Give at least {LEAST_PERMUTATIONS}, better {PERMUTATIONS}.",
            permutations=permutations,
        )


def refusals(validated: Mapping[str, Any]) -> list[str]:
    """Return the reasons why a model is not accepted, one sentence each.

    There is none if its ratings are better than chance and than the duration alone. Every comparison is written so that
    a missing figure or NaN refuses the model.

    Args:
        validated: `Validated` as a mapping, as it is stored with a model; an older one lacks `over_duration`.
    """
    ours, duration, chance = (validated[name] for name in ("all_figures", "duration_only", "chance"))
    rho, rho_by_duration = (of.get("rho", np.nan) for of in (ours, duration))
    low, high = ours.get("rho_interval", UNKNOWN)
    more_low, more_high = validated.get("over_duration", UNKNOWN)
    rho_p = chance.get("rho_p", np.nan)
    why = []
    if not low > 0:
        why.append(f"Its rank correlation may be 0 or less ({rho:.2f}, 95 %: {low:.2f} to {high:.2f}).")
    if not rho_p <= ACCEPTED_P:
        why.append(f"A random order does as well ({_in_words(rho_p, chance)}).")
    if not more_low > 0:
        why.append(
            f"It may order trials no better than the duration alone ({rho_by_duration:.2f}; the difference is "
            f"{more_low:.2f} to {more_high:.2f})."
        )
    return why


def level_refusals(validated: Mapping[str, Any]) -> list[str]:
    """Return the reasons why an accepted model's levels are not given; none if they are better than the rivals' too.

    A surgeon's level is stated by the surgeon and need not follow the ratings, so it is judged by itself.

    Args:
        validated: As for `refusals`.
    """
    ours, duration, chance = (validated[name] for name in ("all_figures", "duration_only", "chance"))
    right_p = chance.get("accuracy_p", np.nan)
    right, commonest, by_duration = (
        100 * of.get(name, np.nan) for of, name in ((ours, "accuracy"), (chance, "commonest"), (duration, "accuracy"))
    )
    why = []
    if not right_p <= ACCEPTED_P:
        why.append(f"Random levels are right as often ({_in_words(right_p, chance)}).")
    if not (right > commonest and right > by_duration):
        why.append(
            f"It is right about the level in {right:.0f} % of the trials, the most frequent level in "
            f"{commonest:.0f} %, the duration alone in {by_duration:.0f} %."
        )
    return why


def _in_words(p: float, chance: Mapping[str, Any]) -> str:
    """Return a p-value above `ACCEPTED_P` in words, and whether it may be above it for want of permutations."""
    said, permutations = f"p = {p:.3f}; at most {ACCEPTED_P} is accepted", chance.get("permutations")
    if permutations is None or np.isnan(p):
        return said
    as_good = round(p * (permutations + 1)) - 1
    low, high = wilson(as_good, permutations)
    if low > ACCEPTED_P:
        return said
    return (
        f"{said}; it may be {low:.3f} to {high:.3f}, because {permutations} permutations are few: calibrate again with "
        "more"
    )


def held_out(cohort: Cohort, *, columns: tuple[int, ...] | None = None) -> HeldOut:
    """Predict every trial by a model that has not seen its surgeon.

    Args:
        cohort: The rated trials.
        columns: Indices of the figures that the model may use, by default all.
    """
    from sklearn.model_selection import LeaveOneGroupOut
    from threadpoolctl import threadpool_limits

    motions = len(cohort.values)
    ratings, likely = np.empty(motions), np.zeros((motions, len(LEVELS)))
    with threadpool_limits(1):  # so few numbers are computed faster than they are distributed to threads
        for seen, unseen in LeaveOneGroupOut().split(cohort.surgeons, groups=cohort.surgeons):
            inside = np.zeros(len(cohort.surgeons), bool)
            inside[seen] = True
            model, theirs = _fitted(cohort, inside, columns), np.isin(cohort.trials, unseen)
            ratings[theirs] = model.ratings(cohort.values[theirs])
            for level, column in zip(model.levels, model.probabilities(cohort.values[theirs]).T, strict=True):
                likely[theirs, LEVELS.index(level)] = column
    return HeldOut(
        ratings=_by_trial(cohort, ratings),
        levels=np.stack([_by_trial(cohort, column) for column in likely.T], axis=1).argmax(axis=1),
        off=ratings - cohort.ratings[cohort.trials],
    )


def shuffled(cohort: Cohort, rng: np.random.Generator) -> Cohort:
    """Return the cohort with ratings and levels permuted among the surgeons, each surgeon's together and in order.

    A surgeon with fewer trials than ratings received leaves some out; one with more begins again with the first.

    Args:
        cohort: The rated trials.
        rng: Generator of the permutation.
    """
    names = np.unique(cohort.surgeons)
    ratings, levels = np.empty_like(cohort.ratings), np.empty_like(cohort.levels)
    for to, of in zip(names, rng.permutation(names), strict=True):
        mine, theirs = cohort.surgeons == to, cohort.surgeons == of
        ratings[mine] = np.resize(cohort.ratings[theirs], mine.sum())
        levels[mine] = np.resize(cohort.levels[theirs], mine.sum())
    return replace(cohort, ratings=ratings, levels=levels)


def spearman(one: Floats, other: Floats) -> float:
    """Return the rank correlation, -1 to 1; 0 if either never varies, because then it orders nothing.

    Args:
        one: Values, shape (T,).
        other: Values, shape (T,).
    """
    return float(_spearman(one[None], other)[0])


def _spearman(several: Floats, other: Floats) -> Floats:
    """Return the rank correlations of several series, (K, ..., T), with another, (..., T): shape (K, ...)."""
    from scipy.stats import rankdata

    ranks = (rankdata(one, axis=-1) for one in (several, other))
    a, b = (one - one.mean(axis=-1, keepdims=True) for one in ranks)
    lengths = np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))
    return np.asarray(np.divide((a * b).sum(axis=-1), lengths, out=np.zeros_like(lengths), where=lengths > 0))


def _fitted(cohort: Cohort, inside: Flags, columns: tuple[int, ...] | None, margin: float = 0.0) -> SkillModel:
    """Fit to the trials marked in `inside`, shape (T,)."""
    from sklearn import config_context
    from sklearn.linear_model import LogisticRegression, Ridge

    chosen = list(range(len(MODELLED)) if columns is None else columns)
    taken = inside[cohort.trials]
    values, trials = cohort.values[taken], cohort.trials[taken]
    weights = 1.0 / np.bincount(trials, minlength=len(inside))[trials]  # so that every trial weighs the same
    centre = np.average(values, axis=0, weights=weights)
    scale = np.sqrt(np.average((values - centre) ** 2, axis=0, weights=weights))
    scale[~(scale > 1e-9 * np.abs(centre).clip(1e-9))] = 1.0  # it never varied
    standard = ((values - centre) / scale)[:, chosen]
    levels = cohort.levels[trials]
    known = np.unique(levels)
    offsets, slopes = np.zeros(len(known)), np.zeros((len(known), len(chosen)))
    logistic = LogisticRegression(C=LOGISTIC, max_iter=1000)
    with config_context(assume_finite=True, skip_parameter_validation=True):  # `Cohort` has checked the numbers
        ridge = Ridge(alpha=RIDGE).fit(standard, cohort.ratings[trials], sample_weight=weights)
        if len(known) > 1:
            logistic.fit(standard, levels, sample_weight=weights)
    if len(known) > 1:
        first = len(known) - len(logistic.coef_)  # with two levels scikit-learn gives weights to the second alone
        offsets[first:], slopes[first:] = logistic.intercept_, logistic.coef_
    rating_weights, level_weights = np.zeros(len(MODELLED)), np.zeros((len(known), len(MODELLED)))
    rating_weights[chosen], level_weights[:, chosen] = ridge.coef_, slopes
    return SkillModel(
        figures=MODELLED,
        centre=centre,
        scale=scale,
        lowest=values.min(axis=0),
        highest=values.max(axis=0),
        rating=float(ridge.intercept_),
        rating_weights=rating_weights,
        rating_margin=margin,
        levels=tuple(LEVELS[level] for level in known),
        level_offsets=offsets,
        level_weights=level_weights,
    )


def _by_trial(cohort: Cohort, values: Floats) -> Floats:
    """Return the mean over each trial, (T,), of values per motion, (N,)."""
    count = len(cohort.surgeons)
    return np.asarray(np.bincount(cohort.trials, values, count) / np.bincount(cohort.trials, minlength=count))


def _judge(
    cohort: Cohort, found: Mapping[str, HeldOut], rng: np.random.Generator
) -> tuple[dict[str, Judged], dict[str, Floats]]:
    """Judge several predictions; return also the rank correlations of each on the same bootstrap draws, shape (B,)."""
    count, predicted = len(cohort.levels), np.stack([one.ratings for one in found.values()])
    draws, drawn_rhos = list(_resampled(cohort.surgeons, rng)), np.empty((len(found), BOOTSTRAPS))
    lengths = np.array([len(drawn) for drawn in draws])
    for length in np.unique(lengths):  # many draws of a length at once, in a tenth of the time
        equal = np.flatnonzero(lengths == length)
        for at in np.array_split(equal, 1 + len(equal) * length // DRAWN_AT_ONCE):
            drawn = np.stack([draws[number] for number in at])
            drawn_rhos[:, at] = _spearman(predicted[:, drawn], cohort.ratings[drawn])
    rhos = dict(zip(found, drawn_rhos, strict=True))
    judged = {}
    for name, one in found.items():
        low, high = np.quantile(rhos[name], (0.025, 0.975)).tolist()
        right = int((one.levels == cohort.levels).sum())
        rho = spearman(one.ratings, cohort.ratings)
        judged[name] = Judged(rho, (low, high), right, right / count, wilson(right, count))
    return judged, rhos


def _resampled(surgeons: Ints, rng: np.random.Generator) -> Iterator[Ints]:
    """Draw surgeons with replacement, each with all trials, and yield the trials."""
    trials_of = [np.flatnonzero(surgeons == surgeon) for surgeon in np.unique(surgeons)]
    for _ in range(BOOTSTRAPS):
        yield np.concatenate([trials_of[drawn] for drawn in rng.integers(len(trials_of), size=len(trials_of))])


def _chance(
    cohort: Cohort, judged: Judged, rng: np.random.Generator, permutations: int, told: Callable[[float], None]
) -> Chance:
    of_order, of_levels = [], []
    for number in range(permutations):
        permuted = shuffled(cohort, rng)
        found = held_out(permuted)
        of_order.append(spearman(found.ratings, permuted.ratings))
        of_levels.append(float((found.levels == permuted.levels).mean()))
        told((number + 1) / permutations)
    rhos, rights = np.array(of_order), np.array(of_levels)
    return Chance(
        permutations=permutations,
        rho=float(rhos.mean()),
        rho_95=float(np.quantile(rhos, 0.95)),
        rho_p=float(1 + (rhos >= judged.rho).sum()) / (1 + permutations),
        accuracy=float(rights.mean()),
        accuracy_95=float(np.quantile(rights, 0.95)),
        accuracy_p=float(1 + (rights >= judged.accuracy).sum()) / (1 + permutations),
        commonest=float(np.bincount(cohort.levels).max() / len(cohort.levels)),
    )
