"""Q-learning on the grid world (Sec. III-C, Eq. 1), in the paper's state and in ours.

    Q(S, A) <- Q(S, A) + alpha [R + gamma max_a Q(S', a) - Q(S, A)]

The paper's state is the *cell*: a demonstration that crosses itself cannot be followed in it, because a cell has one
best action. Ours adds the *phase*, the progress along the demonstration (see `skills.gridworld.domain`). An episode
ends by one of the paper's three rules: at the goal, after `max_steps` moves, or when the time that the arm would have
moved exceeds `max_episode_s`.

In the phase state every move teaches all phases at once, since the result of an action in a cell does not depend on the
phase: moves are stored as a model, and Eq. 1 is applied to the stored moves of each phase in turn, the last phase first
(planning from a learnt model, as in Dyna-Q: Sutton 1990).

Random bits in the loops come from xorshift64 (Marsaglia 2003), whose state, `rng`, is one nonzero uint64, shape (1,):
an action is drawn from the low half of 64 bits, the decision to explore or to slip from the high half.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import floor, isfinite
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats
from skills.compiled import compiled, inner
from skills.errors import BadSettings
from skills.fields import Count
from skills.gridworld import paper
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath
from skills.gridworld.hazards import Hazards
from skills.gridworld.reward import RewardMap
from skills.gridworld.slip import SlipModel
from skills.learning.learner_state import CellState, PhaseState

Model = NDArray[np.int32]

SETTLED = 1e-12  # relative: a Q value that changes by less has settled
# In a model: never tried; would have left the grid, so the arm stays; touches the scene, which ends the pass.
UNKNOWN, OFF_GRID, TOUCHED = -2, -1, -3
# Unsigned integers, because numba makes a float of a uint64 and a Python integer.
NONE, ONE, THREE, SEVEN, NINE, THIRTEEN, SEVENTEEN = (np.uint64(n) for n in (0, 1, 3, 7, 9, 13, 17))
ACTIONS, HALF, LOW_HALF = np.uint64(27), np.uint64(32), np.uint64(0xFFFFFFFF)


@dataclass(frozen=True)
class PhaseQLearning(PhaseState):
    """Settings of Q-learning in the phase state: the default learner.

    The paper states only the stop rules. Moves are deterministic, so alpha 1 loses nothing; with gamma 0.1 the nearest
    waypoint always has the highest value (at 0.3 some starts run for the goal and skip the path). Every pair of a cell
    and an action starts an episode, beginning with one drawn by the seed, so that every pair is tried once: one move is
    enough for that, and is the default length; after the first move an episode continues at random. Phases are then
    swept until a sweep changes nothing: Eq. 1 holds everywhere, whatever the seed.

    With a slip, everything is tried again before each of `max_sweeps` sweeps, and alpha must be below 1: the lower it
    is, the nearer the values are to the exact ones, and the longer it takes. Slips leave differences between actions
    that are smaller than the error of sampled values, so the certificate finds suboptimal actions; `ValueIteration`
    with the same slip is exact.
    """

    kind: ClassVar[str] = "phase-q-learning"

    alpha: float = 1.0
    gamma: float = 0.1
    max_steps: int = 1
    max_episode_s: float = paper.MAX_EPISODE_S
    step_s: float = 0.25  # a cell of 5 mm at 20 mm/s
    max_sweeps: int = 1000  # per phase; with alpha 1 and no slips a few are enough

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self)
        if not 1 <= self.max_sweeps <= 100_000:
            raise BadSettings("max_sweeps must lie between 1 and 100 000.", max_sweeps=self.max_sweeps)


@dataclass(frozen=True)
class CellQLearning(CellState):
    """Settings of Q-learning in the paper's own state.

    With these defaults it reaches the goal from nearly every start, but cuts corners and cannot follow a path that
    crosses itself. The published parameters (`published`) reach it on fewer than one seed in a hundred.
    """

    kind: ClassVar[str] = "cell-q-learning"

    alpha: float = 1.0
    gamma: float = 0.1
    epsilon_start: float = 1.0
    epsilon_end: float = 1.0
    epsilon_falls_over: float = 1.0  # share of the episodes, from the first on, after which epsilon_end is reached
    episodes: int = 5000
    max_steps: int = paper.MAX_STEPS
    max_episode_s: float = paper.MAX_EPISODE_S
    step_s: float = 0.25

    def __post_init__(self) -> None:
        _check(self)
        if not (0 <= self.epsilon_start <= 1 and 0 <= self.epsilon_end <= 1):
            raise BadSettings("epsilon must lie in [0, 1].", epsilon=(self.epsilon_start, self.epsilon_end))
        if not 0 < self.epsilon_falls_over <= 1:
            raise BadSettings("epsilon_falls_over must lie in (0, 1].", epsilon_falls_over=self.epsilon_falls_over)
        if not 1 <= self.episodes <= 10_000_000:
            raise BadSettings("episodes must lie between 1 and 10 000 000.", episodes=self.episodes)

    @classmethod
    def published(cls) -> "CellQLearning":
        """Return the parameters of the authors' published code: epsilon falls to 0 at half of the episodes."""
        return cls(alpha=0.1, gamma=0.01, epsilon_end=0.0, epsilon_falls_over=0.5)


QLearner = PhaseQLearning | CellQLearning


@dataclass(frozen=True)
class Training:
    """The counts of a training; 0 where no arm is moved.

    Attributes:
        steps: Moves of the arm.
        updates: Applications of Eq. 1.
        episodes: Number of episodes.
        finished: Episodes that ended at the goal.
        out_of_steps: Episodes that ended after the greatest number of moves.
        out_of_time: Episodes that ended by the arm's time.
        settled: Nothing changed any more at the end.
    """

    steps: Count = 0
    updates: Count = 0
    episodes: Count = 0
    finished: Count = 0
    out_of_steps: Count = 0
    out_of_time: Count = 0
    settled: bool = False


def _check(learner: QLearner) -> None:
    """Refuse settings outside of their ranges."""
    for name in ("alpha", "gamma"):
        if not 0 < getattr(learner, name) <= 1:
            raise BadSettings(f"{name} must lie in (0, 1].", **{name: getattr(learner, name)})
    if not 1 <= learner.max_steps <= 1_000_000:
        raise BadSettings("max_steps must lie between 1 and 1 000 000.", max_steps=learner.max_steps)
    max_episode_s, step_s = learner.max_episode_s, learner.step_s
    if not (isfinite(max_episode_s) and isfinite(step_s) and 0 < step_s <= max_episode_s):
        raise BadSettings("step_s and max_episode_s must be finite, with 0 < step_s <= max_episode_s.")


def learn_q(reward: RewardMap, learner: QLearner, seed: int, hazards: Hazards | None = None) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain; the same arguments give the same bytes.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: Seed of all random numbers.
        hazards: A scene on the path's grid, in the phase state; an episode that touches it ends. Such episodes are
            counted with those that ran out of steps.

    Returns:
        Q values, shape (rows, 27), and the counts of the training.
    """
    moves_in_time = learner.max_episode_s / learner.step_s + 1e-9  # because 0.3 / 0.1 is 2.9999...
    cap = floor(min(learner.max_steps, moves_in_time))
    chance = _Chance(seed)
    if isinstance(learner, PhaseQLearning):
        q, updates, settled = _learn_in_phases(reward, learner, cap, chance, hazards)
    else:
        q, settled = _run_episodes(reward, learner, cap, chance), False
    steps, finished, capped = (int(n) for n in chance.tally)
    if isinstance(learner, CellQLearning):
        updates = steps  # one update for each move
    episodes = finished + capped
    by_time = cap < learner.max_steps
    out_of_steps, out_of_time = (0, capped) if by_time else (capped, 0)
    return q, Training(steps, updates, episodes, finished, out_of_steps, out_of_time, settled)


class _Chance:
    """The random numbers of a seed, for the starts of episodes and for the kernels, and the kernels' tally."""

    def __init__(self, seed: int) -> None:
        self.draw = np.random.Generator(np.random.PCG64(seed))
        self.bits = np.random.SeedSequence(seed).generate_state(1, np.uint64) | np.uint64(1)
        self.tally = np.zeros(3, np.int64)


def _learn_in_phases(
    reward: RewardMap, learner: PhaseQLearning, cap: int, chance: _Chance, hazards: Hazards | None
) -> tuple[Floats, int, bool]:
    """Try every action in every cell and apply Eq. 1 to the results: returns Q values, updates, settled.

    Without slips one round of trials is complete, and phases are swept until nothing changes. With slips every sweep
    has a round of its own, since the same action may have another result.
    """
    sweeper = Sweeper(reward, learner, hazards)
    model = np.full((reward.path.grid.n_states, paper.N_ACTIONS), UNKNOWN, np.int32)
    slip = learner.slip_model
    if learner.slip == 0:
        _explore(model, reward.path, slip, cap, chance, hazards)
        settled = sweeper.settle(model)
        return sweeper.q, sweeper.updates, settled
    for number in range(learner.max_sweeps):
        _explore(model, reward.path, slip, cap, chance, hazards)
        for phase in sweeper.phases:
            sweeper.sweep(phase, model, (number,))
    return sweeper.q, sweeper.updates, False


def _explore(model: Model, path: GridPath, slip: SlipModel, cap: int, chance: _Chance, hazards: Hazards | None) -> None:
    """Start an episode with every action in every cell, beginning with a random pair, and record the results."""
    first = int(chance.draw.integers(model.size))
    shape = np.array(path.grid.shape)
    touches = np.zeros((0, paper.N_ACTIONS), bool) if hazards is None else hazards.touches
    slips = float(slip.probability), slip.cumulated  # always of one type: see `skills.compiled.compiled`
    explore(model, shape, first, *slips, cap, path.goal, chance.bits, chance.tally, touches)


class Sweeper:
    """The Q values of a domain in the phase state, and the sweeps that apply Eq. 1 to them."""

    def __init__(self, reward: RewardMap, learner: PhaseQLearning, hazards: Hazards | None = None) -> None:
        self.reward, self.learner = reward, learner
        self.domain = Domain(reward.path, learner.phased, learner.join_share)
        domain, path = self.domain, reward.path
        self.cells = path.cells
        self.phases = range(domain.phases - 1, -1, -1)  # the last one first, because values depend on later phases
        self.q, self.value = np.zeros((domain.n_rows, paper.N_ACTIONS)), np.zeros(domain.n_rows)
        self.live = domain.certified & ~domain.terminal
        advances = np.where(domain.phase_of > 0, domain.state_of == path.states[domain.phase_of], False)
        advances[: domain.offset[1]] = domain.joins > 0
        self.rewards, self.touched = domain.rewards_unjoined(reward), 0.0
        self.entering = np.full(path.grid.n_states, reward.levels.other)
        if hazards is not None:
            self.rewards, self.touched = self.rewards - hazards.cost, -hazards.touch
            self.entering -= hazards.cost
            self.live &= ~hazards.forbidden[domain.state_of]
        self.stays = self.live & ~advances
        self.worth = self.entering.copy()
        self.updates = 0

    def settle(self, model: Model) -> bool:
        """Sweep each phase forwards and backwards in turn until nothing changes; return whether all phases settled.

        Both directions are used because values travel with the sweep.
        """
        changed = [self.sweep(phase, model, range(self.learner.max_sweeps)) for phase in self.phases]
        return not any(changed)

    def sweep(self, phase: int, model: Model, numbers: Iterable[int]) -> int:
        """Sweep a phase, backwards in sweeps with an odd number, until nothing changes.

        Returns:
            The number of Q values that the last sweep changed.
        """
        domain, levels, learner = self.domain, self.reward.levels, self.learner
        first, last = int(domain.offset[phase]), int(domain.offset[phase + 1])
        states = domain.state_of[first:last]
        self._enter(phase, first, last)
        changed = tried = int(np.count_nonzero(self.live[first:last])) * paper.N_ACTIONS
        for number in numbers:
            changed = sweep(
                self.q,
                self.value,
                model,
                domain.state_of,
                self.live,
                self.stays,
                self.worth,
                first,
                last,
                number % 2 == 1,
                self.entering,
                levels.off_grid,
                float(self.touched),
                float(learner.alpha),
                float(learner.gamma),
                SETTLED,
            )
            self.updates += tried
            if changed == 0:
                break
        self.worth[states] = self.entering[states]  # shared by all phases; the next one expects these
        return int(changed)

    def _enter(self, phase: int, first: int, last: int) -> None:
        """Set the value of entering each state in a phase; the value beyond the certified domain is 0.

        The reward of other states is 0, so that of a waypoint is added to what entering it costs.
        """
        domain, path, gamma = self.domain, self.reward.path, self.learner.gamma
        stays = first + np.flatnonzero(self.stays[first:last])
        if phase == 0:
            joining = np.flatnonzero(domain.joins)
            after = domain.rows_of(domain.joins[joining], path.grid.cells_of(joining))
            self.worth[:] = self.rewards
            self.worth[joining] += gamma * self.value[after]
        elif phase == domain.phases - 1:
            self.worth[path.goal] += self.reward.levels.goal
        else:
            after = domain.rows_of(phase + 1, self.cells[phase])
            self.worth[path.states[phase]] += self.reward.levels.visited + gamma * self.value[after]
        self.worth[domain.state_of[stays]] = self.entering[domain.state_of[stays]] + gamma * self.value[stays]


def _run_episodes(reward: RewardMap, learner: CellQLearning, cap: int, chance: _Chance) -> Floats:
    """Run the paper's episodes, each from a random cell; epsilon changes linearly, then stays."""
    n_states, goal = reward.path.grid.n_states, reward.path.goal
    q = np.zeros((n_states, paper.N_ACTIONS))
    starts = chance.draw.integers(n_states - 1, size=learner.episodes)
    starts += starts >= goal  # a uniform draw of all states but the goal
    falling = np.arange(learner.episodes) / (learner.epsilon_falls_over * learner.episodes)
    run_episodes(
        q.reshape(-1),
        np.zeros(n_states),
        np.zeros(n_states, np.int8),
        reward.rewards,
        np.array(reward.path.grid.shape, np.uint64),
        starts.astype(np.uint64),
        np.interp(falling, (0.0, 1.0), (learner.epsilon_start, learner.epsilon_end)),
        reward.levels.off_grid,
        float(learner.alpha),
        float(learner.gamma),
        cap,
        np.uint64(goal),
        chance.bits,
        chance.tally,
    )
    return q


# ---- compiled loops -------------------------------------------------------------------------------------------------


@inner
def next_random(x: Any) -> Any:
    """Return the next 64 random bits.

    Args:
        x: The previous bits, uint64, not 0.

    Returns:
        The next bits, uint64, not 0.
    """
    x ^= x << THIRTEEN
    x ^= x >> SEVEN
    x ^= x << SEVENTEEN
    return x


@inner
def any_action(bits: Any) -> Any:
    """Return one of the 27 actions, drawn uniformly.

    Args:
        bits: Random bits, uint64; the low half decides.

    Returns:
        The action, 0 to 26, uint64.
    """
    return ((bits & LOW_HALF) * ACTIONS) >> HALF


@compiled
def run_episodes(
    q: Any,
    value: Any,
    best: Any,
    rewards: Any,
    shape: Any,
    starts: Any,
    epsilons: Any,
    off_grid: float,
    alpha: float,
    gamma: float,
    max_steps: int,
    goal: Any,
    rng: Any,
    tally: Any,
) -> None:
    """Learn Q values in the paper's cell state by Eq. 1, one episode for each start.

    Integers are unsigned, so that numba does not test each index for being negative; x, y and z count from 1, so that a
    move to -1 is 0 and not a wrapped number.

    Args:
        q: Q values, shape (n_states * 27,), float64, learnt in place.
        value: The largest Q value of each state, shape (n_states,), float64, kept up to date.
        best: The action of that Q value, the first of equals, shape (n_states,), int8, kept up to date.
        rewards: Algorithm 1: the reward for entering each state, shape (n_states,), float64.
        shape: Number of cells along each axis, shape (3,), uint64.
        starts: The state that each episode starts in, shape (E,), uint64.
        epsilons: The probability of exploring in each episode, shape (E,), float64.
        off_grid: The reward of a move off the grid.
        alpha: Learning rate.
        gamma: Discount.
        max_steps: The number of moves after which an episode ends.
        goal: The state that finishes an episode, uint64.
        rng: State of the random bits, shape (1,), uint64, advanced in place.
        tally: Counts of steps, of finished episodes, and of those that ran out of steps, shape (3,), int64; added to.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    before_first = (ny + ONE) * nz + ONE
    random = rng[0]
    steps = 0
    for episode in range(len(starts)):
        state = starts[episode]
        x = state // (ny * nz) + ONE
        y = state // nz % ny + ONE
        z = state % nz + ONE
        explores = np.uint64(epsilons[episode] * 4294967296.0)
        finished = False
        for _ in range(max_steps):
            random = next_random(random)
            action = any_action(random) if random >> HALF < explores else np.uint64(best[state])
            to_x = x + action // NINE - ONE
            to_y = y + action // THREE % THREE - ONE
            to_z = z + action % THREE - ONE
            after = state
            if (to_x != NONE) & (to_x <= nx) & (to_y != NONE) & (to_y <= ny) & (to_z != NONE) & (to_z <= nz):
                x, y, z = to_x, to_y, to_z
                after = (x * ny + y) * nz + z - before_first
                target = rewards[after]
                finished = after == goal
                if not finished:
                    target += gamma * value[after]
            else:
                target = off_grid + gamma * value[state]
            row = state * ACTIONS
            new = target
            if alpha < 1:
                new = (1 - alpha) * q[row + action] + alpha * target
            q[row + action] = new
            # Only where the best action itself became worse have all 27 values to be compared.
            if new > value[state]:
                value[state] = new
                best[state] = action
            elif action == np.uint64(best[state]):
                if new < value[state]:
                    top = NONE
                    for other in range(1, 27):
                        if q[row + np.uint64(other)] > q[row + top]:
                            top = np.uint64(other)
                    best[state] = top
                    value[state] = q[row + top]
            elif new == value[state] and action < np.uint64(best[state]):
                best[state] = action
            state = after
            steps += 1
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished
    tally[0] += steps
    rng[0] = random


@compiled
def explore(
    model: Any,
    shape: Any,
    first: int,
    slip: float,
    slipped: Any,
    max_steps: int,
    goal: int,
    rng: Any,
    tally: Any,
    touches: Any,
) -> None:
    """Move in the grid and record the result of each action: one episode for every pair of state and action.

    Args:
        model: The state that each action led to, `OFF_GRID`, `TOUCHED` or `UNKNOWN`, shape (n_states, 27), int32,
            changed in place.
        shape: Number of cells along each axis, shape (3,), int64.
        first: Start state of the first episode times 27, plus its first action; the others follow in order.
        slip: Probability that a move slips.
        slipped: Probability that a slip is one of the moves up to each, shape (27,), float64.
        max_steps: The number of moves after which an episode ends.
        goal: The state that finishes an episode.
        rng: State of the random bits, shape (1,), uint64, advanced in place.
        tally: Counts of steps, of finished episodes, and of episodes that ran out of steps or touched the scene, shape
            (3,), int64; added to.
        touches: Moves that touch the scene and end the episode, shape (n_states, 27), bool; (0, 27) without a scene.
    """
    nx, ny, nz = shape[0], shape[1], shape[2]
    chance = np.uint64(slip * 4294967296.0)
    random = rng[0]
    in_scene = len(touches) > 0
    episodes = nx * ny * nz * 27
    for episode in range(episodes):
        state = (first + episode) % episodes // 27
        action = np.int64((first + episode) % 27)
        finished = False
        for step in range(max_steps):
            if step > 0:
                random = next_random(random)
                action = np.int64(any_action(random))
            made, slips = action, False
            if chance > NONE:
                random = next_random(random)
                slips = random >> HALF < chance
                if slips:
                    share = (random & LOW_HALF) / 4294967296.0
                    made = np.int64(0)
                    while made < 26 and slipped[made] <= share:
                        made += 1
            x = state // (ny * nz) + made // 9 - 1
            y = state // nz % ny + made // 3 % 3 - 1
            z = state % nz + made % 3 - 1
            tally[0] += 1
            if in_scene and touches[state, made]:
                model[state, action] = TOUCHED
                break
            if x >= 0 and x < nx and y >= 0 and y < ny and z >= 0 and z < nz:
                after = (x * ny + y) * nz + z
                model[state, action] = after
                state = after
                finished = after == goal
            else:
                model[state, action] = state if slips else OFF_GRID
            if finished:
                break
        tally[1] += finished
        tally[2] += not finished
    rng[0] = random


@compiled
def sweep(
    q: Any,
    value: Any,
    model: Any,
    states: Any,
    live: Any,
    stays: Any,
    worth: Any,
    first: int,
    last: int,
    backwards: bool,
    entering: Any,
    off_grid: float,
    touched: float,
    alpha: float,
    gamma: float,
    tolerance: float,
) -> Any:
    """Apply Eq. 1 once to every action of a phase that was tried.

    Args:
        q: Q values, shape (rows, 27), float64, learnt in place.
        value: The largest Q value of each row, shape (rows,), float64, kept up to date.
        model: The state that each action led to, as `explore` records it, shape (n_states, 27), int32.
        states: The state of each row, shape (rows,), int64.
        live: Whether Q values are learnt in each row, shape (rows,), bool.
        stays: Whether the phase stays the same on entering the row's state, shape (rows,), bool.
        worth: Reward and discounted value of entering each state in the phase, shape (n_states,), float64, updated.
        first: First row of the phase.
        last: Last row of the phase, exclusive.
        backwards: Whether rows are processed from the last to the first.
        entering: The reward for entering each state without a change of phase, shape (n_states,), float64.
        off_grid: The reward of a move off the grid.
        touched: The reward of touching the scene.
        alpha: Learning rate.
        gamma: Discount.
        tolerance: Relative change up to which a Q value counts as unchanged.

    Returns:
        The number of Q values whose relative change was greater than the tolerance.
    """
    changed = 0
    for i in range(last - first):
        row = last - 1 - i if backwards else first + i
        if not live[row]:
            continue
        state = states[row]
        top = -np.inf
        for action in range(27):
            to = model[state, action]
            new = q[row, action]
            if to != UNKNOWN:
                target = off_grid + gamma * value[row]
                if to >= 0:
                    target = worth[to]
                elif to == TOUCHED:
                    target = touched
                old = new
                new = (1 - alpha) * old + alpha * target
                q[row, action] = new
                if abs(new - old) > tolerance * abs(new):
                    changed += 1
            if new > top:
                top = new
        value[row] = top
        if stays[row]:
            worth[state] = entering[state] + gamma * top
    return changed
