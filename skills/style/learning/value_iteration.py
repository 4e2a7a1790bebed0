"""Value iteration in the phase state: the exact Q values of Algorithm 1's rewards, without a move of the arm.

The paper tried value iteration first, in its *cell* state, and gave it up (Sec. III-C; `skills.style.learning.irl` is
one reason why it failed there, a path that crosses itself is another). In the phase state it finds what Q-learning
finds, without trying: it knows where moves lead, and Q-learning has to find out.
"""

from dataclasses import dataclass
from typing import ClassVar

from skills.errors import BadSettings
from skills.style._arrays import Floats
from skills.style.domain import Domain
from skills.style.exact import Mdp, exact_q
from skills.style.reward import RewardMap


@dataclass(frozen=True)
class ValueIteration:
    """Settings of value iteration in the phase state. No seed is in what it finds.

    The paper does not state its gamma. Ours is that of `PhaseQLearning`: the nearest waypoint is always worth most.
    """

    kind: ClassVar[str] = "value-iteration"
    phased: ClassVar[bool] = True

    gamma: float = 0.1
    slip: float = 0.0  # how likely, instead of the intended move, any of the 27 is made

    def __post_init__(self) -> None:
        if not 0 <= self.slip < 1:
            raise BadSettings("slip must lie in [0, 1).", slip=self.slip)
        if not 0 < self.gamma < 1:
            raise BadSettings(
                "gamma must lie in (0, 1): with 1 arriving later is worth as much as arriving now.", gamma=self.gamma
            )


def iterate_values(reward: RewardMap, settings: ValueIteration) -> Floats:
    """Work the Q values of a reward map's domain out, (rows, 27).

    Raises:
        BadSettings: Value iteration does not settle.
    """
    return exact_q(Mdp(Domain(reward.path, settings.phased), reward, settings.gamma, settings.slip))
