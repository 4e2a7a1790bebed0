"""Evidence for a model of skill: surgeons left out, permutations, intervals over surgeons, and trivial rivals.

    Cohort --validate--> HeldOut, Validation;   a task of a Validation --refusals--> sentences, none if it is rated

Trials of one surgeon are alike, so a model is judged on surgeons all of whose trials of all tasks are left out, and its
design is chosen on others (`skills.scoring.calibration.left_out_scores`). Every task is judged by itself, by the rank
correlation of the scores with the ratings.

Chance is measured and not assumed: the same, choice included, is repeated with the ratings of a surgeon given to
another one. Intervals are of a bootstrap over surgeons, on the same draws for the model and its rivals (`RIVALS`). The
duration competes in two forms, fitted and not, because a rival that is fitted may fall for reasons of its own; the
better one of each draw counts.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from skills.arithmetic import wilson
from skills.arrays import Floats, Ints
from skills.errors import BadInput
from skills.fields import percent
from skills.scoring.calibration import (
    PARTS,
    Cohort,
    Design,
    HeldOut,
    held_out,
    left_out_scores,
    of_durations,
    rank_correlations,
)

BOOTSTRAPS = 2000
DRAWN_AT_ONCE = 100_000  # trials, whose ranks take some 10 MB
PERMUTATIONS = 200
PERMUTED_AT_ONCE = 25
ACCEPTED_P = 0.025  # ours: greatest p-value of an accepted model against chance
LEAST_PERMUTATIONS = 39  # p is at least 1 / (permutations + 1): of fewer, it is above `ACCEPTED_P` for every model
ENOUGH = (40, 5)  # surgeons, and trials of each: of simulated cohorts with a plain signal, so many are accepted
RIVALS = {
    "shorter_first": "shorter trials first, not fitted",
    "duration": "duration, fitted",
    "mean": "mean, and most frequent level",
    "same_surgeon": "mean of the surgeon's other trials",
}
DURATIONS = ("shorter_first", "duration")
SEEN = ("same_surgeon",)  # rivals that have seen the surgeon, beside a repetition left out
NOTHING: Callable[[float], None] = lambda share: None  # noqa: E731


@dataclass(frozen=True)
class Judged:
    """The quality of predictions for the trials of one task.

    Attributes:
        rho: Spearman's rank correlation with the ratings.
        rho_interval: Its interval at 95 %: a bootstrap over surgeons.
        accuracy: Share of trials with the correct level; None for an order that has no levels.
        accuracy_interval: Its interval at 95 % (Wilson), if trials were independent, which they are not quite.
    """

    rho: float
    rho_interval: tuple[float, float]
    accuracy: float | None = None
    accuracy_interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class Chance:
    """The quality of predictions when there is nothing to predict: ratings and levels permuted among the surgeons.

    Attributes:
        permutations: Number of permutations.
        rho: The mean rank correlation.
        rho_p: Share of permutations at least as good as the model, with the model counted as one of them. A permutation
            counts with its best task, so that several tasks give chance no more opportunities than one.
        accuracy: The mean share of correct levels; None for the mean over tasks, as the next two.
        accuracy_p: As `rho_p`, for the share of correct levels.
        commonest: The share of correct levels if the commonest level is always predicted.
    """

    permutations: int
    rho: float
    rho_p: float
    accuracy: float | None = None
    accuracy_p: float | None = None
    commonest: float | None = None


@dataclass(frozen=True)
class TaskValidation:
    """The model judged on one task, or the mean of the rank correlations of all tasks.

    Attributes:
        trials: Number of trials.
        surgeons: Number of surgeons.
        model: The model, for surgeons left out.
        repetition_out: The same design with one repetition of all surgeons left out: it has seen the surgeon.
        rivals: Trivial predictions, by the names of `RIVALS`.
        parts: The model's parts of the rating, for surgeons left out.
        chance: Permuted ratings and levels.
        over_duration: Interval at 95 % of the model's rho minus the greater of `DURATIONS`: a bootstrap over surgeons.
    """

    trials: int
    surgeons: int
    model: Judged
    repetition_out: Judged
    rivals: dict[str, Judged]
    parts: dict[str, Judged]
    chance: Chance
    over_duration: tuple[float, float]


@dataclass(frozen=True)
class Validation:
    """A model judged on surgeons left out.

    Attributes:
        tasks: Each task.
        mean: Rank correlations averaged over the tasks.
        chosen: How often each design was chosen with a surgeon left out, in words.
    """

    tasks: dict[str, TaskValidation]
    mean: TaskValidation
    chosen: dict[str, int]


def validate(
    cohort: Cohort, *, seed: int = 0, permutations: int = PERMUTATIONS, progress: Callable[[float], None] = NOTHING
) -> tuple[HeldOut, Validation]:
    """Judge the model on surgeons left out.

    Args:
        cohort: The rated trials.
        seed: Seed of the bootstrap and the permutations.
        permutations: Number of permutations for chance.
        progress: Callback, called with the finished share, 0 to 1.

    Returns:
        The model's predictions for surgeons left out, and the quality of the model, of its trivial rivals, and of
        chance.

    Raises:
        BadInput: As in `check_permutations`.
    """
    check_permutations(permutations)
    found = held_out(cohort)
    series, levels = _predictions(cohort, found)
    rhos, drawn = _rhos(cohort, series, np.random.default_rng(seed))
    permuted_rhos, permuted_rights = _permuted(cohort, np.random.default_rng([seed, 1]), permutations, progress)

    def judged(rhos: Floats, drawn: Floats, rows: Ints | None = None) -> dict[str, Judged]:
        """Return the quality of each series; with the accuracy of levels if the trials of a task are given."""
        found = {name: _judged(*of_one) for name, *of_one in zip(series, rhos, drawn, strict=True)}
        if rows is None:
            return found
        right = {name: int((said[rows] == cohort.levels[rows]).sum()) for name, said in levels.items()}
        with_levels = {
            name: replace(found[name], accuracy=count / len(rows), accuracy_interval=wilson(count, len(rows)))
            for name, count in right.items()
        }
        return found | with_levels

    tasks = {}
    for task, (name, rows) in enumerate(zip(cohort.names, cohort.by_task, strict=True)):
        of_task, rights = judged(rhos[task], drawn[task], rows), permuted_rights[task]
        chance = Chance(
            permutations,
            rho=float(permuted_rhos[task].mean()),
            rho_p=_p(permuted_rhos.max(axis=0), of_task["model"].rho),
            accuracy=float(rights.mean()),
            accuracy_p=_p(permuted_rights.max(axis=0), of_task["model"].accuracy or 0.0),
            commonest=float(np.bincount(cohort.levels[rows]).max() / len(rows)),
        )
        surgeons = len(np.unique(cohort.surgeons[rows]))
        tasks[name] = _validation(len(rows), surgeons, of_task, chance, dict(zip(series, drawn[task], strict=True)))
    mean, by_chance = judged(rhos.mean(axis=0), drawn.mean(axis=0)), permuted_rhos.mean(axis=0)
    overall = _validation(
        len(cohort.tasks),
        len(np.unique(cohort.surgeons)),
        mean,
        Chance(permutations, rho=float(by_chance.mean()), rho_p=_p(by_chance, mean["model"].rho)),
        dict(zip(series, drawn.mean(axis=0), strict=True)),
    )
    chosen = {_describe_design(design): count for design, count in found.chosen.items() if count}
    return found, Validation(tasks, overall, chosen)


def _describe_design(design: Design) -> str:
    side = "instruments and masters" if design.masters else "instruments"
    return f"{side}, tasks {'together' if design.together else 'apart'}, strength {design.strength:g}"


def _predictions(cohort: Cohort, found: HeldOut) -> tuple[dict[str, Floats], dict[str, Ints]]:
    """Return the predictions of the model and its rivals for every trial, (N,), and the levels of some, (N,)."""
    by_repetition = left_out_scores(cohort, cohort.repetitions, cohort.ratings[:, :1, None]).scores
    durations = of_durations(cohort)
    by_duration = held_out(durations)
    ratings = cohort.ratings[:, 0]
    mean, same, commonest = ratings.copy(), ratings.copy(), cohort.levels.copy()
    for of_task in cohort.by_task:
        for row in of_task:
            mine = cohort.surgeons[of_task] == cohort.surgeons[row]
            others = of_task[~mine]
            mean[row] = ratings[others].mean()
            commonest[row] = np.bincount(cohort.levels[others]).argmax()
            again = of_task[mine & (cohort.repetitions[of_task] != cohort.repetitions[row])]
            same[row] = ratings[again].mean() if len(again) else mean[row]
    series = {
        "model": found.scores[:, 0, 0],
        "repetition_out": by_repetition[:, 0, 0],
        "shorter_first": -durations.values[:, 0, 0],
        "duration": by_duration.scores[:, 0, 0],
        "mean": mean,
        "same_surgeon": same,
        **{part: found.scores[:, 1 + number, 0] for number, part in enumerate(PARTS)},
    }
    return series, {"model": found.levels[:, 0], "duration": by_duration.levels[:, 0], "mean": commonest}


def _rhos(cohort: Cohort, series: Mapping[str, Floats], rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the rank correlations of M series, (T, M), and on bootstrap draws of surgeons, (T, M, B)."""
    predicted = np.stack(list(series.values()))
    truths = np.stack([cohort.ratings[:, 1 + PARTS.index(name) if name in PARTS else 0] for name in series])
    draws = list(_resampled(cohort.surgeons, rng))
    rhos = np.empty((len(cohort.names), len(series)))
    drawn_rhos = np.zeros((*rhos.shape, len(draws)))
    for task, rows in enumerate(cohort.by_task):
        here = np.zeros(len(cohort.tasks), bool)
        here[rows] = True
        rhos[task] = _each(predicted[:, rows], truths[:, rows])
        of_task = [drawn[here[drawn]] for drawn in draws]
        lengths = np.array([len(drawn) for drawn in of_task])
        for length in np.unique(lengths[lengths > 0]):  # many draws of a length at once, in a tenth of the time
            equal = np.flatnonzero(lengths == length)
            for at in np.array_split(equal, 1 + len(equal) * length // DRAWN_AT_ONCE):
                together = np.stack([of_task[number] for number in at])
                drawn_rhos[task][:, at] = _each(predicted[:, together], truths[:, together])
    return rhos, drawn_rhos


def _each(predicted: Floats, truths: Floats) -> Floats:
    """Return the rank correlation of each series, (M, ..., N), with its truth, (M, ..., N): shape (M, ...)."""
    return np.stack([rank_correlations(one[None], truth)[0] for one, truth in zip(predicted, truths, strict=True)])


def _resampled(surgeons: Ints, rng: np.random.Generator) -> Iterator[Ints]:
    """Draw surgeons with replacement, each with all trials, and yield the trials."""
    trials_of = [np.flatnonzero(surgeons == surgeon) for surgeon in np.unique(surgeons)]
    for _ in range(BOOTSTRAPS):
        yield np.concatenate([trials_of[drawn] for drawn in rng.integers(len(trials_of), size=len(trials_of))])


def _judged(rho: float, drawn: Floats) -> Judged:
    """Return a rank correlation with its interval, from bootstrap draws, (B,)."""
    low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
    return Judged(float(rho), (low, high))


def _validation(
    trials: int, surgeons: int, judged: dict[str, Judged], chance: Chance, drawn: Mapping[str, Floats]
) -> TaskValidation:
    """Return the quality of the model and its rivals together, with the interval of the difference between them."""
    more = drawn["model"] - np.max([drawn[name] for name in DURATIONS], axis=0)
    low, high = np.quantile(more, (0.025, 0.975)).tolist()
    return TaskValidation(
        trials=trials,
        surgeons=surgeons,
        model=judged["model"],
        repetition_out=judged["repetition_out"],
        rivals={name: judged[name] for name in RIVALS},
        parts={name: judged[name] for name in PARTS},
        chance=chance,
        over_duration=(low, high),
    )


def _p(permuted: Floats, ours: float) -> float:
    """Return the p-value of our figure among permuted ones, itself counted as one of them."""
    return float(1 + (permuted >= ours).sum()) / (1 + len(permuted))


def _permuted(
    cohort: Cohort, rng: np.random.Generator, permutations: int, progress: Callable[[float], None]
) -> tuple[Floats, Floats]:
    """Predict permuted ratings for surgeons left out; return rank correlations and shares of right levels, (T, K)."""
    orders = np.stack([shuffled(cohort, rng) for _ in range(permutations)], axis=1)
    rhos, rights = (np.empty((len(cohort.names), permutations)) for _ in range(2))
    for first, last in pairwise([*range(0, permutations, PERMUTED_AT_ONCE), permutations]):
        ratings, levels = cohort.ratings[orders[:, first:last], 0], cohort.levels[orders[:, first:last]]
        held = held_out(cohort, ratings[:, None], levels)
        for task, rows in enumerate(cohort.by_task):
            rhos[task, first:last] = rank_correlations(held.scores[rows, 0].T[None], ratings[rows].T)[0]
            rights[task, first:last] = (held.levels[rows] == levels[rows]).mean(axis=0)
        progress(last / permutations)
    return rhos, rights


def shuffled(cohort: Cohort, rng: np.random.Generator) -> Ints:
    """Permute the surgeons, and return the trial whose rating and level each trial receives, shape (N,).

    A surgeon receives those of one other surgeon in all tasks, in order. Where that one has no trials of a task, the
    one counts from whom that one receives. A surgeon with fewer trials than ratings received leaves some out; one with
    more begins again with the first.

    Args:
        cohort: The rated trials.
        rng: Generator of the permutation.
    """
    names = np.unique(cohort.surgeons)
    giver = dict(zip(names.tolist(), rng.permutation(names).tolist(), strict=True))
    order = np.empty(len(cohort.tasks), np.int64)
    for of_task in cohort.by_task:
        here = cohort.surgeons[of_task]
        rows = {name: of_task[here == name] for name in np.unique(here).tolist()}
        for name, mine in rows.items():
            source = giver[name]
            while source not in rows:
                source = giver[source]
            order[mine] = np.resize(rows[source], len(mine))
    return order


def check_permutations(permutations: int) -> None:
    """Refuse a number of permutations with which no model could be accepted.

    Args:
        permutations: Number of random orders with which a model is compared.

    Raises:
        BadInput: There are fewer than `LEAST_PERMUTATIONS`.
    """
    if permutations < LEAST_PERMUTATIONS:
        raise BadInput(
            f"{permutations} permutations can accept no model: p is at least 1 of {permutations + 1}, and at most "
            f"{ACCEPTED_P} is accepted. Give at least {LEAST_PERMUTATIONS}, better {PERMUTATIONS}.",
            permutations=permutations,
        )


def refusals(judged: TaskValidation) -> list[str]:
    """Return the reasons why a task is not rated, one sentence each.

    There is none if its ratings are better than chance and than the duration alone. Every comparison is written so that
    NaN refuses the model.

    Args:
        judged: The model judged on the task.
    """
    rho, (low, high) = judged.model.rho, judged.model.rho_interval
    by_chance, (more_low, more_high) = judged.chance.rho, judged.over_duration
    why = []
    if not (low > 0 and low > by_chance):
        why.append(
            f"Its rank correlation may be no better than by chance ({rho:.2f}, 95 %: {low:.2f} to {high:.2f}; by "
            f"chance {by_chance:.2f})."
        )
    if not judged.chance.rho_p <= ACCEPTED_P:
        why.append(f"A random order does as well ({_describe_p(judged.chance.rho_p, judged.chance)}).")
    if not more_low > 0:
        duration = max(judged.rivals[name].rho for name in DURATIONS)
        why.append(
            f"It may order trials no better than the duration alone ({duration:.2f}; the difference is "
            f"{more_low:.2f} to {more_high:.2f})."
        )
    if why and judged.surgeons < ENOUGH[0]:
        why.append(
            f"There are {judged.surgeons} surgeons; so few leave such intervals wide, and about {ENOUGH[0]} "
            f"with {ENOUGH[1]} trials each are needed."
        )
    return why


def level_refusals(judged: TaskValidation) -> list[str]:
    """Return the reasons why the levels of a rated task are not given; none if they are better than the rivals' too.

    A surgeon's level is stated by the surgeon and need not follow the ratings, so it is judged by itself.

    Args:
        judged: The model judged on a task, and not on the mean of several.
    """
    given = judged.model.accuracy, judged.chance.commonest, judged.rivals["duration"].accuracy, judged.chance.accuracy_p
    right, commonest, by_duration, right_p = (np.nan if one is None else one for one in given)
    why = []
    if not right_p <= ACCEPTED_P:
        why.append(f"Random levels are right as often ({_describe_p(right_p, judged.chance)}).")
    if not (right > commonest and right > by_duration):
        why.append(
            f"It is right about the level in {percent(right)} % of the trials, the most frequent level in "
            f"{percent(commonest)} %, the duration alone in {percent(by_duration)} %."
        )
    return why


def known_parts(judged: TaskValidation) -> tuple[str, ...]:
    """Return the parts of a rated task's rating that are predicted better than by chance, by their names.

    Args:
        judged: The model judged on a task, and not on the mean of several.
    """
    lows = {name: part.rho_interval[0] for name, part in judged.parts.items()}
    return tuple(name for name, low in lows.items() if low > 0 and low > judged.chance.rho)


def _describe_p(p: float, chance: Chance) -> str:
    """Describe a p-value above `ACCEPTED_P`, and whether it may be above it for want of permutations."""
    said = f"p = {p:.3f}; at most {ACCEPTED_P} is accepted"
    if np.isnan(p):
        return said
    low, high = wilson(round(p * (chance.permutations + 1)) - 1, chance.permutations)
    if low > ACCEPTED_P:
        return said
    return (
        f"{said}; it may be {low:.3f} to {high:.3f}, because {chance.permutations} permutations are few: calibrate "
        "again with more"
    )
