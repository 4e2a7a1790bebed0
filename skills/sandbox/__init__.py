"""Function calls in subprocesses under resource limits, which contain the effects of untrusted input.

    forked        `ForkServer` calls functions in forks of a small server that has imported everything already, within a
                  millisecond or two; `call_alone` calls one in a new interpreter
    turns         `Turns` shares the forks fairly among callers
    fork_server   the server process itself
    containment   what these processes cannot reach: files, processes, networks, rights; `system_calls` is its filter

There is one mechanism: a new interpreter is a fork server without imports, for a single call. There is one format: an
input is a file, or a value written by `skills.packing`, and a result is a value written by `skills.packing`, which is
untrusted and validated by the constructors of the few classes that the caller allows. Nothing is unpickled.

Every process gets a minimal environment and a folder for temporary files, has limits on memory, time, open files and
output, is killed with its descendants at the timeout or when its parent dies, and reports its outcome by its exit code.

Here are the limits, and the errors for processes that return no result. A process
that returned no result did one of these; the names are the causes in `Unanswered`:

    hung            it was still running at its timeout, or had used up its processor time
    crashed         a signal ended it
    out of memory   it tried to allocate more than its limit
    too much        it wrote more than its limit
    failed          it exited by itself with an error; the end of its output contains the reason
    contained       it attempted something that its containment refuses, and did not go on
    nonsense        its result is not one of the values that were allowed
"""

import ctypes
import errno
import logging
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, isfinite
from typing import IO, NoReturn

from skills.errors import BadInput, StorageFull, Unanswered

# Our exit codes; the shell's conventions do not use them.
_FAILED, _OUT_OF_MEMORY, _TOO_MUCH, _DISK_FULL, _CONTAINED = (1, 77, 78, 79, 80)
_CODES = {errno.EFBIG: _TOO_MUCH, errno.ENOSPC: _DISK_FULL, errno.EDQUOT: _DISK_FULL}
_CODES |= {errno.EPERM: _CONTAINED, errno.EACCES: _CONTAINED}
_NOTED_BYTES = 2000
# numba needs its cache folder; without it every process would compile the loops again.
_PASSED_ON = ("PATH", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
# glibc's; larger blocks than the second threshold are still returned at once, and it allows no higher one. Arrow's own
# allocator reserves 1 GiB of addresses at a time, which leaves others nothing below a limit.
_MALLOC = {
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
}
_PR_SET_PDEATHSIG = 1  # linux/prctl.h

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ProcessLimits:
    """Resource limits of a subprocess.

    Attributes:
        memory_bytes: Address space, including the libraries that it loads itself.
        wall_s: Timeout by the clock in seconds, after which it is killed.
        cpu_s: Processor time in seconds; 0 stands for the timeout and a second.
        file_bytes: Size of each file that it writes: its result, and temporary files.
        answer_bytes: Memory of its result in this process.
        open_files: Files open at once.
        threads: Whether it may start threads.
        program: The only program that it may start, as an absolute path; empty: none.
    """

    memory_bytes: int
    wall_s: float
    cpu_s: int = 0
    file_bytes: int = 512 << 20
    answer_bytes: int = 512 << 20
    open_files: int = 64
    threads: bool = True
    program: str = ""

    def __post_init__(self) -> None:
        if not (isfinite(self.wall_s) and self.wall_s > 0 and self.memory_bytes > 0):
            raise BadInput(
                "The time and memory limits of a process must be more than 0.",
                timeout_s=self.wall_s,
                memory=self.memory_bytes,
            )
        object.__setattr__(self, "cpu_s", self.cpu_s or ceil(self.wall_s) + 1)


def environment() -> dict[str, str]:
    """Return a minimal environment for a subprocess.

    It has the paths of modules, libraries and compiled loops, and one thread for each numerical library; no secrets.
    One heap for all threads: glibc reserves 64 MiB for each further one, which a fork could use above its limit. The
    heap keeps freed memory: these processes end soon, and a page that is returned is mapped again by the next array.
    """
    kept = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return kept | threads | _MALLOC | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


# ---- outside the process ---------------------------------------------------------------------------------------


def check_end(code: int, said: IO[bytes], limits: ProcessLimits) -> None:
    """Raise an error unless a process exited successfully.

    Args:
        code: Its exit code, or the negative number of the signal that ended it.
        said: Its output on stdout and stderr.
        limits: Its limits, for the message.

    Raises:
        Unanswered: The process ended without a result; the cause is in the error.
        StorageFull: The disk had no space for its files.
    """
    if code == 0:
        return
    if code == _DISK_FULL:
        log.error("The disk for temporary files is full.")
        raise StorageFull("The disk for temporary files is full, so nothing was stored; free some space on it.")
    if code == _OUT_OF_MEMORY or b"bad_alloc" in _last_words(said):  # C++ libraries abort on it
        raise unanswered("out of memory", f"needed more than its {limits.memory_bytes >> 20} MiB", said)
    if code == _TOO_MUCH:
        raise unanswered("too much", f"wrote more than its {limits.file_bytes >> 20} MiB", said)
    if code in (_CONTAINED, -signal.SIGSYS):
        raise unanswered("contained", "was stopped by its containment", said)
    if code == -signal.SIGXCPU:
        raise unanswered("hung", f"used up its {limits.cpu_s} s of processor time", said)
    if code < 0:
        raise unanswered("crashed", f"was ended by {signal.Signals(-code).name}", said)
    raise unanswered("failed", f"stopped with code {code}", said)


def overdue(said: IO[bytes], limits: ProcessLimits) -> Unanswered:
    """Return the error for a process that did not finish before its timeout."""
    return unanswered("hung", f"did not finish within {limits.wall_s:g} s", said)


def unanswered(cause: str, did: str, said: IO[bytes]) -> Unanswered:
    """Return the error for a process that returned no result, with the end of its output as a note."""
    error = Unanswered(cause, did)
    if words := _last_words(said).decode(errors="replace").strip():
        error.add_note(words)
    return error


def _last_words(said: IO[bytes]) -> bytes:
    size = said.seek(0, os.SEEK_END)
    said.seek(max(0, size - _NOTED_BYTES))
    return said.read()


# ---- inside the process ----------------------------------------------------------------------------------------


def confine(limits: ProcessLimits, parent: int) -> None:
    """Limit the resources of this process, and have it killed when its parent dies."""
    for which, limit in (
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_NOFILE, limits.open_files),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        _limit(which, limit, limit)
    # SIGXCPU at the soft limit, which `check_end` can tell from other signals; SIGKILL only at the hard one.
    _limit(resource.RLIMIT_CPU, limits.cpu_s, limits.cpu_s + 1)
    if not (limits.threads or limits.program):
        _limit(resource.RLIMIT_NPROC, 0, 0)
    if sys.platform == "linux":  # strictly, when the thread that started us ends; it waits for us
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent died before prctl was called
        os._exit(_FAILED)


def _limit(which: int, soft: int, hard: int) -> None:
    """Set a limit of this process, or the most that it is permitted."""
    most = resource.getrlimit(which)[1]
    if most != resource.RLIM_INFINITY:
        soft, hard = min(soft, most), min(hard, most)
    resource.setrlimit(which, (soft, hard))


def perform(work: Callable[[], None]) -> NoReturn:
    """Run `work`, then exit this process with a code that reports the outcome.

    The exit skips the interpreter's shutdown: the result is already written, and finalisers of libraries are not
    needed.
    """
    code = _FAILED
    try:
        work()
        code = 0
    except MemoryError:
        code = _OUT_OF_MEMORY
    except BaseException as error:
        code = _CODES.get(error.errno or 0, _FAILED) if isinstance(error, OSError) else _FAILED
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)
