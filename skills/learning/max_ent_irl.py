"""Maximum-entropy inverse reinforcement learning (Ziebart et al. 2008): the baseline that failed in Sec. III-C.

    GridPath --recover_reward--> RecoveredReward

Symbols: the demonstration enters the states w_1 ... w_T from its start w_0, so T is its number of moves. r(s) is the
reward for entering state s, one feature per state. A trajectory of T moves from w_0 to the goal w_T has the probability
exp(sum of its rewards) / Z; standing still is a move, a move off the grid is not. With

    B_t(s)  summed exp(rewards) of all trajectories from s at time t to the goal at T     (backward)
    F_t(s)  the same of all trajectories from w_0 at 0 to s at t, the reward of s included           (forward)

Z = B_0(w_0), the expected visits of s are the sum over t = 1 ... T of F_t B_t / Z, and the gradient of
the demonstration's log-likelihood is its own visits minus the expected ones. Both recursions are the same sum over a
cell and its neighbours of numbers with a power of two each, so that nothing overflows or vanishes.

**The reward is recovered, and does not help.** On the paper's demonstration nearly all of the highest rewards lie on
the visited cells. But a positive reward of a *state* pays again at every step, also for standing still: that is worth
r / (1 - gamma), more than following the path and ending at the goal. So value iteration on it walks to the best cell
nearby and stays. The paper blames a lack of exploration; value iteration needs no exploration, and its policy here is
the exact optimum of the wrong problem. In the model the horizon T and the given goal forbid standing still for ever; a
policy of states has neither. The model also cannot distinguish a reward from the same reward minus a constant, since
every trajectory has T moves: with a constant so large that all rewards are below -1, and with gamma 0.99, the goal is
reached from everywhere (a test shows it), by cutting nearly every corner.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from skills.arithmetic import exp
from skills.arrays import Floats, freeze
from skills.compiled import compiled
from skills.errors import BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardMap
from skills.learning.dynamic_programming import Mdp, exact_q
from skills.learning.learner_state import CellState

HALVES = tuple(0.5**power for power in range(64))  # a part of a sum that is smaller does not change it
MAX_NUMBERS = 2**24  # ours: moves x cells; B_t for all t takes 192 MiB then, and an iteration some seconds


@dataclass(frozen=True)
class MaxEntIRL(CellState):
    """Settings of maximum-entropy IRL, and of value iteration on the recovered reward; the paper states none of them.

    After 200 iterations the likelihood of the paper's demonstration is within 0.004 nat per move of that after 600.
    The failure does not depend on gamma (0.1 to 0.99 were tried).
    """

    kind: ClassVar[str] = "max-ent-irl"

    iterations: int = 200
    learning_rate: float = 0.1  # of Adam
    l2: float = 0.01  # weight of the squared rewards, which holds those of unvisited states at 0
    gamma: float = 0.8  # of the value iteration; Algorithm 1, which certifies, pays for standing still too from 0.9 on

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 1000:
            raise BadSettings("iterations must lie between 1 and 1000.", iterations=self.iterations)
        if not 0 < self.learning_rate <= 1:
            raise BadSettings("learning_rate must lie in (0, 1].", learning_rate=self.learning_rate)
        if not 0 <= self.l2 <= 1:
            raise BadSettings("l2 must lie in [0, 1].", l2=self.l2)
        if not 0 < self.gamma <= 0.99:
            raise BadSettings(
                "gamma must lie in (0, 0.99]: closer to 1, value iteration takes too long to converge.",
                gamma=self.gamma,
            )


@dataclass(frozen=True, eq=False)
class RecoveredReward:
    """The reward for entering each state, (n_states,), and its fit to the demonstration.

    Each pair is (before, after): with all rewards 0, and with the recovered ones. The negative log-likelihood is in
    nat per move, the visit error in visits: |expected - demonstrated| summed over all states.
    """

    rewards: Floats
    negative_log_likelihood: tuple[float, float]
    visit_error: tuple[float, float]

    def __post_init__(self) -> None:
        freeze(self, rewards=(None,))


def recover_reward(path: GridPath, settings: MaxEntIRL) -> RecoveredReward:
    """Maximise the likelihood of the demonstration over the rewards, minus the penalty l2/2 |r|^2.

    The same path and settings give the same bytes; nothing is drawn at random.

    Args:
        path: The demonstrated path.
        settings: The settings of the learner.

    Returns:
        The recovered rewards and their fit.

    Raises:
        BadSettings: Moves times cells are more than `MAX_NUMBERS`.
    """
    if (len(path.states) - 1) * path.grid.n_states > MAX_NUMBERS:
        raise BadSettings(
            f"{len(path.states) - 1} moves in a grid of {path.grid.n_states} cells are too many for "
            "maximum-entropy IRL; use larger cells or a shorter hand-off.",
            moves=len(path.states) - 1,
        )
    demonstrated = np.bincount(path.states[1:], minlength=path.grid.n_states)
    rewards = np.zeros(path.grid.n_states)
    adam = _Adam(rewards, settings.learning_rate)
    likelihood, visits = soft_visits(path, rewards)
    before = likelihood, float(np.abs(visits - demonstrated).sum())
    for _ in range(settings.iterations):
        adam.descend(visits - demonstrated + settings.l2 * rewards)
        likelihood, visits = soft_visits(path, rewards)
    after = likelihood, float(np.abs(visits - demonstrated).sum())
    return RecoveredReward(rewards, (before[0], after[0]), (before[1], after[1]))


def soft_visits(path: GridPath, rewards: Floats) -> tuple[float, Floats]:
    """Evaluate the model of the module's docstring for given rewards.

    Args:
        path: The demonstrated path.
        rewards: The reward for entering each state, shape (n_states,).

    Returns:
        The negative log-likelihood of the demonstration in nat per move, and the expected number of times that each
        state is entered, shape (n_states,); these sum to T.
    """
    moves, shape = len(path.states) - 1, path.grid.shape
    factor, twos = exp(rewards.reshape(shape))
    backward, powers = np.zeros((moves + 1, *shape)), np.zeros((moves + 1, *shape), np.int32)
    backward[moves].flat[path.goal] = 1.0
    for t in range(moves - 1, -1, -1):
        sum_around(factor * backward[t + 1], twos + powers[t + 1], backward[t], powers[t])
    z, z_power = backward[0].flat[path.start], powers[0].flat[path.start]
    forward, power, visits = np.zeros(shape), np.zeros(shape, np.int32), np.zeros(shape)
    forward.flat[path.start] = 1.0
    for t in range(1, moves + 1):
        after, after_power = np.empty(shape), np.empty(shape, np.int32)
        sum_around(forward, power, after, after_power)
        forward, power = factor * after, twos + after_power
        visits += np.ldexp(forward * backward[t] / z, power + powers[t] - z_power)
    log_z = float(np.log(z) + z_power * np.log(2.0))  # reported alone: no learnt number depends on it
    return (log_z - float(rewards[path.states[1:]].sum())) / moves, visits.reshape(-1)


@compiled
def sum_around(numbers: Any, powers: Any, total: Any, total_powers: Any) -> None:
    """Add up each cell of a grid and its neighbours, at most 27 numbers, each times a power of two.

    Args:
        numbers: Not negative, shape (nx, ny, nz), float64; all but 0 of the same size within a few powers of two.
        powers: The power of two of each, shape (nx, ny, nz), int32.
        total: The sums, shape (nx, ny, nz), float64: 0, or from 1 to below 2.
        total_powers: The power of two of each, shape (nx, ny, nz), int32; 0 for a sum of 0.
    """
    nx, ny, nz = numbers.shape
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                added, top = 0.0, 0
                for to_x in range(max(x - 1, 0), min(x + 2, nx)):
                    for to_y in range(max(y - 1, 0), min(y + 2, ny)):
                        for to_z in range(max(z - 1, 0), min(z + 2, nz)):
                            number, power = numbers[to_x, to_y, to_z], powers[to_x, to_y, to_z]
                            if number == 0.0:
                                continue
                            if added == 0.0 or power - top >= len(HALVES):
                                added, top = number, power
                            elif power > top:
                                added, top = added * HALVES[power - top] + number, power
                            elif top - power < len(HALVES):
                                added += number * HALVES[top - power]
                while added >= 2.0:
                    added, top = 0.5 * added, top + 1
                while 0.0 < added < 1.0:
                    added, top = 2.0 * added, top - 1
                total[x, y, z] = added
                total_powers[x, y, z] = top


class _Adam:
    """The optimiser of Kingma and Ba (2015) with their constants; it changes `values` in place."""

    def __init__(self, values: Floats, learning_rate: float) -> None:
        self.values, self.learning_rate = values, learning_rate
        self.mean, self.square = np.zeros_like(values), np.zeros_like(values)
        self.mean_left, self.square_left = 1.0, 1.0  # of the zeros that both began with

    def descend(self, gradient: Floats) -> None:
        """Make one step of gradient descent."""
        self.mean_left, self.square_left = 0.9 * self.mean_left, 0.999 * self.square_left
        self.mean += 0.1 * (gradient - self.mean)
        self.square += 0.001 * (gradient**2 - self.square)
        mean = self.mean / (1 - self.mean_left)
        square = self.square / (1 - self.square_left)
        self.values -= self.learning_rate * mean / (np.sqrt(square) + 1e-8)


def learn_from_recovered(reward: RewardMap, settings: MaxEntIRL) -> Floats:
    """Recover the reward of a map's path and iterate values on it in the cell state.

    Of the map itself only its path and its reward levels are used: of these the one for a move off the grid. An episode
    ends at the goal.

    Args:
        reward: The reward map of the demonstrated path.
        settings: The settings of the learner.

    Returns:
        Q values, shape (n_states, 27).

    Raises:
        BadSettings: As for `recover_reward`.
    """
    recovered = replace(reward, rewards=recover_reward(reward.path, settings).rewards)
    return exact_q(Mdp(Domain(reward.path, settings.phased), recovered, settings.gamma))
