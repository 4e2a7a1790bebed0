"""Learners and policies: the union of all learners, the greedy actions on the certified domain, and rollouts.

    RewardMap --learn_tabular--> Policy --rollout--> Rollout

`skills.deep.learn_policy` learns with all learners, `learn_tabular` with those that need no network. The *greedy*
action of a row has the largest Q value. Of equally good ones the tabular learners of the phase state take the one of
the shortest way (`skills.learning.ties`); the others, whose values have not settled, the one with the
lowest index.
"""

from dataclasses import asdict, dataclass, fields
from functools import cached_property
from math import dist, inf
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Bytes, Floats, Ints, freeze, frozen, xyz
from skills.errors import BadSettings, OutsideGrid
from skills.gridworld import paper
from skills.gridworld.domain import FINISHED, OUTSIDE, Domain, Moves
from skills.gridworld.grid import GridPath, refuse_metres
from skills.gridworld.hazards import Hazards, Surroundings, hazards_of, touching
from skills.gridworld.reward import RewardLevels, RewardMap
from skills.learning.dynamic_programming import ValueIteration, iterate_values
from skills.learning.max_ent_irl import MaxEntIRL, learn_from_recovered
from skills.learning.networks import DDPG, DQN, TRPO, Network
from skills.learning.q_learning import CellQLearning, PhaseQLearning, Training, learn_q
from skills.learning.ties import REMOTE_CENTRE, ShortestApproach, choose
from skills.notebook import card

Tabular = PhaseQLearning | CellQLearning | ValueIteration | MaxEntIRL
Learner = Tabular | DQN | DDPG | TRPO
LEARNERS: dict[str, type[Learner]] = {learner.kind: learner for learner in get_args(Learner)}
LEARNER_VERSION = 1  # part of a training's identity: raise it when the same settings would give another result
MAX_SEED = 2**63 - 1
MAX_BYTES = 4 << 30  # ours: a laptop has 8 GiB, and other trainings run at the same time
BYTES_A_ROW = 600  # of the domain, measured with 51 and 101 cells a side: Q values twice, plus intermediate results
BYTES_A_SLIPPING_ROW = 2400  # the certificate stores the result of each of the 27 actions
GUIDED_MM = 50.0  # ours: greatest distance of a start outside the grid; metres given for millimetres are further off


# ---- learners ------------------------------------------------------------------------------------------------------


def describe_learner(learner: Learner) -> dict[str, Any]:
    """Return a learner as JSON: its kind and its settings.

    Args:
        learner: The learner; `learner_of` returns it again.
    """
    return {"kind": learner.kind, **describe_settings(learner)}


def describe_settings(learner: Learner) -> dict[str, Any]:
    """Return the settings of a learner as JSON.

    Args:
        learner: The learner.
    """
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(learner).items()}


def learner_of(described: dict[str, Any]) -> Learner:
    """Return a learner from its JSON.

    Args:
        described: Its kind and its settings, as `describe_learner` returns them; settings that are missing have their
            defaults.

    Raises:
        BadSettings: There is no learner of this kind, it has no such setting, or a setting is impossible.
    """
    settings = dict(described)
    kind = settings.pop("kind", None)
    if kind not in LEARNERS:
        raise BadSettings(f"There is no learner of this kind; the learners are {', '.join(LEARNERS)}.")
    if unknown := sorted(settings.keys() - {one.name for one in fields(LEARNERS[kind])}):
        raise BadSettings(f"The learner {kind} has no setting {', '.join(unknown)}; a newer version may have it.")
    return LEARNERS[kind](**settings)


def learn_values(
    reward: RewardMap, learner: Tabular, seed: int, hazards: Hazards | None = None
) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain.

    The same reward map, learner and seed give the same bytes; value iteration and IRL do not use the seed.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: Seed of all random numbers, 0 to 2^63 - 1.
        hazards: A scene on the path's grid, which `skills.learning.in_scene.scene_learner` says who can learn in.

    Returns:
        Q values, shape (rows, 27), and the counts of the training.

    Raises:
        BadSettings: As for `check_learnable`; or the values do not settle, or the path is too long for the learner.
    """
    check_learnable(reward, learner, seed, in_scene=hazards is not None)
    if isinstance(learner, ValueIteration):
        return iterate_values(reward, learner, hazards), Training(settled=True)
    if isinstance(learner, MaxEntIRL):
        # IRL ends after a fixed number of iterations, not when nothing changes.
        return learn_from_recovered(reward, learner), Training()
    return learn_q(reward, learner, seed, hazards)


def check_learnable(reward: RewardMap, learner: Learner, seed: int, *, in_scene: bool = False) -> None:
    """Refuse settings with which no learning should be started.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: The seed.
        in_scene: Whether it is learnt in a scene, which needs as much memory as slips do.

    Raises:
        BadSettings: The seed is not an integer from 0 to 2^63 - 1, or arriving would not pay (see `refuse_loops`), or
            the grid is too large for memory.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise BadSettings("The seed must be an integer from 0 to 2^63 - 1.")
    refuse_loops(reward.levels, learner)
    refuse_too_large(reward.path, learner, in_scene=in_scene)


def refuse_too_large(path: GridPath, learner: Learner, *, in_scene: bool = False) -> None:
    """Refuse a path whose policy would need too much memory, before any is allocated.

    Args:
        path: The demonstrated path.
        learner: The settings of the learner.
        in_scene: Whether it is learnt in a scene.

    Raises:
        BadSettings: It would need more than `MAX_BYTES`.
    """
    each = BYTES_A_SLIPPING_ROW if learner.slip > 0 or in_scene else BYTES_A_ROW
    needed = Domain(path, learner.phased).n_rows * each
    if needed > MAX_BYTES:
        raise BadSettings(
            f"Learning {len(path.states)} waypoints in a grid of {path.grid.n_states} cells needs about "
            f"{needed / 2**30:.1f} GiB of memory, and at most {MAX_BYTES / 2**30:g} GiB are allowed; use larger "
            "cells.",
            needed_bytes=needed,
        )


def refuse_loops(levels: RewardLevels, learner: Learner) -> None:
    """Refuse settings with which going round in circles pays more than arriving.

    `MaxEntIRL` learns from other rewards, but is certified against these with its gamma.

    Args:
        levels: The rewards of Algorithm 1.
        learner: The settings of the learner.

    Raises:
        BadSettings: A loop pays more; the message has the greatest gamma with which it does not.
    """
    if learner.phased:
        if levels.other != 0:
            raise BadSettings("In the phase state a move that does not advance has no reward: `other` must be 0.")
        return  # no waypoint pays twice, so no loop does
    if levels.visited <= 0:
        return  # standing still never pays, and the goal pays more
    looping = inf if learner.gamma == 1 else levels.visited / (1 - learner.gamma)
    if not levels.goal > looping:
        raise BadSettings(
            f"Standing on a visited cell is worth {looping:g} in the long run, arriving only {levels.goal:g}: "
            f"use a gamma below {1 - levels.visited / levels.goal:g}.",
            gamma=learner.gamma,
        )


# ---- policies ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Policy:
    """A learnt policy: the Q values on the domain of a path, and the settings with which they were learnt.

    Attributes:
        path: The demonstrated path.
        levels: The rewards of Algorithm 1.
        learner: The settings of the learner.
        seed: The seed.
        training: The counts of the training.
        q: Q values, shape (rows, 27).
        network: The network of a network learner, from which the Q values were computed at each cell's centre; or None.
        ties: The rule among equally good actions; None: the lowest index, the first one with the largest Q value.
        surroundings: The scene that it was learnt in, in the frame of the path, and its costs; None: nothing is there.
    """

    path: GridPath
    levels: RewardLevels
    learner: Learner
    seed: int
    training: Training
    q: Floats
    network: Network | None = None
    ties: ShortestApproach | None = None
    surroundings: Surroundings | None = None

    def __post_init__(self) -> None:
        if self.surroundings is not None and not self.learner.phased:
            raise BadSettings("Only in the phase state a policy is learnt in a scene; leave `surroundings` out.")
        if self.ties is not None and not self.learner.phased:
            raise BadSettings("Only in the phase state a way ends where it joins the path; leave `ties` out.")
        freeze(self, q=(self.domain.n_rows, paper.N_ACTIONS))

    @cached_property
    def domain(self) -> Domain:
        """The certified domain."""
        return Domain(self.path, self.learner.phased, self.learner.join_share)

    @cached_property
    def greedy(self) -> Bytes:
        """The action of each row, (rows,): 0 to 26, `FINISHED` or `OUTSIDE`.

        In a scene it is `OUTSIDE` also in forbidden cells and where the best move touches: a client stops there, also
        one that knows no scenes.
        """
        actions = self.q.argmax(axis=1) if self.ties is None else choose(self.domain, self.q, self.ties)
        actions[self.domain.terminal] = FINISHED
        actions[~self.domain.certified] = OUTSIDE
        if self.surroundings is not None:
            rows = np.flatnonzero(actions >= 0)
            states, made = self.domain.state_of[rows], actions[rows].astype(np.int64)
            actions[rows[touching(self.surroundings.scene, self.path.grid, states, made)]] = OUTSIDE
        return frozen(actions, np.int8, (self.domain.n_rows,), "greedy")

    @cached_property
    def confidence(self) -> Floats:
        """The lead of the best action of each row over the second best, (rows,): 1 - Q2 / Q1, and 0 where Q1 <= 0."""
        second, first = np.partition(self.q, -2, axis=1)[:, -2:].T
        sure = np.where(first > 0, 1 - second / np.where(first > 0, first, 1.0), 0.0)
        return frozen(sure, np.float64, (self.domain.n_rows,), "confidence")

    @cached_property
    def hazards(self) -> Hazards | None:
        """The scene on its grid; None if nothing is there."""
        if self.surroundings is None:
            return None
        scene, costs = self.surroundings.scene, self.surroundings.costs
        return hazards_of(scene, self.path, scene.frame, costs)

    @cached_property
    def moves(self) -> Moves:
        """The result of the greedy action of each row, (rows,); meaningless in rows without an action."""
        return self.domain.move(np.arange(self.domain.n_rows), self.greedy.astype(np.int64).clip(0))

    @cached_property
    def replay(self) -> "Rollout":
        """The rollout from the demonstrated start: the demonstration itself, if the policy learnt it."""
        return rollout_from(self, self.path.start)

    def table(self) -> Bytes:
        """Return the greedy actions of all phases and states, (phases, n_states), as clients receive them."""
        domain = self.domain
        table = np.full((domain.phases, self.path.grid.n_states), OUTSIDE, np.int8)
        table[domain.phase_of, domain.state_of] = self.greedy
        return table

    def row(self, phase: int, state: int) -> int | None:
        """Return the row of a phase and state, or None outside the certified domain."""
        cell = self.path.grid.cells_of(state)
        return int(self.domain.rows_of(phase, cell)) if self.domain.holds(phase, cell) else None

    def _repr_html_(self) -> str:
        grid, states, replay = self.path.grid, self.path.states, self.replay
        same = replay.finished and np.array_equal(replay.states, states)
        facts = {
            "learner": f"{self.learner.kind}, seed {self.seed}",
            "grid world": f"{' x '.join(map(str, grid.shape))} cells of {grid.cell_mm:g} mm",
            "demonstration": f"{len(states)} states",
            "states with an action": f"{np.count_nonzero(self.greedy >= 0)} of {self.domain.n_rows}",
            "from its start": "the demonstration, state by state"
            if same
            else f"{len(replay.states)} states, {'to the goal' if replay.finished else 'not to the goal'}",
            "learnt in a scene": None if self.surroundings is None else f"in {self.surroundings.scene.frame}",
        }
        return card("Policy", facts, {"demonstrated": [self.path.tip_mm], "learnt": [replay.tip_mm]})


def learn_tabular(
    reward: RewardMap, learner: Tabular, seed: int = 0, ties: ShortestApproach | None = REMOTE_CENTRE
) -> Policy:
    """Learn to follow a demonstration from its reward map; the same arguments give the same bytes.

    `skills.deep.learn_policy` does this with the network learners as well.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: Seed of all random numbers, 0 to 2^63 - 1.
        ties: The rule among equally good actions; not used in the cell state, where the lowest index counts.

    Returns:
        The policy.

    Raises:
        BadSettings: As for `learn_values`.
    """
    q, training = learn_values(reward, learner, seed)
    return Policy(reward.path, reward.levels, learner, seed, training, q, ties=ties if learner.phased else None)


@dataclass(frozen=True, eq=False)
class Rollout:
    """The states that the greedy policy visits from a start, (T,), the phase in each, (T,), and whether it finished."""

    path: GridPath
    states: Ints
    phases: Ints
    finished: bool

    @property
    def tip_mm(self) -> Floats:
        """The rollout through the centres of its cells, (T, 3) mm."""
        return self.path.grid.centres_mm(self.states)


def rollout(policy: Policy, start_mm: ArrayLike) -> Rollout:
    """Follow the greedy policy from a position to the goal.

    The rollout stops unfinished where it leaves the certified domain, or when it returns to a phase and state that it
    has visited.

    Args:
        policy: The policy.
        start_mm: Start, shape (3,), in the demonstration's frame.

    Returns:
        The visited states and phases, the start's cell first.

    Raises:
        OutsideGrid: The start is not three finite numbers or not in the grid, or seems to be in metres.
    """
    start_mm = np.asarray(start_mm, float)
    if start_mm.shape != (3,):
        raise OutsideGrid("A start must be three numbers, x, y and z in mm.")
    # Before the state is looked up, because that error would not mention the unit.
    refuse_metres("The start", start_mm, policy.path.grid.centres_mm(policy.path.goal))
    return rollout_from(policy, int(policy.path.grid.states_at(start_mm)))


def rollout_from(policy: Policy, state: int) -> Rollout:
    """Follow the greedy policy from a state; see `rollout`.

    Args:
        policy: The policy.
        state: The state index of the start.

    Returns:
        The visited states and phases, the start first.
    """
    domain, moves = policy.domain, policy.moves
    phase, ends = domain.start(state)
    done = bool(ends)
    states, phases, seen = [state], [int(phase)], set[int]()
    row = -1 if done else int(domain.rows_of(phase, policy.path.grid.cells_of(state)))
    # Without `seen` a policy that goes round in circles would be followed for ever.
    while row >= 0 and row not in seen and policy.greedy[row] >= 0:
        seen.add(row)
        done, after = bool(moves.finishes[row]), int(moves.row[row])
        states.append(int(moves.state[row]))
        phases.append(int(domain.phase_of[row if after < 0 else after]))
        row = after
    return Rollout(policy.path, np.array(states), np.array(phases), done)


@dataclass(frozen=True)
class Step:
    """The answer of a policy for a position; computing it moves nothing.

    Attributes:
        phase: The phase after counting the position.
        action: The action, 0 to 26; None if the task is finished or the position is outside the certified domain.
        next_position_mm: Centre of the next cell; None without an action.
        next_phase: The phase after moving there; None without an action.
        done: The task is finished.
        confidence: The lead of the action over the second best, see `Policy.confidence`; 0 without an action.
        correction_mm: Vector from the position to the waypoint at which it should be; None if it is there.
    """

    phase: int
    action: int | None
    next_position_mm: tuple[float, float, float] | None
    next_phase: int | None
    done: bool
    confidence: float
    correction_mm: tuple[float, float, float] | None


def next_step(policy: Policy, position_mm: ArrayLike, phase: int | None) -> Step:
    """Return the policy's answer for a position reached in a phase.

    Off the path the correction leads back: in phase 0 to the nearest waypoint that may be joined, later to the one just
    passed. From there the policy continues to the goal. Outside the grid there is no action, only the correction.

    Args:
        policy: The policy.
        position_mm: Position, shape (3,), in the demonstration's frame.
        phase: The phase before the position; None at the start of a pass.

    Returns:
        The action and the correction.

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
    # On a closed path the goal's cell finishes when it is entered, not when it is the start.
    entered, finished = domain.start(state) if phase is None else domain.enter(phase, state)
    phase, done = int(entered), bool(finished)
    on_path = state == policy.path.states[phase - 1] if phase > 0 else domain.may_meet[state]
    correction = None if done or on_path else _correction(policy, here, phase)
    row = None if done else policy.row(phase, state)
    if row is None or policy.greedy[row] < 0:
        done = done or (row is not None and policy.greedy[row] == FINISHED)
        return Step(phase, None, None, None, done, 0.0, correction)
    action = int(policy.greedy[row])
    after = int(policy.moves.state[row])
    next_phase = int(domain.enter(phase, after)[0])
    confidence = float(policy.confidence[row])
    return Step(phase, action, xyz(grid.centres_mm(after)), next_phase, False, confidence, correction)


def _state_at(policy: Policy, here: Floats) -> int | None:
    """Return the state of a position, or None outside the grid.

    Raises:
        OutsideGrid: It is further than `GUIDED_MM` outside, too far to lead a hand back.
    """
    grid = policy.path.grid
    try:
        return int(grid.states_at(here))
    except OutsideGrid:
        outside_mm = dist(here, np.clip(here, grid.centres_mm(0), grid.centres_mm(grid.n_states - 1)))
        if not outside_mm <= GUIDED_MM:
            raise OutsideGrid(
                f"The position is {outside_mm:.4g} mm outside the grid; positions are guided back from at most "
                f"{GUIDED_MM:g} mm. Give millimetres in the frame of the policy.",
                outside_mm=outside_mm,
            ) from None
        return None


def _correction(policy: Policy, here: Floats, phase: int) -> tuple[float, float, float]:
    """Return the vector from a position to the waypoint just passed, or in phase 0 to the nearest that it may join."""
    tip = policy.path.tip_mm
    # Those that may be joined are the first ones, so an index among them is one of the path.
    nearest = phase - 1 if phase > 0 else np.abs(tip[policy.domain.may_join] - here).max(axis=1).argmin()
    return xyz(tip[nearest] - here)
