"""All learners, and the learning of Q values with those that need no network.

`skills.deep.learn_policy` learns with all of them.
"""

from dataclasses import asdict
from typing import Any, get_args

from skills.arrays import Floats
from skills.errors import BadSettings
from skills.gridworld.domain import Domain
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardLevels, RewardMap
from skills.learning.dynamic_programming import ValueIteration, iterate_values
from skills.learning.max_ent_irl import MaxEntIRL, learn_from_recovered
from skills.learning.networks import DDPG, DQN, TRPO
from skills.learning.q_learning import CellQLearning, PhaseQLearning, Training, learn_q

Tabular = PhaseQLearning | CellQLearning | ValueIteration | MaxEntIRL
Learner = Tabular | DQN | DDPG | TRPO
LEARNERS: dict[str, type[Learner]] = {learner.kind: learner for learner in get_args(Learner)}
LEARNER_VERSION = 4  # part of a training's identity: raise it when the same settings would give another result
MAX_SEED = 2**63 - 1
MAX_BYTES = 4 << 30  # ours: a laptop has 8 GiB, and other trainings run at the same time
BYTES_A_ROW = 600  # of the domain, measured with 51 and 101 cells a side: Q values twice, plus intermediate results
BYTES_A_SLIPPING_ROW = 2400  # the certificate stores the result of each of the 27 actions


def describe_learner(learner: Learner) -> dict[str, Any]:
    """Return a learner as JSON: its kind and its settings."""
    return {"kind": learner.kind, **asdict(learner)}


def learner_of(described: dict[str, Any]) -> Learner:
    """Return a learner from its JSON."""
    settings = dict(described)
    kind = settings.pop("kind", None)
    if kind not in LEARNERS:
        raise BadSettings(f"There is no learner of this kind; the learners are {', '.join(LEARNERS)}.")
    return LEARNERS[kind](**settings)


def learn_values(reward: RewardMap, learner: Tabular, seed: int) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain.

    The same reward map, learner and seed give the same bytes; value iteration and IRL do not use the seed.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: Seed of all random numbers, 0 to 2^63 - 1.

    Returns:
        Q values, shape (rows, 27), and the counts of the training.

    Raises:
        BadSettings: As for `check_learnable`; or the values do not settle, or the path is too long for the learner.
    """
    check_learnable(reward, learner, seed)
    if isinstance(learner, ValueIteration):
        return iterate_values(reward, learner), _without_moving(settled=True)
    if isinstance(learner, MaxEntIRL):
        # IRL ends after a fixed number of iterations, not when nothing changes.
        return learn_from_recovered(reward, learner), _without_moving(settled=False)
    return learn_q(reward, learner, seed)


def check_learnable(reward: RewardMap, learner: Learner, seed: int) -> None:
    """Refuse settings with which no learning should be started.

    Args:
        reward: The reward map of the demonstrated path.
        learner: The settings of the learner.
        seed: The seed.

    Raises:
        BadSettings: The seed is not an integer from 0 to 2^63 - 1, or arriving would not pay (see `_refuse_loops`), or
            the grid is too large for memory.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise BadSettings("The seed must be an integer from 0 to 2^63 - 1.")
    _refuse_loops(reward.levels, learner)
    refuse_too_large(reward.path, learner)


def refuse_too_large(path: GridPath, learner: Learner) -> None:
    """Refuse a path whose policy would need too much memory, before any is allocated.

    Args:
        path: The demonstrated path.
        learner: The settings of the learner.

    Raises:
        BadSettings: It would need more than `MAX_BYTES`.
    """
    needed = Domain(path, learner.phased).n_rows * (BYTES_A_SLIPPING_ROW if learner.slip > 0 else BYTES_A_ROW)
    if needed > MAX_BYTES:
        raise BadSettings(
            f"Learning {len(path.states)} waypoints in a grid of {path.grid.n_states} cells needs about "
            f"{needed / 2**30:.1f} GiB of memory, and at most {MAX_BYTES / 2**30:g} GiB are allowed; use larger "
            "cells.",
            needed_bytes=needed,
        )


def _without_moving(*, settled: bool) -> Training:
    """Return the counts of a training without moves of an arm."""
    return Training(steps=0, updates=0, episodes=0, finished=0, out_of_steps=0, out_of_time=0, settled=settled)


def _refuse_loops(levels: RewardLevels, learner: Learner) -> None:
    """Refuse rewards under which going round in circles pays more than arriving.

    `MaxEntIRL` learns from other rewards, but is certified against these with its gamma.
    """
    if learner.phased:
        if levels.other != 0:
            raise BadSettings("In the phase state a move that does not advance has no reward: `other` must be 0.")
        return  # no waypoint pays twice, so no loop does
    if levels.visited <= 0:
        return  # standing still never pays, and the goal pays more
    if learner.gamma == 1:
        raise BadSettings("With gamma 1 the value of standing on a visited cell is infinite; use a gamma below 1.")
    looping = levels.visited / (1 - learner.gamma)
    if not levels.goal > looping:
        raise BadSettings(
            f"Standing on a visited cell is worth {looping:g} in the long run, arriving only {levels.goal:g}: use "
            f"a goal above {looping:g} or a gamma below {1 - levels.visited / levels.goal:g}.",
            gamma=learner.gamma,
        )
