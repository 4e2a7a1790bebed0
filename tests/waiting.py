"""Waiting in tests: polling for a condition with a timeout that only a failure reaches, and processes that end."""

import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from subprocess import Popen

SPUN_S = 0.02
END_S = 600.0  # of steps that take seconds: on a busy machine a service was seen to start in four minutes


def until(what: Callable[[], object], within_s: float = END_S, *, by: Iterable[Popen[bytes]] = ()) -> float:
    """Wait until a condition is true; return how long that took, in seconds.

    Args:
        what: The condition.
        within_s: The timeout, in seconds.
        by: The processes that are to make it true: if one of them ends before, the wait fails at once.
    """
    began = time.monotonic()
    while not what():
        ended = [f"{process.args} with {process.returncode}" for process in by if process.poll() is not None]
        assert not ended, f"it did not happen, and cannot any more: {', '.join(ended)} has ended"
        assert time.monotonic() - began < within_s, f"it did not happen within {within_s} s"
        time.sleep(0.02)
    return time.monotonic() - began


def alive(pid: int) -> bool:
    """Return whether a process runs; a killed one that its parent has not reaped yet does not."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def children(pid: int) -> list[int]:
    """Return the process ids of the children of a process, whichever of its threads started them.

    The kernel's lists of each thread's children name one twice, or never, if the thread ends while they are read.
    """
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            found += [int(process.name)] if parent == pid else []
    return found


def leaders(pid: int) -> list[int]:
    """Return those children of a process that lead a process group, as servers and forks do.

    A contained process cannot tell its own id to a test.
    """
    with suppress(ProcessLookupError):
        return [one for one in children(pid) if os.getpgid(one) == one]
    return []


def crowded() -> float:
    """Return the slowdown of this machine by other load, at least 1.

    Time limits are multiplied by it; costs that must be small are measured in processor time instead.
    """
    began, used = time.monotonic(), time.thread_time()
    while time.thread_time() - used < SPUN_S:
        pass
    waited = (time.monotonic() - began) / SPUN_S
    return max(1.0, waited, os.getloadavg()[0] / len(os.sched_getaffinity(0)))
