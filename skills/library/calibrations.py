"""Models of skill: fitted to a laboratory's folder of rated trials, and stored as plain numbers.

    folder in the layout of JIGSAWS --read_cohort--> Rated --calibrate_on--> about --keep--> StoredCalibration

A model is stored with its provenance: the digests of all files, the settings, the versions of the code, and its
accuracy on surgeons that were left out of the fit. The trials themselves and their names are not stored.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills import __version__
from skills.arrays import Floats
from skills.db.models import StoredCalibration
from skills.db.service_tables import record_event
from skills.demonstration.demonstration import Demo, Recording, cut_demo
from skills.demonstration.segments import Segment, propose_by_arm
from skills.errors import BadInput, BadRecording, BadSegment, Corrupt, NotMetres
from skills.formats import jigsaws
from skills.formats.jigsaws import Trial
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy, did_you_mean
from skills.scoring import calibration
from skills.scoring.calibration import (
    LEAST_RATING,
    LEVELS,
    MOST_RATING,
    NOTHING,
    PERMUTATIONS,
    Cohort,
    SkillModel,
    as_numbers,
    calibrate,
    from_numbers,
    validate,
)
from skills.scoring.features import measure, modelled

Of = Literal["hand-off", "trial"]
NAMED = 5  # the most trials that an error names
LIBRARIES = ("scikit-learn", "scipy", "numpy")  # the libraries that compute the numbers


@dataclass(frozen=True)
class Rated:
    """A cohort, its source, and the names of trials that were left out, by the reason."""

    cohort: Cohort
    data: dict[str, Any]
    left_out: dict[str, list[str]]


def read_cohort(
    folder: Path,
    *,
    task: str | None = None,
    arm: str | None = None,
    of: Of = "hand-off",
    told: Callable[[float], None] = NOTHING,
) -> Rated:
    """Read the rated trials of a folder in the layout of JIGSAWS.

    Args:
        folder: The data set, or the folder of one task.
        task: Such as "Suturing"; required if the folder has several.
        arm: "PSM_left" or "PSM_right"; None: both.
        of: The unit of measurement in a trial: its proposed hand-offs, or all of it.
        told: Progress callback, called with the share that is done, 0 to 1.

    Raises:
        BadInput: There is no such trial, none that is rated, or none with a motion that can be measured; a rating
            cannot be read; or an error of `Cohort`.
        BadRecording: A file cannot be read as a recording; the message names it.
    """
    trials = _one_task(folder, task)
    ratings = _ratings(trials)
    empty = [trial for trial in trials if trial.kinematics.stat().st_size == 0]
    rated = [trial for trial in trials if trial.name in ratings and trial not in empty]
    measured: dict[str, _Measured] = {}
    for number, trial in enumerate(rated):
        measured[trial.name] = _measured(trial, arm, of)
        told((number + 1) / len(rated))
    kept = [trial for trial in rated if measured[trial.name].motions]
    if not kept:
        raise BadInput(f"None of {len(rated)} trials has a {of} that can be measured.{_other_unit(of)}")
    users = sorted({trial.user for trial in kept})
    found = [measured[trial.name] for trial in kept]
    counts = [len(one.motions) for one in found]
    by_label = all(one.gestures for one in found)  # or hand-offs, because the two are not comparable
    cohort = Cohort(
        values=np.concatenate([one.motions for one in found]),
        trials=np.repeat(np.arange(len(kept)), counts),
        surgeons=np.array([users.index(trial.user) for trial in kept]),
        ratings=np.array([float(ratings[trial.name].score) for trial in kept]),
        levels=np.array([LEVELS.index(ratings[trial.name].skill) for trial in kept]),
        whole=np.array(
            [(one.duration_s, one.path_mm, one.gestures if by_label else one.hand_offs) for one in found], np.float64
        ),
    )
    data = {
        "task": kept[0].task,
        "of": of,
        "arm": arm,
        "surgeons": len(users),
        "trials": len(kept),
        "motions": sum(counts),
        "left_out": len(trials) - len(kept),
        "levels": dict(sorted(Counter(ratings[trial.name].skill for trial in kept).items())),
        "gestures": "labelled" if by_label else "proposed hand-offs",
        "files": sorted(map(_digest, _files(trials))),
    }
    left_out = {
        "rated, but without a kinematics file": _without_file(trials),
        "unrated": [trial.name for trial in trials if trial.name not in ratings],
        "empty": [trial.name for trial in empty if trial.name in ratings],
        f"without a {of} that can be measured": [trial.name for trial in rated if not measured[trial.name]],
    }
    return Rated(cohort, data, {why: names for why, names in left_out.items() if names})


def calibrate_on(
    rated: Rated, *, seed: int = 0, permutations: int = PERMUTATIONS, told: Callable[[float], None] = NOTHING
) -> dict[str, Any]:
    """Fit a model, validate it on surgeons left out, and return both with their provenance as JSON."""
    judged = validate(rated.cohort, seed=seed, permutations=permutations, told=told)
    settings = {"ridge": calibration.RIDGE, "logistic": calibration.LOGISTIC, "seed": seed}
    return {
        "model": as_numbers(calibrate(rated.cohort)),
        "data": rated.data,
        "validated": asdict(judged),
        "settings": settings | {"permutations": permutations, "bootstraps": calibration.BOOTSTRAPS},
        "versions": {"suture-skills": __version__} | {name: version(name) for name in LIBRARIES},
    }


def keep(session: Session, about: dict[str, Any], actor: str) -> tuple[StoredCalibration, bool]:
    """Store a calibration, which becomes the current one; return the row, and whether it is new.

    Raises:
        BadInput: The model is not better than chance and than the duration alone; nothing is stored.
    """
    refused = calibration.refusals(about["validated"])
    if refused:
        raise BadInput(
            f"The model is not accepted, and nothing was stored. {' '.join(refused)} These figures are for "
            "surgeons left out of the fit. Calibrate on more rated trials of more surgeons, on one task in one "
            f"set-up.{_other_unit(about['data']['of'])}",
            rho=about["validated"]["all_figures"]["rho"],
        )
    digest = sha256(canonical(about))
    current = newest(session)
    if current is not None and current.sha256 == digest:
        return current, False
    stored = StoredCalibration(sha256=digest, about=about)
    session.add(stored)
    session.flush()
    record_event(session, actor, "add", "calibration", digest)
    return stored, True


def newest(session: Session) -> StoredCalibration | None:
    """Return the current calibration; None if there is none."""
    return session.scalar(select(StoredCalibration).order_by(StoredCalibration.row.desc()).limit(1))


def read_calibration(stored: StoredCalibration) -> SkillModel:
    """Return the model of a calibration.

    Raises:
        Corrupt: It does not match its digest, or is of another version.
    """
    if sha256(canonical(stored.about)) != stored.sha256:
        raise Corrupt("The stored calibration is damaged.", Remedy(Action.CALIBRATE))
    try:
        return from_numbers(stored.about["model"])
    except (BadInput, KeyError, TypeError) as error:
        raise Corrupt("The stored calibration belongs to another version.", Remedy(Action.CALIBRATE)) from error


def _one_task(folder: Path, task: str | None) -> list[Trial]:
    there = list(jigsaws.trials(folder))
    tasks = sorted({trial.task for trial in there})
    if there and task not in (None, *tasks):
        raise BadInput(f"{folder} has trials of {', '.join(tasks)}, not of {task}.", *did_you_mean(str(task), tasks))
    found = [trial for trial in there if task in (None, trial.task)]
    if not found:
        raise BadInput(
            f"{folder} has no trials of JIGSAWS; they are expected as "
            "TASK/kinematics/AllGestures/TASK_B001.txt, with TASK/meta_file_TASK.txt."
        )
    if task is None and len(tasks) > 1:
        raise BadInput(f"The folder has trials of {', '.join(tasks)}; name one of them with --task.")
    twice = [name for name, count in Counter(trial.name for trial in found).items() if count > 1]
    if twice:
        raise BadInput(
            f"The folder has {len(twice)} trials more than once, such as {twice[0]}; name the folder of one copy."
        )
    return found


def _ratings(trials: Sequence[Trial]) -> dict[str, jigsaws.RatedTrial]:
    """Return the rating of each trial that has one, by the trial's name.

    Raises:
        BadInput: The file of ratings is missing, has none of these trials, or has one that cannot be read.
    """
    meta = _meta(trials[0])
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
        if not LEAST_RATING <= one.score <= MOST_RATING:
            limits = f"{LEAST_RATING:g} to {MOST_RATING:g}"
            raise BadInput(f"{meta} rates {name} with {one.score}; the global rating score is {limits}.")
    return rated


def _without_file(trials: Sequence[Trial]) -> list[str]:
    """Return the names of the trials that have a rating and no file."""
    rated = jigsaws.read_meta(_meta(trials[0]).read_text(errors="replace"))
    return sorted(rated.keys() - {trial.name for trial in trials})


def _meta(trial: Trial) -> Path:
    return trial.kinematics.parents[2] / f"meta_file_{trial.task}.txt"


def _files(trials: Sequence[Trial]) -> set[Path]:
    """Return the paths of all files that a cohort was read from."""
    motions = {path for trial in trials for path in (trial.kinematics, trial.transcription) if path is not None}
    return motions | {_meta(trial) for trial in trials}


@dataclass(frozen=True)
class _Measured:
    """One trial: the figures of its motions, and trivial figures of all of it.

    Attributes:
        motions: The figures of each motion that has all of the model's.
        duration_s: Duration, from the first sample to the last.
        path_mm: Length of the path of all instruments, tremor and pauses included.
        gestures: Number of labelled gestures; 0 without a transcription.
        hand_offs: Number of proposed hand-offs of all instruments.
    """

    motions: list[Floats]
    duration_s: float
    path_mm: float
    gestures: int
    hand_offs: int


def _measured(trial: Trial, arm: str | None, of: Of) -> _Measured:
    """Measure a trial; a stretch that cannot be cut as a demonstration is skipped.

    Raises:
        BadRecording: A file cannot be read; the message names it.
    """
    try:
        with trial.kinematics.open("rb") as file:
            transcription = "" if trial.transcription is None else trial.transcription.read_text(errors="replace")
            recording = jigsaws.read_jigsaws(file, transcription)
    except BadRecording as error:
        raise type(error)(f"{trial.kinematics}: {error.message}", *error.remedies, **error.numbers) from error
    proposed = propose_by_arm(recording)
    found = (modelled(measure(demo)) for demo in _motions(recording, proposed, arm, of))
    tips_mm = [motion.tip_mm for motion in recording.motions]
    return _Measured(
        motions=[one for one in found if one is not None],
        duration_s=recording.duration_s,
        path_mm=float(sum(np.linalg.norm(np.diff(tip_mm, axis=0), axis=1).sum() for tip_mm in tips_mm)),
        gestures=len(recording.labels),
        hand_offs=len(proposed),
    )


def _motions(recording: Recording, proposed: Sequence[Segment], arm: str | None, of: Of) -> Iterator[Demo]:
    spans: list[tuple[str, float | None, float | None]]
    if of == "trial":
        spans = [(one, None, None) for one in recording.arms]
    else:
        spans = [(one.arm, one.start_s, one.end_s) for one in proposed]
    for one, start_s, end_s in spans:
        if arm in (None, one):
            try:
                yield cut_demo(recording, arm=one, start_s=start_s, end_s=end_s)
            except (BadSegment, NotMetres):
                continue


def _other_unit(of: Of) -> str:
    return " Or try --of trial." if of == "hand-off" else ""


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
