"""The door to numba: ordinary Python loops, compiled, and loaded only from where nobody else writes.

    loop --compiled--> the same loop as machine code

Loops are in modules called `_kernels`. numba keeps machine code in files, and loads it from them without asking who
wrote them: in NUMBA_CACHE_DIR where that is set, else beside the code, else in the user's cache folder. Where it can
write to none of these, every process compiles for itself, which takes it a second or two. numba itself is loaded with
the first loop that is called, for that takes an eighth of a server's start.
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

_INNER: list[Callable[..., Any]] = []  # that numba has not been told of yet
_TELLING = Lock()


class Loop:
    """A loop that is compiled, or its machine code loaded, when it is first called."""

    def __init__(self, loop: Callable[..., Any]) -> None:
        self.loop = loop

    def __call__(self, *given: Any) -> Any:
        """Run it as machine code."""
        return self.machine(*given)

    @cached_property
    def machine(self) -> Any:
        """What numba makes of it."""
        from numba import njit
        from numba.extending import register_jitable

        with _TELLING:
            while _INNER:
                register_jitable(_INNER.pop())
        try:
            return njit(nogil=True, cache=True)(self.loop)
        except RuntimeError:  # numba's way to say that it has nowhere to write
            return njit(nogil=True)(self.loop)


def compiled(loop: Callable[..., Any]) -> Loop:
    """Compile a loop at its first call, and keep its machine code for other processes.

    Call it with the same types always: two processes that compile it for different ones at once can keep one's code
    under the other's name. Of an array the layout, the alignment and whether it is read-only are part of its type.
    """
    return Loop(loop)


def inner(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function known to the compiled loops that call it."""
    _INNER.append(loop)
    return loop


def kept_in(loop: Loop) -> Path | None:
    """Find the folder that the machine code of a compiled loop and of those beside it is kept in; None: nowhere."""
    folder = loop.machine.stats.cache_path
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
    elif folder.name != "__pycache__" or PACKAGE not in folder.parents:  # beside the code one could change the code
        _refuse_shared(folder, inside=True)


def check_wanted() -> None:
    """Refuse a NUMBA_CACHE_DIR that others can write to, before anything is begun and without loading numba.

    Raises:
        BadSettings: As `check_kept`, which has the last word when the first loop is loaded.
    """
    wanted = os.environ.get("NUMBA_CACHE_DIR")
    if wanted and Path(wanted).is_dir():
        _refuse_shared(Path(wanted).resolve(), inside=False)


def make_ready(work: Callable[[], object], folder: Path | None) -> None:
    """Do some work once, so that the loops that it calls are compiled or loaded.

    Where kept files are damaged, as a power cut leaves them, they are thrown away and the work is done again.
    """
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


def _refuse_shared(folder: Path, *, inside: bool) -> None:
    """Refuse a folder that other users can change, or put another one in its place; inside: it has files of ours."""
    for part in (folder, *folder.parents):
        if _others_write(part, inside=inside and part == folder):
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
