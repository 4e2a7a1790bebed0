"""Approaches on the paper's user: the rule among equally good actions, and the lowest index before it."""

from dataclasses import replace

import numpy as np
import pytest

from skills.learning.certificate import certify
from skills.learning.policy import learn_tabular
from skills.learning.q_learning import PhaseQLearning
from tests.bench.ties import SEEN_MM, approaches


@pytest.fixture(scope="module")
def now(user_reward):
    return learn_tabular(user_reward, PhaseQLearning())


@pytest.mark.parametrize(
    ("later", "deeper", "mean_mm", "longest_mm"),
    [(False, (248, 0), (25.65, 22.25), (52.0, 52.0)), (True, (1025, 0), (15.36, 13.51), (26.0, 22.3))],
    ids=["to the path", "back to the next waypoint"],
)
def test_no_approach_goes_deeper_than_its_ends_and_all_are_shorter(now, later, deeper, mean_mm, longest_mm):
    before, after = (approaches(one, later=later) for one in (replace(now, ties=None), now))
    assert [np.count_nonzero(one.beyond_mm > SEEN_MM) for one in (before, after)] == [*deeper]
    assert [one.length_mm.mean() for one in (before, after)] == pytest.approx([*mean_mm], abs=0.006)
    assert [one.length_mm.max() for one in (before, after)] == pytest.approx([*longest_mm], abs=0.06)
    assert np.array_equal(before.rows, after.rows)


def test_the_demonstration_is_reproduced_and_no_action_is_off_the_rule(now, user_path):
    certificate, _ = certify(now)
    assert (certificate.off_rule, certificate.suboptimal) == (0, 0)
    assert certificate.starts_joining_nearest == 1331
    assert now.replay.states.tolist() == replace(now, ties=None).replay.states.tolist() == user_path.states.tolist()
