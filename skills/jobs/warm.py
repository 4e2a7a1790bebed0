"""The compiled loops, ready before the first job or request needs them, and loaded only from where nobody else writes.

numba keeps machine code in files, and loads it from them without asking who wrote them: in NUMBA_CACHE_DIR where that
is set, else beside the code, else in the user's cache folder. Where it can write to none of these, every process
compiles for itself, which takes it a second or two.
"""

import logging
import os
import stat
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import numpy as np

from skills.errors import BadSettings
from skills.style.certificate import certify
from skills.style.evaluation import dtw, measure
from skills.style.grid import GridPath, GridWorld
from skills.style.learning import _kernels
from skills.style.learning.q_learning import PhaseQLearning
from skills.style.policy import learn_policy, rollout_from
from skills.style.reward import sparse_reward

TWO_CELLS = GridPath(GridWorld((0.0, 0.0, 0.0), 1.0, (1, 1, 2)), np.array([0, 1]))

log = logging.getLogger(__name__)


def warm_up(work: Callable[[], object]) -> Thread:
    """Do some work once, beside what goes on, so that what it calls is compiled or loaded.

    Raises:
        BadSettings: Machine code would be loaded from where others can write; see `check_kept`.
    """
    folder = kept_in()
    check_kept(folder)
    warming = Thread(target=_make_ready, args=(work, folder), name="warm-up")  # no daemon: it may not die compiling
    warming.start()
    return warming


def learn_once() -> None:
    """Learn the shortest path there is, as a job would."""
    policy = learn_policy(sparse_reward(TWO_CELLS), PhaseQLearning())
    certify(policy)
    measure(rollout_from(policy, TWO_CELLS.start))


def align_once() -> None:
    """Align the shortest path there is, as a request would."""
    dtw(TWO_CELLS.tip_mm, TWO_CELLS.tip_mm)


def kept_in() -> Path | None:
    """Find the folder that machine code is kept in; None: nowhere."""
    folder = _kernels.warp_compiled.stats.cache_path
    return None if folder is None else Path(folder).resolve()


def check_kept(folder: Path | None) -> None:
    """Refuse a folder that others can write to, and one that is not where NUMBA_CACHE_DIR wants it.

    Raises:
        BadSettings: It says which folder, and what to do.
    """
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    if wanted and (folder is None or Path(wanted).resolve() not in folder.parents):
        raise BadSettings(f"NUMBA_CACHE_DIR={wanted} cannot be written to; name a folder of this user's own.")
    if folder is None:
        log.warning(
            "Nothing is writable that compiled loops could be kept in, so every process compiles them for itself; "
            "set NUMBA_CACHE_DIR to a folder of this user's own."
        )
    elif folder.parent != Path(_kernels.__file__).resolve().parent:  # there one could as well change the code
        for part in (folder, *folder.parents):
            if _others_write(part, inside=part == folder):
                raise BadSettings(
                    f"Machine code is loaded from {folder}, and other users can write to {part}: "
                    f"set NUMBA_CACHE_DIR to a folder of this user's own, or take the right away (chmod go-w {part})."
                )


def _others_write(part: Path, *, inside: bool) -> bool:
    """Tell whether other users than this one and root could put a file in a folder, or a folder in another's place."""
    found = part.stat()
    shared = bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    sticky = bool(found.st_mode & stat.S_ISVTX) and not inside  # as /tmp: nobody moves what is another's
    return found.st_uid not in (0, os.geteuid()) or (shared and not sticky)


def _make_ready(work: Callable[[], object], folder: Path | None) -> None:
    """Do the work; where kept files are damaged, as a power cut leaves them, throw them away and do it again."""
    try:
        work()
    except Exception:
        kept = [] if folder is None else sorted(folder.glob("_kernels.*.nb[ci]"))
        if not kept:
            raise
        log.warning("The compiled loops in %s cannot be loaded; they are made anew.", folder, exc_info=True)
        for file in kept:
            file.unlink(missing_ok=True)
        work()
