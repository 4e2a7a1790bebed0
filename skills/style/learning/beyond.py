"""The learners beyond the table that Sec. V of the paper hopes for: DQN, DDPG and TRPO. Their settings; no learning.

A table has a row for every cell; a network has its weights, however many cells there are. All three work in the
paper's state, the position alone. Deep Q-learning (Mnih et al. 2015) stays on the grid: its network takes a cell, one
input for each coordinate that there is along an axis, and answers with the Q values of the 27 moves. The deep
deterministic policy gradient (Lillicrap et al. 2016) and trust-region policy optimisation (Schulman et al. 2015) leave
it for `skills.style.space`: their networks take a position and answer with a step.

What they learn is put on the grid, so that it is certified, served and played back as any other policy: at each cell's
centre the step a that is asked for, as far as the box lets it be made, gives every move m, in cells, the value

    q(m) = 1 - |a - m| / sqrt(12)                              (sqrt(12) is the longest that |a - m| can be)

so the greedy move is the nearest one, and the confidence, 1 - q2/q1, falls to 0 where a lies between two moves.

What learns is `skills.deep`; a budget is in steps and not in seconds, so that the same settings and seed give the same
bytes on one machine. Where a setting has no reason beside it, it is the default of the library that learns.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skills.errors import BadInput, BadSettings
from skills.style import paper
from skills.style._arrays import Floats
from skills.style.grid import MOVES
from skills.style.network import Network
from skills.style.reward import RewardMap
from skills.style.space import Space

AT_ONCE = 1 << 16  # cells that are asked about together: 150 MB at the widest network
FARTHEST = np.sqrt(12.0)


@dataclass(frozen=True)
class DQN:
    """Settings of deep Q-learning on the grid.

    The behaviour is random to the end (Q-learning is off-policy): episodes start anywhere, and from a random walk a
    replay memory has every cell and move in it, which a greedy arm would stop visiting.
    """

    kind: ClassVar[str] = "dqn"
    phased: ClassVar[bool] = False
    slip: ClassVar[float] = 0.0

    gamma: float = 0.8  # at 0.1, the table's, values a few cells off the path are below what a network can tell apart
    steps: int = 400_000  # of all worlds together: about ten minutes on one core
    width: int = 256  # of both hidden layers; with 128 three times as many actions are not the best ones
    learning_rate: float = 1e-3  # falls on a line to a fiftieth: a rate that stays leaves the values trembling
    batch: int = 256
    steps_per_update: int = 4  # the library's default
    target_every: int = 1000  # steps: 250 updates towards values that stand still meanwhile
    worlds: int = 8  # episodes side by side: an answer for eight costs what one for one does

    def __post_init__(self) -> None:
        if not 0 < self.gamma < 1:
            raise BadSettings("gamma must lie in (0, 1).", gamma=self.gamma)
        _check(self)
        if not 1 <= self.target_every <= 10_000_000:
            raise BadSettings("target_every must lie between 1 and 10 000 000.", target_every=self.target_every)


@dataclass(frozen=True)
class DDPG:
    """Settings of the deep deterministic policy gradient in the continuous space.

    `discount` is the one that it learns with. It is certified as all are, against Algorithm 1's rewards, with the
    `gamma` of the table's learners.
    """

    kind: ClassVar[str] = "ddpg"
    phased: ClassVar[bool] = False
    slip: ClassVar[float] = 0.0
    gamma: ClassVar[float] = 0.1

    discount: float = 0.98  # the end of a path of 28 states still counts for half; at 0.95 the shortcut wins
    steps: int = 200_000  # two to five minutes on one core
    width: int = 128
    learning_rate: float = 1e-3
    batch: int = 256
    steps_per_update: int = 8  # one update for each move of all worlds
    noise: float = 0.3  # cells: the deviation of what is added to each step while learning, so that moves are tried
    worlds: int = 8

    def __post_init__(self) -> None:
        _check_discount(self.discount)
        _check(self)
        if not 0 <= self.noise <= 1:
            raise BadSettings("noise must lie between 0 and 1 cell.", noise=self.noise)


@dataclass(frozen=True)
class TRPO:
    """Settings of trust-region policy optimisation in the continuous space; `discount` and `gamma` as of `DDPG`."""

    kind: ClassVar[str] = "trpo"
    phased: ClassVar[bool] = False
    slip: ClassVar[float] = 0.0
    gamma: ClassVar[float] = 0.1

    discount: float = 0.98
    steps: int = 500_000  # two to five minutes on one core
    width: int = 128
    learning_rate: float = 1e-3  # of what judges; the policy's own step is bounded by `trust`
    batch: int = 256
    steps_per_update: int = 2048
    trust: float = 0.01  # the Kullback-Leibler divergence that an update may reach
    worlds: int = 8

    def __post_init__(self) -> None:
        _check_discount(self.discount)
        _check(self)
        if not 0 < self.trust <= 1:
            raise BadSettings("trust must lie in (0, 1].", trust=self.trust)


InSpace = DDPG | TRPO
Deep = DQN | InSpace


def _check(learner: Deep) -> None:
    ranges = {"steps": 10**9, "width": 1024, "batch": 65_536, "steps_per_update": 1_000_000, "worlds": 64}
    for name, most in ranges.items():
        if not 1 <= getattr(learner, name) <= most:
            raise BadSettings(f"{name} must lie between 1 and {most}.", **{name: getattr(learner, name)})
    if not 0 < learner.learning_rate <= 1:
        raise BadSettings("learning_rate must lie in (0, 1].", learning_rate=learner.learning_rate)


def _check_discount(discount: float) -> None:
    if not 0 < discount < 1:
        raise BadSettings("discount must lie in (0, 1).", discount=discount)


def inputs_of(learner: Deep, reward: RewardMap) -> int:
    """Say how many numbers a learner's network takes."""
    return sum(reward.path.grid.shape) if isinstance(learner, DQN) else 3


def outputs_of(learner: Deep) -> int:
    """Say with how many numbers a learner's network answers."""
    return paper.N_ACTIONS if isinstance(learner, DQN) else 3


def asked_step(learner: InSpace, network: Network, space: Space, positions_mm: ArrayLike) -> Floats:
    """Ask for a step at each position, (N, 3) mm: (N, 3), each from -1 to 1 cell."""
    answer = network.answer(space.scaled(positions_mm))
    return np.tanh(answer) if isinstance(learner, DDPG) else np.clip(answer, -1.0, 1.0)


def network_q(reward: RewardMap, learner: Deep, network: Network) -> Floats:
    """Put what a network learnt on the grid: its Q values, (n_states, 27); 0 at the goal, where it is finished.

    Raises:
        BadInput: The network is not one of this learner on this grid.
    """
    if (network.inputs, network.outputs) != (inputs_of(learner, reward), outputs_of(learner)):
        raise BadInput(
            f"A {learner.kind} network for this grid takes {inputs_of(learner, reward)} numbers and answers with "
            f"{outputs_of(learner)}; this one takes {network.inputs} and answers with {network.outputs}."
        )
    n_states = reward.path.grid.n_states
    q = np.empty((n_states, paper.N_ACTIONS))
    for first in range(0, n_states, AT_ONCE):
        states = np.arange(first, min(first + AT_ONCE, n_states))
        cells = reward.path.grid.cells_of(states)
        if isinstance(learner, DQN):
            q[states] = network.answer(_one_hot(cells, reward.path.grid.shape))
        else:
            space = Space(reward.path, reward.levels)
            centres_mm = reward.path.grid.centres_mm(states)
            made_mm = space.moved(centres_mm, asked_step(learner, network, space, centres_mm)) - centres_mm
            apart = np.linalg.norm((made_mm / reward.path.grid.cell_mm)[:, None] - MOVES, axis=-1)
            q[states] = (1 - apart / FARTHEST).round(6)
    q[reward.path.goal] = 0.0
    return q


def _one_hot(cells: ArrayLike, shape: tuple[int, int, int]) -> Floats:
    """Write cells, (N, 3), as 1 for each coordinate that they have and 0 for each that they have not, (N, sum)."""
    return np.concatenate([np.eye(side)[axis] for axis, side in zip(np.asarray(cells).T, shape, strict=True)], axis=1)
