"""Models of skill: fitted to a folder of rated trials that the laboratory has, and kept as plain numbers.

    folder in the layout of JIGSAWS --read_cohort--> Rated --calibrate_on--> about --keep--> StoredCalibration

A model is kept with what it was made of: the digests of all files, the settings, the versions of the code, how it did
on surgeons that it had not seen. The trials themselves are not kept, nor what they are called.
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
from skills.db.models import StoredCalibration
from skills.errors import BadInput, BadRecording, BadSegment, Corrupt, NotMetres
from skills.library.events import record
from skills.packing import canonical, sha256
from skills.recordings import jigsaws
from skills.recordings.jigsaws import Trial
from skills.style._arrays import Floats
from skills.style.demo import Demo, Recording, cut_demo, propose_segments
from skills.style.scoring import calibrating
from skills.style.scoring.calibrating import NOTHING, PERMUTATIONS, Cohort, calibrate, validate
from skills.style.scoring.figures import measure, modelled
from skills.style.scoring.model import LEAST_RATING, LEVELS, MOST_RATING, SkillModel, as_numbers, from_numbers

Of = Literal["hand-off", "trial"]
NAMED = 5  # trials that a refusal names
LIBRARIES = ("scikit-learn", "scipy", "numpy")  # of which the numbers are


@dataclass(frozen=True)
class Rated:
    """A cohort, and what it was read from."""

    cohort: Cohort
    data: dict[str, Any]


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
        task: Such as "Suturing"; needed where there are several.
        arm: Of "PSM_left" or "PSM_right" only; None of both.
        of: What is measured of a trial: its proposed hand-offs, or all of it.
        told: Is told how much is done, 0 to 1.

    Raises:
        BadInput: There is no such trial, no rating of one, or none in which there is anything to measure; or what
            `Cohort` refuses.
        BadRecording: A file is none; the message names it.
    """
    trials = _one_task(folder, task)
    ratings = _ratings(trials)
    measured: dict[str, list[Floats]] = {}
    for number, trial in enumerate(trials):
        found = [modelled(measure(demo)) for demo in _motions(trial, arm, of)]
        measured[trial.name] = [one for one in found if one is not None]
        told((number + 1) / len(trials))
    kept = [trial for trial in trials if measured[trial.name]]
    if not kept:
        raise BadInput(f"In none of {len(trials)} trials is there a {of} that can be measured; try --of trial.")
    users = sorted({trial.user for trial in kept})
    counts = [len(measured[trial.name]) for trial in kept]
    cohort = Cohort(
        values=np.concatenate([measured[trial.name] for trial in kept]),
        trials=np.repeat(np.arange(len(kept)), counts),
        surgeons=np.array([users.index(trial.user) for trial in kept]),
        ratings=np.array([float(ratings[trial.name].score) for trial in kept]),
        levels=np.array([LEVELS.index(ratings[trial.name].skill) for trial in kept]),
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
        "files": sorted(map(_digest, _files(trials))),
    }
    return Rated(cohort, data)


def calibrate_on(
    rated: Rated, *, seed: int = 0, permutations: int = PERMUTATIONS, told: Callable[[float], None] = NOTHING
) -> dict[str, Any]:
    """Fit a model, judge it on surgeons left out, and write all that there is to know of it."""
    judged = validate(rated.cohort, seed=seed, permutations=permutations, told=told)
    settings = {"ridge": calibrating.RIDGE, "logistic": calibrating.LOGISTIC, "seed": seed}
    return {
        "model": as_numbers(calibrate(rated.cohort)),
        "data": rated.data,
        "validated": asdict(judged),
        "settings": settings | {"permutations": permutations, "bootstraps": calibrating.BOOTSTRAPS},
        "versions": {"suture-skills": __version__} | {name: version(name) for name in LIBRARIES},
    }


def keep(session: Session, about: dict[str, Any], actor: str) -> tuple[StoredCalibration, bool]:
    """Store a calibration, which is the one in use from then on: (the row, whether it is new)."""
    digest = sha256(canonical(about))
    current = newest(session)
    if current is not None and current.sha256 == digest:
        return current, False
    stored = StoredCalibration(sha256=digest, about=about)
    session.add(stored)
    session.flush()
    record(session, actor, "add", "calibration", digest)
    return stored, True


def newest(session: Session) -> StoredCalibration | None:
    """Find the calibration that is in use; None where there is none."""
    return session.scalar(select(StoredCalibration).order_by(StoredCalibration.row.desc()).limit(1))


def read_calibration(stored: StoredCalibration) -> SkillModel:
    """Read the model of a calibration.

    Raises:
        Corrupt: It is not what its digest was taken of, or no model of this version.
    """
    if sha256(canonical(stored.about)) != stored.sha256:
        raise Corrupt("A calibration is not what was calibrated; run `skills calibrate` again.")
    try:
        return from_numbers(stored.about["model"])
    except (BadInput, KeyError, TypeError) as error:
        raise Corrupt("A calibration is none that this version knows; run `skills calibrate` again.") from error


def _one_task(folder: Path, task: str | None) -> list[Trial]:
    found = [trial for trial in jigsaws.trials(folder) if task in (None, trial.task)]
    tasks = sorted({trial.task for trial in found})
    if not found:
        named = f" of the task {task}" if task else ""
        raise BadInput(
            f"{folder} has no trials of JIGSAWS{named}; they are expected as "
            "TASK/kinematics/AllGestures/TASK_B001.txt, with TASK/meta_file_TASK.txt."
        )
    if len(tasks) > 1:
        raise BadInput(f"The folder has trials of {', '.join(tasks)}; name one of them with --task.")
    twice = [name for name, count in Counter(trial.name for trial in found).items() if count > 1]
    if twice:
        raise BadInput(f"The folder has {len(twice)} trials more than once, such as {twice[0]}; name one copy of it.")
    return found


def _ratings(trials: Sequence[Trial]) -> dict[str, jigsaws.Rated]:
    """Take the rating of each trial, by its name.

    Raises:
        BadInput: Trials and ratings do not belong together.
    """
    meta = _meta(trials[0])
    if not meta.is_file():
        raise BadInput(f"There is no {meta}; it has the ratings, a trial in a line: TASK_B001, N, 13, 3 2 1 2 2 3.")
    rated = {trial.name: trial.rated for trial in trials if trial.rated is not None}
    unrated = [trial.name for trial in trials if trial.name not in rated]
    if unrated:
        some = ", ".join(unrated[:NAMED]) + (", ..." if len(unrated) > NAMED else "")
        raise BadInput(
            f"{meta} has no rating that can be read of {len(unrated)} of {len(trials)} trials: {some}. Names must be "
            "those of the files, and a line has a name, N, I or E, the score, and its six parts, all whole numbers.",
            unrated=len(unrated),
        )
    for name, one in rated.items():
        if not LEAST_RATING <= one.score <= MOST_RATING:
            limits = f"{LEAST_RATING:g} to {MOST_RATING:g}"
            raise BadInput(f"{meta} rates {name} with {one.score}; the global rating score is {limits}.")
    return rated


def _meta(trial: Trial) -> Path:
    return trial.kinematics.parents[2] / f"meta_file_{trial.task}.txt"


def _files(trials: Sequence[Trial]) -> set[Path]:
    """Name all files that a cohort was read from."""
    motions = {path for trial in trials for path in (trial.kinematics, trial.transcription) if path is not None}
    return motions | {_meta(trial) for trial in trials}


def _motions(trial: Trial, arm: str | None, of: Of) -> Iterator[Demo]:
    """Cut what is to be measured out of a trial; what is no motion of a hand is passed over."""
    try:
        with trial.kinematics.open("rb") as file:
            transcription = "" if trial.transcription is None else trial.transcription.read_text(errors="replace")
            recording = jigsaws.read_jigsaws(file, transcription)
    except BadRecording as error:
        raise type(error)(f"{trial.kinematics}: {error}", **error.numbers) from error
    arms = recording.arms if arm is None else (arm,)
    for one in arms:
        for start_s, end_s in _spans(recording, one, of):
            try:
                yield cut_demo(recording, arm=one, start_s=start_s, end_s=end_s)
            except (BadSegment, NotMetres):
                continue


def _spans(recording: Recording, arm: str, of: Of) -> Iterator[tuple[float | None, float | None]]:
    if of == "trial":
        yield None, None
    else:
        yield from ((segment.start_s, segment.end_s) for segment in propose_segments(recording, arm))


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
