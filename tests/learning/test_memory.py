"""Memory of learning and its certificate: proportional to the domain's rows, never to phases times cells."""

from functools import cache
from pathlib import Path

import pytest

from tests.measured import Cost, measured

GIB, SIDE = 1024.0, 51  # MiB; cells of 1 mm in the paper's cube of 50 mm
pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="memory: the peak of a process is read in Linux's /proc"
)


@cache
def cost(waypoints: int) -> Cost:
    return measured(SIDE, waypoints)


@pytest.mark.nightly  # 2 s
def test_400_waypoints_at_1_mm_are_learnt_and_certified_within_1_gib():
    assert cost(400).certified
    assert cost(400).certificate_mib < GIB


@pytest.mark.nightly
def test_300_more_waypoints_need_far_less_than_one_number_per_cell_each():
    more_mib = cost(400).certificate_mib - cost(100).certificate_mib
    assert more_mib < 300 * SIDE**3 * 8 / 2**20 / 4  # 8 bytes each would be 304 MiB
