"""The warm-up of the compiled loops: after it, the first job or request does not wait for compilation."""

from collections.abc import Callable
from threading import Thread

import numpy as np

from skills.compiled import cache_folders, check_cache_folder, make_ready
from skills.demonstration.demonstration import Demo
from skills.gridworld.grid import GridPath, GridWorld
from skills.gridworld.reward import sparse_reward
from skills.learning.certificate import certify
from skills.learning.evaluation import dtw, measure
from skills.learning.policy import learn_tabular, rollout_from
from skills.learning.pose_step import next_pose
from skills.learning.pose_style import PosePath
from skills.learning.q_learning import PhaseQLearning
from skills.learning.tube import certify_tube
from skills.learning.tube_certificate import TubeLimits
from skills.packing import palette_of
from skills.planning.plan import driven_pass

TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (1, 1, 2)), np.array([0, 1]))
STILL = np.zeros(2)
TWO_SAMPLES = Demo("PSM1", "", "PSM1_base", 0.0, 1.0, np.array([0.0, 1.0]), TWO_CELLS.tip_mm)
TWO_POSES = PosePath(np.eye(2, 3), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.array([0.0, 1.0]), None, STILL, STILL)


def warm_up(work: Callable[[], object]) -> Thread:
    """Run `work` once in a background thread, so that the functions it calls are compiled or loaded.

    The reader's loops are prepared in the process that runs them, the fork server (`skills.formats.reader_process`);
    their cache folder is checked here too, so that a process which would refuse it later does not start.

    Args:
        work: Callback that calls the compiled loops with small inputs.

    Returns:
        The thread.

    Raises:
        BadSettings: Machine code would be loaded from a folder that other users can write to; see `check_cache_folder`.
    """
    for folder in cache_folders():
        check_cache_folder(folder)
    # Not a daemon thread: the interpreter's shutdown must not kill it while it compiles.
    warming = Thread(target=make_ready, args=(work,), name="warm-up")
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
    driven_pass(policy, TWO_SAMPLES)
    certify_tube(TWO_POSES, TubeLimits())
    align_once()


def align_once() -> None:
    """Align the shortest possible path with its reverse, compute a palette, and follow two poses.

    A request calls the same functions.
    """
    dtw(TWO_CELLS.tip_mm, TWO_CELLS.tip_mm[::-1])
    palette_of(TWO_CELLS.tip_mm)
    next_pose(TWO_POSES, TWO_POSES.tip_mm[0], TWO_POSES.rotation_xyzw[0], None, TubeLimits())
