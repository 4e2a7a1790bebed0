"""Whether a policy that was fetched is the one that its digest names.

The digest is over the policy and over all that is said of it. A service sends both, so they are put together again here
and the digest is taken anew: whoever changed a number, on the way or in the store, would have to change the digest too,
and it is the digest that is cited.
"""

import io
from typing import Any

import numpy as np

from skills.errors import Corrupt
from skills.library.training import learner_of
from skills.library.verified import policy_identity
from skills.style.domain import Domain
from skills.style.grid import GridPath, GridWorld
from skills.style.learning.q_learning import Training
from skills.style.network import Network
from skills.style.policy import Policy
from skills.style.reward import RewardLevels

# What is said of a version, and not of the policy: it is no part of the digest.
OF_THE_VERSION = ("version", "sha256", "created_at", "released_at", "released_by", "actions", "arrays")


def rebuilt(about: dict[str, Any], arrays: bytes, demo: dict[str, Any]) -> Policy:
    """Put a policy together from what the service says of it, its arrays, and the demonstration that it follows.

    Raises:
        Corrupt: It is not what its digest was taken of.
    """
    try:
        policy = _policy(about, arrays, demo)
        manifest = {name: value for name, value in about.items() if name not in OF_THE_VERSION}
        whole = policy_identity(manifest, policy) == about["sha256"]
        told = about["actions"] is None or about["actions"] == policy.table().tolist()
    except Exception as error:  # of any class, where it is something else
        raise Corrupt("What came is no policy that this version of the client can check; update it.") from error
    if not (whole and told):
        raise Corrupt("What came is not the policy that its digest names. Do not use it; fetch it again.")
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
