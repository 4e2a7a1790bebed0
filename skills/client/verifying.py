"""Verification of a downloaded policy, without a database.

The service sends a policy and its metadata; the policy is rebuilt from them, and their digest is computed again.
Whoever changed a number, in transit or in the store, would have to change the digest too, and the digest is cited.
"""

import io
import json

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
from skills.schemas.policies import Policy
from skills.schemas.policy_document import live_actions_of, policy_identity

FORMATS = (1, 2)  # of a policy, that this client can follow
# Fields of a version or of its response, which the digest of a policy does not cover.
OF_THE_VERSION = (
    *("version", "sha256", "created_at", "released_at", "released_by", "arrays"),
    *("actions", "actions_joining", "live_actions", "live_actions_joining"),
)


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
    sent = json.loads(document)
    said = Policy.model_validate(sent)
    manifest = {name: value for name, value in sent.items() if name not in OF_THE_VERSION}
    actions, live = said.actions, said.live_actions
    if said.joining is not None:
        actions, live = said.actions_joining, said.live_actions_joining
    return (
        said.format in FORMATS
        and policy_identity(manifest, policy) == said.sha256
        and (actions is None or actions == policy.table().tolist())
        and (None if live is None else [one.model_dump() for one in live]) == live_actions_of(policy)
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
