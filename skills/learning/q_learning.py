"""Q-learning on the grid world (Sec. III-C, Eq. 1), in the paper's state and in ours.

    Q(S, A) <- Q(S, A) + alpha [R + gamma max_a Q(S', a) - Q(S, A)]

The paper's state is the *cell*: a demonstration that crosses itself cannot be followed in it, because a cell has one
best action. Ours adds the *phase*, the progress along the demonstration (see `skills.gridworld.domain`). An episode
ends by one of the paper's three rules: at the goal, after `max_steps` moves, or when the time that the arm would have
moved exceeds `max_episode_s`.

In the phase state every move teaches all phases at once, since the result of an action in a cell does not depend on the
phase: moves are stored as a model, and Eq. 1 is applied to the stored moves of each phase in turn, the last phase first
(planning from a learnt model, as in Dyna-Q: Sutton 1990).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import floor, isfinite
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats
from skills.errors import BadSettings
from skills.fields import Count
from skills.gridworld import paper
from skills.gridworld.domain import Domain, check_join_share
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardMap
from skills.gridworld.scene import Hazards
from skills.learning import _kernels

Model = NDArray[np.int32]

SETTLED = 1e-12  # relative: a Q value that changes by less has settled


@dataclass(frozen=True)
class PhaseQLearning:
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
    phased: ClassVar[bool] = True

    alpha: float = 1.0
    gamma: float = 0.1
    max_steps: int = 1
    max_episode_s: float = paper.MAX_EPISODE_S
    step_s: float = 0.25  # a cell of 5 mm at 20 mm/s
    slip: float = 0.0  # probability that one of the 27 moves, drawn uniformly, replaces the intended one
    max_sweeps: int = 1000  # per phase; with alpha 1 and no slips a few are enough
    join_share: float = 0.0  # the joining rule: least share of the demonstration that a start is led to follow

    def __post_init__(self) -> None:
        if not 0 <= self.slip < 1:
            raise BadSettings("slip must lie in [0, 1).", slip=self.slip)
        _check(self.alpha, self.gamma, (), self.max_steps, self.max_episode_s, self.step_s)
        check_join_share(self.join_share)
        if not 1 <= self.max_sweeps <= 100_000:
            raise BadSettings("max_sweeps must lie between 1 and 100 000.", max_sweeps=self.max_sweeps)


@dataclass(frozen=True)
class CellQLearning:
    """Settings of Q-learning in the paper's own state.

    With these defaults it reaches the goal from nearly every start, but cuts corners and cannot follow a path that
    crosses itself. The published parameters (`published`) reach it on fewer than one seed in a hundred.
    """

    kind: ClassVar[str] = "cell-q-learning"
    phased: ClassVar[bool] = False
    slip: ClassVar[float] = 0.0
    join_share: ClassVar[float] = 0.0

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
        epsilons = (self.epsilon_start, self.epsilon_end)
        _check(self.alpha, self.gamma, epsilons, self.max_steps, self.max_episode_s, self.step_s)
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
    """The counts of a training.

    Attributes:
        steps: Moves of the arm.
        updates: Applications of Eq. 1.
        episodes: Number of episodes.
        finished: Episodes that ended at the goal.
        out_of_steps: Episodes that ended after the greatest number of moves.
        out_of_time: Episodes that ended by the arm's time.
        settled: Nothing changed any more at the end.
    """

    steps: Count
    updates: Count
    episodes: Count
    finished: Count
    out_of_steps: Count
    out_of_time: Count
    settled: bool


def _check(
    alpha: float, gamma: float, epsilons: tuple[float, ...], max_steps: int, max_episode_s: float, step_s: float
) -> None:
    if not 0 < alpha <= 1:
        raise BadSettings("alpha must lie in (0, 1].", alpha=alpha)
    if not 0 < gamma <= 1:
        raise BadSettings("gamma must lie in (0, 1].", gamma=gamma)
    if not all(0 <= e <= 1 for e in epsilons):
        raise BadSettings("epsilon must lie in [0, 1].", epsilon=epsilons)
    if not 1 <= max_steps <= 1_000_000:
        raise BadSettings("max_steps must lie between 1 and 1 000 000.", max_steps=max_steps)
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
    model = np.full((reward.path.grid.n_states, paper.N_ACTIONS), _kernels.UNKNOWN, np.int32)
    if learner.slip == 0:
        _explore(model, reward.path, learner.slip, cap, chance, hazards)
        settled = sweeper.settle(model)
        return sweeper.q, sweeper.updates, settled
    for number in range(learner.max_sweeps):
        _explore(model, reward.path, learner.slip, cap, chance, hazards)
        for phase in sweeper.phases:
            sweeper.sweep(phase, model, (number,))
    return sweeper.q, sweeper.updates, False


def _explore(model: Model, path: GridPath, slip: float, cap: int, chance: _Chance, hazards: Hazards | None) -> None:
    """Start an episode with every action in every cell, beginning with a random pair, and record the results."""
    first = int(chance.draw.integers(model.size))
    shape = np.array(path.grid.shape)
    touches = np.zeros((0, paper.N_ACTIONS), bool) if hazards is None else hazards.touches
    _kernels.explore_compiled(model, shape, first, float(slip), cap, path.goal, chance.bits, chance.tally, touches)


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
            changed = _kernels.sweep_compiled(
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
                float(learner.alpha),  # always of one type: see `skills.compiled.compiled`
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
    _kernels.run_episodes_compiled(
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
