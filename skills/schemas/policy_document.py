"""The document of a policy: the layout of its actions in JSON, and the digest of its numbers.

The service writes and verifies policies with this module, and so does the client, which has no database.
"""

from typing import Any

import numpy as np

from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.hazards import SceneCosts, Surroundings
from skills.gridworld.reward import RewardLevels
from skills.gridworld.scene import Box, Capsule, Scene, Tissue
from skills.learning.networks import Network
from skills.learning.policy import LEARNERS, Policy
from skills.learning.q_learning import Training
from skills.learning.ties import ShortestApproach
from skills.packing import digest_of, flatten, known, store_as_palette
from skills.schemas.policies import PhaseActions

MAX_JSON_ACTIONS = 10**6  # ours: above it, JSON has the certified domain alone, in `live_actions`
# The classes of a policy and of its parts.
POLICY_CLASSES = known(
    Policy, GridWorld, GridPath, RewardLevels, *LEARNERS.values(), Training, Network, ShortestApproach
)
POLICY_CLASSES |= known(Surroundings, Scene, SceneCosts, Box, Capsule, Tissue)
store_as_palette(Policy, "q")  # some 130 different values in 200,000 places: stored as a palette


def digest_of_numbers(policy: Policy) -> str:
    """Return the digest of a policy's numbers, the part of its version's digest beside `PolicyManifest.identity`."""
    arrays: list[Any] = []
    return digest_of(flatten(policy, arrays, POLICY_CLASSES), arrays)


def actions_of(policy: Policy) -> list[list[int]] | None:
    """Return the greedy actions by phase and state; None if there are more than `MAX_JSON_ACTIONS`."""
    if policy.domain.phases * policy.path.grid.n_states > MAX_JSON_ACTIONS:
        return None
    table: list[list[int]] = policy.table().tolist()
    return table


def live_actions_of(policy: Policy) -> list[PhaseActions] | None:
    """Return the greedy actions of the certified domain by phase.

    There are at most `skills.learning.policy.MAX_BYTES` / `BYTES_A_ROW` actions, 7 million; a larger policy cannot be
    learnt.

    Returns:
        None where `actions_of` returns the actions of all states.
    """
    domain = policy.domain
    if domain.phases * policy.path.grid.n_states <= MAX_JSON_ACTIONS:
        return None
    of_phases = np.split(policy.greedy, domain.offset[1:-1])
    return [
        PhaseActions.model_construct(low=low, size=size, actions=actions.tolist())
        for low, size, actions in zip(domain.low.tolist(), domain.size.tolist(), of_phases, strict=True)
    ]
