"""The policy of a style: what to do in every state of its certified domain, and what following it leads to.

A *greedy* action is the first one of largest Q value. `rollout` follows them from a start to the goal.
"""

from dataclasses import dataclass
from functools import cached_property
from math import dist

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import OutsideGrid
from skills.style import paper
from skills.style._arrays import Bytes, Floats, Ints, frozen
from skills.style.domain import FINISHED, OUTSIDE, Domain, Moves
from skills.style.grid import GridPath
from skills.style.learning.learners import Learner, Tabular, learn_values
from skills.style.learning.q_learning import Training
from skills.style.network import Network
from skills.style.reward import RewardLevels, RewardMap

GUIDED_MM = 50.0  # ours: as far outside its grid as a plan may start; metres given for millimetres are further off


@dataclass(frozen=True, eq=False)
class Policy:
    """What was learnt: Q values of shape (rows, 27) on the domain of a path, and how they were learnt.

    `network` is what a learner beyond the table learnt, of which the Q values are what it says at each cell's centre.
    """

    path: GridPath
    levels: RewardLevels
    learner: Learner
    seed: int
    training: Training
    q: Floats
    network: Network | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(self.q, np.float64, (self.domain.n_rows, paper.N_ACTIONS), "q"))

    @cached_property
    def domain(self) -> Domain:
        """The certified domain."""
        return Domain(self.path, self.learner.phased)

    @cached_property
    def greedy(self) -> Bytes:
        """The action of each row, (rows,): 0 to 26, `FINISHED` or `OUTSIDE`."""
        actions = self.q.argmax(axis=1)
        actions[self.domain.terminal] = FINISHED
        actions[~self.domain.certified] = OUTSIDE
        return frozen(actions, np.int8, (self.domain.n_rows,), "greedy")

    @cached_property
    def confidence(self) -> Floats:
        """How far the best action of each row stands out, (rows,): 1 - Q2 / Q1, and 0 where Q1 <= 0."""
        second, first = np.partition(self.q, -2, axis=1)[:, -2:].T
        sure = np.where(first > 0, 1 - second / np.where(first > 0, first, 1.0), 0.0)
        return frozen(sure, np.float64, (self.domain.n_rows,), "confidence")

    @cached_property
    def moves(self) -> Moves:
        """Where the greedy action of each row leads, (rows,); of no meaning where there is none."""
        return self.domain.move(np.arange(self.domain.n_rows), self.greedy.astype(np.int64).clip(0))

    @cached_property
    def replay(self) -> "Rollout":
        """The rollout from the demonstrated start: the demonstration, if it was learnt."""
        return rollout_from(self, self.path.start)

    def table(self) -> Bytes:
        """Spread the greedy actions over all phases and states, (phases, n_states), for a client."""
        domain = self.domain
        table = np.full((domain.phases, self.path.grid.n_states), OUTSIDE, np.int8)
        table[domain.phase_of, domain.state_of] = self.greedy
        return table

    def row(self, phase: int, state: int) -> int | None:
        """Find the row of a phase and state, or None outside the certified domain."""
        cell = self.path.grid.cells_of(state)
        return int(self.domain.rows_of(phase, cell)) if self.domain.holds(phase, cell) else None


def learn_policy(reward: RewardMap, learner: Tabular, seed: int = 0) -> Policy:
    """Learn to follow a demonstration from its reward map; the same arguments give the same bytes.

    `skills.deep.learn_policy` does so with the learners beyond the table too.

    Raises:
        BadSettings: The seed or the levels cannot be meant.
    """
    q, training = learn_values(reward, learner, seed)
    return Policy(reward.path, reward.levels, learner, seed, training, q)


@dataclass(frozen=True, eq=False)
class Rollout:
    """The states that the greedy policy visits from a start, (T,), the phase on each, and whether it finished."""

    path: GridPath
    states: Ints
    phases: Ints
    finished: bool

    @property
    def tip_mm(self) -> Floats:
        """The rollout through the centres of its cells, (T, 3) mm."""
        return self.path.grid.centres_mm(self.states)


def rollout(policy: Policy, start_mm: ArrayLike) -> Rollout:
    """Follow the greedy policy from a position, (3,) mm in the demonstration's frame, to the goal.

    It stops unfinished where the policy promises nothing, or when it comes back to a phase and state it has been in.

    Raises:
        OutsideGrid: The start is not in the grid.
    """
    start_mm = np.asarray(start_mm, float)
    if start_mm.shape != (3,):
        raise OutsideGrid("A start is three numbers, x, y and z in mm.")
    return rollout_from(policy, int(policy.path.grid.states_at(start_mm)))


def rollout_from(policy: Policy, state: int) -> Rollout:
    """Follow the greedy policy from a state; see `rollout`."""
    domain, moves = policy.domain, policy.moves
    phase, done = domain.start(state)
    states, phases, seen = [state], [phase], set[int]()
    row = -1 if done else int(domain.rows_of(phase, policy.path.grid.cells_of(state)))
    while row >= 0 and row not in seen and policy.greedy[row] >= 0:
        seen.add(row)
        done, after = bool(moves.finishes[row]), int(moves.row[row])
        states.append(int(moves.state[row]))
        phases.append(int(domain.phase_of[row if after < 0 else after]))
        row = after
    return Rollout(policy.path, np.array(states), np.array(phases), done)


@dataclass(frozen=True)
class Step:
    """What a policy says of a position: nothing moves by it.

    `phase` is the one after counting the position, `action` is None where it is done or nothing is promised, and
    `correction_mm` leads from the position to the waypoint that it should be at, where that is not here.
    """

    phase: int
    action: int | None
    next_position_mm: tuple[float, float, float] | None
    next_phase: int | None
    done: bool
    confidence: float
    correction_mm: tuple[float, float, float] | None


def next_step(policy: Policy, position_mm: ArrayLike, phase: int | None) -> Step:
    """Say what to do at a position, (3,) mm, reached in a phase; None: it is the start of a pass.

    Off the path the correction leads back: in phase 0 to the nearest waypoint, later to the one just passed. From there
    the policy goes on to the goal. Outside the grid it promises no action, and the correction is all that it says.

    Raises:
        BadInput: The position is not three finite numbers.
        OutsideGrid: It is further than `GUIDED_MM` outside the grid, or there is no such phase.
    """
    domain, grid = policy.domain, policy.path.grid
    here = frozen(position_mm, np.float64, (3,), "position_mm")
    if phase is not None and not 0 <= phase < domain.phases:
        raise OutsideGrid(f"The policy has the phases 0 to {domain.phases - 1}.", phase=phase)
    state = _state_at(policy, here)
    if state is None:
        phase = 0 if phase is None else phase
        return Step(phase, None, None, None, False, 0.0, _correction(policy, here, phase))
    phase, done = domain.start(state) if phase is None else domain.enter(phase, state)
    on_path = state == policy.path.states[phase - 1] if phase > 0 else state in policy.path.states
    correction = None if done or on_path else _correction(policy, here, phase)
    row = None if done else policy.row(phase, state)
    if row is None or policy.greedy[row] < 0:
        done = done or (row is not None and policy.greedy[row] == FINISHED)
        return Step(phase, None, None, None, done, 0.0, correction)
    action = int(policy.greedy[row])
    after = int(policy.moves.state[row])
    next_phase, _ = domain.enter(phase, after)
    confidence = float(policy.confidence[row])
    return Step(phase, action, _xyz(grid.centres_mm(after)), next_phase, False, confidence, correction)


def _state_at(policy: Policy, here: Floats) -> int | None:
    """Find the state of a position, or None outside the grid.

    Raises:
        OutsideGrid: It is so far outside that no hand is to be led back from there.
    """
    grid = policy.path.grid
    try:
        return int(grid.states_at(here))
    except OutsideGrid:
        outside_mm = dist(here, np.clip(here, grid.centres_mm(0), grid.centres_mm(grid.n_states - 1)))
        if not outside_mm <= GUIDED_MM:
            raise OutsideGrid(
                f"The position is {outside_mm:.4g} mm outside the grid; a hand is led back from at most {GUIDED_MM:g} "
                "mm. Give millimetres in the frame of the policy.",
                outside_mm=outside_mm,
            ) from None
        return None


def _correction(policy: Policy, here: Floats, phase: int) -> tuple[float, float, float]:
    """Point from a position to the waypoint just passed, or to the nearest one where none was."""
    tip = policy.path.tip_mm
    nearest = phase - 1 if phase > 0 else np.abs(tip - here).max(axis=1).argmin()
    return _xyz(tip[nearest] - here)


def _xyz(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
