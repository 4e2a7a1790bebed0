"""Recognition of real surgeons: two tasks of JIGSAWS, leaving the trial out. docs/atlas.md has the figures."""

from math import log

import pytest

from tests.needs import need


@pytest.mark.nightly  # a minute of processor time
def test_real_surgeons_are_recognised_by_their_hand_offs_and_by_votes():
    need("jigsaws")
    from skills.demonstration.segments import movements_by_arm
    from tests.bench import recognition as bench  # imported here, because it imports much

    nearest_whole_trial = {"Knot_Tying": 0.92, "Needle_Passing": 0.88}  # by DTW on the raw positions
    movements = bench.by_task(movements_by_arm)
    for task, some in bench.by_task().items():
        for name in ("ours", "ours, with the place"):
            single, whole = (bench.judged(parts, bench.METHODS[name]) for parts in (some, movements[task]))
            print(task, name, single.accuracy, single.interval, single.log_loss, whole.accuracy, whole.votes)
            assert single.accuracy >= 0.55
            assert whole.votes > nearest_whole_trial[task]
            for found in (single, whole):
                assert found.log_loss < 0.75 * log(8)
                assert all(abs(said - was) < 0.25 for said, was in found.curve())
