"""Approaches before and after the rule among equally good actions: their length, and the depth that they reach.

An approach leads from a cell to the first waypoint that the policy enters: in phase 0 from every cell off the path to
the joining point, in later phases, after a disturbance, from every cell of the certified domain back to the next
waypoint. "Before" is the lowest index of equally good actions. Depth is the distance from the remote centre.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table

from skills.arrays import Floats, Ints
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import propose_segments
from skills.formats import read_recording
from skills.gridworld.grid import GridPath, choose_grid, discretize
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.policy import Policy, learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.report.numbers import paper_source, sample_source
from skills.settings import Settings

RECORDINGS = ("rosbag2/rosbag2.mcap", "old_transform_stamped.mcap")  # of SKILLS_SAMPLE_RECORDINGS
SEEN_MM = 1e-6  # deeper by less is not deeper


@dataclass(frozen=True, eq=False)
class Approaches:
    """The approaches of a policy, arrays of shape (N,).

    Attributes:
        rows: The rows in which they start.
        length_mm: Their lengths.
        beyond_mm: By how much their deepest cell is deeper than both start and end; 0 if it is not.
    """

    rows: Ints
    length_mm: Floats
    beyond_mm: Floats


def ties(table: Table) -> None:
    """Print length and depth of the approaches before and after, on the paper's user and on real recordings."""
    for name, path in paths():
        now = learn_tabular(sparse_reward(path), PhaseQLearning())
        certificate, _ = certify(now)
        table.add_row(
            f"[bold]{name}: {'x'.join(map(str, path.grid.shape))} cells of {path.grid.cell_mm:g} mm",
            f"{certificate.off_rule} of {certificate.checked} off the rule",
            f"{np.count_nonzero(now.replay.states[: len(path.states)] == path.states)} of {len(path.states)} states, "
            f"{certificate.starts_joining_nearest} of {certificate.starts} starts join nearest",
        )
        for title, later in (("to the path", False), ("back to the next waypoint", True)):
            before, after = approaches(replace(now, ties=None), later=later), approaches(now, later=later)
            for when, one in (("before", before), ("after", after)):
                deeper = one.beyond_mm > SEEN_MM
                table.add_row(
                    f"  {title}, {when}",
                    f"{one.length_mm.mean():.2f} mm in the mean, {one.length_mm.max():.1f} at most",
                    f"{np.count_nonzero(deeper)} of {len(deeper)} ({deeper.mean():.1%}) deeper than both ends, by "
                    f"{one.beyond_mm.max():.1f} mm at most",
                )


def paths() -> Iterator[tuple[str, GridPath]]:
    """Yield the paper's user, a sample, and the hand-offs of real recordings, as far as the data is there."""
    if theirs := paper_source(Settings().paper_data):
        yield theirs.title, theirs.path
    yield "wren, a sample", sample_source().path
    folder = Settings().sample_recordings
    for name in RECORDINGS if folder else ():
        with (Path(folder) / name).open("rb") as file:
            recording = read_recording(file)
        for number, segment in enumerate(propose_segments(recording)):
            demo = cut_demo(recording, start_s=segment.start_s, end_s=segment.end_s)
            yield f"{name}, hand-off {number}", discretize(demo.tip_mm, choose_grid(demo.tip_mm))


def approaches(policy: Policy, *, later: bool) -> Approaches:
    """Follow a policy to the first waypoint from every cell off the path, or from every row of the later phases."""
    domain, path = policy.domain, policy.path
    rows = np.flatnonzero((policy.greedy >= 0) & ((domain.phase_of > 0) == later))
    waypoints = path.states[domain.phase_of[rows]]
    off = domain.state_of[rows] != waypoints if later else ~np.isin(domain.state_of[rows], path.states)
    at = rows = rows[off]
    cells_mm = path.grid.centres_mm(domain.state_of)
    length_mm, deepest_mm = np.zeros(len(rows)), np.zeros(len(rows))
    end_mm = start_mm = np.linalg.norm(cells_mm[rows], axis=1)
    going = np.full(len(rows), True)
    while going.any():
        moved_mm = path.grid.centres_mm(policy.moves.state[at])
        after = policy.moves.row[at]
        length_mm += np.where(going, np.linalg.norm(moved_mm - cells_mm[at], axis=1), 0.0)
        ends = (after < 0) | (domain.phase_of[after] != domain.phase_of[at])
        depth_mm = np.linalg.norm(moved_mm, axis=1)
        deepest_mm = np.where(going & ~ends, np.maximum(deepest_mm, depth_mm), deepest_mm)
        end_mm = np.where(going, depth_mm, end_mm)
        going &= ~ends
        at = np.where(going, after, at)
    return Approaches(rows, length_mm, (deepest_mm - np.maximum(start_mm, end_mm)).clip(0.0))
