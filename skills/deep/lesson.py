"""What is asked of the process that learns, and what it answers."""

from dataclasses import dataclass

from skills.packing import known
from skills.style.grid import GridPath, GridWorld
from skills.style.learning.beyond import DDPG, DQN, TRPO, Deep
from skills.style.learning.q_learning import Training
from skills.style.network import Network
from skills.style.reward import RewardLevels, RewardMap


@dataclass(frozen=True, eq=False)
class Lesson:
    """What is to be learnt, and how."""

    reward: RewardMap
    learner: Deep
    seed: int


@dataclass(frozen=True, eq=False)
class Learnt:
    """What was learnt, and what it took."""

    network: Network
    training: Training


KNOWN = known(Lesson, Learnt, RewardMap, RewardLevels, GridPath, GridWorld, DQN, DDPG, TRPO, Network, Training)
