"""Workers that are killed, stopped, terminated, or lose their parent."""

import os
import signal
import subprocess
import sys
import time

import pytest

from skills.jobs.worker import NICENESS
from skills.serving import environment
from tests.jobs.house import ROOT, House
from tests.waiting import END_S, until


@pytest.mark.nightly  # by day a batch has a worker that is killed, and one that is stopped
def test_killed_and_stopped_workers_are_replaced_and_jobs_have_one_result(empty_house: House):
    house = empty_house
    with house.workers(3) as workers:
        # SIGKILL in the middle of a job: another worker repeats it.
        killed = house.ask("slow", seconds=0.6)
        first = house.begun(killed)
        workers[first].kill()
        took_s = until(lambda: house.job(killed).state == "succeeded")
        print(f"killed to succeeded elsewhere, a job of 0.6 s: {took_s:.2f} s")
        assert house.noted("wrote", killed) == [house.job(killed).result["by"]] != [first]

        # SIGSTOP beyond the lease: its late result is discarded.
        stopped = house.ask("slow", seconds=0.6)
        second = house.begun(stopped)
        workers[second].send_signal(signal.SIGSTOP)
        relieved = house.ended(stopped)
        workers[second].send_signal(signal.SIGCONT)
        until(lambda: house.noted("came-late", stopped) == [second])
        after = house.job(stopped)
        assert (after.state, after.result, after.ended_at) == ("succeeded", relieved.result, relieved.ended_at)
        assert house.noted("wrote", stopped) == [after.result["by"]] != [second]

        # SIGTERM: the running job is finished, no new one begins, and the worker is removed from the list.
        begun = [house.ask("slow", seconds=1.0) for _ in range(4)]
        holders = {house.begun(row) for row in begun}
        left = [workers[pid] for pid in workers if pid != first]
        assert holders <= {worker.pid for worker in left}
        for worker in left:
            worker.terminate()
        assert [worker.wait(END_S) for worker in left] == [0, 0]
        assert [house.job(row).state for row in begun] == ["succeeded"] * 4
        assert all(len(house.noted("begins", row)) == 1 for row in begun)
        assert len(house.executors()) <= 1  # the killed one, until it is forgotten


@pytest.mark.nightly  # 11 s of waiting; by day tests/e2e stops a service and its worker
def test_a_worker_goes_when_its_parent_is_gone(empty_house: House):
    """The real child with the real library is started by a process that is then killed."""
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], cwd=ROOT, env=environment(empty_house.settings), stdout=subprocess.PIPE
    )
    with parent:
        child = int(parent.stdout.readline())
        until(empty_house.executors)
        assert os.getpriority(os.PRIO_PROCESS, child) == min(19, os.nice(0) + NICENESS)
        time.sleep(1.0)
        assert alive(child)
        parent.kill()
    until(lambda: not alive(child))
    assert empty_house.executors() == []


PARENT = """
import time
from skills.serving import start_worker_child
from skills.settings import Settings
print(start_worker_child(Settings()).pid, flush=True)
time.sleep(600)
"""


def alive(pid: int) -> bool:
    """Return whether a process runs; zombies do not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
