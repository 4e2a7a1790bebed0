"""Q-learning on the grid world (Sec. III-C, Eq. 1), in the paper's state and in ours.

    Q(S, A) <- Q(S, A) + alpha [R + gamma max_a Q(S', a) - Q(S, A)]

The paper's state is the *cell*: a demonstration that crosses itself cannot be followed then, because a cell has one
best action. Ours adds the *phase*, how far along the demonstration one is (see `skills.style.domain`). An episode
ends by one of the paper's three rules: at the goal, after `max_steps` moves, or when the time that the arm would have
moved passes `max_episode_s`.

In the phase state every move teaches all phases at once, since where a cell's action leads does not depend on the
phase: moves are remembered as a model, and Eq. 1 is applied to the remembered moves of each phase in turn, the last one
first (planning from a learnt model, as in Dyna-Q: Sutton 1990).
"""

from dataclasses import astuple, dataclass
from math import floor, isfinite
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skills.errors import BadSettings
from skills.style import paper
from skills.style._arrays import Floats
from skills.style.domain import REACH, Domain
from skills.style.learning import _kernels
from skills.style.reward import RewardMap

Model = NDArray[np.int32]

SETTLED = 1e-12  # relative: a Q value that changes by less has settled


@dataclass(frozen=True)
class PhaseQLearning:
    """Settings of Q-learning in the phase state: the default learner.

    The paper is silent on all but the stop rules. Moves are deterministic, so alpha 1 loses nothing; with gamma 0.1
    the nearest waypoint is always worth most (at 0.3 some starts run for the goal and skip the path). Every cell and
    action starts an episode in an order drawn from the seed, so that all has been tried once: one move is enough for
    that, and is the default length; after the first move an episode goes on at random. Phases are then swept until a
    sweep changes nothing: Eq. 1 holds everywhere, whatever the seed.
    """

    kind: ClassVar[str] = "phase-q-learning"
    phased: ClassVar[bool] = True

    alpha: float = 1.0
    gamma: float = 0.1
    max_steps: int = 1
    max_episode_s: float = paper.MAX_EPISODE_S
    step_s: float = 0.25  # a cell of 5 mm at 20 mm/s
    max_sweeps: int = 1000  # of a phase; with alpha 1 a handful is enough

    def __post_init__(self) -> None:
        _check(self.alpha, self.gamma, (), self.max_steps, self.max_episode_s, self.step_s)
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


QLearner = PhaseQLearning | CellQLearning


@dataclass(frozen=True)
class Training:
    """How much it took: moves of the arm, how often Eq. 1 was applied, episodes by how they ended, and whether nothing
    changed any more at the end.
    """

    steps: int
    updates: int
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


def learn_q(reward: RewardMap, learner: QLearner, seed: int) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain, (rows, 27), and tell what it took.

    The same reward map, learner and seed give the same bytes.
    """
    moves_in_time = learner.max_episode_s / learner.step_s + 1e-9  # for 0.3 / 0.1 is 2.9999...
    cap = floor(min(learner.max_steps, moves_in_time))
    chance = _Chance(seed)
    if isinstance(learner, PhaseQLearning):
        model, episodes = _explore(reward, cap, chance)
        q, updates, settled = _plan(reward, learner, model)
    else:
        q, episodes, settled = _run_episodes(reward, learner, cap, chance), learner.episodes, False
    steps, finished, capped = (int(n) for n in chance.tally)
    if isinstance(learner, CellQLearning):
        updates = steps  # once for each move
    by_time = cap < learner.max_steps
    out_of_steps, out_of_time = (0, capped) if by_time else (capped, 0)
    return q, Training(steps, updates, episodes, finished, out_of_steps, out_of_time, settled)


class _Chance:
    """What a seed decides, and what came of it: the order of starts, the kernels' random bits, and their tally."""

    def __init__(self, seed: int) -> None:
        self.order = np.random.Generator(np.random.PCG64(seed))
        self.bits = np.random.SeedSequence(seed).generate_state(1, np.uint64) | np.uint64(1)
        self.tally = np.zeros(3, np.int64)


def _explore(reward: RewardMap, cap: int, chance: _Chance) -> tuple[Model, int]:
    """Start an episode with every action in every cell: where each led, (n_states, 27), and how many episodes."""
    grid = reward.path.grid
    pairs = grid.n_states * paper.N_ACTIONS
    model = np.full((grid.n_states, paper.N_ACTIONS), _kernels.UNKNOWN, np.int32)
    starts = chance.order.permutation(pairs)
    _kernels.explore_compiled(model, np.array(grid.shape), starts, cap, reward.path.goal, chance.bits, chance.tally)
    return model, pairs


def _plan(reward: RewardMap, learner: PhaseQLearning, model: Model) -> tuple[Floats, int, bool]:
    """Apply Eq. 1 to the model, phase by phase from the last, until nothing changes: Q values, updates, settled."""
    domain, levels = Domain(reward.path, phased=True), reward.levels
    q, value = np.zeros((domain.n_rows, paper.N_ACTIONS)), np.zeros(domain.n_rows)
    live = domain.certified & ~domain.terminal
    cells, pays = reward.path.grid.cells_of(np.arange(reward.path.grid.n_states)), np.array(astuple(levels))
    updates, settled = 0, True
    for phase in range(domain.phases - 1, -1, -1):
        tried = int(live[domain.offset[phase] : domain.offset[phase + 1]].sum()) * paper.N_ACTIONS
        changed = tried
        for number in range(learner.max_sweeps):
            changed = _kernels.sweep_compiled(
                q,
                value,
                model,
                cells,
                reward.rewards,
                domain.joins,
                reward.path.cells,
                domain.low,
                domain.size,
                domain.offset,
                domain.state_of,
                live,
                phase,
                number % 2 == 1,  # to and fro, for values travel with the sweep
                pays,
                learner.alpha,
                learner.gamma,
                reward.path.goal,
                REACH,
                SETTLED,
            )
            updates += tried
            if changed == 0:
                break
        settled &= changed == 0
    return q, updates, settled


def _run_episodes(reward: RewardMap, learner: CellQLearning, cap: int, chance: _Chance) -> Floats:
    """Run the paper's episodes, each from a cell drawn at random; epsilon falls on a line, then stays."""
    n_states, goal = reward.path.grid.n_states, reward.path.goal
    q = np.zeros((n_states, paper.N_ACTIONS))
    starts = chance.order.integers(n_states - 1, size=learner.episodes)
    starts += starts >= goal  # anywhere but at the goal
    falling = np.arange(learner.episodes) / (learner.epsilon_falls_over * learner.episodes)
    _kernels.run_episodes_compiled(
        q.reshape(-1),
        np.zeros(n_states),
        np.zeros(n_states, np.int8),
        reward.rewards,
        np.array(reward.path.grid.shape),
        starts,
        np.interp(falling, (0.0, 1.0), (learner.epsilon_start, learner.epsilon_end)),
        reward.levels.off_grid,
        learner.alpha,
        learner.gamma,
        cap,
        goal,
        chance.bits,
        chance.tally,
    )
    return q
