"""Compilation of loops with numba: ordinary Python loops as machine code, loaded only from folders that are safe.

    @compiled
    def loop(...)   called as machine code; its attribute `plain` is the Python function

A loop stands beside its caller. It takes arrays and numbers, allocates nothing and raises nothing; the plain function
and the compiled one agree to the last bit, and a test checks it. A division by zero has numpy's result: to look for one
would keep the compiler from computing several numbers at once.

numba stores machine code in files and loads it without checking who wrote them: in NUMBA_CACHE_DIR if that is set,
otherwise beside the code, otherwise in the user's cache folder. If none of these is writable, every process compiles
for itself, which takes a second or two. numba is imported with the first loop that is called, because the import takes
an eighth of a server's start.
"""

import logging
import os
import stat
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

from skills.errors import BadSettings

PACKAGE = Path(__file__).resolve().parent

log = logging.getLogger(__name__)

LOOPS: list["Loop"] = []  # of all modules that were imported
_INNER: list[Callable[..., Any]] = []  # not yet registered with numba
_REGISTERING = Lock()


class Loop:
    """A loop that is compiled, or whose machine code is loaded, at its first call."""

    def __init__(self, plain: Callable[..., Any]) -> None:
        self.plain = plain
        LOOPS.append(self)

    def __call__(self, *given: Any) -> Any:
        """Call the machine code."""
        return self.machine(*given)

    @cached_property
    def machine(self) -> Any:
        """The function that numba compiles from the loop."""
        from numba import njit
        from numba.extending import register_jitable

        # Before the loop is compiled, because numba has to know the functions that it calls.
        with _REGISTERING:
            while _INNER:
                register_jitable(_INNER.pop())
        try:
            return njit(nogil=True, cache=True, error_model="numpy")(self.plain)
        except RuntimeError:  # raised by numba if no cache folder is writable
            return njit(nogil=True, error_model="numpy")(self.plain)

    @property
    def cache_folder(self) -> Path | None:
        """The folder in which the machine code of the loop's module is cached; None if there is none."""
        folder = self.machine.stats.cache_path
        return None if folder is None else Path(folder).resolve()


def compiled(loop: Callable[..., Any]) -> Loop:
    """Return a loop that is compiled at its first call, and whose machine code is cached for other processes.

    Always call it with the same argument types: two processes that compile it for different types at the same time can
    store the code of one under the name of the other. The type of an array includes its layout, its alignment and
    whether it is read-only.
    """
    return Loop(loop)


def inner(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Register a function that compiled loops of the same file call, so that numba compiles it with them.

    Of the same file, because numba compiles cached code again only if the file of the loop itself has changed.
    """
    _INNER.append(loop)
    return loop


def cache_folders() -> set[Path | None]:
    """Return the folders in which the machine code of all imported loops is cached; None is in it if one has none."""
    return {loop.cache_folder for loop in LOOPS}


def is_cached() -> bool:
    """Return whether machine code of an imported loop is in a cache folder."""
    return any(any(folder.glob("*.nbi")) for folder in cache_folders() if folder is not None)


def check_cache_folder(folder: Path | None) -> None:
    """Refuse a cache folder to which others can write, and one that is not inside NUMBA_CACHE_DIR if that is set.

    Args:
        folder: The folder that numba uses, one of `cache_folders`.

    Raises:
        BadSettings: The message names the folder and the remedy.
    """
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    if wanted and (folder is None or Path(wanted).resolve() not in folder.parents):
        raise BadSettings(f"NUMBA_CACHE_DIR={wanted} is not writable; name a folder that only this user can write to.")
    if folder is None:
        log.warning(
            "No folder for compiled loops is writable, so every process compiles them again; set NUMBA_CACHE_DIR "
            "to a folder that only this user can write to."
        )
    elif folder.name != "__pycache__" or PACKAGE not in folder.parents:
        # Not checked beside the code: a user who can write there can change the code itself.
        _refuse_shared(folder, inside=True)


def check_cache_setting() -> None:
    """Refuse a NUMBA_CACHE_DIR to which others can write, before any work and without importing numba.

    Raises:
        BadSettings: As for `check_cache_folder`, which checks the folder that numba really uses when a loop is loaded.
    """
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    if wanted and Path(wanted).is_dir():
        _refuse_shared(Path(wanted).resolve(), inside=False)


def make_ready(work: Callable[[], object]) -> None:
    """Call a function once, so that the loops that it uses are compiled or loaded.

    If cached files are damaged, as after a power failure, they are deleted and the function is called again.

    Args:
        work: The function.
    """
    try:
        work()
    except Exception:
        cached = [file for folder in cache_folders() if folder is not None for file in folder.glob("*.nb[ci]")]
        if not cached:  # without cached files the failure has another cause
            raise
        log.warning("The compiled loops cannot be loaded; they are compiled again.", exc_info=True)
        for file in cached:
            file.unlink(missing_ok=True)
        work()


def _refuse_shared(folder: Path, *, inside: bool) -> None:
    """Refuse a folder that other users can change or replace; `inside`: it has files of ours."""
    for part in (folder, *folder.parents):  # parents too: renaming one of them replaces the folder
        if _others_write(part, inside=inside and part == folder):
            raise BadSettings(
                f"Machine code is loaded from {folder}, and other users can write to {part}: set NUMBA_CACHE_DIR "
                f"to a folder that only this user can write to, or remove the right (chmod go-w {part})."
            )


def _others_write(part: Path, *, inside: bool) -> bool:
    """Return whether users other than this one and root could put a file in a folder, or replace a folder in it."""
    found = part.stat()
    shared = bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    sticky = bool(found.st_mode & stat.S_ISVTX) and not inside  # as /tmp, where nobody can move files of another user
    return found.st_uid not in (0, os.geteuid()) or (shared and not sticky)
