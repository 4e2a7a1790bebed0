"""What the settings of all learners of one state have in common: the paper's cell state, and the phase state, ours."""

from dataclasses import dataclass
from typing import ClassVar

from skills.errors import BadSettings
from skills.gridworld.domain import check_join_share
from skills.gridworld.slip import SlipModel, slip_model


class CellState:
    """Settings of a learner in the paper's cell state, which has no slips and joins by the rule nearest alone."""

    phased: ClassVar[bool] = False
    slip: ClassVar[float] = 0.0
    join_share: ClassVar[float] = 0.0
    slip_model: ClassVar[SlipModel] = slip_model(0.0)


@dataclass(frozen=True, kw_only=True)
class PhaseState:
    """Settings of a learner in the phase state.

    Attributes:
        slip: Probability that a move slips (`skills.gridworld.slip`).
        join_share: The joining rule: least share of the demonstration that a start is led to follow.
    """

    phased: ClassVar[bool] = True

    slip: float = 0.0
    join_share: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.slip < 1:
            raise BadSettings("slip must lie in [0, 1).", slip=self.slip)
        check_join_share(self.join_share)

    @property
    def slip_model(self) -> SlipModel:
        """How moves slip: learning, exact values, certificates and odds follow it."""
        return slip_model(self.slip)
