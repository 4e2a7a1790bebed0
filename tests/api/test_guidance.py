"""Guidance of a novice's hand along a style by the loop that `docs/replay.md` shows."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.api.service import GOAL_MM, KESTREL, POLICY, Service, assert_problem

PAGE = (Path(__file__).parents[2] / "docs" / "replay.md").read_text()
STEP_MM = 2.0


@pytest.mark.parametrize("start_mm", [(-10.0, 55.0, -135.0), (-27.0, 28.0, -98.0), (-60.0, 90.0, -150.0)])
def test_the_loop_of_the_page_leads_an_unsteady_hand_to_the_hand_off(still: Service, start_mm):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    page: dict = {}
    exec(compile(code, "docs/replay.md", "exec"), page)
    rng = np.random.default_rng(0)
    hand, shown = np.array(start_mm), []

    def show(pull_mm, target_mm):
        """Move the hand by 2 mm along the arrow, back to the path first, with tremor and occasional slips."""
        shown.append((pull_mm, target_mm))
        way = np.array(pull_mm) if pull_mm is not None else np.array(target_mm) - hand
        length = float(np.linalg.norm(way))
        hand[:] += way * min(1.0, STEP_MM / max(length, 1e-9)) + rng.normal(0, 0.1, 3)
        if len(shown) in (40, 80):
            hand[:] += [0.0, 12.0, -9.0]
        assert len(shown) < 500, "the hand was not led to the goal"

    page["guide"](still.client, KESTREL["surgeon"], KESTREL["suture"], lambda: hand.tolist(), show)
    assert np.abs(hand - GOAL_MM).max() <= 2.5  # mm: in the goal's cell
    assert any(pull is not None for pull, _ in shown)
    assert any(target is not None for _, target in shown)


def test_next_outside_the_grid_returns_only_a_correction_back_to_it(still: Service):
    outside = [-10.0, 55.0, -150.0]
    for phase, after in ((None, 0), (1, 1)):
        step = still.client.next(**KESTREL, position_mm=outside, phase=phase)
        assert (step["action"], step["next_position_mm"], step["done"], step["phase"]) == (None, None, False, after)
        assert step["correction_mm"] == [0.0, 0.0, 15.0]
    for place in ([-0.010, 0.055, -0.135], [-10.0, 55.0, -195.0]):  # metres; and a point too far away
        refused = assert_problem(still.http.post(f"{POLICY}/next", json={"position_mm": place}), 422, "outside-grid")
        assert "millimetres" in refused["detail"]
