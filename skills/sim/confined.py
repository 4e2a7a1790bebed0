"""Run one function in a process of its own, under limits, so that whatever it does it does to itself.

The function takes bytes and gives bytes, and is named as `module:function`. Its process is started anew (nothing of
ours is forked into it), sees next to nothing of our environment, may use so much memory, time, files and output, and is
killed when the time is over or its parent dies. Nothing is unpickled on either side.
"""

import ctypes
import importlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from math import ceil, isfinite
from typing import IO

from skills.errors import BadInput, SimulationFailed

MAX_ANSWER_BYTES = 512 << 20
MAX_OPEN_FILES = 64
_OUT_OF_MEMORY = 77  # exit code of ours; the shell's conventions leave it free
_NOTED_BYTES = 2000
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_ENTRY = "import sys; from skills.sim.confined import main; main(sys.argv[1:])"


def run(target: str, request: bytes, *, timeout_s: float, memory_bytes: int) -> bytes:
    """Give bytes to a function in a process of its own and wait for its answer.

    Args:
        target: The function, as `module:function`.
        request: What it is given.
        timeout_s: Wall time after which the process is killed; its processor time is limited to the same.
        memory_bytes: Limit of its address space.

    Raises:
        SimulationFailed: It hung, crashed, ran out of memory, failed, or answered too much; `numbers["cause"]` says
            which, and the end of what it printed is a note of the error.
    """
    if not (isfinite(timeout_s) and timeout_s > 0 and memory_bytes > 0):
        raise BadInput("A process needs time and memory; give more than 0.", timeout_s=timeout_s, memory=memory_bytes)
    limits = [str(memory_bytes), str(ceil(timeout_s) + 1), str(os.getpid())]
    # Files and no pipes: neither side can block the other, and the child's own limit bounds what it writes.
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as said:
        given.write(request)
        given.seek(0)
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-P", "-c", _ENTRY, target, *limits],
            stdin=given,
            stdout=answer,
            stderr=said,
            env=_environment(),
        )
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise _failed("hung", f"did not finish within {timeout_s:g} s; play fewer passes", said) from None
        finally:
            process.kill()
            process.wait()
        if code != 0:
            raise _failed(*_reason(code, said, memory_bytes), said)
        size = answer.seek(0, os.SEEK_END)
        answer.seek(0)
        if size > MAX_ANSWER_BYTES:
            raise _failed("nonsense", f"answered {size} bytes, which no playback has", said)
        return answer.read()


def _environment() -> dict[str, str]:
    """Pass on where modules and libraries are, one thread for all of them, and no secrets."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return kept | threads | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


def _reason(code: int, said: IO[bytes], memory_bytes: int) -> tuple[str, str]:
    """Tell from a process's end what was wrong with it."""
    if code == _OUT_OF_MEMORY or b"bad_alloc" in _last_words(said):
        return "out of memory", f"needed more than its {memory_bytes >> 20} MiB; play fewer passes or allow more"
    if code == -signal.SIGXCPU:
        return "hung", "used up its processor time; play fewer passes"
    if code < 0:
        return "crashed", f"was ended by {signal.Signals(-code).name}; play it again, and report it if it stays"
    return "failed", f"stopped with code {code}; its last words are in the log"


def _failed(cause: str, sentence: str, said: IO[bytes]) -> SimulationFailed:
    error = SimulationFailed(f"The simulator {sentence}.", cause=cause)
    if words := _last_words(said).decode(errors="replace").strip():
        error.add_note(words)
    return error


def _last_words(said: IO[bytes]) -> bytes:
    size = said.seek(0, os.SEEK_END)
    said.seek(max(0, size - _NOTED_BYTES))
    return said.read()


# ---- inside the process ----------------------------------------------------------------------------------------


def main(arguments: list[str]) -> None:
    """Be the process: confine yourself, call the function, write its answer, leave."""
    target, memory_bytes, cpu_s, parent = arguments[0], *map(int, arguments[1:])
    # Whatever the function or its C libraries print must not end up in the answer.
    answer = os.dup(1)
    os.dup2(2, 1)
    _confine(memory_bytes, cpu_s, parent)
    module, _, name = target.partition(":")
    try:
        reply = getattr(importlib.import_module(module), name)(sys.stdin.buffer.read())
        with os.fdopen(answer, "wb") as out:
            out.write(reply)
    except MemoryError:
        os._exit(_OUT_OF_MEMORY)
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    # Without the interpreter's shutdown: the answer is written, and libraries have nothing left to say.
    os._exit(0)


def _confine(memory_bytes: int, cpu_s: int, parent: int) -> None:
    """Limit this process, and tie its life to its parent's."""
    for which, limit in (
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_NOFILE, MAX_OPEN_FILES),
        (resource.RLIMIT_FSIZE, MAX_ANSWER_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(which)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(which, (limit, limit))
    if sys.platform == "linux":  # really the thread that started us, which waits for us
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we could ask
        os._exit(1)
