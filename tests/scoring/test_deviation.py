"""Deviation of a motion from a reference, and differences from an expert: by hand, by laws, and in words.

Planted differences are named where they are, and an expert's own spread is not.
"""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skills.demonstration.demonstration import Demo
from skills.errors import BadPath
from skills.scoring import deviation as module
from skills.scoring.deviation import Differences, as_recorded, deviation, differences, laid_on
from tests.by_day import examples
from tests.comparison.cohort import demo_of

FLAT = np.zeros((3, 2))


def hump(sideways_mm: float = 0.0, upwards_mm: float = 0.0) -> np.ndarray:
    humps = np.zeros((3, 2))
    humps[0] = sideways_mm, upwards_mm
    return humps


def made(humps: np.ndarray, turn: float = 0.0, place: tuple[float, float, float] = (0, 0, 0), lasts: float = 3.0):
    return demo_of(humps, turn, np.array(place, float), lasts)


def test_a_hump_is_found_where_it_is_with_its_side_and_size() -> None:
    found = laid_on(made(hump(upwards_mm=12.0)), made(FLAT))
    assert np.argmax(found.shares) == 5  # the middle third, upwards
    assert max(found.apart_mm) == pytest.approx(12.0, rel=0.1)
    assert abs(int(np.argmax(found.apart_mm)) - 50) <= 5
    assert "middle third it is" in " ".join(found.words) and "higher" in " ".join(found.words)
    assert "lower" in " ".join(laid_on(made(hump(upwards_mm=-12.0)), made(FLAT)).words)


def test_left_is_left_of_the_way() -> None:
    """The path leads along x, so y is to its left, whichever way both are rotated."""
    for turn in (0.0, 2.0):
        found = laid_on(made(hump(sideways_mm=12.0), turn), made(FLAT, turn))
        assert "to the left" in " ".join(found.words)


@examples(25)  # the first call compiles
@given(st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(0.5, 2.0), st.floats(2.0, 5.0))
def test_place_direction_size_and_tempo_say_nothing(turn: float, shift: float, times: float, lasts: float) -> None:
    reference, demo = made(hump(6.0, 3.0)), made(hump(4.0, -8.0))
    other = made(hump(4.0, -8.0), turn, (shift, -shift, 3.0), lasts)
    other = Demo(other.arm, other.topic, other.frame, 0.0, other.end_s, other.stamps_s, times * other.tip_mm)
    assert laid_on(other, reference).total_mm == pytest.approx(laid_on(demo, reference).total_mm, rel=0.05)


def test_as_recorded_the_place_counts_and_other_frames_have_none() -> None:
    there = as_recorded(made(FLAT, place=(0, 0, 10)), made(FLAT))
    assert there is not None
    np.testing.assert_allclose(there.dtw_mean_mm, (0, 0, 10), atol=0.5)
    assert "more in z" in " ".join(there.words)
    one = made(FLAT)
    other = Demo("PSM1", one.topic, "PSM1_base", 0.0, one.end_s, one.stamps_s, one.tip_mm)
    assert as_recorded(one, other) is None


def test_nothing_lies_from_itself() -> None:
    found = laid_on(made(hump(5.0)), made(hump(5.0)))
    assert found.total_mm == 0.0
    assert found.words == ("The path follows the reference all along: 0.0 mm from it on average.",)


@pytest.mark.nightly  # its library compiles for 12 s
def test_the_total_is_that_of_another_library_and_the_axes_add_up_to_it() -> None:
    from tslearn.metrics import dtw_path_from_metric  # here, because it imports much

    found = laid_on(made(hump(7.0, -4.0)), made(hump(-3.0, 6.0)))
    other = dtw_path_from_metric(found.path_mm, found.reference_mm, metric="cityblock")[1]
    assert found.total_mm == pytest.approx(other)
    assert found.distance_mm == pytest.approx(other / 100)
    assert np.sum(found.shares) == pytest.approx(1.0)
    pairs = found.total_mm / sum(found.dtw_mean_mm)
    assert 100 <= pairs <= 199


def test_three_points_by_hand() -> None:
    """A step of 2 mm in y at the last point of three: means are 0, 2/3 and 0, the spread is sqrt(8)/3."""
    path, reference = [[0.0, 0, 0], [5.0, 0, 0], [10.0, 2, 0]], [[0.0, 0, 0], [5.0, 0, 0], [10.0, 0, 0]]
    found = deviation(np.array(path), np.array(reference))
    assert found.total_mm == 2.0
    assert found.dtw_mean_mm == pytest.approx((0, 2 / 3, 0))
    assert found.dtw_std_mm == pytest.approx((0, np.sqrt(8) / 3, 0))
    np.testing.assert_allclose(found.apart_mm, [0, 0, 2])


def test_what_ends_where_it_began_has_no_shape() -> None:
    seconds = np.arange(0.0, 3.0, 0.01)
    circle = np.stack([10 * np.cos(2.1 * seconds), 10 * np.sin(2.1 * seconds), 0 * seconds], axis=1)
    circle[-1] = circle[0]
    with pytest.raises(BadPath, match="from where it began"):
        laid_on(Demo("PSM2", "/t", "f", 0.0, 2.99, seconds, circle), made(FLAT))


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
