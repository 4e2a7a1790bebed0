"""Network learners (DQN, DDPG, TRPO): their settings, the continuous space of two of them, and the learnt network.

Sec. V of the paper names these learners as future work: they have network weights instead of a table with a row for
every cell. This module has their settings, their rewards and the projection onto the grid; `skills.deep` trains them. A
budget is in steps and not in seconds, so that the same settings and seed give the same bytes on one machine. A setting
without a reason is the default of the training library.

All three work in the paper's state, the position alone. Deep Q-learning (Mnih et al. 2015) stays on the grid: its
network takes a cell, one-hot encoded along each axis, and returns the Q values of the 27 moves. The deep deterministic
policy gradient (Lillicrap et al. 2016) and trust-region policy optimisation (Schulman et al. 2015) use the continuous
space: their networks take a position and return a step.

**Space.** The *space* is the box between the centres of a grid's outermost cells. A *step* is three numbers from -1 to
1, in cells along x, y and z; a step that would leave the box ends at its face. The goal is reached anywhere in the
goal's cell. The rewards of the space are ours, because Algorithm 1 pays per cell, and pays again for standing still,
which in a continuous space is the only behaviour that would be learnt. With s the length of the demonstration up to its
point nearest to a position (the later one of equals) and u the distance to that point, both in cells, a step from p to
q pays

    min(gamma F(q) - F(p), 1) - u(q) / 2 - [stopped at a face] + goal [arrived],      F = s - u

`F` is a potential: its part of the reward sums to zero on any round trip (Ng, Harada and Russell 1999), so no loop
gains anything. The bound of 1, one cell's progress, only ever reduces the reward and removes the gain of a shortcut: a
step that leaves out half of the path is paid for one cell. The term u / 2 holds the tip on the path, and leaving the
box costs the reward `off_grid`.

**Projection onto the grid.** A learnt network is converted to Q values on the grid, so that it is certified, served and
played back like any other policy. At each cell's centre let a be the step that the network returns, as far as the box
allows it. Every move m, in cells, has the value

    q(m) = 1 - |a - m| / sqrt(12)                              (sqrt(12) is the greatest possible |a - m|)

so the greedy move is the nearest one, and the confidence, 1 - q2/q1, falls to 0 if a lies between two moves.

**Network.** A learnt network is a multilayer perceptron: each layer but the last is a weighted sum with a bias,
followed by a ReLU; the last has no ReLU. The weights are stored as the bytes of a safetensors file, which contains
names and numbers and no code, so a network that is read back equals the learnt one to the last bit, and evaluating it
needs only numpy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from skills.arrays import Floats
from skills.errors import BadInput, BadSettings
from skills.gridworld import paper
from skills.gridworld.grid import MOVES, GridPath
from skills.gridworld.reward import RewardLevels, RewardMap
from skills.learning.learner_state import CellState

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]  # weights, (outputs, inputs), and biases, (outputs,)
DECIMALS = 6  # ours: a float32 has seven digits, and sums agree to six whatever the order of summation
DRIFT = 0.5  # ours: the cost per step and per cell of distance from the path


@dataclass(frozen=True)
class Network:
    """The weights of a network, as the bytes of a safetensors file with `0.weight`, `0.bias`, `1.weight` ..."""

    tensors: bytes

    def __post_init__(self) -> None:
        layers = self.layers
        widths = all(below[1].size == above[0].shape[1] for below, above in pairwise(layers))
        if not (layers and widths):
            raise BadInput("A network needs at least one layer, and the sizes of adjacent layers must match.")

    @classmethod
    def of(cls, layers: Sequence[tuple[ArrayLike, ArrayLike]]) -> "Network":
        """Construct a network from the weights, (outputs, inputs), and biases, (outputs,), of its layers."""
        named = {}
        for number, (weight, bias) in enumerate(layers):
            named[f"{number}.weight"] = np.array(weight, np.float32, order="C")
            named[f"{number}.bias"] = np.array(bias, np.float32, order="C")
        return cls(save(named))

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """The layers, read-only.

        Raises:
            BadInput: The bytes are not those of a network, or a number in them is not finite.
        """
        try:
            named = load(self.tensors)
        except SafetensorError as error:
            raise BadInput("The bytes are not a safetensors file.") from error
        layers = []
        for number in range(len(named) // 2):
            weight, bias = named.pop(f"{number}.weight", None), named.pop(f"{number}.bias", None)
            if weight is None or bias is None:
                raise BadInput("A network has a weight and a bias for each of its layers, numbered from 0.")
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or {weight.dtype, bias.dtype} != {np.dtype("f4")}:
                raise BadInput("The weights of a layer are (outputs, inputs), its biases (outputs,), all float32.")
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise BadInput("A weight of the network is NaN or infinite.")
            weight.setflags(write=False)
            bias.setflags(write=False)
            layers.append((weight, bias))
        if named:
            raise BadInput("The file of a network must contain only its layers.")
        return tuple(layers)

    @property
    def inputs(self) -> int:
        """The number of inputs."""
        return int(self.layers[0][0].shape[1])

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return int(self.layers[-1][1].size)

    def answer(self, inputs: ArrayLike) -> Floats:
        """Evaluate the network for inputs, (N, inputs); returns (N, outputs), rounded to `DECIMALS`."""
        at = np.asarray(inputs, np.float64)
        for number, (weight, bias) in enumerate(self.layers):
            at = at @ weight.T.astype(np.float64) + bias  # in float64, so that rounding hides the order of summation
            if number < len(self.layers) - 1:
                at = np.maximum(at, 0.0)
        return np.asarray(at.round(DECIMALS) + 0.0)  # + 0.0 turns -0.0 into 0.0


# ---- settings, and the continuous space ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Space:
    """The continuous space of a path's grid world, and its rewards."""

    path: GridPath
    levels: RewardLevels

    @cached_property
    def low_mm(self) -> Floats:
        """The box's lowest corner, (3,) mm."""
        return self.path.grid.centres_mm(0)

    @cached_property
    def high_mm(self) -> Floats:
        """The box's highest corner, (3,) mm."""
        return self.path.grid.centres_mm(self.path.grid.n_states - 1)

    def scaled(self, positions_mm: ArrayLike) -> Floats:
        """Scale positions, (..., 3) mm, so that the box is -1 to 1 along each axis (0 along an axis without length)."""
        extent = np.where(self.high_mm > self.low_mm, self.high_mm - self.low_mm, np.inf)
        return np.asarray(2 * (np.asarray(positions_mm, float) - (self.low_mm + self.high_mm) / 2) / extent)

    def moved(self, positions_mm: ArrayLike, steps: ArrayLike) -> Floats:
        """Return the positions, (..., 3) mm, after steps, (..., 3) in cells, from positions, (..., 3) mm."""
        made_mm = np.clip(np.asarray(steps, float), -1.0, 1.0) * self.path.grid.cell_mm
        return np.asarray(np.clip(np.asarray(positions_mm, float) + made_mm, self.low_mm, self.high_mm))

    def arrived(self, positions_mm: ArrayLike) -> NDArray[np.bool_]:
        """Return for each position, (..., 3) mm, whether it is in the goal's cell."""
        goal = self.path.cells[-1]
        return np.asarray((self.path.grid.cells_at(positions_mm) == goal).all(axis=-1))

    def along(self, positions_mm: ArrayLike) -> tuple[Floats, Floats]:
        """Return the progress of positions along the demonstration, and their distance from it.

        Args:
            positions_mm: Positions, shape (N, 3).

        Returns:
            The lengths s and the distances u of the module's docstring, both of shape (N,), in cells.
        """
        from_mm = np.asarray(positions_mm, float)[:, None] - self.path.tip_mm[:-1]  # (N, R - 1, 3)
        cells = from_mm / self.path.grid.cell_mm
        share = np.clip((cells * self._legs).sum(axis=-1) / self._lengths**2, 0.0, 1.0)
        off = np.linalg.norm(cells - share[..., None] * self._legs, axis=-1)
        # Rounded, so that distances that differ by a rounding error count as equal.
        nearest = off.shape[1] - 1 - off[:, ::-1].round(9).argmin(axis=1)  # the later one of equals
        rows = np.arange(len(off))
        length = self._before[nearest] + share[rows, nearest] * self._lengths[nearest]
        return np.asarray(length), np.asarray(off[rows, nearest])

    def pays(self, before_mm: ArrayLike, steps: ArrayLike, after_mm: ArrayLike, gamma: float) -> Floats:
        """Return the rewards of steps.

        Args:
            before_mm: Positions before the steps, shape (N, 3).
            steps: The steps, shape (N, 3), in cells.
            after_mm: Positions after the steps, shape (N, 3), as `moved` returns them.
            gamma: The discount in the potential's part of the reward.

        Returns:
            Rewards, shape (N,).
        """
        (s, u), (then, off) = self.along(before_mm), self.along(after_mm)
        made = (np.asarray(after_mm, float) - np.asarray(before_mm, float)) / self.path.grid.cell_mm
        stopped = (np.abs(made - np.clip(np.asarray(steps, float), -1.0, 1.0)) > 1e-6).any(axis=-1)
        progress = np.minimum(gamma * (then - off) - (s - u), 1.0)
        here = progress - DRIFT * off + self.levels.off_grid * stopped
        return np.asarray(here + self.levels.goal * self.arrived(after_mm))

    @cached_property
    def _legs(self) -> Floats:
        """The moves of the demonstration, (R - 1, 3), in cells."""
        return np.asarray(np.diff(self.path.cells, axis=0), np.float64)

    @cached_property
    def _lengths(self) -> Floats:
        """The lengths of these moves, (R - 1,), in cells."""
        return np.asarray(np.linalg.norm(self._legs, axis=1))

    @cached_property
    def _before(self) -> Floats:
        """The length of the demonstration before each of these moves, (R - 1,), in cells."""
        return np.concatenate(([0.0], np.cumsum(self._lengths)[:-1]))


AT_ONCE = 1 << 16  # cells per evaluation of the network: 150 MB at the widest network
FARTHEST = np.sqrt(12.0)


@dataclass(frozen=True)
class DQN(CellState):
    """Settings of deep Q-learning on the grid.

    The behaviour is random until the end, since Q-learning is off-policy: episodes start anywhere, and with a random
    walk the replay memory contains every cell and move of it, which a greedy arm would stop visiting.
    """

    kind: ClassVar[str] = "dqn"

    gamma: float = 0.8  # at 0.1, the table's, values a few cells off the path are too small for a network to resolve
    steps: int = 400_000  # in all environments together: about ten minutes on one core
    width: int = 256  # of both hidden layers; with 128, three times as many actions are suboptimal
    learning_rate: float = 1e-3  # decreases linearly to a fiftieth: with a constant rate the values keep fluctuating
    batch: int = 256
    steps_per_update: int = 4  # the library's default
    target_every: int = 1000  # steps: 250 updates towards values that are constant meanwhile
    worlds: int = 8  # parallel episodes: evaluating the network for eight costs the same as for one

    def __post_init__(self) -> None:
        _check(self)
        if not 1 <= self.target_every <= 10_000_000:
            raise BadSettings("target_every must lie between 1 and 10 000 000.", target_every=self.target_every)


@dataclass(frozen=True)
class DDPG(CellState):
    """Settings of the deep deterministic policy gradient in the continuous space.

    `discount` is the one of the training. The policy is certified like all others, against Algorithm 1's rewards with
    the `gamma` of the table's learners.
    """

    kind: ClassVar[str] = "ddpg"
    gamma: ClassVar[float] = 0.1

    discount: float = 0.98  # the end of a path of 28 states still counts for half; at 0.95 the shortcut wins
    steps: int = 200_000  # two to five minutes on one core
    width: int = 128
    learning_rate: float = 1e-3
    batch: int = 256
    steps_per_update: int = 8  # one update for each step of all eight environments
    noise: float = 0.3  # cells: standard deviation of the noise added to each step in training, so that it explores
    worlds: int = 8

    def __post_init__(self) -> None:
        _check(self)
        if not 0 <= self.noise <= 1:
            raise BadSettings("noise must lie between 0 and 1 cell.", noise=self.noise)


@dataclass(frozen=True)
class TRPO(CellState):
    """Settings of trust-region policy optimisation in the continuous space; `discount` and `gamma` as for `DDPG`."""

    kind: ClassVar[str] = "trpo"
    gamma: ClassVar[float] = 0.1

    discount: float = 0.98
    steps: int = 500_000  # two to five minutes on one core
    width: int = 128
    learning_rate: float = 1e-3  # of the critic; the policy's step is bounded by `trust`
    batch: int = 256
    steps_per_update: int = 2048
    trust: float = 0.01  # the greatest Kullback-Leibler divergence of an update
    worlds: int = 8

    def __post_init__(self) -> None:
        _check(self)
        if not 0 < self.trust <= 1:
            raise BadSettings("trust must lie in (0, 1].", trust=self.trust)


InSpace = DDPG | TRPO
Deep = DQN | InSpace


def _check(learner: Deep) -> None:
    """Refuse settings outside of their ranges."""
    ranges = {"steps": 10**9, "width": 1024, "batch": 65_536, "steps_per_update": 1_000_000, "worlds": 64}
    for name, most in ranges.items():
        if not 1 <= getattr(learner, name) <= most:
            raise BadSettings(f"{name} must lie between 1 and {most}.", **{name: getattr(learner, name)})
    discount = "gamma" if isinstance(learner, DQN) else "discount"
    if not 0 < (share := getattr(learner, discount)) < 1:
        raise BadSettings(f"{discount} must lie in (0, 1).", **{discount: share})
    if not 0 < learner.learning_rate <= 1:
        raise BadSettings("learning_rate must lie in (0, 1].", learning_rate=learner.learning_rate)


def inputs_of(learner: Deep, reward: RewardMap) -> int:
    """Return the number of inputs of a learner's network.

    Args:
        learner: The learner.
        reward: The reward map, whose grid determines the one-hot inputs of `DQN`.

    Returns:
        The sum of the grid's shape for `DQN`, otherwise 3.
    """
    return sum(reward.path.grid.shape) if isinstance(learner, DQN) else 3


def outputs_of(learner: Deep) -> int:
    """Return the number of outputs of a learner's network.

    Args:
        learner: The learner.

    Returns:
        27 for `DQN`, otherwise 3.
    """
    return paper.N_ACTIONS if isinstance(learner, DQN) else 3


def asked_step(learner: InSpace, network: Network, space: Space, positions_mm: ArrayLike) -> Floats:
    """Return the step of a network at each position.

    Args:
        learner: The learner, which determines the output function.
        network: Its network.
        space: The space of the path.
        positions_mm: Positions, shape (N, 3).

    Returns:
        Steps, shape (N, 3), from -1 to 1 cell.
    """
    answer = network.answer(space.scaled(positions_mm))
    return np.tanh(answer) if isinstance(learner, DDPG) else np.clip(answer, -1.0, 1.0)


def network_q(reward: RewardMap, learner: Deep, network: Network) -> Floats:
    """Return the Q values of a network on the grid.

    Args:
        reward: The reward map from which it was learnt.
        learner: The settings of the learner.
        network: The network.

    Returns:
        Q values, shape (n_states, 27); 0 at the goal, where the task is finished.

    Raises:
        BadInput: The network's inputs and outputs are not those of this learner on this grid.
    """
    if (network.inputs, network.outputs) != (inputs_of(learner, reward), outputs_of(learner)):
        raise BadInput(
            f"A {learner.kind} network for this grid takes {inputs_of(learner, reward)} numbers and returns "
            f"{outputs_of(learner)}; this one takes {network.inputs} and returns {network.outputs}."
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
    """Return cells, (N, 3), one-hot encoded along each axis and concatenated, (N, sum of the shape)."""
    return np.concatenate([np.eye(side)[axis] for axis, side in zip(np.asarray(cells).T, shape, strict=True)], axis=1)
