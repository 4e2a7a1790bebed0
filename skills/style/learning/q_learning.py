"""Q-learning on the grid world (Sec. III-C, Eq. 1), in the paper's state and in ours.

    Q(S, A) <- Q(S, A) + alpha [R + gamma max_a Q(S', a) - Q(S, A)]

The paper's state is the *cell*: a demonstration that crosses itself cannot be followed then, because a cell has one
best action. Ours adds the *phase*, how far along the demonstration one is (see `skills.style.domain`). An episode
ends by one of the paper's three rules: at the goal, after `max_steps` moves, or when the time that the arm would have
moved passes `max_episode_s`. In the phase state it also ends where it reaches another phase, whose values are learnt
first, or leaves the certified domain.
"""

from dataclasses import dataclass
from math import floor, isfinite
from typing import ClassVar

import numpy as np

from skills.errors import BadSettings
from skills.style import paper
from skills.style._arrays import Floats, Ints
from skills.style.domain import REACH, Domain
from skills.style.learning import _kernels
from skills.style.reward import RewardLevels, RewardMap

MAX_SEED = 2**63 - 1


@dataclass(frozen=True)
class PhaseQLearning:
    """Settings of Q-learning in the phase state: the default learner.

    The paper is silent on all but the stop rules. Moves are deterministic, so alpha 1 loses nothing; with gamma 0.1
    the nearest waypoint is always worth most (at 0.3 some starts run for the goal and skip the path). Every
    state-action pair of a phase starts an episode in turn, the last phase first, sweep after sweep until one changes
    nothing: then Eq. 1 holds everywhere. Longer episodes than one move only repeat what other starts teach (measured
    on the paper's path: 0.5 against 1.3 million moves), so that is their default here; the paper's cap is 100.
    """

    kind: ClassVar[str] = "phase-q-learning"
    phased: ClassVar[bool] = True

    alpha: float = 1.0
    gamma: float = 0.1
    epsilon: float = 0.0  # after an episode's first move, which is given
    max_steps: int = 1
    max_episode_s: float = paper.MAX_EPISODE_S
    step_s: float = 0.25  # a cell of 5 mm at 20 mm/s
    max_sweeps: int = 200

    def __post_init__(self) -> None:
        _check(self.alpha, self.gamma, (self.epsilon,), self.max_steps, self.max_episode_s, self.step_s)
        if not 1 <= self.max_sweeps <= 100_000:
            raise BadSettings("max_sweeps must lie between 1 and 100 000.", max_sweeps=self.max_sweeps)


@dataclass(frozen=True)
class CellQLearning:
    """Settings of Q-learning in the paper's own state.

    With these defaults it reaches the goal from nearly every start, but cuts corners and cannot cross itself. The
    published parameters (`published`) reach it on fewer than one seed in a hundred.
    """

    kind: ClassVar[str] = "cell-q-learning"
    phased: ClassVar[bool] = False

    alpha: float = 1.0
    gamma: float = 0.1
    epsilon_start: float = 1.0
    epsilon_end: float = 1.0
    epsilon_falls_over: float = 1.0  # the share of the episodes, from the first on, over which it gets there
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
        """Take the parameters of the authors' published code: epsilon falls to 0 at half of the episodes."""
        return cls(alpha=0.1, gamma=0.01, epsilon_end=0.0, epsilon_falls_over=0.5)


Learner = PhaseQLearning | CellQLearning
LEARNER_VERSION = 1  # part of a training's identity: raise it when the same settings would learn something else


@dataclass(frozen=True)
class Training:
    """How much it took: moves of the arm, episodes by how they ended, and whether the last sweep changed nothing."""

    steps: int
    episodes: int
    finished: int
    out_of_steps: int
    out_of_time: int
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


def learn_q(reward: RewardMap, learner: Learner, seed: int) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain, (rows, 27), and tell what it took.

    The same reward map, learner and seed give the same bytes.

    Raises:
        BadSettings: The seed is not an integer from 0 to 2^63 - 1, or arriving would not pay (see `_refuse_loops`).
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise BadSettings("The seed must be an integer from 0 to 2^63 - 1.")
    _refuse_loops(reward.levels, learner)
    run = _Run(reward, learner, seed)
    settled = run.every_pair(learner) if isinstance(learner, PhaseQLearning) else run.random_starts(learner)
    steps, finished, capped = (int(n) for n in run.tally)
    by_time = run.cap < learner.max_steps
    return run.q, Training(steps, run.episodes, finished, 0 if by_time else capped, capped if by_time else 0, settled)


def _refuse_loops(levels: RewardLevels, learner: Learner) -> None:
    """Refuse rewards under which going round in circles pays more than arriving."""
    if isinstance(learner, PhaseQLearning):
        if levels.other != 0:
            raise BadSettings("In the phase state a move that advances nothing pays nothing: `other` must be 0.")
        return  # no waypoint pays twice, so no loop does
    if levels.visited <= 0:
        return  # standing still never pays, and the goal is above that
    if learner.gamma == 1:
        raise BadSettings("With gamma 1 standing on a visited cell pays without end; take a gamma below 1.")
    looping = levels.visited / (1 - learner.gamma)
    if not levels.goal > looping:
        raise BadSettings(
            f"Standing on a visited cell pays {looping:g} in the long run, arriving only {levels.goal:g}: "
            f"take a goal above {looping:g} or a gamma below {1 - levels.visited / levels.goal:g}.",
            gamma=learner.gamma,
        )


class _Run:
    """One training: the arrays that the kernel works on."""

    def __init__(self, reward: RewardMap, learner: Learner, seed: int) -> None:
        self.reward = reward
        self.domain = Domain(reward.path, learner.phased)
        self.q = np.zeros((self.domain.n_rows, paper.N_ACTIONS))
        moves_in_time = learner.max_episode_s / learner.step_s + 1e-9  # for 0.3 / 0.1 is 2.9999...
        self.cap = floor(min(learner.max_steps, moves_in_time))
        self.gamma, self.alpha = learner.gamma, learner.alpha
        self.order = np.random.Generator(np.random.PCG64(seed))
        self.rng = np.random.SeedSequence(seed).generate_state(1, np.uint64) | np.uint64(1)
        self.tally = np.zeros(3, np.int64)
        self.episodes = 0

    def every_pair(self, learner: PhaseQLearning) -> bool:
        """Sweep over every state-action pair, phase by phase from the last, until a sweep changes nothing."""
        domain = self.domain
        live = domain.certified & ~domain.terminal
        settled = True
        for phase in range(domain.phases - 1, -1, -1):
            rows = slice(domain.offset[phase], domain.offset[phase + 1])
            states = domain.state_of[rows][live[rows]]
            pairs = np.empty((len(states) * paper.N_ACTIONS, 3), np.int64)
            pairs[:, 0] = phase
            pairs[:, 1] = np.repeat(states, paper.N_ACTIONS)
            pairs[:, 2] = np.tile(np.arange(paper.N_ACTIONS), len(states))
            settled &= self._settle(rows, pairs, learner)
        return settled

    def _settle(self, rows: slice, pairs: Ints, learner: PhaseQLearning) -> bool:
        epsilons = np.full(len(pairs), learner.epsilon)
        for _ in range(learner.max_sweeps):
            before = self.q[rows].copy()
            self._episodes(self.order.permutation(pairs), epsilons)
            if np.allclose(self.q[rows], before, rtol=1e-12, atol=0):
                return True
        return False

    def random_starts(self, learner: CellQLearning) -> bool:
        """Run the paper's episodes, each from a cell drawn at random; epsilon falls on a line, then stays."""
        states = np.flatnonzero(np.arange(self.domain.n_rows) != self.reward.path.goal)
        starts = np.full((learner.episodes, 3), -1, np.int64)
        starts[:, 0] = 0
        starts[:, 1] = self.order.choice(states, learner.episodes)
        falling = np.arange(learner.episodes) / (learner.epsilon_falls_over * learner.episodes)
        epsilons = np.interp(falling, (0.0, 1.0), (learner.epsilon_start, learner.epsilon_end))
        self._episodes(starts, epsilons)
        return False

    def _episodes(self, starts: Ints, epsilons: Floats) -> None:
        levels, domain = self.reward.levels, self.domain
        self.episodes += len(starts)
        _kernels.run_episodes_compiled(
            self.q,
            self.reward.rewards,
            domain.joins,
            domain.path.cells,
            domain.low,
            domain.size,
            domain.offset,
            np.array(domain.path.grid.shape),
            starts,
            np.array([levels.goal, levels.visited, levels.other, levels.off_grid]),
            self.alpha,
            self.gamma,
            epsilons,
            self.cap,
            domain.path.goal,
            REACH,
            self.rng,
            self.tally,
        )
