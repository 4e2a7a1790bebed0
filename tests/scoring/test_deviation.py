"""Deviation of a motion from a reference, and its place: by hand, by laws, and in words."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration.demonstration import Demo
from skills.errors import BadPath
from skills.scoring.deviation import as_recorded, deviation, laid_on
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
