"""Workers that are killed, stopped, told to go, or left alone by their parent."""

import os
import signal
import subprocess
import sys
import time

from skills.jobs.child import environment
from tests.jobs.house import ROOT, House, until

GRACE_S = 5.0


def test_a_killed_and_a_stopped_worker_are_relieved_and_every_job_has_one_result(empty_house: House):
    house = empty_house
    within_s = house.settings.lease_s + GRACE_S
    with house.workers(3) as workers:
        # SIGKILL in the middle of a job: another worker does it again.
        killed = house.ask("slow", seconds=0.6)
        first = house.begun(killed)
        workers[first].kill()
        took_s = until(lambda: house.job(killed).state == "succeeded", within_s)
        print(f"killed to succeeded elsewhere, a job of 0.6 s: {took_s:.2f} s")
        assert house.noted("wrote", killed) == [house.job(killed).result["by"]] != [first]

        # SIGSTOP beyond the lease: it comes back with a result that nobody wants any more.
        stopped = house.ask("slow", seconds=0.6)
        second = house.begun(stopped)
        workers[second].send_signal(signal.SIGSTOP)
        relieved = house.ended(stopped, within_s)
        workers[second].send_signal(signal.SIGCONT)
        until(lambda: house.noted("came-late", stopped) == [second], GRACE_S)
        after = house.job(stopped)
        assert (after.state, after.result, after.ended_at) == ("succeeded", relieved.result, relieved.ended_at)
        assert house.noted("wrote", stopped) == [after.result["by"]] != [second]

        # SIGTERM: what is begun is finished, nothing new is, and the name is taken off the list.
        begun = [house.ask("slow", seconds=1.0) for _ in range(4)]
        holders = {house.begun(row) for row in begun}
        left = [workers[pid] for pid in workers if pid != first]
        assert holders <= {worker.pid for worker in left}
        for worker in left:
            worker.terminate()
        assert [worker.wait(10.0) for worker in left] == [0, 0]
        assert [house.job(row).state for row in begun] == ["succeeded"] * 4
        assert all(len(house.noted("begins", row)) == 1 for row in begun)
        assert len(house.executors()) <= 1  # the killed one's, until it is forgotten


def test_a_worker_goes_when_its_parent_is_gone(empty_house: House):
    """The real child with the real library, started by a process that is then killed."""
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], cwd=ROOT, env=environment(empty_house.settings), stdout=subprocess.PIPE
    )
    with parent:
        child = int(parent.stdout.readline())
        until(empty_house.executors, 20.0)
        assert os.getpriority(os.PRIO_PROCESS, child) == 10
        time.sleep(1.0)
        assert alive(child)
        parent.kill()
    until(lambda: not alive(child), GRACE_S)
    assert empty_house.executors() == []


PARENT = """
import time
from skills.jobs.child import start_worker_child
from skills.settings import Settings
print(start_worker_child(Settings()).pid, flush=True)
time.sleep(60)
"""


def alive(pid: int) -> bool:
    """Tell whether a process runs; one that only waits to be buried does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
