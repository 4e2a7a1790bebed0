"""Models of skill: fitted to a laboratory's folder of rated trials, and stored as plain numbers.

    folder in the layout of JIGSAWS --read_cohort--> Rated --calibrate_on--> Calibration --put_calibration--> row

A model is stored with its provenance: the digests of all files, the settings, the versions of the code, and its
accuracy on surgeons that were left out of the fit. The trials themselves and their names are not stored. It rates only
the tasks for which the evidence suffices (`accepted`).
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills import __version__
from skills.db.models import StoredCalibration
from skills.db.service_tables import record_event
from skills.errors import BadInput, BadRecording, Corrupt
from skills.formats import jigsaws
from skills.formats.jigsaws import Trial
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy, did_you_mean
from skills.schemas.calibrations import Calibration, CalibrationSettings, RatedTrials, TaskCounts
from skills.scoring import calibration
from skills.scoring.features import TRIAL_NAMES as FIGURES
from skills.scoring.features import TrialFigures, measure_trial
from skills.scoring.validation import BOOTSTRAPS, NOTHING, PERMUTATIONS, refusals, validate

NAMED = 5  # the most trials that an error names
LIBRARIES = ("scipy", "numpy")  # the libraries that compute the numbers
VERSION = 1  # of what is stored; a calibration of another version is not used


@dataclass(frozen=True)
class Rated:
    """A cohort, its source, and the names of trials that were left out, by the reason."""

    cohort: calibration.Cohort
    data: RatedTrials
    left_out: dict[str, list[str]]


def read_cohort(folder: Path, *, tasks: Sequence[str] = (), progress: Callable[[float], None] = NOTHING) -> Rated:
    """Read the rated trials of a folder in the layout of JIGSAWS.

    A letter is the same surgeon in all tasks.

    Args:
        folder: The data set, or the folder of one task.
        tasks: Such as "Suturing"; without any, all of the folder.
        progress: Callback, called with the share that is done, 0 to 1.

    Raises:
        BadInput: There is no such trial, none that is rated, or none that can be measured; a rating cannot be read; or
            an error of `Cohort`.
        BadRecording: A file cannot be read as a recording; the message names it.
    """
    trials = _of_tasks(folder, tasks)
    for task in sorted({trial.task for trial in trials}):
        _check_ratings([trial for trial in trials if trial.task == task])
    rated = [(trial, trial.rated) for trial in trials if trial.rated is not None]
    empty = [trial.name for trial, _ in rated if trial.kinematics.stat().st_size == 0]
    moving = [one for one in rated if one[0].name not in empty]
    measured = []
    for number, (trial, rating) in enumerate(moving, 1):
        measured.append((trial, rating, _measured(trial)))
        progress(number / len(moving))
    used = [(trial, rating, figures) for trial, rating, figures in measured if figures is not None]
    if not used:
        raise BadInput(f"None of {len(moving)} trials can be measured: a trial has both instruments and some seconds.")
    users, names = sorted({trial.user for trial, *_ in used}), sorted({trial.task for trial, *_ in used})
    cohort = calibration.Cohort(
        names=tuple(names),
        values=np.stack([figures.values for *_, figures in used]),
        thirds=np.stack([figures.thirds for *_, figures in used]),
        tasks=np.array([names.index(trial.task) for trial, *_ in used]),
        surgeons=np.array([users.index(trial.user) for trial, *_ in used]),
        repetitions=np.array([trial.number for trial, *_ in used]),
        ratings=np.array([(rating.score, *rating.parts) for _, rating, _ in used], np.float64),
        levels=np.array([calibration.LEVELS.index(rating.skill) for _, rating, _ in used]),
    )
    data = RatedTrials(
        tasks={name: _counts([(trial, rating) for trial, rating, _ in used if trial.task == name]) for name in names},
        left_out=len(trials) - len(used),
        surgeons=len(users),
        trials=len(used),
        files=sorted(map(_digest, {trial.kinematics for trial in trials} | {trial.meta for trial in trials})),
    )
    left_out = {
        "rated, but without a kinematics file": _without_file(trials),
        "unrated": [trial.name for trial in trials if trial.rated is None],
        "empty": empty,
        "too short to be measured": [trial.name for trial, _, figures in measured if figures is None],
    }
    return Rated(cohort, data, {why: names for why, names in left_out.items() if names})


def calibrate_on(
    rated: Rated, *, seed: int = 0, permutations: int = PERMUTATIONS, progress: Callable[[float], None] = NOTHING
) -> Calibration:
    """Fit a model, validate it on surgeons left out, and return both with their provenance."""
    found, judged = validate(rated.cohort, seed=seed, permutations=permutations, progress=progress)
    return Calibration(
        version=VERSION,
        model=calibration.as_numbers(calibration.calibrate(rated.cohort, found)),
        data=rated.data,
        validated=judged,
        settings=CalibrationSettings(
            strengths=list(calibration.STRENGTHS), seed=seed, permutations=permutations, bootstraps=BOOTSTRAPS
        ),
        versions={"suture-skills": __version__} | {name: version(name) for name in LIBRARIES},
    )


def accepted(about: Calibration) -> list[str]:
    """Return the tasks that a calibration rates."""
    return [name for name, judged in about.validated.tasks.items() if not refusals(judged)]


def put_calibration(session: Session, about: Calibration, actor: str) -> tuple[StoredCalibration, bool]:
    """Store a calibration, which becomes the current one; return the row, and whether it is new.

    Raises:
        BadInput: On no task is the model better than chance and than the duration alone; nothing is stored.
    """
    if not accepted(about):
        judged = about.validated
        why = " ".join(f"{name}: {' '.join(refusals(one))}" for name, one in judged.tasks.items())
        raise BadInput(
            f"The model is not accepted, and nothing was stored. {why} These figures are for surgeons left out of the "
            "fit. Calibrate on rated trials of more surgeons, in one set-up.",
            rho=judged.mean.model.rho,
        )
    digest = digest_of(about)
    current = newest(session)
    if current is not None and current.sha256 == digest:
        return current, False
    stored = StoredCalibration(sha256=digest, about=about)
    session.add(stored)
    session.flush()
    record_event(session, actor, "add", "calibration", digest)
    return stored, True


def digest_of(about: Calibration) -> str:
    """Return the digest of a calibration."""
    return sha256(canonical(about.model_dump(mode="json")))


def newest(session: Session) -> StoredCalibration | None:
    """Return the current calibration, the one stored last; None if there is none."""
    return session.scalar(select(StoredCalibration).order_by(StoredCalibration.row.desc()).limit(1))


def read_calibration(stored: StoredCalibration) -> calibration.SkillModel | None:
    """Return the model of a calibration; None for one of another version, which is not used.

    Raises:
        Corrupt: It does not match its digest, or its numbers are no model.
    """
    if digest_of(stored.about) != stored.sha256:
        raise Corrupt("The stored calibration is damaged.", Remedy(Action.CALIBRATE))
    if stored.about.version != VERSION:
        return None
    try:
        model = calibration.from_numbers(stored.about.model)
        return model if model.figures == FIGURES else None
    except (BadInput, KeyError, TypeError) as error:
        raise Corrupt("The numbers of the stored calibration are no model.", Remedy(Action.CALIBRATE)) from error


def _of_tasks(folder: Path, tasks: Sequence[str]) -> list[Trial]:
    there = list(jigsaws.trials(folder))
    names = sorted({trial.task for trial in there})
    for task in tasks:
        if there and task not in names:
            raise BadInput(f"{folder} has trials of {', '.join(names)}, not of {task}.", *did_you_mean(task, names))
    found = [trial for trial in there if not tasks or trial.task in tasks]
    if not found:
        raise BadInput(
            f"{folder} has no trials of JIGSAWS; they are expected as "
            "TASK/kinematics/AllGestures/TASK_B001.txt, with TASK/meta_file_TASK.txt."
        )
    twice = [name for name, count in Counter(trial.name for trial in found).items() if count > 1]
    if twice:
        raise BadInput(
            f"The folder has {len(twice)} trials more than once, such as {twice[0]}; name the folder of one copy."
        )
    return found


def _check_ratings(trials: Sequence[Trial]) -> None:
    """Refuse the trials of a task whose ratings cannot be used.

    Raises:
        BadInput: The file of ratings is missing, has none of these trials, or has one that cannot be read.
    """
    meta = trials[0].meta
    if not meta.is_file():
        raise BadInput(
            f"There is no {meta}; it must have the ratings, one line per trial: TASK_B001, N, 13, 3 2 1 2 2 3."
        )
    rated = {trial.name: trial.rated for trial in trials if trial.rated is not None}
    listed = {line.split()[0] for line in meta.read_text(errors="replace").splitlines() if line.split()}
    unread = [trial.name for trial in trials if trial.name not in rated and (trial.name in listed or not rated)]
    if unread:
        some = ", ".join(unread[:NAMED]) + (", ..." if len(unread) > NAMED else "")
        raise BadInput(
            f"{meta} has no readable rating for {len(unread)} of {len(trials)} trials: {some}. Names must be "
            "those of the files, and a line has a name, N, I or E, the score, and its six parts, all whole "
            "numbers.",
            unrated=len(unread),
        )
    for name, one in rated.items():
        if not calibration.LEAST_RATING <= one.score <= calibration.MOST_RATING:
            limits = f"{calibration.LEAST_RATING:g} to {calibration.MOST_RATING:g}"
            raise BadInput(f"{meta} rates {name} with {one.score}; the global rating score is {limits}.")


def _counts(used: Sequence[tuple[Trial, jigsaws.RatedTrial]]) -> TaskCounts:
    """Return the numbers of trials, surgeons and levels of a task."""
    levels = Counter(rating.skill for _, rating in used)
    users = {trial.user for trial, _ in used}
    return TaskCounts(trials=len(used), surgeons=len(users), levels=dict(sorted(levels.items())))


def _without_file(trials: Sequence[Trial]) -> list[str]:
    """Return the names of the trials that have a rating and no file."""
    texts = [meta.read_text(errors="replace") for meta in {trial.meta for trial in trials}]
    listed = {name for text in texts for name in jigsaws.read_meta(text)}
    return sorted(listed - {trial.name for trial in trials})


def _measured(trial: Trial) -> TrialFigures | None:
    """Measure a trial; None for one that is too short.

    Raises:
        BadRecording: A file cannot be read; the message names it.
    """
    try:
        with trial.kinematics.open("rb") as file:
            recording = jigsaws.read_jigsaws(file)
    except BadRecording as error:
        raise type(error)(f"{trial.kinematics}: {error.message}", *error.remedies, **error.numbers) from error
    try:
        return measure_trial(recording)
    except BadInput:
        return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
