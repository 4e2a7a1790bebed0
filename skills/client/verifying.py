"""Verification of a downloaded policy, without a database.

The service sends a policy and its metadata; the policy is rebuilt from them, and their digest is computed again.
Whoever changed a number, in transit or in the store, would have to change the digest too, and the digest is cited.
"""

import io

import numpy as np

from skills.errors import Corrupt
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.hazards import Surroundings
from skills.learning.networks import Network
from skills.learning.policy import Policy as LearntPolicy
from skills.learning.policy import learner_of
from skills.learning.q_learning import Training
from skills.schemas.demos import Demonstration
from skills.schemas.policies import Policy, PolicyManifest
from skills.schemas.policy_document import digest_of_numbers, live_actions_of


def rebuild_policy(document: bytes, arrays: bytes, demo: bytes) -> LearntPolicy:
    """Return a policy, rebuilt from its JSON, its arrays, and the JSON of the demonstration that it follows.

    Raises:
        Corrupt: It does not match its digest.
    """
    try:
        policy = _policy(Policy.model_validate_json(document), arrays, Demonstration.model_validate_json(demo))
        is_intact = _is_intact(document, policy)
    except Exception as error:  # data of another kind can raise any class
        raise Corrupt("This version of the client cannot verify the received policy; update the client.") from error
    if not is_intact:
        raise Corrupt("The received policy does not match its digest. Do not use it; fetch it again.")
    return policy


def _is_intact(document: bytes, policy: LearntPolicy) -> bool:
    """Return whether a policy and its JSON match the digest in it, and the actions there those of the policy."""
    said = Policy.model_validate_json(document)
    live = None if said.live_actions is None else [*said.live_actions]
    return (
        PolicyManifest.model_validate_json(document).identity(digest_of_numbers(policy)) == said.sha256
        and (said.actions is None or said.actions == policy.table().tolist())
        and live == live_actions_of(policy)
    )


def _policy(said: Policy, arrays: bytes, demo: Demonstration) -> LearntPolicy:
    grid = GridWorld(**vars(said.grid))
    if said.combined is None:
        bridged, hysteresis = demo.report.bridged_cells, demo.hysteresis
    else:
        bridged, hysteresis = said.combined.bridged_cells, said.combined.hysteresis
    path = GridPath(grid, np.array(said.waypoints), bridged=bridged, hysteresis=hysteresis)
    learner = learner_of({"kind": said.learner, **said.settings})
    domain = Domain(path, learner.phased, learner.join_share)
    q = np.zeros((domain.n_rows, 27))
    with np.load(io.BytesIO(arrays), allow_pickle=False) as sent:
        q[domain.certified] = sent["q"]
        network = Network(sent["network"].tobytes()) if "network" in sent else None
    training = Training(**vars(said.training))
    scene = None if said.scene is None else Surroundings(said.scene.scene, said.scene.costs)
    return LearntPolicy(path, said.reward_levels, learner, said.seed, training, q, network, said.ties, scene)
