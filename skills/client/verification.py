"""Verification of a downloaded policy against its digest.

The digest covers the policy and its metadata. The service sends both; the policy is rebuilt from them and the digest
computed again. Whoever changed a number, in transit or in the store, would have to change the digest too, and the
digest is the one that is cited.
"""

import io
from typing import Any

import numpy as np

from skills.errors import Corrupt
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import RewardLevels
from skills.learning.learners import learner_of
from skills.learning.network import Network
from skills.learning.policy import Policy
from skills.learning.q_learning import Training
from skills.library.integrity import policy_identity

# Fields of a version or of its response, which the digest does not cover.
OF_THE_VERSION = ("version", "sha256", "created_at", "released_at", "released_by", "actions", "arrays")


def rebuilt(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> Policy:
    """Return a policy, rebuilt from its JSON, its arrays, and the demonstration that it follows.

    Raises:
        Corrupt: It does not match its digest.
    """
    try:
        policy = _policy(about, arrays, demo)
        manifest = {name: value for name, value in about.items() if name not in OF_THE_VERSION}
        whole = policy_identity(manifest, policy) == about["sha256"]
        told = about["actions"] is None or about["actions"] == policy.table().tolist()
    except Exception as error:  # data of another kind can raise any class
        raise Corrupt("This version of the client cannot verify the received policy; update the client.") from error
    if not (whole and told):
        raise Corrupt("The received policy does not match its digest. Do not use it; fetch it again.")
    return policy


def _policy(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> Policy:
    grid = GridWorld(**{name: about["grid"][name] for name in ("origin_mm", "cell_mm", "shape")})
    shown = about.get("combined") or demo["report"] | {"hysteresis": demo["hysteresis"]}
    bridged, hysteresis = shown.get("bridged_cells") or 0, shown["hysteresis"]
    path = GridPath(grid, np.array(about["waypoints"]), bridged=bridged, hysteresis=hysteresis)
    learner = learner_of({"kind": about["learner"], **about["settings"]})
    domain = Domain(path, learner.phased)
    q = np.zeros((domain.n_rows, 27))
    with np.load(io.BytesIO(arrays), allow_pickle=False) as sent:
        q[domain.certified] = sent["q"]
        network = Network(sent["network"].tobytes()) if "network" in sent else None
    levels, training = RewardLevels(**about["reward_levels"]), Training(**about["training"])
    return Policy(path, levels, learner, about["seed"], training, q, network)
