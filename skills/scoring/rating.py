"""The rating of a whole trial by a calibrated model: points, what they come from, and in which third of the trial.

    SkillModel, TrialFigures --rate--> Skill

A term is the number of points by which a figure moves the rating from the mean of the calibration's trials of the task;
the terms add up to the rating. The same weights on the figures of each third of the trial, against the same third of
the calibration's trials, show where the motion differs; these do not add up to the rating, because most figures of a
trial are not sums of those of its parts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from skills.arrays import Floats
from skills.errors import BadInput
from skills.fields import Fraction, Sha256, percent, schema
from skills.scoring.calibration import LEAST_RATING, LEVELS, MOST_RATING, PARTS, SkillModel
from skills.scoring.features import SIDES, TRIAL_KIND_OF, FigureKind, TrialFigures
from skills.scoring.validation import TaskValidation, known_parts, level_refusals

NAMED = 3  # terms in the sentence
THIRD_NAMES = ("first", "middle", "last")


@schema
@dataclass(frozen=True)
class Term(FigureKind):
    """What one figure of the trial adds to its rating.

    Attributes:
        unit: Empty for a number without a unit.
        value: The trial's.
        typical: The mean of the calibration's trials of the task.
        points: Added to the rating.
        thirds: The same weight on this figure of the first, middle and last third of the trial's time, against the same
            third of the calibration's trials, in points; they do not add up to `points`.
    """

    value: float
    typical: float
    points: float
    thirds: tuple[float, float, float]


@schema
@dataclass(frozen=True)
class Skill:
    """The rating of the whole recording of a motion by the calibrated model; null where there is none.

    Attributes:
        calibrated: Whether there is a rating.
        calibration: Digest of the calibration.
        words: The cohort of the calibration, the quality of the model there, and the rating; or why there is none.
        task: The task of the calibration.
        rating: The global rating score, 6 to 30.
        interval: Its interval at 90 %, as far as the trial is like those of the calibration.
        parts: The parts of the rating that the model predicts better than by chance, 1 to 5.
        levels: Share of each skill level among the trials that the model, without their surgeon, rated as of the same
            level; null if the model is not better at levels than chance and duration.
        terms: What each figure adds to the rating, the largest first.
        outside: Sentences on the figures outside the range of the calibration; with any, do not rely on the rating.
    """

    calibrated: bool
    calibration: Sha256 | None
    words: tuple[str, ...]
    task: str | None = None
    rating: float | None = None
    interval: tuple[float, float] | None = None
    parts: dict[str, float] | None = None
    levels: dict[str, Fraction] | None = None
    terms: tuple[Term, ...] = ()
    outside: tuple[str, ...] = ()


def unrated(why: str) -> Skill:
    """Return the result for a trial that no model rates, with the reason.

    Args:
        why: The reason, one sentence or more.
    """
    return Skill(calibrated=False, calibration=None, words=(why,))


def rate(model: SkillModel, name: str, trial: TrialFigures, calibration: str, judged: TaskValidation) -> Skill:
    """Rate a trial.

    Args:
        model: The fitted model.
        name: The trial's task, one of the model's.
        trial: Its figures.
        calibration: Digest of the calibration that the model is part of.
        judged: The model judged on the task, which is one that may be rated.

    Raises:
        BadInput: The model needs the masters, and they were not recorded.
    """
    if model.masters and len(trial.values) < len(SIDES):
        raise BadInput(
            "The calibrated model needs both masters, each with pose, orientation and gripper, and the recording does "
            "not have them. Record them."
        )
    task = model.tasks.index(name)
    sides = slice(None) if model.masters else slice(1)
    values, thirds = trial.values[sides].mean(axis=0), trial.thirds[sides].mean(axis=0)
    rating, *parts = model.ratings(task, values).tolist()
    margin = float(model.margins[task])
    low, high = np.clip([rating - margin, rating + margin], LEAST_RATING, MOST_RATING).tolist()
    terms = tuple(_terms(model, task, values, thirds))
    said = int(np.abs(np.where(model.level_ratings[task] > 0, model.level_ratings[task], np.inf) - rating).argmin())
    levels_refused = level_refusals(judged)
    levels = dict(zip(LEVELS, model.level_shares[task, said].tolist(), strict=True))
    outside = tuple(_outside(model, task, values))
    words = [
        _describe_quality(name, judged),
        f"It would rate the whole recording {rating:.1f} of 30 (90 %: {low:.1f} to {high:.1f}).",
        _describe_terms(terms),
        _describe_thirds(terms),
    ]
    if levels_refused:
        words.append(f"It gives no skill level. {' '.join(levels_refused)}")
    else:
        level = LEVELS[said]
        words.append(
            f"Nearest is the mean rating of the level {level}: of the trials that it rated so without their surgeon, "
            f"{percent(levels[level])} % were of that level."
        )
    if outside:
        words.append(
            "This recording is unlike what it was calibrated on, so do not rely on this rating: " + " ".join(outside)
        )
    known = known_parts(judged)
    return Skill(
        calibrated=True,
        calibration=calibration,
        words=tuple(words),
        task=name,
        rating=rating,
        interval=(low, high),
        parts={part: points for part, points in zip(PARTS, parts, strict=True) if part in known},
        levels=None if levels_refused else levels,
        terms=terms,
        outside=outside,
    )


def _terms(model: SkillModel, task: int, values: Floats, thirds: Floats) -> Iterator[Term]:
    """Yield the terms of the rating, the largest first."""
    weights = model.weights[task, 0]
    points = model.standard(task, values) * weights
    by_third = (thirds - model.thirds_centre[task]) / model.thirds_scale[task] * weights
    for number in np.argsort(-np.abs(points), kind="stable").tolist():
        kind = TRIAL_KIND_OF[model.figures[number]]
        first, middle, last = by_third[:, number].tolist()
        yield Term(
            name=kind.name,
            unit=kind.unit,
            label=kind.label,
            meaning=kind.meaning,
            value=kind.readable(float(values[number])),
            typical=kind.readable(float(model.centre[task, number])),
            points=float(points[number]),
            thirds=(first, middle, last),
        )


def _describe_quality(name: str, judged: TaskValidation) -> str:
    """Return the quality of the model on a task in a sentence."""
    low, high = judged.model.rho_interval
    return (
        f"Calibrated on {judged.trials} rated trials of {name} by {judged.surgeons} surgeons. For a surgeon left "
        f"out of the fit, it orders trials with a rank correlation of {judged.model.rho:.2f} ({low:.2f} to {high:.2f}; "
        f"shorter trials first: {judged.rivals['shorter_first'].rho:.2f}, chance: {judged.chance.rho:.2f})."
    )


def _describe_terms(terms: Sequence[Term]) -> str:
    """Return the largest terms in a sentence."""
    most = ", ".join(f"{term.label} {term.points:+.1f}" for term in terms[:NAMED])
    return f"From the mean of these trials, the rating moves most by: {most} points."


def _describe_thirds(terms: Sequence[Term]) -> str:
    """Return the sums of the terms in each third in words."""
    sums = [sum(term.thirds[third] for term in terms) for third in range(len(THIRD_NAMES))]
    worst = int(np.argmin(sums))
    cause = min(terms, key=lambda term: term.thirds[worst])
    by_third = ", ".join(f"{name} {points:+.1f}" for name, points in zip(THIRD_NAMES, sums, strict=True))
    return (
        f"Each third of its time against the same third of these trials, by the same weights: {by_third} points. The "
        f"lowest is the {THIRD_NAMES[worst]} third, there most by {cause.label} ({cause.thirds[worst]:+.1f}). These do "
        "not add up to the rating."
    )


def _outside(model: SkillModel, task: int, values: Floats) -> Iterator[str]:
    """Yield a sentence for each figure outside the range of the calibration."""
    for name, value, low, high in zip(model.figures, values, model.lowest[task], model.highest[task], strict=True):
        if not low <= value <= high:
            kind = TRIAL_KIND_OF[name]
            unit = f" {kind.unit}" if kind.unit else ""
            found, least, most = (f"{kind.readable(float(one)):.3g}" for one in (value, low, high))
            yield f"{kind.label} is {found}{unit}; the calibration data has {least} to {most}{unit}."
