"""Data of drawings as plain numbers: a demonstration and the policy learnt from it in 3-D, and signals over time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, PolicyVersion, StoredRewardMap
from skills.db.session import Database
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import press_times, smoothed_speed
from skills.demonstration.recording import Recording
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardMap, sparse_reward
from skills.learning.policy import Policy
from skills.library.operation.integrity import covered, learnt
from skills.library.people.recorded import shown_recording
from skills.library.policies.combined import learnt_from
from skills.library.recordings.recordings import Parser

MOST_STARTS = 20_000  # drawn smoothly by a browser: of a larger grid every second, third, ... cell is returned
MOST_SAMPLES = 1500  # of a line on a screen; twice as many are not visible


def view_of_demo(session: Session, demo: Demonstration) -> dict[str, object]:
    """Return a demonstration as it was recorded, as its path in the grid, and as the rewards of Algorithm 1."""
    stored = session.scalars(select(StoredRewardMap).where(StoredRewardMap.demonstration_row == demo.row)).one()
    return _view(demo.demo, demo.path, stored.map)


def _view(recorded: Demo, path: GridPath, reward: RewardMap) -> dict[str, object]:
    rewards, levels, grid = reward.rewards, reward.levels, path.grid
    special = np.flatnonzero(rewards != levels.other)
    return {
        "frame": recorded.frame,
        "arm": recorded.arm,
        "grid": {"origin_mm": list(grid.origin_mm), "cell_mm": grid.cell_mm, "shape": list(grid.shape)},
        "recorded_mm": _thinned(recorded.tip_mm),
        "path_mm": _rounded(path.tip_mm),
        "rewards": {"at_mm": _rounded(grid.centres_mm(special)), "of": rewards[special].tolist(), "goal": levels.goal},
    }


def view_of_version(version: PolicyVersion) -> dict[str, object]:
    """Return the demonstration that a version was learnt from, and for every cell the rollout that starts there."""
    policy, coverage = learnt(version), covered(version)
    grid = policy.path.grid
    shown = np.arange(grid.n_states)
    every = 1
    # Thin along all three axes until the starts fit.
    while len(shown) > MOST_STARTS:
        every += 1
        shown = np.flatnonzero((grid.cells_of(np.arange(grid.n_states)) % every == 0).all(axis=1))
    moves = moves_to_goal(policy, coverage.reaches)
    return _view(learnt_from(version).demo, policy.path, sparse_reward(policy.path, policy.levels)) | {
        "version": version.version,
        "starts": {
            "every": every,
            "at_mm": _rounded(grid.centres_mm(shown)),
            "reaches": coverage.reaches[shown].tolist(),
            "nearest": coverage.joins_nearest[shown].tolist(),
            "moves": moves[shown].tolist(),
            "share": _rounded(coverage.share[shown]),
        },
    }


def moves_to_goal(policy: Policy, reaches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of moves from every start to the goal, shape (n_states,); -1 if the goal is not reached.

    Args:
        policy: The policy.
        reaches: The starts that reach the goal, shape (n_states,).
    """
    moves, at = policy.moves, policy.domain.start_rows
    counted = np.where(reaches, 0, -1)
    walking = reaches & (at >= 0) & (policy.greedy[at] >= 0)
    while walking.any():
        counted += walking
        finished = moves.finishes[at]
        at = np.where(walking, moves.row[at], at)
        walking &= ~finished & (at >= 0) & (policy.greedy[at] >= 0)
    return counted


def traces_of(database: Database, recording_sha256: str, parse: Parser) -> dict[str, object]:
    """Return the signals of a stored recording's arms, jaws and clutch over time."""
    recording = shown_recording(database, recording_sha256, parse).recording
    return {"duration_s": recording.duration_s, "arms": [_arm(recording, arm) for arm in recording.arms]}


def _arm(recording: Recording, arm: str) -> dict[str, object]:
    motion, jaw = recording.motion_of(arm=arm), recording.jaw_of(arm)
    seconds, speed = smoothed_speed(recording.seconds(motion.stamps_ns), motion.tip_mm)
    return {
        "arm": arm,
        "topic": motion.topic,
        "speed": {"t_s": _thinned(seconds), "mm_s": _thinned(speed)},
        "jaw": jaw and {"t_s": _thinned(recording.seconds(jaw.stamps_ns)), "rad": _thinned(jaw.values)},
        "clutch_s": _pressed(recording),
    }


def _pressed(recording: Recording) -> list[list[float]]:
    """Return the intervals in which the clutch was down, in s, to the end of the recording if it never went up."""
    presses = [] if recording.clutch is None else press_times(recording.clutch)
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    spans_ns = np.array([(down, last_ns if up is None else up) for down, up in presses], np.int64).reshape(-1, 2)
    return _rounded(recording.seconds(spans_ns))


def _thinned(values: NDArray[Any]) -> list[Any]:
    """Return every n-th sample, rounded; of more than `MOST_SAMPLES`, at least these and less than twice as many."""
    return _rounded(values[:: max(1, len(values) // MOST_SAMPLES)])


def _rounded(values: NDArray[Any]) -> list[Any]:
    """Return numbers rounded to a thousandth, of mm finer than a screen can show."""
    rounded: list[Any] = np.round(values, 3).tolist()
    return rounded
