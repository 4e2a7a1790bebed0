"""Fit a model of skill to rated trials, and tell how good it is at surgeons that it has not seen.

    Cohort --calibrate--> SkillModel;   Cohort --validate--> Validated

Ridge regression for the rating and logistic regression for the level, on standardised figures, both of scikit-learn and
with one fixed strength each: a cohort of eight surgeons is too small to choose it by. A trial that has several motions
weighs as much as any other, and is judged by their mean.

Trials of one surgeon are alike, so a model is judged by surgeons who are left out whole. Leaving out has a bias of its
own: without a good trial the mean of the others is lower, so that predictions of nothing but the mean fall as the truth
rises, and rank correlation is below 0 where there is nothing to know. Chance is therefore measured and not assumed:
the same is done again with the surgeons' ratings dealt out anew among the surgeons.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from skills.errors import BadInput
from skills.style._arrays import Floats, Ints, frozen
from skills.style.comparing.recognition import wilson
from skills.style.movement import Flags
from skills.style.scoring.figures import MODELLED
from skills.style.scoring.model import LEVELS, SkillModel

RIDGE = 1.0  # penalty on squared weights, ours: of the order of one trial's share, so it calms and hardly bends
LOGISTIC = 1.0  # inverse of the same, scikit-learn's default
LEAST_SURGEONS = 3  # with fewer, one is learnt from when the other is left out
WITHIN = 0.90  # of the ratings of unseen surgeons the margin holds
BOOTSTRAPS = 2000
PERMUTATIONS = 200
NOTHING: Callable[[float], None] = lambda share: None  # noqa: E731


@dataclass(frozen=True, eq=False)
class Cohort:
    """Rated trials of several surgeons: N motions of T trials.

    Attributes:
        values: The figures `MODELLED` of each motion, shape (N, F).
        trials: Which trial each motion is of, shape (N,).
        surgeons: Which surgeon did each trial, shape (T,).
        ratings: The global rating score of each trial, shape (T,).
        levels: Which of `LEVELS` the surgeon of each trial is, shape (T,).
    """

    values: Floats
    trials: Ints
    surgeons: Ints
    ratings: Floats
    levels: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values, np.float64, (None, len(MODELLED)), "values"))
        object.__setattr__(self, "trials", frozen(self.trials, np.int64, (len(self.values),), "trials"))
        for name, dtype in (("surgeons", np.int64), ("ratings", np.float64), ("levels", np.int64)):
            object.__setattr__(self, name, frozen(getattr(self, name), dtype, (len(self.surgeons),), name))
        count = len(np.unique(self.surgeons))
        if count < LEAST_SURGEONS:
            raise BadInput(
                f"There {'is 1 surgeon' if count == 1 else f'are {count} surgeons'}; at least {LEAST_SURGEONS} are "
                "needed, so that one can be left out.",
                surgeons=count,
            )
        if len(np.unique(self.levels)) < 2:
            raise BadInput("All surgeons are of one skill level; at least two levels are needed to tell them apart.")
        if len(np.unique(self.ratings)) < 2:
            raise BadInput("All trials have the same rating; there is nothing to learn.")


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What was predicted of each trial by a model that had not seen its surgeon.

    Attributes:
        ratings: Shape (T,).
        levels: The likeliest of `LEVELS`, shape (T,).
        off: By how much the rating of each motion was missed, shape (N,).
    """

    ratings: Floats
    levels: Ints
    off: Floats


@dataclass(frozen=True)
class Judged:
    """How good predictions of unseen surgeons are.

    Attributes:
        rho: Spearman's rank correlation between predicted and true ratings.
        rho_interval: Where it is with 95 %: a bootstrap over surgeons.
        right: How many trials' levels were right.
        accuracy: Their share.
        accuracy_interval: Where it is with 95 % (Wilson), if trials were independent, which they are not quite.
    """

    rho: float
    rho_interval: tuple[float, float]
    right: int
    accuracy: float
    accuracy_interval: tuple[float, float]


@dataclass(frozen=True)
class Chance:
    """The same where there is nothing to know: ratings and levels dealt out anew among the surgeons.

    Attributes:
        permutations: How often.
        rho: The mean rank correlation.
        rho_95: Below it are 95 % of them.
        rho_p: How often chance does as well.
        accuracy: The mean share of right levels.
        accuracy_95: Below it are 95 % of them.
        accuracy_p: How often chance does as well.
        commonest: The share of right levels of whoever always says the commonest.
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
class Validated:
    """A model judged on surgeons left out, beside one that knows the duration alone, and beside chance."""

    all_figures: Judged
    duration_only: Judged
    chance: Chance


def calibrate(cohort: Cohort, *, columns: tuple[int, ...] | None = None) -> SkillModel:
    """Fit the model to a whole cohort; `columns` are the figures that it may use, by default all."""
    off = np.sort(np.abs(held_out(cohort, columns=columns).off))
    level = min(1.0, WITHIN * (len(off) + 1) / len(off))  # as conformal prediction has it
    return _fitted(cohort, np.ones(len(cohort.surgeons), bool), columns, margin=float(np.quantile(off, level)))


def validate(
    cohort: Cohort, *, seed: int = 0, permutations: int = PERMUTATIONS, told: Callable[[float], None] = NOTHING
) -> Validated:
    """Judge the model on surgeons left out.

    Args:
        cohort: The rated trials.
        seed: Of the bootstrap and the permutations.
        permutations: How often chance is tried.
        told: Is told how much is done, 0 to 1.
    """
    rng = np.random.default_rng(seed)
    all_figures = _judge(cohort, held_out(cohort), rng)
    duration = _judge(cohort, held_out(cohort, columns=(MODELLED.index("duration_s"),)), rng)
    rhos, rights = [], []
    for number in range(permutations):
        dealt = shuffled(cohort, rng)
        found = held_out(dealt)
        rhos.append(spearman(found.ratings, dealt.ratings))
        rights.append(float((found.levels == dealt.levels).mean()))
        told((number + 1) / permutations)
    return Validated(all_figures, duration, _chance(cohort, all_figures, np.array(rhos), np.array(rights)))


def held_out(cohort: Cohort, *, columns: tuple[int, ...] | None = None) -> HeldOut:
    """Predict every trial by a model that has not seen its surgeon."""
    from sklearn.model_selection import LeaveOneGroupOut
    from threadpoolctl import threadpool_limits

    motions = len(cohort.values)
    ratings, likely = np.empty(motions), np.zeros((motions, len(LEVELS)))
    with threadpool_limits(1):  # so few numbers are added up faster than they are dealt out to threads
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
    """Deal the surgeons' ratings and levels out anew among the surgeons, each surgeon's together and in their order.

    Whoever gets more ratings than there are trials leaves some out, whoever gets fewer begins again with the first.
    """
    names = np.unique(cohort.surgeons)
    ratings, levels = np.empty_like(cohort.ratings), np.empty_like(cohort.levels)
    for to, of in zip(names, rng.permutation(names), strict=True):
        mine, theirs = cohort.surgeons == to, cohort.surgeons == of
        ratings[mine] = np.resize(cohort.ratings[theirs], mine.sum())
        levels[mine] = np.resize(cohort.levels[theirs], mine.sum())
    return Cohort(cohort.values, cohort.trials, cohort.surgeons, ratings, levels)


def spearman(one: Floats, other: Floats) -> float:
    """Measure the rank correlation, -1 to 1; 0 where either never varies, for then it orders nothing."""
    from scipy.stats import rankdata

    a, b = (ranks - ranks.mean() for ranks in (rankdata(one), rankdata(other)))
    length = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / length if length > 0 else 0.0


def _fitted(cohort: Cohort, inside: Flags, columns: tuple[int, ...] | None, margin: float = 0.0) -> SkillModel:
    """Fit to the trials that are `inside`, shape (T,), boolean."""
    from sklearn.linear_model import LogisticRegression, Ridge

    chosen = list(range(len(MODELLED)) if columns is None else columns)
    taken = inside[cohort.trials]
    values, trials = cohort.values[taken], cohort.trials[taken]
    weights = 1.0 / np.bincount(trials, minlength=len(inside))[trials]
    centre = np.average(values, axis=0, weights=weights)
    scale = np.sqrt(np.average((values - centre) ** 2, axis=0, weights=weights))
    scale[~(scale > 1e-9 * np.abs(centre).clip(1e-9))] = 1.0  # it never varied
    standard = ((values - centre) / scale)[:, chosen]
    ridge = Ridge(alpha=RIDGE).fit(standard, cohort.ratings[trials], sample_weight=weights)
    levels = cohort.levels[trials]
    known = np.unique(levels)
    offsets, slopes = np.zeros(len(known)), np.zeros((len(known), len(chosen)))
    if len(known) > 1:
        logistic = LogisticRegression(C=LOGISTIC, max_iter=1000).fit(standard, levels, sample_weight=weights)
        first = len(known) - len(logistic.coef_)  # of two levels only the second has weights; the first has none
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
    """Average what is said of motions, (N,), over each trial: (T,)."""
    count = len(cohort.surgeons)
    return np.asarray(np.bincount(cohort.trials, values, count) / np.bincount(cohort.trials, minlength=count))


def _judge(cohort: Cohort, found: HeldOut, rng: np.random.Generator) -> Judged:
    right, count = int((found.levels == cohort.levels).sum()), len(cohort.levels)
    rhos = [spearman(found.ratings[drawn], cohort.ratings[drawn]) for drawn in _resampled(cohort.surgeons, rng)]
    low, high = np.quantile(rhos, (0.025, 0.975)).tolist()
    return Judged(spearman(found.ratings, cohort.ratings), (low, high), right, right / count, wilson(right, count))


def _resampled(surgeons: Ints, rng: np.random.Generator) -> Iterator[Ints]:
    """Draw surgeons with replacement, each with all trials."""
    trials_of = [np.flatnonzero(surgeons == surgeon) for surgeon in np.unique(surgeons)]
    for _ in range(BOOTSTRAPS):
        yield np.concatenate([trials_of[drawn] for drawn in rng.integers(len(trials_of), size=len(trials_of))])


def _chance(cohort: Cohort, judged: Judged, rhos: Floats, rights: Floats) -> Chance:
    tried = len(rhos)
    return Chance(
        permutations=tried,
        rho=float(rhos.mean()),
        rho_95=float(np.quantile(rhos, 0.95)),
        rho_p=float(1 + (rhos >= judged.rho).sum()) / (1 + tried),
        accuracy=float(rights.mean()),
        accuracy_95=float(np.quantile(rights, 0.95)),
        accuracy_p=float(1 + (rights >= judged.accuracy).sum()) / (1 + tried),
        commonest=float(np.bincount(cohort.levels).max() / len(cohort.levels)),
    )
