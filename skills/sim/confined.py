"""Run a simulator in a process of its own: a new interpreter each time, for loading PyBullet takes little of it.

What goes wrong there is told in the simulator's words.
"""

from math import ceil, isfinite

from skills.confined import fresh
from skills.confined.limits import Limits
from skills.errors import SimulationFailed, Unanswered

_ADVICE = {
    "hung": "play fewer passes",
    "crashed": "play it again, and report it if it stays",
    "out of memory": "play fewer passes or allow more",
    "too much": "which no playback does; report it",
    "failed": "its last words are in the log",
}


def run(target: str, request: bytes, *, timeout_s: float, memory_bytes: int) -> bytes:
    """Give bytes to a simulator and wait for its answer.

    Args:
        target: The simulator, as `module:function`, from bytes to bytes.
        request: What it is given.
        timeout_s: Wall time after which the process is killed; its processor time is limited to the same.
        memory_bytes: Limit of its address space.

    Raises:
        SimulationFailed: It hung, crashed, ran out of memory, failed, or answered too much; `numbers["cause"]` says
            which, and the end of what it printed is a note of the error.
    """
    cpu_s = ceil(timeout_s) + 1 if isfinite(timeout_s) else 0
    try:
        return fresh.run(target, request, Limits(memory_bytes, timeout_s, cpu_s))
    except Unanswered as error:
        failed = SimulationFailed(f"The simulator {error.did}; {_ADVICE[error.cause]}.", cause=error.cause)
        for words in getattr(error, "__notes__", ()):
            failed.add_note(words)
        raise failed from None
