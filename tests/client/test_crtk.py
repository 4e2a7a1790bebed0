"""examples/crtk_session.py with a stand-in for the bus, an arm in this process without ROS.

`test_sessions.py` has it with a real session.
"""

import math
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from examples.crtk_session import MOST_MM, Measured, follow
from skills.client import SessionClosed

FRAME = "PSM2_base"
AT = Measured((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), FRAME, 0.0)


class StandInBus:
    """An arm that is at each setpoint at once; `changed` changes its measured pose, or what it says of itself.

    Its time does not pass, or with `tick_s` so long for each setpoint.
    """

    def __init__(self, start: Measured | None = AT, tick_s: float = 0.0, **changed: Any) -> None:
        self.here, self.tick_s, self.changed, self.said, self.slept_s = start, tick_s, changed, [], 0.0

    def measured(self) -> Measured | None:
        return self.here and replace(self.here, **self.changed.get("pose", {}))

    def enabled(self) -> bool:
        return self.changed.get("enabled", True)

    def servo(self, position_mm, rotation_xyzw, jaw_rad) -> None:
        self.said.append((tuple(position_mm), jaw_rad))
        self.here = replace(self.here, position_mm=tuple(position_mm), rotation_xyzw=tuple(rotation_xyzw))

    def sleep(self, seconds: float) -> None:
        self.slept_s += seconds
        time.sleep(self.tick_s)


class StandInSession:
    """Ten poses a millimetre apart; `changed` changes each answer."""

    opening = SimpleNamespace(frame=FRAME, tick_s=0.05)

    def __init__(self, **changed: Any) -> None:
        self.asked, self.changed = 0, changed

    def next(self, position_mm, rotation_xyzw) -> SimpleNamespace:
        self.asked += 1
        if self.changed.get("closed"):
            raise SessionClosed(4404, "The release was withdrawn. Stop the arm.")
        answer = {
            "position_mm": (self.asked * 1.0, 0.0, 0.0), "rotation_xyzw": (0.0, 0.0, 0.0, 1.0), "jaw_rad": 0.1,
            "inside": True, "finished": self.asked > 10, "off_mm": 0.0, "off_rad": 0.0,
        }  # fmt: skip
        return SimpleNamespace(**answer | self.changed)


def test_it_publishes_one_setpoint_a_tick_and_ends_at_the_last_pose():
    bus = StandInBus()
    assert follow(bus, StandInSession()) == "finished"
    assert bus.said == [((float(x), 0.0, 0.0), 0.1) for x in range(1, 11)]
    assert bus.slept_s == pytest.approx(10 * 0.05)


@pytest.mark.parametrize(
    ("arm", "answer", "why"),
    [
        ({"pose": {"age_s": 0.2}}, {}, "older"),
        ({"pose": {"age_s": math.nan}}, {}, "older"),
        ({"pose": {"frame": "ECM"}}, {}, "'ECM'"),
        ({"enabled": False}, {}, "not enabled"),
        ({}, {"closed": True}, "withdrawn"),
        ({}, {"inside": False, "off_mm": 9.0}, "outside the tube: 9.0 mm"),
        ({}, {"position_mm": (MOST_MM + 1, 0.0, 0.0)}, "6.0 mm"),
        ({}, {"position_mm": (math.nan, 0.0, 0.0)}, "nan mm"),
        ({}, {"rotation_xyzw": (0.0, 0.0, 1.0, 0.0)}, "180.0 degrees"),
    ],
)
def test_it_publishes_nothing_where_it_must_not_go_on(arm, answer, why):
    bus = StandInBus(**arm)
    assert why in follow(bus, StandInSession(**answer))
    assert bus.said == []


def test_without_a_measured_pose_it_ends_in_words():
    assert "no pose was measured" in follow(StandInBus(None), StandInSession())
