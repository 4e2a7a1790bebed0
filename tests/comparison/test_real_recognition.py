"""Recognition of real surgeons: two tasks of JIGSAWS, leaving the trial out. docs/atlas.md has the figures."""

from math import log

import pytest

from tests.needs import need


@pytest.mark.nightly  # 25 s of processor time
def test_real_surgeons_are_recognised_by_their_hand_offs_and_by_votes():
    need("jigsaws")
    from tests.bench import recognition as bench  # imported here, because it imports much

    for task, some in bench.by_task().items():
        for name in ("ours", "ours, with the place"):
            found = bench.judged(some, bench.METHODS[name])
            print(task, name, found.accuracy, found.interval, found.log_loss, found.votes)
            assert found.accuracy >= 0.55
            assert found.log_loss < 0.75 * log(8)
            assert task != "Needle_Passing" or found.votes > 0.88
            assert all(abs(said - was) < 0.25 for said, was in found.curve())
