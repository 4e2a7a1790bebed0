"""The learners there are, and the one call that learns with any of those that need no network.

`skills.deep.learn_policy` learns with all of them.
"""

from typing import get_args

from skills.errors import BadSettings
from skills.style._arrays import Floats
from skills.style.domain import Domain
from skills.style.grid import GridPath
from skills.style.learning.beyond import DDPG, DQN, TRPO
from skills.style.learning.irl import MaxEntIRL, learn_from_recovered
from skills.style.learning.q_learning import CellQLearning, PhaseQLearning, Training, learn_q
from skills.style.learning.value_iteration import ValueIteration, iterate_values
from skills.style.reward import RewardLevels, RewardMap

Tabular = PhaseQLearning | CellQLearning | ValueIteration | MaxEntIRL
Learner = Tabular | DQN | DDPG | TRPO
LEARNERS: dict[str, type[Learner]] = {learner.kind: learner for learner in get_args(Learner)}
LEARNER_VERSION = 4  # part of a training's identity: raise it when the same settings would learn something else
MAX_SEED = 2**63 - 1
MAX_BYTES = 4 << 30  # ours: a laptop has 8 GiB, and others learn beside it
BYTES_A_ROW = 600  # of the domain, measured with 51 and 101 cells a side: Q values twice, and what the rest works out
BYTES_A_SLIPPING_ROW = 2400  # the certificate keeps what each of the 27 actions leads to


def learn_values(reward: RewardMap, learner: Tabular, seed: int) -> tuple[Floats, Training]:
    """Learn the Q values of a reward map's domain, (rows, 27), and tell what it took.

    The same reward map, learner and seed give the same bytes; the learners that solve instead of trying use no seed.

    Raises:
        BadSettings: As for `check_learnable`, or the path is too long for the learner.
    """
    check_learnable(reward, learner, seed)
    if isinstance(learner, ValueIteration):
        return iterate_values(reward, learner), _without_moving(settled=True)
    if isinstance(learner, MaxEntIRL):
        return learn_from_recovered(reward, learner), _without_moving(settled=False)
    return learn_q(reward, learner, seed)


def check_learnable(reward: RewardMap, learner: Learner, seed: int) -> None:
    """Refuse what no learner should begin with.

    Raises:
        BadSettings: The seed is not an integer from 0 to 2^63 - 1, or arriving would not pay (see `_refuse_loops`), or
            the grid is too large for memory.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise BadSettings("The seed must be an integer from 0 to 2^63 - 1.")
    _refuse_loops(reward.levels, learner)
    refuse_too_large(reward.path, learner)


def refuse_too_large(path: GridPath, learner: Learner) -> None:
    """Refuse a path whose policy would need too much memory, before any is taken.

    Raises:
        BadSettings: It would need more than `MAX_BYTES`.
    """
    needed = Domain(path, learner.phased).n_rows * (BYTES_A_SLIPPING_ROW if learner.slip > 0 else BYTES_A_ROW)
    if needed > MAX_BYTES:
        raise BadSettings(
            f"Learning {len(path.states)} waypoints in a grid of {path.grid.n_states} cells needs about "
            f"{needed / 2**30:.1f} GiB of memory, and at most {MAX_BYTES / 2**30:g} GiB may be; take larger cells.",
            needed_bytes=needed,
        )


def _without_moving(*, settled: bool) -> Training:
    """Tell of a training in which no arm moved; an IRL that stops after so many iterations has not settled."""
    return Training(steps=0, updates=0, episodes=0, finished=0, out_of_steps=0, out_of_time=0, settled=settled)


def _refuse_loops(levels: RewardLevels, learner: Learner) -> None:
    """Refuse rewards under which going round in circles pays more than arriving.

    `MaxEntIRL` learns from other rewards, but is certified against these with its gamma.
    """
    if learner.phased:
        if levels.other != 0:
            raise BadSettings("In the phase state a move that advances nothing pays nothing: `other` must be 0.")
        return  # no waypoint pays twice, so no loop does
    if levels.visited <= 0:
        return  # standing still never pays, and the goal is above that
    if learner.gamma == 1:
        raise BadSettings("With gamma 1 standing on a visited cell pays without end; take a gamma below 1.")
    looping = levels.visited / (1 - learner.gamma)
    if not levels.goal > looping:
        raise BadSettings(
            f"Standing on a visited cell pays {looping:g} in the long run, arriving only {levels.goal:g}: "
            f"take a goal above {looping:g} or a gamma below {1 - levels.visited / levels.goal:g}.",
            gamma=learner.gamma,
        )
