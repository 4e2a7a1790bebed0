"""Fig. 5: the reward that maximum-entropy IRL recovers from a demonstration, and the sparse reward of Algorithm 1."""

from dataclasses import dataclass

import numpy as np

from skills.style._arrays import Floats
from skills.style.certificate import coverage
from skills.style.grid import GridPath
from skills.style.learning.irl import MaxEntIRL, recover_reward
from skills.style.policy import Rollout, learn_policy, rollout_from
from skills.style.reward import sparse_reward


@dataclass(frozen=True, eq=False)
class RewardFunctions:
    """Both rewards of every state, and what became of the recovered one.

    Attributes:
        recovered: Reward of entering each state, (n_states,).
        sparse: The same of Algorithm 1.
        visited: Different states that the demonstration visits.
        found: How many of the `visited` highest recovered rewards lie on visited states.
        nats: Negative log-likelihood of the demonstration per move, with all rewards 0 and with the recovered ones.
        iterations: Of IRL.
        starts_reaching: Starts from which value iteration on the recovered reward leads to the goal.
        walk: Where it leads from the demonstrated start.
    """

    recovered: Floats
    sparse: Floats
    visited: int
    found: int
    nats: tuple[float, float]
    iterations: int
    starts_reaching: int
    walk: Rollout


def compare_rewards(path: GridPath, iterations: int) -> RewardFunctions:
    """Recover a reward by IRL, iterate values on it, and put Algorithm 1's beside it. No seed is in it."""
    learner, reward = MaxEntIRL(iterations=iterations), sparse_reward(path)
    recovered, policy = recover_reward(path, learner), learn_policy(reward, learner)
    visited = np.unique(path.states)
    highest = np.argsort(-recovered.rewards, kind="stable")[: len(visited)]
    return RewardFunctions(
        recovered=recovered.rewards,
        sparse=reward.rewards,
        visited=len(visited),
        found=int(np.isin(highest, visited).sum()),
        nats=recovered.negative_log_likelihood,
        iterations=iterations,
        starts_reaching=int(coverage(policy).reaches.sum()),
        walk=rollout_from(policy, path.start),
    )
