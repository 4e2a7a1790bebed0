"""What a process may use, and what its end says.

A process that gave no answer did one of these:
    hung            it was still at work when its time was over
    crashed         a signal ended it
    out of memory   it asked for more than it may have
    too much        it wrote more than it may
    failed          it stopped by itself, for a reason that is among its last words
"""

import ctypes
import errno
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, NoReturn

from skills.errors import Unanswered

_FAILED, _OUT_OF_MEMORY, _TOO_MUCH = 1, 77, 78  # exit codes of ours; the shell's conventions leave them free
_NOTED_BYTES = 2000
_KEPT = ("PATH", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@dataclass(frozen=True)
class Limits:
    """What a process may use.

    Attributes:
        memory_bytes: Address space, the libraries that it loads included.
        wall_s: Seconds by the clock, after which it is killed.
        cpu_s: Seconds of processor time.
        file_bytes: The size of each file that it writes: its answer, and what it unpacks on the way.
        open_files: Files open at once.
        children: Whether it may start processes and threads. (Linux does not keep root from it.)
    """

    memory_bytes: int
    wall_s: float
    cpu_s: int
    file_bytes: int = 512 << 20
    open_files: int = 64
    children: bool = True


def environment() -> dict[str, str]:
    """Pass on where modules, libraries and compiled loops are, one thread for all of them, and no secrets."""
    kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return kept | threads | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


# ---- outside the process ---------------------------------------------------------------------------------------


def check_end(code: int, said: IO[bytes], limits: Limits) -> None:
    """Refuse a process's end that is not a good one.

    Args:
        code: Its exit code, or the negative number of the signal that ended it.
        said: What it printed.
        limits: What it was allowed.

    Raises:
        Unanswered: It tells what the process did.
    """
    if code == 0:
        return
    if code == _OUT_OF_MEMORY or b"bad_alloc" in _last_words(said):
        raise unanswered("out of memory", f"needed more than its {limits.memory_bytes >> 20} MiB", said)
    if code == _TOO_MUCH:
        raise unanswered("too much", f"wrote more than its {limits.file_bytes >> 20} MiB", said)
    if code == -signal.SIGXCPU:
        raise unanswered("hung", f"used up its {limits.cpu_s} s of processor time", said)
    if code < 0:
        raise unanswered("crashed", f"was ended by {signal.Signals(-code).name}", said)
    raise unanswered("failed", f"stopped with code {code}", said)


def overdue(said: IO[bytes], limits: Limits) -> Unanswered:
    """Say that a process was not done in time."""
    return unanswered("hung", f"did not finish within {limits.wall_s:g} s", said)


def unanswered(cause: str, did: str, said: IO[bytes]) -> Unanswered:
    """Say what a process did instead of answering, with the end of what it printed as a note."""
    error = Unanswered(cause, did)
    if words := _last_words(said).decode(errors="replace").strip():
        error.add_note(words)
    return error


def _last_words(said: IO[bytes]) -> bytes:
    size = said.seek(0, os.SEEK_END)
    said.seek(max(0, size - _NOTED_BYTES))
    return said.read()


# ---- inside the process ----------------------------------------------------------------------------------------


def confine(limits: Limits, parent: int) -> None:
    """Limit this process, and tie its life to its parent's."""
    for which, limit in (
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_NOFILE, limits.open_files),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        _limit(which, limit, limit)
    _limit(resource.RLIMIT_CPU, limits.cpu_s, limits.cpu_s + 1)  # at the second one it would be SIGKILL at once
    if not limits.children:
        _limit(resource.RLIMIT_NPROC, 0, 0)
    if sys.platform == "linux":  # really the thread that started us, which waits for us
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we could ask
        os._exit(_FAILED)


def _limit(which: int, soft: int, hard: int) -> None:
    most = resource.getrlimit(which)[1]
    if most != resource.RLIM_INFINITY:
        soft, hard = min(soft, most), min(hard, most)
    resource.setrlimit(which, (soft, hard))


def perform(work: Callable[[], None]) -> NoReturn:
    """Do what this process is for, and leave it with a code that says how it went.

    Without the interpreter's shutdown: the answer is written, and libraries have nothing left to say.
    """
    code = _FAILED
    try:
        work()
        code = 0
    except MemoryError:
        code = _OUT_OF_MEMORY
    except BaseException as error:
        code = _TOO_MUCH if isinstance(error, OSError) and error.errno == errno.EFBIG else _FAILED
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)
