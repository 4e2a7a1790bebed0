"""A calibrated model of skill with its provenance, as it is stored and printed."""

from typing import Any

from skills.fields import Count, Sha256
from skills.schemas import Given
from skills.scoring.validation import Validation


class TaskCounts(Given):
    """The numbers of trials, surgeons, and trials by skill level of a task."""

    trials: Count
    surgeons: Count
    levels: dict[str, Count]


class RatedTrials(Given):
    """The trials that a model was fitted to, with the digests of all files; their names are not stored."""

    tasks: dict[str, TaskCounts]
    left_out: Count
    surgeons: Count
    trials: Count
    files: list[Sha256]


class CalibrationSettings(Given):
    """The settings of a fit and its validation."""

    strengths: list[float]
    seed: int
    permutations: int
    bootstraps: int


class Calibration(Given):
    """A model of skill with its data set, its accuracy on surgeons left out, and the versions of the code."""

    version: int
    model: dict[str, Any]  # arrays of any shape, as lists: `skills.scoring.calibration.as_numbers`
    data: RatedTrials
    validated: Validation
    settings: CalibrationSettings
    versions: dict[str, str]
