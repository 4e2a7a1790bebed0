"""Learn with any learner: in this process with a table, in one of its own with a network.

Libraries that learn with networks seed the random numbers of the whole process and choose its threads. In a process of
their own they can do both, two trainings do not disturb each other, one that is cancelled is ended at once, and its
memory is given back.
"""

import re
from collections.abc import Callable
from importlib.util import find_spec
from io import BytesIO
from math import ceil

from skills import packing
from skills.confined import fresh
from skills.confined.limits import Limits
from skills.deep.lesson import KNOWN, Learnt, Lesson
from skills.errors import LearnerNotInstalled, LearningFailed, Unanswered
from skills.style import policy as table
from skills.style.learning.beyond import DDPG, DQN, TRPO, network_q
from skills.style.learning.learners import Learner, check_learnable
from skills.style.policy import Policy
from skills.style.reward import RewardMap

NEEDED = ("torch", "stable_baselines3", "sb3_contrib", "gymnasium")
TARGET = "skills.deep.training:train"
TIMEOUT_S = 3600.0  # ours: the default budgets take ten minutes on one core
MEMORY_BYTES = 6 << 30  # ours, of addresses: torch alone claims 3 GiB, and uses a tenth of it
PROGRESS = re.compile(rb"progress (\d\.\d+)\n")
_ADVICE = {
    "hung": "ask for fewer steps, or allow more time",
    "crashed": "train again, and report it if it stays",
    "out of memory": "ask for fewer steps or a smaller batch, or allow more",
    "too much": "which no training does; report it",
    "failed": "its last words are in the log",
}

Tell = Callable[[float], None]


def require_installed(learner: Learner) -> None:
    """Refuse a learner that cannot be had here, before anything is begun.

    Raises:
        LearnerNotInstalled: It needs the extra `deep`.
    """
    if isinstance(learner, DQN | DDPG | TRPO) and (missing := [name for name in NEEDED if find_spec(name) is None]):
        raise LearnerNotInstalled(
            f"The learner '{learner.kind}' needs {', '.join(missing)}, which is not installed here. Install the extra "
            "'deep' for the service and its workers (`make deep`, or `pip install 'suture-skills[deep]'`), or take "
            "another learner.",
            missing=missing,
        )


def learn_policy(
    reward: RewardMap,
    learner: Learner,
    seed: int = 0,
    *,
    tell: Tell | None = None,
    timeout_s: float = TIMEOUT_S,
    memory_bytes: int = MEMORY_BYTES,
) -> Policy:
    """Learn to follow a demonstration from its reward map; the same arguments give the same bytes on one machine.

    Args:
        reward: What is to be learnt from.
        learner: How; those of `skills.style.learning.beyond` learn in a process of their own.
        seed: Of whatever is drawn.
        tell: Is told about every second how far the learning has come, from 0 to 1; what it raises ends the learning.
        timeout_s: Seconds by the clock after which such a process is killed.
        memory_bytes: What it may use.

    Raises:
        BadSettings: The seed, the levels or the settings cannot be meant.
        LearnerNotInstalled: The learner needs the extra `deep`.
        LearningFailed: Its process crashed, or was not done within its limits.
    """
    if not isinstance(learner, DQN | DDPG | TRPO):
        return table.learn_policy(reward, learner, seed)
    check_learnable(reward, learner, seed)
    require_installed(learner)
    learnt = _learn_aside(Lesson(reward, learner, seed), tell, timeout_s, memory_bytes)
    q = network_q(reward, learner, learnt.network)
    return Policy(reward.path, reward.levels, learner, seed, learnt.training, q, learnt.network)


def _learn_aside(lesson: Lesson, tell: Tell | None, timeout_s: float, memory_bytes: int) -> Learnt:
    request = BytesIO()
    packing.write(request, lesson, KNOWN)
    limits = Limits(memory_bytes, timeout_s, ceil(timeout_s) + 1)

    def watch(said: bytes) -> None:
        if tell is not None and (steps := PROGRESS.findall(said)):
            tell(min(float(steps[-1]), 1.0))

    try:
        answer = fresh.run(TARGET, request.getvalue(), limits, watch)
    except Unanswered as error:
        failed = LearningFailed(f"What learns {error.did}; {_ADVICE[error.cause]}.", cause=error.cause)
        for words in getattr(error, "__notes__", ()):
            failed.add_note(words)
        raise failed from None
    try:
        learnt = packing.read(BytesIO(answer), KNOWN)
    except Exception as error:  # of any class, where it is something else
        raise LearningFailed("What learns answered nonsense; train again.", cause="nonsense") from error
    if not isinstance(learnt, Learnt):
        raise LearningFailed("What learns answered something else than was asked; report it.", cause="nonsense")
    return learnt
