"""Cohorts of rated trials drawn by a known rule, as figures: nothing of them is a recording."""

from typing import Literal

import numpy as np

from skills.scoring.calibration import LEVELS, OUTCOMES, Cohort
from skills.scoring.features import TRIAL_NAMES

Rule = Literal["skill", "plain", "nothing", "surgeon", "duration", "shared"]


def cohort(
    seed: int = 0, rule: Rule = "skill", surgeons: int = 8, trials: int = 5, tasks: int = 1, sides: int = 1
) -> Cohort:
    """Draw a cohort whose figures have an effect of the surgeon, one of the trial, and noise of their own.

    Args:
        seed: Seed of the draw.
        rule: The rule of the ratings: the "skill" that every figure shows, the duration least; a "plain" signal, about
            as large as on real trials (rank correlation 0.73, of the duration 0.45); "nothing"; the "surgeon", by an
            effect that no figure shows; the "duration"; or the duration with all other figures following it ("shared").
        surgeons: Number of surgeons.
        trials: Number of trials of each, in each task.
        tasks: Number of tasks.
        sides: 2 with masters, which move as the instruments.
    """
    rng = np.random.default_rng([seed, len(rule)])
    count = tasks * surgeons * trials
    task, whose, repetition = (one.ravel() for one in np.indices((tasks, surgeons, trials)))

    def effects(size: float) -> np.ndarray:
        """Return a number for each trial: half of its variance is the surgeon's, in all tasks."""
        return size * (rng.normal(size=surgeons)[whose] + rng.normal(size=count)) / np.sqrt(2.0)

    skill, figures = effects(1.0), np.stack([effects(1.0) for _ in TRIAL_NAMES], axis=1)
    if rule == "shared":
        figures[:, 1:] = figures[:, :1] + 0.5 * figures[:, 1:]
    better = np.where(
        np.arange(len(TRIAL_NAMES)) % 2, 1.0, -1.0
    )  # more of one figure is better, more of the other worse
    if rule == "skill":
        figures += skill[:, None] * np.append(-0.5, better[1:])
    if rule == "plain":
        figures += skill[:, None] * np.append(-0.7, 0.4 * better[1:])
    told = {
        "skill": skill + effects(0.3),
        "plain": skill + effects(0.6),
        "nothing": rng.normal(size=count),
        "surgeon": effects(1.0),
        "duration": effects(0.3) - figures[:, 0],
        "shared": effects(0.3) - figures[:, 0],
    }[rule]
    ratings = np.rint(np.clip(18.0 + 5.0 * told / told.std(), 6, 30))
    parts = np.rint(np.clip(ratings[:, None] / 6 + rng.normal(0.0, 0.4, (count, OUTCOMES - 1)), 1, 5))
    means = np.array([ratings[whose == surgeon].mean() for surgeon in range(surgeons)])
    levels = means.argsort().argsort() * len(LEVELS) // surgeons
    noise = rng.normal(0.0, 0.3, (count, sides, len(TRIAL_NAMES)))
    values = figures[:, None] + noise * (np.arange(sides) > 0)[:, None]
    return Cohort(
        names=tuple(f"Task_{letter}" for letter in "ABC"[:tasks]),
        values=values,
        thirds=np.repeat(values[:, :, None], 3, axis=2),
        tasks=task,
        surgeons=whose,
        repetitions=repetition,
        ratings=np.column_stack([ratings, parts]),
        levels=levels[whose],
    )
