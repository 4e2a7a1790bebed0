"""Recognition of real surgeons: two tasks of JIGSAWS, leaving the trial out. docs/atlas.md has the figures."""

from math import log

import numpy as np
import pytest

from tests.needs import need

STATED = {"Knot_Tying": 0.92, "Needle_Passing": 0.88}  # votes of the nearest neighbour on raw positions


@pytest.mark.nightly  # 25 s of processor time
def test_real_surgeons_are_recognised_by_their_hand_offs_and_by_votes():
    need("jigsaws")
    from tests.bench import recognition as bench  # imported here, because it imports much

    for task, some in bench.by_task().items():
        for name in ("ours", "ours, with the place"):
            found = bench.judged(some, bench.METHODS[name])
            print(task, name, found.accuracy, found.interval, found.log_loss, found.votes)
            assert found.accuracy >= 0.55 and found.interval[0] > 0.5
            assert found.votes > STATED[task]
            assert found.log_loss < 0.7 * log(8)
            assert all(abs(said - was) < 0.25 for said, was in found.curve())
        for name in ("duration alone", "first and last position", "mean position", "nearest shape by DTW"):
            assert bench.judged(some, bench.METHODS[name]).accuracy < found.interval[0], name
        for arm, validated in bench.strangers(some):
            assert validated.unknown.mean() > 1.5 * validated.stranger.mean(), arm
            assert np.isclose(validated.stranger.mean(), 1 / 9, atol=0.05)
