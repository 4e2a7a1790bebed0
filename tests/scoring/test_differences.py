"""Differences in words: planted ones are named where they are, and an expert's own spread is not."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skills.demonstration.demonstration import Demo
from skills.errors import BadPath
from skills.scoring import deviation as module
from skills.scoring.deviation import Differences, differences

RATE_HZ = 100.0
PLANTED = {"deeper": "height", "slower": "time in motion", "turned": "wrist", "stopped": "pause"}
NEAR = 0.05  # of the way, beside the named part
CREDENTIAL = re.compile(
    r"certif|qualif|compet|pass(ed)?\b|fail|grade|licen|credential|skilled|expert level|better|worse", re.I
)


@dataclass(frozen=True, eq=False)
class Hand:
    """An expert: humps to the side and upwards, a way, an orientation that turns, and a duration."""

    humps_mm: np.ndarray
    way_mm: np.ndarray
    held: Rotation
    twist_rad: np.ndarray
    duration_s: float

    @property
    def axes(self) -> np.ndarray:
        x = self.way_mm / np.linalg.norm(self.way_mm)
        z = np.array([0.0, 0.0, 1.0]) - x[2] * x
        z /= np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z])

    def path(self, along: np.ndarray, humps_mm: np.ndarray) -> np.ndarray:
        waves = np.sin(np.pi * np.outer(along, np.arange(1, 4)))
        return along[:, None] * self.way_mm + waves @ humps_mm @ self.axes[1:]

    def share(self, at: float) -> float:
        """Return the share of the path's length at a share of the way."""
        along = np.linspace(0.0, 1.0, 2001)
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.path(along, self.humps_mm), axis=0), axis=1)))
        return float(np.interp(at, along, lengths / lengths[-1]))


def hand(rng: np.random.Generator) -> Hand:
    way = rng.normal(size=3) * [1.0, 1.0, 0.3]
    way *= rng.uniform(35.0, 60.0) / np.linalg.norm(way)
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.6, 3))
    return Hand(rng.normal(0.0, 4.0, (3, 2)), way, turn, rng.normal(0.0, 0.4, 3), rng.uniform(2.5, 5.0))


def motion(of: Hand, rng: np.random.Generator, planted: str | None = None, at: float = 0.5) -> Demo:
    """Return a repetition with the hand's own noise, in a set-up of its own, and with one thing planted."""
    u = np.arange(0.0, 1.0, 1.0 / RATE_HZ / (of.duration_s * np.exp(rng.normal(0.0, 0.12))))
    along = 0.5 * u + 0.5 * (10 * u**3 - 15 * u**4 + 6 * u**5) + rng.normal(0.0, 0.01) * np.sin(2 * np.pi * u)
    if planted == "slower":  # takes 2.5 times as long in a fifth of the way
        longer = 1.0 + 1.5 * np.exp(-(((along - at) / 0.1) ** 4))
        clock = np.append(0.0, np.cumsum((longer[1:] + longer[:-1]) / 2.0))
        along = np.interp(np.arange(0.0, clock[-1]), clock, along)
    if planted == "stopped":  # 1.2 s
        along = np.insert(along, int(np.searchsorted(along, at)), np.full(int(1.2 * RATE_HZ), at))
    tip_mm = of.path(along, of.humps_mm + rng.normal(0.0, 0.7, (3, 2)))
    if planted == "deeper":  # 8 mm
        there = np.exp(-(((along - at) / 0.12) ** 2)) * (1.0 - (2.0 * along - 1.0) ** 8)
        tip_mm = tip_mm - 8.0 * there[:, None] * of.axes[2]
    turn = np.outer(along, of.twist_rad) + rng.normal(0.0, 0.025, 3)
    turned = Rotation.from_rotvec(turn + np.outer(np.sin(np.pi * along), rng.normal(0.0, 0.025, 3))) * of.held
    if planted == "turned":  # 20 degrees
        axis = rng.normal(size=3)
        by = np.radians(20.0) * np.exp(-(((along - at) / 0.15) ** 4))
        turned = turned * Rotation.from_rotvec(np.outer(by, axis / np.linalg.norm(axis)))
    tip_mm = tip_mm + np.cumsum(rng.normal(0.0, 0.02, tip_mm.shape), axis=0)
    room = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    stamps_s = np.arange(len(along)) / RATE_HZ
    placed_mm, rotation = room.apply(tip_mm) + rng.normal(0.0, 20.0, 3), (room * turned).as_quat()
    return Demo("PSM2", "/PSM2/measured_cp", "PSM2_base", 0.0, float(stamps_s[-1]), stamps_s, placed_mm, rotation)


def counted(experts: int, demos: int) -> tuple[int, int, list[str]]:
    """Return the number of own motions without a difference, that of planted ones named in place, and all words."""
    none, right, words = 0, 0, list[str]()
    for seed in range(experts):
        rng = np.random.default_rng(seed)
        of = hand(rng)
        expert = [motion(of, rng) for _ in range(demos)]
        found = differences(motion(of, rng), expert, expert[0])
        none += not found.named
        words += found.words
        for planted, kind in PLANTED.items():
            at = rng.uniform(0.25, 0.75)
            found = differences(motion(of, rng, planted, at), expert, expert[0])
            right += is_named(found, kind, of.share(at))
            words += found.words
    return none, right, words


def is_named(found: Differences, kind: str, share: float) -> bool:
    return any(one.kind == kind and one.start - NEAR <= share <= one.end + NEAR for one in found.named)


def test_planted_differences_are_named_where_they_are_and_noise_is_not():
    none, right, words = counted(8, 6)
    assert none >= 7 and right >= 29, (none, right)
    assert not [one for one in words if CREDENTIAL.search(one)]


@pytest.mark.nightly  # a minute of processor time
@pytest.mark.parametrize("demos", [3, 6, 12])
def test_of_two_hundred_experts_95_percent_are_right(demos: int):
    none, right, _ = counted(200, demos)
    print(demos, none, right)
    assert none >= 190 and right >= 0.95 * 4 * 200


def test_amounts_are_those_that_were_planted():
    rng = np.random.default_rng(3)
    of = hand(rng)
    expert = [motion(of, rng) for _ in range(6)]
    amounts = {}
    for planted, kind in PLANTED.items():
        found = differences(motion(of, rng, planted), expert, expert[0])
        amounts[planted] = next(one.amount for one in found.named if one.kind == kind)
        assert len(found.named) == len(found.words) <= module.NAMED
        assert all(0.0 <= one.start <= one.end <= 1.0 and 0.0 <= one.start_s < one.end_s for one in found.named)
    assert amounts["deeper"] == pytest.approx(-8.0, abs=2.0)
    assert amounts["turned"] == pytest.approx(20.0, abs=4.0)
    assert amounts["stopped"] == pytest.approx(1.2, abs=0.2)
    assert amounts["slower"] > 0.4


def test_a_motion_without_orientation_is_compared_without_it():
    rng = np.random.default_rng(4)
    of = hand(rng)
    expert = [motion(of, rng) for _ in range(3)]
    one = motion(of, rng, "turned")
    without = Demo(one.arm, one.topic, one.frame, one.start_s, one.end_s, one.stamps_s, one.tip_mm)
    assert "wrist" in [named.kind for named in differences(one, expert, expert[0]).named]
    assert "wrist" not in [named.kind for named in differences(without, expert, expert[0]).named]


def test_of_one_demonstration_the_spread_is_said_to_be_unknown():
    rng = np.random.default_rng(5)
    of = hand(rng)
    one = motion(of, rng)
    (said,) = differences(one, [one], one).words
    assert "not known from one demonstration" in said


def test_a_motion_without_a_direction_is_refused():
    rng = np.random.default_rng(6)
    one = motion(hand(rng), rng)
    there = np.concatenate([one.tip_mm, one.tip_mm[::-1]])
    circle = Demo(one.arm, one.topic, one.frame, 0.0, 1.0, np.linspace(0.0, 1.0, len(there)), there)
    with pytest.raises(BadPath):
        differences(circle, [one], one)
