"""What a view in 3-D is drawn from, as plain numbers for JSON: a demonstration, what was learnt of it, a recording's
signals over time.
"""

import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, PolicyVersion, StoredRewardMap
from skills.db.session import Database
from skills.library.combined import learnt_from
from skills.library.recordings import Reader, find_recording, recording_bytes
from skills.library.verified import covered, learnt
from skills.style.demo import Demo, Recording
from skills.style.grid import GridPath
from skills.style.movement import smoothed_speed
from skills.style.pauses import press_times
from skills.style.policy import Policy
from skills.style.reward import RewardMap, sparse_reward

MOST_STARTS = 20_000  # that a browser draws at ease: of a larger grid every second, third, ... cell is told
MOST_SAMPLES = 1500  # of a line on a screen


def view_of_demo(session: Session, demo: Demonstration) -> dict[str, Any]:
    """Write a demonstration as it was recorded, in its grid, and as the rewards of Algorithm 1."""
    stored = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == demo.row)).one()
    return _view(demo.demo, demo.path, stored.map)


def _view(recorded: Demo, path: GridPath, reward: RewardMap) -> dict[str, Any]:
    rewards, levels, grid = reward.rewards, reward.levels, path.grid
    special = np.flatnonzero(rewards != levels.other)
    every = max(1, len(recorded.tip_mm) // MOST_SAMPLES)
    return {
        "frame": recorded.frame,
        "arm": recorded.arm,
        "grid": {"origin_mm": list(grid.origin_mm), "cell_mm": grid.cell_mm, "shape": list(grid.shape)},
        "recorded_mm": _mm(recorded.tip_mm[::every]),
        "path_mm": _mm(path.tip_mm),
        "rewards": {"at_mm": _mm(grid.centres_mm(special)), "of": rewards[special].tolist(), "goal": levels.goal},
    }


def view_of_version(session: Session, version: PolicyVersion) -> dict[str, Any]:
    """Write what a version was learnt from, and of every cell how the policy starts there."""
    policy, coverage = learnt(version), covered(version)
    grid = policy.path.grid
    shown = np.arange(grid.n_states)
    every = 1
    while len(shown) > MOST_STARTS:
        every += 1
        shown = np.flatnonzero((grid.cells_of(np.arange(grid.n_states)) % every == 0).all(axis=1))
    moves = moves_to_goal(policy, coverage.reaches)
    return _view(learnt_from(version), policy.path, sparse_reward(policy.path, policy.levels)) | {
        "version": version.version,
        "starts": {
            "every": every,
            "at_mm": _mm(grid.centres_mm(shown)),
            "reaches": coverage.reaches[shown].tolist(),
            "nearest": coverage.joins_nearest[shown].tolist(),
            "moves": moves[shown].tolist(),
        },
    }


def moves_to_goal(policy: Policy, reaches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the moves from every start, (n_states,), to the goal; -1 where it is not reached."""
    domain, path, moves = policy.domain, policy.path, policy.moves
    at = np.arange(path.grid.n_states)  # the rows of phase 0
    for state in np.unique(path.states):
        phase, done = domain.start(int(state))
        at[state] = -1 if done else domain.rows_of(phase, path.grid.cells_of(state))
    counted = np.where(reaches, 0, -1)
    walking = reaches & (at >= 0) & (policy.greedy[at] >= 0)
    while walking.any():
        counted += walking
        finished = moves.finishes[at]
        at = np.where(walking, moves.row[at], at)
        walking &= ~finished & (at >= 0) & (policy.greedy[at] >= 0)
    return counted


def traces_of(database: Database, recording_sha256: str, read: Reader) -> dict[str, Any]:
    """Read a stored recording again, for what its arms, jaws and clutch did over time."""
    with tempfile.TemporaryFile() as file:
        with database.reading() as session:
            stored = find_recording(session, recording_sha256)
            reading = dict(stored.reading)
            file.writelines(recording_bytes(session, stored))
        recording = read(file, **reading)
    return {"duration_s": recording.duration_s, "arms": [_arm(recording, arm) for arm in recording.arms]}


def _arm(recording: Recording, arm: str) -> dict[str, Any]:
    motion = recording.motion_of(arm=arm)
    seconds, speed = smoothed_speed(recording.seconds(motion.stamps_ns), motion.tip_mm)
    every = max(1, len(seconds) // MOST_SAMPLES)
    jaw = recording.jaw_of(arm)
    told: dict[str, Any] = {
        "arm": arm,
        "topic": motion.topic,
        "speed": {"t_s": _rounded(seconds[::every]), "mm_s": _rounded(speed[::every])},
        "jaw": None,
        "clutch_s": _pressed(recording),
    }
    if jaw is not None:
        every = max(1, len(jaw.values) // MOST_SAMPLES)
        told["jaw"] = {
            "t_s": _rounded(recording.seconds(jaw.stamps_ns[::every])),
            "rad": _rounded(jaw.values[::every]),
        }
    return told


def _pressed(recording: Recording) -> list[list[float]]:
    """Write when the clutch was down, to the end of the recording where it never went up."""
    presses = [] if recording.clutch is None else press_times(recording.clutch)
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    spans_ns = np.array([(down, last_ns if up is None else up) for down, up in presses], np.int64).reshape(-1, 2)
    return _rounded(recording.seconds(spans_ns))


def _mm(points: NDArray[Any]) -> list[Any]:
    """Write points to a thousandth of a millimetre: more than a screen can show."""
    return _rounded(np.asarray(points, float))


def _rounded(values: NDArray[Any]) -> list[Any]:
    rounded: list[Any] = np.round(values, 3).tolist()
    return rounded
