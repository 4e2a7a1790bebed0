"""Run one function, from bytes to bytes, in a new interpreter under limits."""

import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from math import isfinite

from skills.confined.limits import Limits, check_end, confine, environment, overdue, perform
from skills.errors import BadInput

_LOOKED_AT_S = 1.0
_LATELY_BYTES = 1000
_ENTRY = "import sys; from skills.confined.fresh import main; main(*sys.argv[1:])"


Watch = Callable[[bytes], None]


def run(target: str, request: bytes, limits: Limits, watch: Watch | None = None) -> bytes:
    """Give bytes to a function in a process of its own and wait for its answer.

    Args:
        target: The function, as `module:function`.
        request: What it is given.
        limits: What its process may use.
        watch: Is given about every second the end of what the process has printed; what it raises ends the process.

    Raises:
        Unanswered: It hung, crashed, ran out of memory, wrote too much, or failed; the end of what it printed is a
            note of the error.
    """
    if not (isfinite(limits.wall_s) and limits.wall_s > 0 and limits.memory_bytes > 0):
        raise BadInput(
            "A process needs time and memory; give more than 0.", timeout_s=limits.wall_s, memory=limits.memory_bytes
        )
    may_use = [str(limits.memory_bytes), str(limits.cpu_s), str(limits.file_bytes), str(os.getpid())]
    # Files and no pipes: neither side can block the other, and the child's own limit bounds what it writes.
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as said:
        given.write(request)
        given.seek(0)
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-P", "-c", _ENTRY, target, *may_use],
            stdin=given,
            stdout=answer,
            stderr=said,
            env=environment(),
        )
        try:
            code = _watched(process, said.fileno(), limits.wall_s, watch) if watch else process.wait(limits.wall_s)
        except subprocess.TimeoutExpired:
            raise overdue(said, limits) from None
        finally:
            process.kill()
            process.wait()
        check_end(code, said, limits)
        answer.seek(0)
        return answer.read()


def _watched(process: subprocess.Popen[bytes], said: int, wall_s: float, watch: Watch) -> int:
    """Wait for a process, with a look at what it prints now and then: its exit code.

    Raises:
        subprocess.TimeoutExpired: It did not end in time.
    """
    until = time.monotonic() + wall_s
    while True:
        left_s = until - time.monotonic()
        try:
            return process.wait(min(_LOOKED_AT_S, left_s))
        except subprocess.TimeoutExpired:
            if left_s <= _LOOKED_AT_S:
                raise
        # The process writes where this file stands, so it is read without going there.
        watch(os.pread(said, _LATELY_BYTES, max(0, os.fstat(said).st_size - _LATELY_BYTES)))


def main(target: str, memory_bytes: str, cpu_s: str, file_bytes: str, parent: str) -> None:
    """Be the process: confine yourself, call the function, write its answer, leave."""
    # Whatever the function or its C libraries print must not end up in the answer.
    answer = os.dup(1)
    os.dup2(2, 1)
    confine(Limits(int(memory_bytes), 0.0, int(cpu_s), int(file_bytes)), int(parent))

    def work() -> None:
        module, _, name = target.partition(":")
        reply = getattr(importlib.import_module(module), name)(sys.stdin.buffer.read())
        with os.fdopen(answer, "wb") as out:
            out.write(reply)

    perform(work)
