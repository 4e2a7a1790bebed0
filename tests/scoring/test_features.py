"""Figures of whole trials: by hand, independent of the rate, and what they need."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skills.demonstration.motion import Motion, Signal
from skills.demonstration.recording import Recording
from skills.errors import BadInput
from skills.formats.jigsaws import read_jigsaws
from skills.scoring.features import TRIAL_KINDS, TRIAL_NAMES, TrialFigures, measure_trial
from tests.library import rated

PERIOD_S, RADIUS_MM = 4.0, 20.0


def arm(
    name: str, seconds: np.ndarray, tip_mm: np.ndarray, jaw_rad: np.ndarray, turn_rad: np.ndarray
) -> tuple[Motion, Signal]:
    stamps_ns = np.rint(1e9 * seconds).astype(np.int64)
    half = turn_rad / 2
    rotation = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return Motion(name, f"/{name}/measured_cp", "base", stamps_ns, tip_mm, rotation), Signal(stamps_ns, jaw_rad, name)


def recording(*arms: tuple[Motion, Signal], masters: tuple[tuple[Motion, Signal], ...] = ()) -> Recording:
    return Recording(
        "mcap",
        "none",
        motions=tuple(motion for motion, _ in arms),
        jaws=tuple((motion.arm, jaw) for motion, jaw in arms),
        masters=tuple(motion for motion, _ in masters),
        grippers=tuple((motion.arm, jaw) for motion, jaw in masters),
    )


def circle(
    name: str, rate_hz: float = 100.0, lasts_s: float = 40.0, radius_mm: float = RADIUS_MM
) -> tuple[Motion, Signal]:
    """Return an arm that goes round and round, turns by 0.1 rad/s and opens its jaw every 8 s."""
    seconds = np.arange(0.0, lasts_s, 1 / rate_hz)
    angle = 2 * np.pi * seconds / PERIOD_S
    tip_mm = radius_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return arm(name, seconds, tip_mm, np.where(seconds % 8 < 4, 0.8, 0.0), 0.1 * seconds)


def readable(found: TrialFigures, side: int = 0) -> dict[str, float]:
    return {kind.name: kind.readable(float(one)) for kind, one in zip(TRIAL_KINDS, found.values[side], strict=True)}


def test_the_figures_of_a_circle_are_those_by_hand() -> None:
    found = readable(measure_trial(recording(circle("PSM1"), circle("PSM2"))))
    speed = 2 * np.pi * RADIUS_MM / PERIOD_S
    assert found["duration_s"] == pytest.approx(40.0, rel=1e-3)
    assert found["speed_mm_s"] == pytest.approx(speed, rel=0.03)  # the window makes the circle a little smaller
    assert found["path_length_mm"] == pytest.approx(40.0 * speed, rel=0.03)
    assert found["turn_rad"] == pytest.approx(4.0, rel=0.02)
    assert found["turn_per_mm"] == pytest.approx(4.0 / (40.0 * speed), rel=0.05)
    assert found["jerk_per_speed"] == pytest.approx((2 * np.pi / PERIOD_S) ** 2, rel=0.02)
    assert found["grips"] == pytest.approx(9.0)  # it closes five times, and opens four times after the first
    assert found["idle_share"] == pytest.approx(0.0) and found["together_share"] == pytest.approx(1.0)
    assert found["stops"] == pytest.approx(0.0, abs=1e-9)


def test_the_mean_over_the_arms_is_geometric_and_ignores_their_order() -> None:
    small, large = circle("PSM1", radius_mm=10.0), circle("PSM2", radius_mm=40.0)
    found = readable(measure_trial(recording(small, large)))
    assert found["path_length_mm"] == pytest.approx(
        readable(measure_trial(recording(circle("PSM1"), circle("PSM2"))))["path_length_mm"]
    )
    swapped = measure_trial(recording(circle("PSM1", radius_mm=40.0), circle("PSM2", radius_mm=10.0)))
    np.testing.assert_allclose(swapped.values, measure_trial(recording(small, large)).values)


def trial_at(rate_hz: float, seed: int = 3) -> Recording:
    """Return a synthetic trial, of which a recorder of 30 Hz or of 200 Hz takes its samples."""
    rng = np.random.default_rng(seed)
    arms = []
    for name in ("PSM1", "PSM2"):
        fine = np.arange(0.0, 30.0, 1e-3)
        tip_mm = sum(
            size * np.sin(2 * np.pi * (hertz * fine[:, None] + rng.uniform(size=3)))
            for size, hertz in ((20.0, 0.11), (10.0, 0.37), (4.0, 0.9), (0.1, 6.0))
        )
        jaw = np.where(np.sin(2 * np.pi * fine / 7.0) > 0, 0.7, -0.2)
        rest = np.clip(np.sin(2 * np.pi * fine / 15.0) + 0.7, 0.0, 1.0)[:, None]
        seconds = np.arange(0.0, 29.9, 1 / rate_hz)
        at = np.searchsorted(fine, seconds)
        turn = 0.5 * np.sin(2 * np.pi * 0.3 * fine)
        arms.append(arm(name, seconds, (tip_mm * rest)[at], jaw[at], turn[at]))
    return recording(*arms)


def test_the_rate_of_the_recording_does_not_matter() -> None:
    """A trial recorded at 30 Hz and at 200 Hz has figures within 2 %, or 0.02 without a logarithm."""
    slow, fast = (measure_trial(trial_at(rate)) for rate in (30.0, 200.0))
    off = dict(zip(TRIAL_NAMES, np.abs(slow.values - fast.values)[0].tolist(), strict=True))
    assert max(off.values()) < 0.02, off


def test_the_place_and_the_frame_do_not_matter() -> None:
    there = trial_at(30.0)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = replace(there, motions=tuple(replace(one, tip_mm=one.tip_mm @ turn + 100.0) for one in there.motions))
    np.testing.assert_allclose(measure_trial(moved).values, measure_trial(there).values, atol=1e-6)


def test_thirds_are_the_figures_of_the_parts_cut_out() -> None:
    """The middle third of a trial has the figures of a recording of it, but for the window at its ends."""
    found = measure_trial(trial_at(100.0))
    third = found.thirds[0, 1]
    assert TRIAL_KINDS[0].readable(float(third[0])) == pytest.approx(29.9 / 3, rel=0.01)
    paths = [TRIAL_KINDS[1].readable(float(one[1])) for one in found.thirds[0]]
    assert TRIAL_KINDS[1].readable(float(found.values[0, 1])) == pytest.approx(sum(paths), rel=0.02)


def test_masters_are_a_side_of_their_own() -> None:
    instruments = (circle("PSM1"), circle("PSM2"))
    masters = (circle("MTML", radius_mm=50.0), circle("MTMR", radius_mm=50.0))
    found = measure_trial(recording(*instruments, masters=masters))
    assert found.values.shape == (2, len(TRIAL_KINDS)) and found.thirds.shape == (2, 3, len(TRIAL_KINDS))
    ratio = readable(found, 1)["path_length_mm"] / readable(found, 0)["path_length_mm"]
    assert ratio == pytest.approx(2.5, rel=1e-6)
    one = measure_trial(recording(*instruments, masters=masters[:1]))
    assert len(one.values) == 1


def test_an_arm_that_stands_still_has_figures() -> None:
    motion, jaw = circle("PSM2")
    still = (replace(motion, tip_mm=np.zeros_like(motion.tip_mm)), Signal(jaw.stamps_ns, 0 * jaw.values, "PSM2"))
    found = measure_trial(recording(circle("PSM1"), still))
    assert np.isfinite(found.values).all()
    assert readable(found)["idle_share"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("arms", "said"),
    [
        (lambda: (circle("PSM1"),), r"has 1 \(PSM1\)"),
        (lambda: (circle("PSM1"), circle("PSM2"), circle("PSM3")), "has 3 .*no third one"),
        (lambda: (circle("PSM1"), circle("PSM2", lasts_s=2.0)), "for 2.0 s; a trial has at least 3 s"),
    ],
)
def test_a_recording_that_is_no_trial_is_refused(arms: object, said: str) -> None:
    with pytest.raises(BadInput, match=said):
        measure_trial(recording(*arms()))  # type: ignore[operator]


def test_a_recording_without_jaws_or_orientation_is_refused() -> None:
    whole = recording(circle("PSM1"), circle("PSM2"))
    for lacking in (
        replace(whole, jaws=whole.jaws[:1]),
        replace(whole, motions=(replace(whole.motions[0], rotation_xyzw=None), whole.motions[1])),
    ):
        with pytest.raises(BadInput, match="each with pose, orientation and jaw"):
            measure_trial(lacking)


def test_a_clumsy_trial_of_jigsaws_layout_differs_as_it_should(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    numbers = []
    for skill in (0.9, 0.1):
        path = tmp_path / f"{skill}.txt"
        path.write_bytes(rated.text(rated.trial(skill, rng)[0]))
        with path.open("rb") as file:
            numbers.append(readable(measure_trial(read_jigsaws(file))))
    skilled, clumsy = numbers
    for more in ("path_length_mm", "speed_peaks", "grips", "turn_rad"):
        assert clumsy[more] > skilled[more], more
