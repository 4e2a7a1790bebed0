"""Learning with any learner: tabular in this process, with a network in a process of its own.

    RewardMap --learn_policy--> Policy

The libraries that train networks (the extra `deep`) seed the random numbers and set the threads of the whole process,
so they are imported only in a separate process. Two trainings do not disturb each other, a cancelled training ends at
once, and its memory is returned to the system. A service starts without them, and serves policies that were learnt
elsewhere. `skills.deep.trainer` is that process; `skills.deep.environments` has its Gymnasium
environments.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

from skills.errors import LearningFailed, NotInstalled, Unanswered
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import RewardLevels, RewardMap
from skills.learning import policy as table
from skills.learning.networks import DDPG, DQN, TRPO, Deep, Network, network_q
from skills.learning.policy import Learner, Policy, check_learnable
from skills.learning.q_learning import Training
from skills.learning.ties import REMOTE_CENTRE, ShortestApproach
from skills.packing import known
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import call_alone

NEEDED = ("torch", "stable_baselines3", "sb3_contrib", "gymnasium")
TARGET = "skills.deep.trainer:train"
TIMEOUT_S = 3600.0  # ours: the default budgets take ten minutes on one core
MEMORY_BYTES = 6 << 30  # ours, of address space: torch alone reserves 3 GiB, and uses a tenth of it
PROGRESS = re.compile(rb"progress (\d\.\d+)\n")
_ADVICE = {
    "hung": "request fewer steps, or allow more time",
    "crashed": "train again, and report it if it happens again",
    "contained": "report it with the log",
    "out of memory": "request fewer steps or a smaller batch, or allow more",
    "too much": "which no training does; report it",
    "failed": "train again, and report it if it happens again",
    "nonsense": "train again",
}


@dataclass(frozen=True, eq=False)
class NetworkLesson:
    """The request: the reward map, the settings of the learner and the seed."""

    reward: RewardMap
    learner: Deep
    seed: int


@dataclass(frozen=True, eq=False)
class LearntNetwork:
    """The response: the trained network, and the counts of the training."""

    network: Network
    training: Training


KNOWN = known(
    NetworkLesson, LearntNetwork, RewardMap, RewardLevels, GridPath, GridWorld, DQN, DDPG, TRPO, Network, Training
)


Progress = Callable[[float], None]


def require_installed(learner: Learner) -> None:
    """Refuse a learner whose libraries are not installed, before any work.

    Raises:
        NotInstalled: It needs the extra `deep`.
    """
    # `find_spec` does not import torch, which this process is to do without.
    if isinstance(learner, DQN | DDPG | TRPO) and (missing := [name for name in NEEDED if find_spec(name) is None]):
        raise NotInstalled(
            f"The learner '{learner.kind}' needs {', '.join(missing)}, which is not installed here. Install the "
            "extra 'deep' for the service and its workers (`make deep`, or `pip install 'suture-skills[deep]'`), "
            "or choose another learner.",
            missing=missing,
        )


def learn_policy(
    reward: RewardMap,
    learner: Learner,
    seed: int = 0,
    *,
    ties: ShortestApproach | None = REMOTE_CENTRE,
    progress: Progress | None = None,
    timeout_s: float = TIMEOUT_S,
    memory_bytes: int = MEMORY_BYTES,
) -> Policy:
    """Learn to follow a demonstration from its reward map; the same arguments give the same bytes on one machine.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner; those of `skills.learning.networks` are trained in a separate
            process.
        seed: Seed of all random numbers.
        ties: The rule among equally good actions, as for `learn_tabular`; not used by learners with a network.
        progress: Callback with the progress, from 0 to 1, about every second; an exception that it raises ends the
            training.
        timeout_s: Seconds of wall time after which the separate process is killed.
        memory_bytes: Limit of the separate process's address space.

    Returns:
        The policy.

    Raises:
        BadSettings: The seed, the levels or the settings are out of range.
        NotInstalled: The learner needs the extra `deep`.
        LearningFailed: The separate process crashed, or exceeded its time or memory.
    """
    if not isinstance(learner, DQN | DDPG | TRPO):
        return table.learn_tabular(reward, learner, seed, ties)
    check_learnable(reward, learner, seed)
    require_installed(learner)
    learnt = _learn_in_process(NetworkLesson(reward, learner, seed), progress, ProcessLimits(memory_bytes, timeout_s))
    q = network_q(reward, learner, learnt.network)
    return Policy(reward.path, reward.levels, learner, seed, learnt.training, q, learnt.network)


def _learn_in_process(lesson: NetworkLesson, progress: Progress | None, limits: ProcessLimits) -> LearntNetwork:
    def watch(output: bytes) -> None:
        if progress is not None and (steps := PROGRESS.findall(output)):
            progress(min(float(steps[-1]), 1.0))

    try:
        return call_alone(TARGET, lesson, returns=(LearntNetwork,), classes=KNOWN, limits=limits, watch=watch)
    except Unanswered as error:
        raise error.translated(LearningFailed, "The learning process", _ADVICE) from error.__cause__
