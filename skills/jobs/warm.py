"""The compiled loops, ready before the first job or request needs them."""

from collections.abc import Callable
from threading import Thread

import numpy as np

from skills.compiled import check_kept, kept_in, make_ready
from skills.recordings._kernels import follow_compiled
from skills.style.certificate import certify
from skills.style.comparing._kernels import warp_pairs_compiled
from skills.style.evaluation import dtw, measure
from skills.style.grid import GridPath, GridWorld
from skills.style.learning._kernels import warp_compiled
from skills.style.learning.q_learning import PhaseQLearning
from skills.style.palette import palette_of
from skills.style.policy import learn_policy, rollout_from
from skills.style.reward import sparse_reward

TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (1, 1, 2)), np.array([0, 1]))


def warm_up(work: Callable[[], object]) -> Thread:
    """Do some work once, beside what goes on, so that what it calls is compiled or loaded.

    The reader's loops are made ready where they run, in the fork server (`skills.recordings.confined`); where they are
    kept is checked here too, so that nothing starts where they would be refused.

    Raises:
        BadSettings: Machine code would be loaded from where others can write; see `check_kept`.
    """
    folder = kept_in(warp_compiled)
    for each in {folder, kept_in(follow_compiled), kept_in(warp_pairs_compiled)}:
        check_kept(each)
    warming = Thread(target=make_ready, args=(work, folder), name="warm-up")  # no daemon: it may not die compiling
    warming.start()
    return warming


def learn_once() -> None:
    """Learn the shortest path there is, as a job would."""
    policy = learn_policy(sparse_reward(TWO_CELLS), PhaseQLearning())
    certify(policy)
    measure(rollout_from(policy, TWO_CELLS.start))
    palette_of(policy.q)
    align_once()


def align_once() -> None:
    """Align the shortest path there is with itself backwards, and look for a palette, as a request would."""
    dtw(TWO_CELLS.tip_mm, TWO_CELLS.tip_mm[::-1])
    palette_of(TWO_CELLS.tip_mm)
