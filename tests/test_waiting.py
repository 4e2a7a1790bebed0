"""Processes that end while a test looks at them."""

import os
import subprocess
from concurrent.futures import ThreadPoolExecutor

from tests.waiting import children


def test_a_child_is_found_once_also_after_its_thread_has_ended():
    with ThreadPoolExecutor(1) as thread:
        child = thread.submit(subprocess.Popen, ["cat"], stdin=subprocess.PIPE).result()
        assert children(os.getpid()).count(child.pid) == 1
    assert children(os.getpid()).count(child.pid) == 1
    with child:
        pass
    assert child.pid not in children(os.getpid())
