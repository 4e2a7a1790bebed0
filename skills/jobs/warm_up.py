"""Warm-up of the compiled loops, so that the first job or request does not wait for compilation."""

from collections.abc import Callable
from threading import Thread

import numpy as np

from skills.comparison._kernels import warp_pairs_compiled
from skills.compiled import check_kept, kept_in, make_ready
from skills.formats.mcap._kernels import follow_compiled
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning._kernels import warp_compiled
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw, measure
from skills.learning.policy import learn_tabular, rollout_from
from skills.learning.q_learning import PhaseQLearning
from skills.packing import palette_of

TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (1, 1, 2)), np.array([0, 1]))


def warm_up(work: Callable[[], object]) -> Thread:
    """Run `work` once in a background thread, so that the functions it calls are compiled or loaded.

    The reader's loops are prepared in the process that runs them, the fork server (`skills.formats.reader_process`);
    their cache folder is checked here too, so that a process which would refuse it later does not start.

    Args:
        work: Callback that calls the compiled loops with small inputs.

    Returns:
        The thread.

    Raises:
        BadSettings: Machine code would be loaded from a folder that other users can write to; see `check_kept`.
    """
    folder = kept_in(warp_compiled)
    for each in {folder, kept_in(follow_compiled), kept_in(warp_pairs_compiled)}:
        check_kept(each)
    # Not a daemon thread: the interpreter's shutdown must not kill it while it compiles.
    warming = Thread(target=make_ready, args=(work, folder), name="warm-up")
    warming.start()
    return warming


def learn_once() -> None:
    """Learn a policy of the shortest possible path.

    A job calls the same functions.
    """
    policy = learn_tabular(sparse_reward(TWO_CELLS), PhaseQLearning())
    certify(policy)
    measure(rollout_from(policy, TWO_CELLS.start))
    palette_of(policy.q)
    align_once()


def align_once() -> None:
    """Align the shortest possible path with its reverse, and compute a palette.

    A request calls the same functions.
    """
    dtw(TWO_CELLS.tip_mm, TWO_CELLS.tip_mm[::-1])
    palette_of(TWO_CELLS.tip_mm)
