"""Whose hand-off it is, on real surgeons: two tasks of JIGSAWS, leaving the trial out.

`SKILLS_TEST_JIGSAWS` names the folder of the archive. Every hand-off that is proposed for either instrument is
recognised by those of the same instrument in other trials. A trial is recognised by all its movements, of which the
proposals are some: each is recognised by the movements of other trials, and they vote. Settings and temperature are
chosen on the training trials alone. The rivals have the same metric with fewer numbers, or the nearest neighbour by
DTW. The trials are what the library calls sessions: the data set does not say which were recorded on one day.
"""

import os
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path

import numpy as np
from rich.table import Table

from skills.arithmetic import wilson
from skills.comparison.distances import STATES, distances, resampled, shape_of
from skills.comparison.recognition import FAMILIES, NUMBERS, Validated, signature_of, usable, validate, vote
from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.recording import Recording
from skills.demonstration.segments import Segment, movements_by_arm, propose_by_arm
from skills.errors import BadPath
from skills.formats.jigsaws import read_jigsaws, trials

TASKS = {"knot_tying": "Knot_Tying", "needle_passing": "Needle_Passing"}  # folders of the archive, and their names
DRAWS = 2000  # of the bootstrap over trials
BINS = 5
Parts = Callable[[Recording], Sequence[Segment]]
MAKES_NO_SENSE = 1e9  # a distance between motions of one trial, so that none is its own nearest neighbour


@dataclass(frozen=True, eq=False)
class HandOff:
    """A proposed hand-off of a trial, or another movement of it."""

    user: str
    trial: str
    arm: str
    demo: Demo


def recordings() -> Iterator[tuple[str, str, str, Recording]]:
    """Yield task, surgeon, name and recording of each trial that is not empty."""
    (archive,) = Path(os.environ["SKILLS_TEST_JIGSAWS"]).glob("*.tar.xz")
    with tempfile.TemporaryDirectory() as name, tarfile.open(archive) as packed:
        for member in packed:
            task = TASKS.get(Path(member.name).parent.name)
            content = packed.extractfile(member)
            if task is None or content is None:
                continue
            to = Path(name, task, "kinematics", "AllGestures", Path(member.name).name)
            to.parent.mkdir(parents=True, exist_ok=True)
            to.write_bytes(content.read())
        for trial in trials(Path(name)):
            if trial.kinematics.stat().st_size == 0:
                continue  # one trial has an empty file
            with trial.kinematics.open("rb") as file:
                yield trial.task, trial.user, trial.name, read_jigsaws(file)


def hand_offs(recording: Recording, user: str, trial: str, parts: Parts = propose_by_arm) -> list[HandOff]:
    """Return the proposed hand-offs, or other parts, of both instruments that have a direction."""
    found = []
    for part in parts(recording):
        demo = cut_demo(recording, arm=part.arm, start_s=part.start_s, end_s=part.end_s)
        try:
            shape_of(demo)
        except BadPath:
            continue
        found.append(HandOff(user, trial, part.arm, demo))
    return found


# ---- methods: the probability of each surgeon, for the hand-offs of one arm -----------------------------------------

Method = Callable[[Sequence[HandOff], "Labels"], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Labels:
    """The surgeon and the trial of each hand-off of one arm, as numbers, and the number of the task's surgeons."""

    truth: np.ndarray
    trials: np.ndarray
    users: int


def learnt(numbers: Callable[[HandOff], np.ndarray], *, place: bool = False, framed: bool = True) -> Method:
    """Recognise by our metric on these numbers; the untested have no probability."""

    def recognise(some: Sequence[HandOff], labels: Labels) -> tuple[np.ndarray, np.ndarray]:
        given = np.array([numbers(one) for one in some])
        sets = usable(given, place=place, one_frame=framed)
        found = validate(given, labels.truth, labels.trials, labels.trials, sets)
        every = np.zeros((len(found.tested), labels.users))
        every[:, found.surgeons] = found.probability
        return found.tested, every

    return recognise


def nearest(path: Callable[[HandOff], np.ndarray]) -> Method:
    """Recognise by the nearest neighbour of another trial, by DTW; it has no probability, so it is sure."""

    def recognise(some: Sequence[HandOff], labels: Labels) -> tuple[np.ndarray, np.ndarray]:
        paths = np.array([path(one) for one in some])
        far = distances(paths, paths)
        far[labels.trials[:, None] == labels.trials] = MAKES_NO_SENSE
        return np.arange(len(some)), np.eye(labels.users)[labels.truth[far.argmin(axis=1)]]

    return recognise


def signature(one: HandOff) -> np.ndarray:
    return signature_of(one.demo)


def alone(numbers: Callable[[Demo], np.ndarray]) -> Callable[[HandOff], np.ndarray]:
    """Return a signature with nothing but some numbers, in the family `tempo`; constants count for nothing."""

    def only(one: HandOff) -> np.ndarray:
        made, values = np.full(NUMBERS, np.nan), np.atleast_1d(numbers(one.demo))
        made[FAMILIES["tempo"]] = np.pad(values, (0, FAMILIES["tempo"].stop - FAMILIES["tempo"].start - len(values)))
        return made

    return only


METHODS: dict[str, Method] = {
    "ours": learnt(signature),
    "ours, with the place": learnt(signature, place=True),
    "ours, without orientation either": learnt(signature, framed=False),
    "nearest shape by DTW": nearest(lambda one: shape_of(one.demo)),
    "nearest path where it was, by DTW": nearest(lambda one: resampled(one.demo.tip_mm, STATES)),
    "duration alone": learnt(alone(lambda demo: np.log(demo.stamps_s[-1]))),
    "first and last position": learnt(alone(lambda demo: demo.tip_mm[[0, -1]].ravel())),
    "mean position": learnt(alone(lambda demo: demo.tip_mm.mean(axis=0))),
}


# ---- figures --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Figures:
    """The figures of a method on one task; by trials: the right hand-offs, all hand-offs, and whether the vote is."""

    right: np.ndarray
    count: np.ndarray
    voted: np.ndarray
    log_loss: float
    sure: np.ndarray
    was: np.ndarray

    @property
    def accuracy(self) -> float:
        return float(self.right.sum() / self.count.sum())

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the accuracy at 95 %, by a bootstrap over trials."""
        drawn = np.random.default_rng(0).integers(0, len(self.count), (DRAWS, len(self.count)))
        low, high = np.quantile(self.right[drawn].sum(axis=1) / self.count[drawn].sum(axis=1), [0.025, 0.975])
        return float(low), float(high)

    @property
    def votes(self) -> float:
        return float(self.voted.mean())

    def curve(self) -> list[tuple[float, float]]:
        """Return said and was of groups of hand-offs with increasing probability."""
        parts = np.array_split(np.argsort(self.sure, kind="stable"), BINS)
        return [(float(self.sure[part].mean()), float(self.was[part].mean())) for part in parts]


def judged(some: Sequence[HandOff], method: Method) -> Figures:
    """Recognise the hand-offs of a task, each within its arm, and count by trials."""
    users = sorted({one.user for one in some})
    ballots: dict[str, list[np.ndarray]] = {}
    said, truth_of, losses = [], {one.trial: users.index(one.user) for one in some}, []
    trial_of = []
    for arm in sorted({one.arm for one in some}):
        mine = [one for one in some if one.arm == arm]
        trial = np.unique([one.trial for one in mine], return_inverse=True)[1]
        truth = np.array([users.index(one.user) for one in mine])
        tested, probability = method(mine, Labels(truth, trial, len(users)))
        several = np.array([len(np.unique(trial[truth == truth[one]])) > 1 for one in tested])
        for one, found in zip(tested[several].tolist(), probability[several], strict=True):
            ballots.setdefault(mine[one].trial, []).append(found)
            losses.append(-log(max(float(found[truth[one]]), 1e-9)))
            said.append((float(found.max()), bool(found.argmax() == truth[one])))
            trial_of.append(mine[one].trial)
    names = sorted(ballots)
    sure, was = (np.array(column, float) for column in zip(*said, strict=True))
    right = np.array([was[[at for at, name in enumerate(trial_of) if name == one]].sum() for one in names])
    voted = np.array([vote(np.array(ballots[one])).argmax() == truth_of[one] for one in names])
    return Figures(right, np.array([len(ballots[one]) for one in names]), voted, float(np.mean(losses)), sure, was)


def by_task(parts: Parts = propose_by_arm) -> dict[str, list[HandOff]]:
    """Return the hand-offs, or other parts, of each task."""
    found: dict[str, list[HandOff]] = {}
    for task, user, name, recording in recordings():
        found.setdefault(task, []).extend(hand_offs(recording, user, name, parts))
    return found


def whole_trials() -> dict[tuple[str, str], float]:
    """Return how often the nearest other trial, by DTW on the raw positions of both instruments, is the surgeon's.

    The trials are sampled evenly in time, or along the path.
    """
    paths: dict[str, list[tuple[str, Recording]]] = {}
    for task, user, _, recording in recordings():
        paths.setdefault(task, []).append((user, recording))
    shares = {}
    for task, some in paths.items():
        users = np.array([user for user, _ in some])
        several = np.array([(users == user).sum() > 1 for user in users])
        for how, sample in {"in time": in_time, "along the path": along}.items():
            both = np.array([[sample(motion.tip_mm) for motion in recording.motions] for _, recording in some])
            far = sum(distances(both[:, arm], both[:, arm]) for arm in range(2))
            far[np.eye(len(users), dtype=bool)] = MAKES_NO_SENSE
            shares[task, how] = float((users[far.argmin(axis=1)] == users)[several].mean())
    return shares


def in_time(tip_mm: np.ndarray) -> np.ndarray:
    at = np.linspace(0.0, len(tip_mm) - 1.0, 4 * STATES)
    return np.stack([np.interp(at, np.arange(len(tip_mm)), axis) for axis in tip_mm.T], axis=1)


def along(tip_mm: np.ndarray) -> np.ndarray:
    return resampled(tip_mm, 4 * STATES)


def strangers(some: Sequence[HandOff]) -> list[tuple[str, Validated]]:
    """Return the validation of our recognition, for each arm."""
    found = []
    for arm in sorted({one.arm for one in some}):
        mine = [one for one in some if one.arm == arm]
        trial, truth = (
            np.unique(names, return_inverse=True)[1] for names in zip(*((o.trial, o.user) for o in mine), strict=True)
        )
        found.append((arm, validate(np.array([signature(one) for one in mine]), truth, trial, trial)))
    return found


def recognition(table: Table) -> None:
    """Measure all methods on both tasks."""
    if not os.environ.get("SKILLS_TEST_JIGSAWS"):
        table.add_row("recognition", "not measured", "SKILLS_TEST_JIGSAWS names no folder")
        return
    raw = whole_trials()
    for part, tasks in {"hand-offs": by_task(), "movements": by_task(movements_by_arm)}.items():
        for task, some in tasks.items():
            users = len({one.user for one in some})
            table.add_row(f"{task}: guessing", f"{1 / users:.1%}", f"log loss {log(users):.2f}; {len(some)} {part}")
            for name, method in METHODS.items():
                _tell(table, f"{task}, {part}: {name}", judged(some, method), has_loss="nearest" not in name)
            for arm, validated in strangers(some):
                known, unknown = validated.stranger.mean(), validated.unknown.mean()
                table.add_row(f"none of these, {arm}", f"{known:.2f}, {unknown:.2f}", "surgeon known, left out")
    for (task, how), share in raw.items():
        table.add_row(f"{task}: nearest whole trial by DTW", f"{share:.2f}", f"raw positions of both instruments {how}")


def _tell(table: Table, label: str, found: Figures, *, has_loss: bool) -> None:
    low, high = found.interval
    votes = wilson(int(found.voted.sum()), len(found.voted))
    table.add_row(
        label,
        f"{found.accuracy:.1%} ({low:.1%} to {high:.1%})",
        f"log loss {found.log_loss if has_loss else float('nan'):.2f}; votes {found.voted.sum()} of "
        f"{len(found.voted)}: {found.votes:.2f} ({votes[0]:.2f} to {votes[1]:.2f})",
    )
    if has_loss:
        table.add_row("", "said, was", ", ".join(f"{said:.2f} {was:.2f}" for said, was in found.curve()))
