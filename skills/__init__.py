"""suture-skills: learn, certify, serve and check how a surgeon hands over the needle. Research use only.

The public names, in the order of the data flow from a recording to a checked playback: each type next to the function
that makes it. They are imported at first use, so that the client and the command line start without the learning core.
"""

from importlib import import_module
from typing import Any

_CONTENTS = {
    "Recording": "demonstration.recording",
    "read_recording": "formats",
    "Demo": "demonstration.demonstration",
    "cut_demo": "demonstration.demonstration",
    "partner_motion": "demonstration.demonstration",
    "GridWorld": "gridworld.grid",
    "GridPath": "gridworld.grid",
    "PAPER_GRID": "gridworld.grid",
    "discretize": "gridworld.grid",
    "RewardMap": "gridworld.reward",
    "sparse_reward": "gridworld.reward",
    "PhaseQLearning": "learning.q_learning",
    "CellQLearning": "learning.q_learning",
    "ValueIteration": "learning.dynamic_programming",
    "MaxEntIRL": "learning.max_ent_irl",
    "Policy": "learning.policy",
    "DQN": "learning.networks",
    "DDPG": "learning.networks",
    "TRPO": "learning.networks",
    "learn_policy": "deep",
    "Certificate": "learning.certificate",
    "certify": "learning.certificate",
    "Rollout": "learning.policy",
    "rollout": "learning.policy",
    "Scene": "gridworld.scene",
    "Hazards": "gridworld.hazards",
    "hazards_of": "gridworld.hazards",
    "learn_in_scene": "learning.in_scene",
    "SceneCertificate": "learning.in_scene",
    "certify_in_scene": "learning.in_scene",
    "PoseStyle": "learning.pose_style",
    "learn_pose_style": "learning.pose_style",
    "PosePath": "learning.pose_style",
    "next_pose": "learning.pose_step",
    "TubeCertificate": "learning.tube",
    "certify_tube": "learning.tube",
    "SuturePoint": "planning.plan",
    "SuturePlan": "planning.plan",
    "stack": "planning.plan",
    "Trajectory": "planning.trajectory",
    "time_parametrise": "planning.trajectory",
    "Playback": "verification.playback",
    "play": "simulation.player",
    "PlaybackReport": "verification.verdict",
    "judge": "verification.verdict",
    "PlanVerdict": "verification.verdict",
    "judge_plan": "verification.verdict",
    "Refereed": "simulation.referee",
    "referee": "simulation.referee",
}
__all__ = [*_CONTENTS, "__version__"]


def __getattr__(name: str) -> Any:
    """Import a public name, or look up the version, at its first use."""
    if name == "__version__":
        from importlib.metadata import version  # as slow to import as the rest of a process in the sandbox

        return version("suture-skills")
    if name not in _CONTENTS:
        raise AttributeError(f"skills has no {name!r}")
    return getattr(import_module(f"skills.{_CONTENTS[name]}"), name)
