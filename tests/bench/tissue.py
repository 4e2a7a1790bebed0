"""Moves that slip beside tissue and a keep-out box: policies learnt in the scene, and rivals, with the same slips.

The paper's user, whose data `SKILLS_PAPER_DATA` names. Tissue is a plane 5 mm below the deepest state of the path, so a
cell below that state is forbidden. From a corner of the grid a box of 15 mm stands across the shortest way to the path,
or of the second start, the demonstrated one, across nothing.
"""

import os
import sys
from pathlib import Path

import numpy as np
from rich.table import Table

from skills.arrays import Floats, Ints
from skills.gridworld.grid import MOVES, PAPER_GRID, GridPath, discretize
from skills.gridworld.hazards import Hazards, hazards_of
from skills.gridworld.reward import sparse_reward
from skills.gridworld.scene import Box, Scene, Tissue
from skills.gridworld.slip import slip_model
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.in_scene import certify_in_scene, learn_in_scene
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from skills.learning.slip_runs import (
    STOPS,
    Controller,
    FollowPolicy,
    ReplayMoves,
    ReplayPositions,
    StartAnew,
    budget,
    follows,
    shortest_way,
    walk,
)
from tests.learning.two_line_rule import TwoLineRule

RUNS, GAMMA, SLIPS = 1000, 0.95, (0.1, 0.2, 0.3)
CORNER = (0, 0, 10)  # the start cell whose shortest way the box stands across, six moves from the path


class GoRound:
    """The two-line rule of a planner that knows the scene: the fewest moves that do not touch, to each waypoint."""

    def __init__(self, path: GridPath, hazards: Hazards) -> None:
        self.follow = TwoLineRule(path)
        cells = path.grid.cells_of(np.arange(path.grid.n_states))[:, None] + MOVES
        possible = path.grid.holds(cells) & ~hazards.touches
        self.after = np.where(possible, path.grid.states_of(np.where(path.grid.holds(cells)[..., None], cells, 0)), -1)
        self.to_each = np.stack([self.moves_to(path.states[p : p + 1]) for p in range(len(path.states))])
        self.to_path = self.moves_to(path.states)

    def moves_to(self, goals: Ints) -> Floats:
        """Return the fewest moves from each state to the nearest goal, (n_states,), infinite where there is no way."""
        moves = np.full(len(self.after) + 1, np.inf)  # the last one: no move
        moves[goals] = 0.0
        while True:
            fewer = np.minimum(moves[:-1], moves[self.after].min(axis=1) + 1)
            if np.array_equal(fewer, moves[:-1]):
                return moves
            moves[:-1] = fewer

    def decide(self, tick: int, states: Ints, phases: Ints) -> tuple[Ints, Ints]:
        """Make the first action of those that come nearest to the waypoint."""
        actions, phases = self.follow.decide(tick, states, phases)
        joined = self.to_each[phases[:, None], self.after[states]]
        moves = np.where(phases[:, None] > 0, joined, self.to_path[self.after[states]])
        return np.where(actions == STOPS, STOPS, moves.argmin(axis=1)), phases


def tissue(table: Table) -> None:
    """Compare finishing and touching, from both starts."""
    user = np.loadtxt(Path(os.environ["SKILLS_PAPER_DATA"], "user_path_grid11.csv"), delimiter=",")
    path = discretize(1000 * user[:, :3], PAPER_GRID)
    deepest_mm = float(path.tip_mm[:, 2].min())
    flat = Tissue.plane((0.0, 0.0, deepest_mm - 5.0), (0.0, 0.0, 1.0))
    corner = int(path.grid.states_of(CORNER))
    to_path = path.grid.centres_mm(shortest_way(path, corner))
    x, y, z = to_path[int(np.abs(path.cells - CORNER).max(axis=1).min()) // 2]
    box = Box((x - 7.5, y - 7.5, z - 7.5), (x + 7.5, y + 7.5, z + 7.5))
    hazards = hazards_of(Scene("PSM2_base", (box,), tissue=flat), path, "PSM2_base")
    for slip in SLIPS:
        rivals = controllers(path, hazards, slip)
        for name, start in (("box in between", corner), ("demonstrated start", path.start)):
            _compare(table, f"slip {slip}, {name}", rivals | replays(path, start), path, start, hazards, slip)


def controllers(path: GridPath, hazards: Hazards, slip: float) -> dict[str, Controller]:
    """Return ours, learnt with this slip, and the rules."""
    reward = sparse_reward(path)
    exact = learn_in_scene(reward, ValueIteration(GAMMA, slip=slip), hazards)
    learnt = learn_in_scene(reward, PhaseQLearning(alpha=0.02, gamma=GAMMA, slip=slip), hazards)
    for name, policy in (("exact", exact), ("learnt", learnt)):
        print(f"slip {slip}, {name}: {certify_in_scene(policy, hazards)[0]}", file=sys.stderr)
    return {
        "ours, exact": FollowPolicy(exact),
        "ours, exact, starting anew outside its domain": StartAnew(FollowPolicy(exact)),
        "ours, learnt": FollowPolicy(learnt),
        "ours, learnt, starting anew": StartAnew(FollowPolicy(learnt)),
        "ours, learnt without the scene": FollowPolicy(learn_tabular(reward, PhaseQLearning())),
        "two-line rule": TwoLineRule(path),
        "two-line rule that goes round": GoRound(path, hazards),
    }


def replays(path: GridPath, start: int) -> dict[str, Controller]:
    """Return the controllers that are planned from a start."""
    plan, ends = shortest_way(path, start), path.grid.centres_mm([start, path.goal])
    return {
        "replay of moves": ReplayMoves(path.grid, plan),
        "replay of positions by the clock": ReplayPositions(path.grid, plan),
        "straight line to the goal": ReplayPositions(path.grid, discretize(ends, path.grid).states),
    }


def _compare(
    table: Table, name: str, rivals: dict[str, Controller], path: GridPath, start: int, hazards: Hazards, slip: float
) -> None:
    slips = slip_model(slip).draw(runs=RUNS, moves=budget(path), seed=0)
    for rival, controller in rivals.items():
        walks = walk(controller, path, start, slips, hazards.touches)
        assert walks.touched is not None
        finish, touch = (follows(walks) & ~walks.touched).mean(), walks.touched.mean()
        table.add_row(f"{name}: {rival}", f"{finish:.1%} finish", f"{touch:.1%} touch")
