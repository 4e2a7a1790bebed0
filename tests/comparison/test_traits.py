"""Signatures of motions: what changes them, and what does not."""

from dataclasses import replace

import numpy as np
import pytest

from skills.comparison.recognition import FAMILIES, NUMBERS, signature_of
from skills.demonstration.demonstration import Demo
from skills.kinematics import matrix_of, quaternion_of
from tests.comparison.cohort import cohort


def motion(rate_hz: float = 100.0) -> Demo:
    """Return a hand-off of 3 s with orientation and jaw, sampled at a rate."""
    drawn = cohort(1, surgeons=1, sessions=1).demos[0]
    u = np.arange(0.0, 3.0 + 1e-9, 1.0 / rate_hz)
    at = drawn.stamps_s / drawn.stamps_s[-1] * 3.0
    tip_mm = np.stack([np.interp(u, at, axis) for axis in drawn.tip_mm.T], axis=1)
    angle = 0.8 * np.sin(u)
    rotation = np.stack([np.sin(angle / 2), 0 * u, 0.2 * np.sin(u), np.cos(angle / 2)], axis=1)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Demo("PSM2", "/t", "PSM2_base", 0.0, 3.0, u, tip_mm, rotation, 0.3 + 0.2 * np.cos(2 * u))


def family(demo: Demo, name: str) -> np.ndarray:
    return signature_of(demo)[FAMILIES[name]]


def changed(one: Demo, other: Demo) -> set[str]:
    return {name for name in FAMILIES if not np.allclose(family(one, name), family(other, name), atol=1e-6)}


def test_each_change_changes_the_families_that_it_should():
    demo = motion()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the base's z axis
    turned = quaternion_of(turn @ matrix_of(demo.rotation_xyzw))
    assert changed(demo, replace(demo, tip_mm=demo.tip_mm + np.array([5.0, -3.0, 2.0]))) == {"place"}
    assert changed(demo, replace(demo, tip_mm=demo.tip_mm @ turn.T, rotation_xyzw=turned)) == {"place", "orientation"}
    assert changed(demo, replace(demo, jaw_rad=demo.jaw_rad + 0.1)) == {"jaw"}
    assert changed(demo, replace(demo, rotation_xyzw=-demo.rotation_xyzw)) == set()
    slower = replace(demo, stamps_s=2 * demo.stamps_s)
    assert {"tempo"} <= changed(demo, slower)
    assert FAMILIES["place"].stop == NUMBERS


@pytest.mark.parametrize("rate_hz", [30.0, 200.0])
def test_it_hardly_depends_on_the_sampling_rate(rate_hz: float):
    demo, other = signature_of(motion()), signature_of(motion(rate_hz))
    for name, part in FAMILIES.items():
        apart = np.abs(demo[part] - other[part])
        scale = 1.0 if name in ("shape", "place") else 0.05  # mm; logarithms, rad and cosines
        assert apart.max() < scale, (name, apart)


def test_what_was_not_recorded_is_nan():
    bare = replace(motion(), rotation_xyzw=None, jaw_rad=None)
    missing = {name for name, part in FAMILIES.items() if np.isnan(signature_of(bare)[part]).all()}
    assert missing == {"jaw", "turning", "orientation"}
    around = replace(bare, tip_mm=np.concatenate([bare.tip_mm[:150], bare.tip_mm[150::-1]]))
    assert np.isnan(family(around, "shape")).all() and np.isfinite(family(around, "tempo")).all()


def test_two_samples_a_nanosecond_apart_have_finite_numbers():
    short = Demo("PSM2", "/t", "PSM2_base", 0.0, 1e-9, np.array([0.0, 1e-9]), np.array([[0.0, 0, 0], [5.0, 0, 0]]))
    numbers = signature_of(short)
    assert np.isfinite(numbers[FAMILIES["tempo"]]).all() and np.isfinite(numbers[FAMILIES["place"]]).all()
