"""Memory of workers: freed memory stays with the process, so that the next style can use it."""

import resource
import subprocess
import sys

import pytest

from tests.waiting import END_S

CODE = """
import resource, sys
import numpy as np
from skills.jobs.worker import keep_freed_memory
kept = keep_freed_memory()
def work():
    for _ in range(50):
        several = [np.ones(400_000) for _ in range(4)]
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.nightly  # 2 s of processor time for a setting that nothing else changes
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a C library other than glibc")
def test_arrays_of_megabytes_cost_no_pages_the_second_time():
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=END_S)
    kept, faults = run.stdout.split()
    a_pass = 50 * 4 * 400_000 * 8 // resource.getpagesize()
    assert kept == "True"
    assert int(faults) < a_pass / 10, "every page was asked for again"
