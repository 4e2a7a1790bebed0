"""Calibration: a readable model of skill, fitted to rated whole trials of one or several tasks.

    Cohort --held_out--> HeldOut   the rating of every trial by a model that has not seen its surgeon
    Cohort, HeldOut --calibrate--> SkillModel

The figures of a trial (`skills.scoring.features`) and its ratings are standardised within each task. Ridge regression
without an intercept, on all tasks together or on each, gives the weights of a score:

    score  = sum of weight * (figure - the task's mean) / the task's standard deviation
    rating = the task's mean + slope * score

Without an intercept a model cannot learn the mean of the surgeons that it has seen, which is lower when a good one is
left out. A score is scaled to mean square 1 on the trials of the fit, so that scores of models of different strength
have one scale. Every trial of a task weighs the same, and so does every task.

Strength, tasks together or apart, and instruments alone or with the masters are the settings of a `Design`. The best
one is chosen by the rank correlation on groups left out of the trials of the fit. So `held_out` leaves two surgeons
out, one inside the other, and a surgeon is judged by a design that was chosen without that surgeon. The six parts of
the rating are predicted by the design that is chosen for their sum.

The slope, the mean and the margin of a rating are those of trials as they were predicted when left out. A level is the
one whose mean rating in the task is nearest to the predicted rating.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Literal, get_args

import numpy as np

from skills.arrays import Flags, Floats, Ints, freeze
from skills.errors import BadInput
from skills.scoring.features import THIRDS, TRIAL_NAMES

Level = Literal["novice", "intermediate", "expert"]
LEVELS: tuple[Level, ...] = get_args(Level)
LEAST_RATING, MOST_RATING = 6.0, 30.0  # range of the global rating score: six parts of one to five points
LEAST_PART, MOST_PART = 1.0, 5.0
PARTS = (
    "respect for tissue",
    "suture and needle handling",
    "time and motion",
    "flow of operation",
    "overall performance",
    "quality of final product",
)
OUTCOMES = 1 + len(PARTS)  # the rating, and its parts
LEAST_SURGEONS = 4  # of a task: with two left out, one inside the other, two are left to fit
STRENGTHS = (1.0, 10.0, 100.0)  # ours, fixed on two tasks before a third was seen: all of them far above least squares
WITHIN = 0.90  # share of the ratings of unseen surgeons that are within the margin


@dataclass(frozen=True, eq=False)
class Cohort:
    """N rated trials of several surgeons, of T tasks.

    Attributes:
        names: The names of the tasks, T.
        values: F figures of each trial as they are modelled, of S sides, shape (N, S, F).
        thirds: The same for each third of a trial, shape (N, S, 3, F).
        tasks: Index of each trial's task, shape (N,).
        surgeons: Number of each trial's surgeon, the same in all tasks, shape (N,).
        repetitions: Number of the trial among those of its surgeon and task, shape (N,).
        ratings: The global rating score and its six parts, shape (N, 7).
        levels: Index in `LEVELS` of the surgeon's level in each trial, shape (N,).
    """

    names: tuple[str, ...]
    values: Floats
    thirds: Floats
    tasks: Ints
    surgeons: Ints
    repetitions: Ints
    ratings: Floats
    levels: Ints

    def __post_init__(self) -> None:
        count = len(self.tasks)
        freeze(self, values=(count, None, None), ratings=(count, OUTCOMES))
        freeze(self, thirds=(count, self.values.shape[1], THIRDS, self.values.shape[2]))
        freeze(self, np.int64, tasks=(count,), surgeons=(count,), repetitions=(count,), levels=(count,))
        for task, name in enumerate(self.names):
            here = self.tasks == task
            surgeons = len(np.unique(self.surgeons[here]))
            if surgeons < LEAST_SURGEONS:
                raise BadInput(
                    f"{name} has rated trials of {surgeons} surgeon{'' if surgeons == 1 else 's'}; at least "
                    f"{LEAST_SURGEONS} are needed, because two at a time are left out. Record more, or leave the task "
                    "out with --task.",
                    surgeons=surgeons,
                )
            if np.ptp(self.ratings[here, 0]) == 0:
                raise BadInput(f"All trials of {name} have the same rating; ratings that differ are needed.")

    @cached_property
    def by_task(self) -> tuple[Ints, ...]:
        """The indices of the trials of each task."""
        return tuple(np.flatnonzero(self.tasks == task) for task in range(len(self.names)))

    def figures(self, masters: bool) -> Floats:
        """Return the figures of the instruments, or the mean of theirs and of the masters', shape (N, F)."""
        return np.asarray(self.values.mean(axis=1) if masters else self.values[:, 0])


@dataclass(frozen=True)
class Design:
    """The settings of a fit.

    Attributes:
        masters: Whether figures are the mean of the instruments' and of the masters'.
        together: Whether one sum of figures holds for all tasks.
        strength: The penalty on squared weights, where the squared errors of a task are averaged over its trials.
    """

    masters: bool
    together: bool
    strength: float


def designs_of(cohort: Cohort) -> tuple[Design, ...]:
    """Return the designs among which is chosen, the simplest first: of equally good ones the first is taken.

    Args:
        cohort: The rated trials. Without figures of the masters there is no mean with theirs; of a single task there is
            one sum.
    """
    masters, together = (False, True)[: cohort.values.shape[1]], (True, False)[: len(cohort.names)]
    return tuple(Design(*chosen) for chosen in product(masters, together, STRENGTHS[::-1]))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Weights for standardised figures, with the figures' means and deviations.

    Attributes:
        design: Its settings.
        centre: Shape (T, F).
        scale: 1 where a figure never varied, shape (T, F).
        weights: Of P outcomes in K variants of the ratings, shape (T, F, P, K).
    """

    design: Design
    centre: Floats
    scale: Floats
    weights: Floats

    def scores(self, cohort: Cohort, which: Flags) -> Floats:
        """Return the scores of the trials marked in `which`, (N,): shape (M, P, K)."""
        tasks, figures = cohort.tasks[which], cohort.figures(self.design.masters)[which]
        standard = (figures - self.centre[tasks]) / self.scale[tasks]
        found = np.empty((len(tasks), *self.weights.shape[2:]))
        for task, weights in enumerate(self.weights):
            found[tasks == task] = np.tensordot(standard[tasks == task], weights, axes=1)
        return found


def _fits(cohort: Cohort, inside: Flags, outcomes: Floats, designs: tuple[Design, ...]) -> list[_Fit]:
    """Fit every design to the trials marked in `inside`, (N,), for outcomes of shape (N, P, K)."""
    tasks = [of_task[inside[of_task]] for of_task in cohort.by_task]
    aims = [_standard(outcomes[rows])[0] for rows in tasks]
    fits = {}
    for masters in {design.masters for design in designs}:
        figures = cohort.figures(masters)
        parts = [_standard(figures[rows]) for rows in tasks]
        squares = np.stack([z.T @ z / max(1, len(z)) for z, _, _ in parts])  # (T, F, F)
        towards = np.stack(
            [np.tensordot(z.T, aim, axes=1) / max(1, len(z)) for (z, _, _), aim in zip(parts, aims, strict=True)]
        )
        centre, scale = (np.stack([part[number] for part in parts]) for number in (1, 2))
        for together in {design.together for design in designs}:
            # A sum over the tasks, or each alone.
            gram = squares.sum(axis=0, keepdims=True) if together else squares
            aimed = towards.sum(axis=0, keepdims=True) if together else towards
            roots, axes = np.linalg.eigh(gram)
            turned = np.einsum("tfe,tfpk->tepk", axes, aimed)
            for strength in {design.strength for design in designs}:
                weights = np.einsum("tfe,tepk->tfpk", axes, turned / (roots + strength)[..., None, None])
                mean_square = np.einsum("tfpk,tfg,tgpk->tpk", weights, gram, weights, optimize=True)
                mean_square /= len(tasks) if together else 1
                size = np.sqrt(mean_square)[:, None]
                weights = np.divide(weights, size, out=np.zeros_like(weights), where=size > 1e-12)
                weights = np.broadcast_to(weights, (len(tasks), *weights.shape[1:]))
                design = Design(masters, together, strength)
                fits[design] = _Fit(design, centre, scale, weights)
    return [fits[design] for design in designs]


def _standard(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return values, (M, ...), standardised over the first axis, with their means and deviations."""
    if not len(values):  # no trial of a task is left: every score there is 0
        return values, np.zeros(values.shape[1:]), np.full(values.shape[1:], np.inf)
    centre, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 1e-9 * np.abs(centre).clip(1e-9), scale, 1.0)  # otherwise it never varied
    return (values - centre) / scale, centre, scale


@dataclass(frozen=True, eq=False)
class LeftOutScores:
    """Scores of every trial by models that have not seen its group, in K variants of the ratings.

    Attributes:
        scores: Shape (N, P, K).
        chosen: Index in `designs_of` of the design that was chosen without each of G groups, shape (G, K).
        inner: The first outcome's scores by the chosen designs of models that have seen neither the group nor that of
            the trial, shape (G, N, K); 0 for the trials of the group.
    """

    scores: Floats
    chosen: Ints
    inner: Floats


def left_out_scores(cohort: Cohort, groups: Ints, outcomes: Floats) -> LeftOutScores:
    """Score every trial by a model that has not seen its group, of a design that was chosen without that group.

    Args:
        cohort: The rated trials; its own ratings are not used.
        groups: The group of each trial that is left out at a time, shape (N,).
        outcomes: P outcomes in K variants, shape (N, P, K); the first outcome chooses the design.
    """
    designs = designs_of(cohort)
    scores, chosen, inner = np.zeros(outcomes.shape), [], []
    variants = np.arange(outcomes.shape[2])
    for name in np.unique(groups):
        seen = groups != name
        best, without = _best(cohort, groups, seen, outcomes[:, :1], designs)
        found = np.stack([fit.scores(cohort, ~seen) for fit in _fits(cohort, seen, outcomes, designs)])
        scores[~seen] = np.moveaxis(found[best, :, :, variants], 0, -1)
        chosen.append(best)
        inner.append(without)
    return LeftOutScores(scores, np.stack(chosen), np.stack(inner))


def _best(
    cohort: Cohort, groups: Ints, seen: Flags, outcomes: Floats, designs: tuple[Design, ...]
) -> tuple[Ints, Floats]:
    """Choose a design for each variant, by groups left out of the trials in `seen`.

    Returns:
        The index of the best design, shape (K,), and its scores of the trials left out, shape (N, K).
    """
    scores = np.zeros((len(designs), len(groups), outcomes.shape[2]))
    for name in np.unique(groups[seen]):
        out = seen & (groups == name)
        fits = _fits(cohort, seen & ~out, outcomes, designs)
        scores[:, out] = np.stack([fit.scores(cohort, out)[:, 0] for fit in fits])
    rhos = [
        rank_correlations(np.moveaxis(scores[:, rows], 1, -1), outcomes[rows, 0].T)
        for rows in (of_task[seen[of_task]] for of_task in cohort.by_task)
    ]
    best = np.asarray(np.mean(rhos, axis=0).argmax(axis=0))
    return best, scores[best, :, np.arange(len(best))].T


def rank_correlations(several: Floats, other: Floats) -> Floats:
    """Return Spearman's rank correlations, 0 where a series never varies, because then it orders nothing.

    Args:
        several: K series, shape (K, ..., N).
        other: The other series, shape (..., N).

    Returns:
        Shape (K, ...).
    """
    from scipy.stats import rankdata

    if not other.shape[-1]:
        return np.zeros(several.shape[:-1])
    ranks = (rankdata(one, axis=-1) for one in (several, other))
    a, b = (one - one.mean(axis=-1, keepdims=True) for one in ranks)
    lengths = np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))
    return np.asarray(np.divide((a * b).sum(axis=-1), lengths, out=np.zeros_like(lengths), where=lengths > 0))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The predictions for each trial by models that have not seen its surgeon, in K variants of the ratings.

    Attributes:
        scores: Shape (N, P, K).
        ratings: The first outcome in points, shape (N, K).
        levels: Index in `LEVELS`, shape (N, K).
        chosen: The designs that were chosen, by the number of groups, over all variants.
    """

    scores: Floats
    ratings: Floats
    levels: Ints
    chosen: Mapping[Design, int]


def held_out(cohort: Cohort, outcomes: Floats | None = None, levels: Ints | None = None) -> HeldOut:
    """Predict every trial by a model that has not seen its surgeon.

    Args:
        cohort: The rated trials.
        outcomes: Ratings, and perhaps their parts, in K variants, shape (N, P, K); by default the cohort's own.
        levels: Levels in K variants, shape (N, K); by default the cohort's own.
    """
    outcomes = cohort.ratings[:, :, None] if outcomes is None else outcomes
    levels = cohort.levels[:, None] if levels is None else levels
    left_out = left_out_scores(cohort, cohort.surgeons, outcomes)
    ratings, told = np.zeros(levels.shape), np.zeros(levels.shape, np.int64)
    for of_task in cohort.by_task:
        for surgeon, inner in zip(np.unique(cohort.surgeons), left_out.inner, strict=True):
            mine = cohort.surgeons[of_task] == surgeon
            out, others = of_task[mine], of_task[~mine]
            mean, slope = _line(inner[others], outcomes[others, 0])
            ratings[out] = mean + slope * left_out.scores[out, 0]
            told[out] = _nearest_level(ratings[out], outcomes[others, 0], levels[others])
    designs = designs_of(cohort)
    counts = np.bincount(left_out.chosen.ravel(), minlength=len(designs))
    return HeldOut(left_out.scores, ratings, told, dict(zip(designs, counts.tolist(), strict=True)))


def _line(scores: Floats, ratings: Floats) -> tuple[Floats, Floats]:
    """Return the mean rating and the points per score, 0 if ratings fall with it: each of shape (...), of (M, ...)."""
    mean, square = ratings.mean(axis=0), (scores**2).mean(axis=0)
    along = (scores * (ratings - mean)).mean(axis=0)
    return mean, np.divide(along, square, out=np.zeros_like(along), where=square > 0).clip(0.0)


def _nearest_level(predicted: Floats, ratings: Floats, levels: Ints) -> Ints:
    """Return the level with the nearest mean rating, (M, K), by the ratings and levels of other trials, (O, K)."""
    means = _level_means(ratings, levels)
    apart = np.abs(predicted[:, None] - means)
    return np.asarray(np.where(np.isnan(apart), np.inf, apart).argmin(axis=1))


def _level_means(ratings: Floats, levels: Ints) -> Floats:
    """Return the mean rating of each level, shape (L, K), of (O, K); NaN for a level without a trial."""
    here = levels == np.arange(len(LEVELS))[:, None, None]
    counts = here.sum(axis=1)
    sums = (ratings * here).sum(axis=1)
    return np.asarray(np.divide(sums, counts, out=np.full(counts.shape, np.nan), where=counts > 0))


@dataclass(frozen=True, eq=False)
class SkillModel:
    """The fitted model, of T tasks, F figures and the outcomes rating and six parts.

    Attributes:
        tasks: The names of the tasks.
        figures: The names of the figures.
        masters: Whether the figures are the mean of the instruments' and of the masters'.
        together: Whether one sum of figures was fitted for all tasks.
        strength: The penalty.
        centre: Means of the figures as they are modelled, shape (T, F).
        scale: Their standard deviations, shape (T, F).
        lowest: The smallest value of each in the task, shape (T, F).
        highest: The greatest, shape (T, F).
        thirds_centre: Means of the figures of each third of a trial, shape (T, 3, F).
        thirds_scale: Their standard deviations, shape (T, 3, F).
        means: The rating and its parts at the means, shape (T, 7).
        weights: Points per standard deviation, shape (T, 7, F).
        margins: The error that 90 % of the ratings of unseen surgeons did not exceed, in points, shape (T,).
        level_ratings: The mean rating of each of `LEVELS`, 0 for one without a trial, shape (T, 3).
        level_shares: Share of each level among the trials that were said to be of a level, when left out; the first
            index after the task is the level that was said, shape (T, 3, 3).
    """

    tasks: tuple[str, ...]
    figures: tuple[str, ...]
    masters: bool
    together: bool
    strength: float
    centre: Floats
    scale: Floats
    lowest: Floats
    highest: Floats
    thirds_centre: Floats
    thirds_scale: Floats
    means: Floats
    weights: Floats
    margins: Floats
    level_ratings: Floats
    level_shares: Floats

    def __post_init__(self) -> None:
        tasks, count, levels = len(self.tasks), len(self.figures), len(LEVELS)
        freeze(self, **dict.fromkeys(("centre", "scale", "lowest", "highest"), (tasks, count)))
        freeze(self, thirds_centre=(tasks, THIRDS, count), thirds_scale=(tasks, THIRDS, count), margins=(tasks,))
        freeze(self, means=(tasks, OUTCOMES), weights=(tasks, OUTCOMES, count))
        freeze(self, level_ratings=(tasks, levels), level_shares=(tasks, levels, levels))

    def standard(self, task: int, values: Floats) -> Floats:
        """Return figures of trials of a task, (..., F), in standard deviations from the task's means."""
        return np.asarray((values - self.centre[task]) / self.scale[task])

    def ratings(self, task: int, values: Floats) -> Floats:
        """Return the rating of trials of a task and its parts, (..., F) to (..., 7), clipped to their ranges."""
        sums = self.means[task] + self.standard(task, values) @ self.weights[task].T
        lowest, highest = [LEAST_RATING, *[LEAST_PART] * len(PARTS)], [MOST_RATING, *[MOST_PART] * len(PARTS)]
        return np.asarray(sums.clip(lowest, highest))


def calibrate(cohort: Cohort, found: HeldOut) -> SkillModel:
    """Fit the model to a complete cohort, with the slopes and margins of the trials left out.

    Args:
        cohort: The rated trials.
        found: `held_out` of the same cohort.
    """
    everything = np.ones(len(cohort.tasks), bool)
    outcomes, designs = cohort.ratings[:, :, None], designs_of(cohort)
    best = int(_best(cohort, cohort.surgeons, everything, outcomes[:, :1], designs)[0][0])
    fit, figures = _fits(cohort, everything, outcomes, (designs[best],))[0], cohort.figures(designs[best].masters)
    of_thirds = cohort.thirds.mean(axis=1) if fit.design.masters else cohort.thirds[:, 0]
    lines = [_line(found.scores[rows, :, 0], cohort.ratings[rows]) for rows in cohort.by_task]
    slopes = np.stack([slope for _, slope in lines])
    thirds = [_standard(of_thirds[rows]) for rows in cohort.by_task]
    levels = [_level_means(cohort.ratings[rows, :1], cohort.levels[rows, None])[:, 0] for rows in cohort.by_task]
    return SkillModel(
        tasks=cohort.names,
        figures=TRIAL_NAMES,
        masters=fit.design.masters,
        together=fit.design.together,
        strength=fit.design.strength,
        centre=fit.centre,
        scale=fit.scale,
        lowest=np.stack([figures[rows].min(axis=0) for rows in cohort.by_task]),
        highest=np.stack([figures[rows].max(axis=0) for rows in cohort.by_task]),
        thirds_centre=np.stack([centre for _, centre, _ in thirds]),
        thirds_scale=np.stack([scale for _, _, scale in thirds]),
        means=np.stack([mean for mean, _ in lines]),
        weights=slopes[:, :, None] * np.moveaxis(fit.weights[..., 0], 1, 2),
        margins=np.array([_margin(cohort.ratings[rows, 0] - found.ratings[rows, 0]) for rows in cohort.by_task]),
        level_ratings=np.nan_to_num(np.stack(levels)),
        level_shares=np.stack([_shares(found.levels[rows, 0], cohort.levels[rows]) for rows in cohort.by_task]),
    )


def _margin(off: Floats) -> float:
    share = min(1.0, WITHIN * (len(off) + 1) / len(off))  # the quantile of conformal prediction
    return float(np.quantile(np.abs(off), share))


def _shares(said: Ints, true: Ints) -> Floats:
    """Return the share of each level among the trials said to be of a level, one trial of each added: shape (3, 3)."""
    counts = np.ones((len(LEVELS), len(LEVELS)))
    np.add.at(counts, (said, true), 1)
    return np.asarray(counts / counts.sum(axis=1, keepdims=True))


def as_numbers(model: SkillModel) -> dict[str, Any]:
    """Return a model as plain numbers for JSON, without loss.

    Args:
        model: The fitted model.
    """
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(model).items()}


def from_numbers(numbers: Mapping[str, Any]) -> SkillModel:
    """Return the model that `as_numbers` wrote.

    Args:
        numbers: The model's attributes by their names; arrays as lists.

    Raises:
        BadInput: An array has the wrong shape, or a number is NaN or infinite.
    """
    named = {name: tuple(numbers[name]) for name in ("tasks", "figures")}
    return SkillModel(**{**numbers, **named})


def of_durations(cohort: Cohort) -> Cohort:
    """Return the cohort with the duration alone as its figure.

    Args:
        cohort: The rated trials, with the duration as their first figure.

    Returns:
        The same trials with one side and one figure: `values` of shape (N, 1, 1), `thirds` of shape (N, 1, 3, 1).
    """
    return replace(cohort, values=cohort.values[:, :1, :1], thirds=cohort.thirds[:, :1, :, :1])
