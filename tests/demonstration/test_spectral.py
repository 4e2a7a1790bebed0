"""The spectral arc length: by a second method, and by the laws that its authors state."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.demonstration.movement import spectral_arc_length
from tests.by_day import some

STEP_S = 0.01


def stroke(duration_s: float, step_s: float = STEP_S) -> np.ndarray:
    """Return the speed of a minimum-jerk stroke of length 1."""
    u = np.arange(round(duration_s / step_s) + 1) * step_s / duration_s
    return 30 * u**2 * (1 - u) ** 2 / duration_s


def strokes(*at_s: float, lasting_s: float = 1.0, in_all_s: float = 6.0) -> np.ndarray:
    speed = np.zeros(round(in_all_s / STEP_S) + 1)
    for start_s in at_s:
        one = stroke(lasting_s)
        first = round(start_s / STEP_S)
        speed[first : first + len(one)] += one
    return speed


def by_integration(speed: np.ndarray, step_s: float) -> float:
    """Compute the definition with the Fourier integral summed at each of 20,000 frequencies, without our code."""
    seconds, hertz = np.arange(len(speed)) * step_s, np.linspace(0.0, 10.0, 20_001)
    spectrum = np.abs([np.sum(speed * np.exp(-2j * np.pi * f * seconds)) for f in hertz])
    spectrum /= spectrum[0]
    cut = np.flatnonzero(spectrum >= 0.05).max()
    along = np.diff(hertz[: cut + 1]) / hertz[cut]
    return -float(np.sqrt(along**2 + np.diff(spectrum[: cut + 1]) ** 2).sum())


@pytest.mark.parametrize(
    "speed", some([strokes(0.5, 2.0), stroke(1.0), strokes(0.0, 0.7, 3.0)], 3), ids=["2", "1", "3"]
)
def test_it_is_what_integrating_its_definition_gives(speed: np.ndarray) -> None:
    assert spectral_arc_length(speed, STEP_S) == pytest.approx(by_integration(speed, STEP_S), rel=0.01)


def test_a_speed_whose_spectrum_is_known_by_hand() -> None:
    """The spectrum of a Gaussian of 0.1 s falls without a ripple from 1 to 0.05, at 0.39 Hz by 0.1 s."""
    seconds = np.arange(-200, 201) * STEP_S
    speed = np.exp(-(seconds**2) / (2 * 0.1**2))
    cut_hz = np.sqrt(-2 * np.log(0.05)) / (2 * np.pi * 0.1)
    f = np.linspace(0.0, cut_hz, 100_001)
    shape = np.exp(-0.5 * (2 * np.pi * f * 0.1) ** 2)
    by_hand = -np.hypot(np.diff(f) / cut_hz, np.diff(shape)).sum()
    assert spectral_arc_length(speed, STEP_S) == pytest.approx(by_hand, abs=0.01)


@given(st.floats(1e-3, 1e3))
def test_it_does_not_depend_on_how_far_the_hand_goes(times: float) -> None:
    speed = strokes(0.5, 2.0)
    assert spectral_arc_length(times * speed, STEP_S) == pytest.approx(spectral_arc_length(speed, STEP_S), rel=1e-9)


@given(st.floats(0.5, 6.0))
def test_it_does_not_depend_on_how_fast(duration_s: float) -> None:
    assert spectral_arc_length(stroke(duration_s), STEP_S) == pytest.approx(-1.406, abs=0.02)


def test_nor_on_how_often_it_is_sampled() -> None:
    fine, coarse = (spectral_arc_length(stroke(2.0, step_s), step_s) for step_s in (0.001, 0.02))
    assert fine == pytest.approx(coarse, abs=0.01)


def test_every_stop_on_the_way_costs_smoothness_and_longer_ones_cost_more() -> None:
    one, near, far = (
        spectral_arc_length(speed, STEP_S) for speed in (strokes(0.5), strokes(0.5, 1.6), strokes(0.5, 3.5))
    )
    assert one > near > far


def test_where_nothing_moves_there_is_none() -> None:
    for speed, step_s in (
        (np.zeros(100), 0.01),
        (np.ones(1), 0.01),
        (np.ones(10), 0.0),
        (np.full(10, np.nan), 0.01),
        (np.ones(10), np.nan),
    ):
        assert spectral_arc_length(speed, step_s) is None
