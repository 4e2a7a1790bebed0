"""suture-skills: learn, certify, serve and check how a surgeon hands the needle on. Research use only.

The table of contents: the line from a recording to a checked playback, a noun and the verb that makes it at a time.
Names are loaded when they are first used, so that the client and the command line start without the learning core.
"""

from importlib import import_module
from importlib.metadata import version
from typing import Any

__version__ = version("suture-skills")

_CONTENTS = {
    "Recording": "style.recording",
    "read_recording": "recordings",
    "Demo": "style.demo",
    "cut_demo": "style.demo",
    "GridWorld": "style.grid",
    "GridPath": "style.grid",
    "discretize": "style.grid",
    "RewardMap": "style.reward",
    "sparse_reward": "style.reward",
    "PhaseQLearning": "style.learning.q_learning",
    "CellQLearning": "style.learning.q_learning",
    "ValueIteration": "style.learning.value_iteration",
    "MaxEntIRL": "style.learning.irl",
    "Policy": "style.policy",
    "DQN": "style.learning.beyond",
    "DDPG": "style.learning.beyond",
    "TRPO": "style.learning.beyond",
    "learn_policy": "deep",
    "Certificate": "style.certificate",
    "certify": "style.certificate",
    "Rollout": "style.policy",
    "rollout": "style.policy",
    "SuturePoint": "style.plan",
    "SuturePlan": "style.plan",
    "stack": "style.plan",
    "Trajectory": "style.trajectory",
    "time_parametrise": "style.trajectory",
    "Playback": "style.playback",
    "play": "sim.player",
    "PlaybackReport": "style.playback_report",
    "judge": "style.verdict",
}
__all__ = [*_CONTENTS, "__version__"]


def __getattr__(name: str) -> Any:
    """Load a name of the table of contents."""
    if name not in _CONTENTS:
        raise AttributeError(f"skills has no {name!r}")
    return getattr(import_module(f"skills.{_CONTENTS[name]}"), name)
