"""Rivals: what slips cost the policy, and the plain ways of doing without one.

Every controller meets the same slips: those of one seed, and a larger probability adds to them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from skills.report.dmp import Primitive, walk_primitive
from skills.style._arrays import Bytes
from skills.style.disturbance import (
    Controller,
    FollowPolicy,
    Odds,
    Outcome,
    StartAnew,
    Walks,
    budget,
    draw_slips,
    judge,
    odds,
    walk,
)
from skills.style.learning.value_iteration import ValueIteration
from skills.style.policy import Policy, learn_policy
from skills.style.reward import sparse_reward
from skills.style.rivals import ReplayMoves, ReplayPositions, shortest_way

SLIPS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
SEED = 0
OURS, ANEW, CELL = "ours: phase and cell", "ours, started anew where lost", "the paper's state: cell"
SOLVED = "ours, solved for this slip"
MOVES_REPLAYED, POSITIONS_REPLAYED, PRIMITIVE = (
    "replay of moves",
    "replay of positions by the clock",
    "dynamic movement primitive",
)

Run = Callable[[Bytes], Walks]


@dataclass(frozen=True)
class Disturbed:
    """How one way of doing it fares with slips of one probability; `exact` says it of ours without drawing."""

    by: str
    slip: float
    outcome: Outcome
    exact: Odds | None


def disturb(ours: Policy, cell: Policy, primitive: Primitive, runs: int) -> tuple[Disturbed, ...]:
    """Run everything from the demonstrated start, so often for each probability of a slip."""
    return tuple(one for slip in SLIPS for one in _at(slip, ours, cell, primitive, runs))


def _at(slip: float, ours: Policy, cell: Policy, primitive: Primitive, runs: int) -> Iterator[Disturbed]:
    path, moves = ours.path, budget(ours.path)
    slips = draw_slips(slip, runs=runs, moves=moves, seed=SEED)
    solved = learn_policy(sparse_reward(path, ours.levels), ValueIteration(slip=slip))
    without_drawing = {OURS: ours, SOLVED: solved}
    for by, run in _runners(ours, solved, cell, primitive).items():
        exact = odds(without_drawing[by], slip, path.start, moves) if by in without_drawing else None
        yield Disturbed(by, slip, judge(run(slips)), exact)


def _runners(ours: Policy, solved: Policy, cell: Policy, primitive: Primitive) -> dict[str, Run]:
    """Name everything that is run; each takes the slips."""
    path = ours.path
    plan = shortest_way(path, path.start)
    controllers: dict[str, Controller] = {
        OURS: FollowPolicy(ours),
        SOLVED: FollowPolicy(solved),
        ANEW: StartAnew(FollowPolicy(ours)),
        CELL: FollowPolicy(cell),
        MOVES_REPLAYED: ReplayMoves(path.grid, plan),
        POSITIONS_REPLAYED: ReplayPositions(path.grid, plan),
    }
    runners: dict[str, Run] = {by: _led_by(controller, ours) for by, controller in controllers.items()}
    runners[PRIMITIVE] = lambda slips: walk_primitive(primitive, np.full(slips.shape[1], path.start), slips)
    return runners


def _led_by(controller: Controller, ours: Policy) -> Run:
    return lambda slips: walk(controller, ours.path, ours.path.start, slips)
