"""Errors of arms: their defaults, what is refused, and those that a laboratory measured.

Of measured ones: the effective number of samples, bands, their coverage, and the tracker's fit.
"""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from pydantic import ValidationError

from skills.errors import BadInput, BadSettings
from skills.kinematics import forward
from skills.library.plans.arm_errors import stated_errors
from skills.schemas.playbacks import PlaybackIn
from skills.settings import Settings
from skills.verification import arm_calibration
from skills.verification.arm_calibration import LEAST_EFFECTIVE, MeasuredArm, calibrate_arm, effective_number
from skills.verification.arm_errors import CALIBRATED, CALLED, NAMED, SIZES, UNCALIBRATED, ArmErrors
from skills.verification.error_draws import rotation_of
from tests.arms import ARMS

PLAN = "0" * 64


def test_every_default_has_sources_and_a_calibrated_arm_no_greater_error():
    for errors in NAMED.values():
        assert set(errors.sources) == set(SIZES)
    assert all(getattr(CALIBRATED, size) <= getattr(UNCALIBRATED, size) for size in SIZES)
    assert set(CALLED) == set(SIZES) - {"tip_correlation_s"}


def test_errors_are_stated_by_name_or_json_and_are_else_uncalibrated(tmp_path, monkeypatch):
    assert stated_errors("calibrated") == CALIBRATED
    assert stated_errors(json.dumps(asdict(ARMS))) == ARMS
    monkeypatch.delenv("SKILLS_ARM_ERRORS", raising=False)
    assert stated_errors(Settings().arm_errors) == UNCALIBRATED
    (tmp_path / "arms.json").write_text(json.dumps(asdict(ARMS)))
    monkeypatch.setenv("SKILLS_ARM_ERRORS", str(tmp_path / "arms.json"))
    assert stated_errors(Settings().arm_errors) == ARMS


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"tip_bias_mm": float("nan")}, "tip_bias_mm must be a number from 0"),
        ({"wrist_deg": -1.0}, "wrist_deg must be"),
        ({"registration_mm": 1001.0}, "registration_mm must be"),
        ({"sources": {}}, "registration_mm needs its source"),
        ({"sources": dict.fromkeys(SIZES, " ")}, "needs its source"),
        ({"sources": dict.fromkeys([*SIZES, "grip"], "a")}, "sources has grip"),
        ({"name": "\n"}, "need a name"),
        ({"name": "calibrated"}, "give your own another name"),
    ],
)
def test_errors_that_cannot_be_meant_are_refused(change, why):
    with pytest.raises(BadSettings, match=why):
        stated_errors(json.dumps(asdict(ARMS) | change))


@pytest.mark.parametrize("text", ["", "0.65", "exact", "[]", "{}", '{"name": 3}', json.dumps({"name": "a"})])
def test_text_that_states_no_errors_is_refused(text):
    with pytest.raises(BadSettings, match="uncalibrated, or JSON with name, registration_mm"):
        stated_errors(text)


def test_a_request_states_errors_by_name_or_all_of_them():
    assert PlaybackIn(plan=PLAN).arm_errors is None
    assert PlaybackIn(plan=PLAN, errors="calibrated").arm_errors == CALIBRATED
    assert PlaybackIn(plan=PLAN, errors=asdict(ARMS)).arm_errors == ARMS
    for wrong in ("exact", 0.65, asdict(ARMS) | {"sources": {}}, asdict(ARMS) | {"grip_mm": 1.0}):
        with pytest.raises(ValidationError):
            PlaybackIn(plan=PLAN, errors=wrong)
    with pytest.raises(BadSettings, match="another name"):
        assert PlaybackIn(plan=PLAN, errors=asdict(replace(ARMS, name="uncalibrated"))).arm_errors


def test_without_a_size_all_others_stay():
    spared = ARMS.without("wrist_deg")
    assert spared == ArmErrors(**asdict(ARMS) | {"wrist_deg": 0.0})


def lasting(rng, count: int, keeps: float, axes: int = 3) -> np.ndarray:
    """Return errors of size 1 of which each keeps a part of the one before, shape (count, axes)."""
    made = rng.standard_normal((count, axes))
    for k in range(1, count):
        made[k] = keeps * made[k - 1] + np.sqrt(1 - keeps**2) * made[k]
    return made


def recorded(count: int = 3000, keeps: float = 0.9, seed: int = 0) -> MeasuredArm:
    """Return an arm that moves about, with errors of 0.2 mm and 0.5 degrees that last 10 samples or so."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 40, count)[:, None] * [1.0, 0.7, 0.9, 0.5, 1.3, 1.1] + [0, 1, 2, 3, 4, 5]
    joints = [0.0, 0.0, 150.0, 0.0, 0.0, 0.0] + np.sin(phase) * [0.4, 0.3, 30.0, 1.0, 0.6, 0.6]
    tip, jaw = forward(joints)
    turned = jaw @ rotation_of(np.radians(0.5) * lasting(rng, count, keeps))
    return MeasuredArm(tip, jaw, tip + 0.2 * lasting(rng, count, keeps), turned, np.arange(count) * 0.01)


def test_the_effective_number_is_that_of_noise_of_known_autocorrelation():
    rng = np.random.default_rng(1)
    for keeps in (0.0, 0.5, 0.9):
        values = lasting(rng, 20_000, keeps, axes=1)[:, 0]
        assert effective_number(values) / len(values) == pytest.approx((1 - keeps) / (1 + keeps), rel=0.2)
    assert effective_number(np.zeros(100)) == 100


def test_the_stated_errors_are_those_that_were_put_in():
    found = calibrate_arm(recorded(8000), name="bench 3")
    assert found.errors.tip_noise_mm == pytest.approx(0.2, rel=0.07)
    assert found.errors.tip_correlation_s == pytest.approx(-0.01 / np.log(0.9), rel=0.2)
    assert [one.deviation for one in found.wrist] == pytest.approx([0.5] * 3, rel=0.08)
    left = set(SIZES) - {"tip_noise_mm", "tip_correlation_s"}
    assert all(getattr(found.errors, size) == getattr(UNCALIBRATED, size) for size in left)
    assert all(found.errors.sources[size].startswith("Not measured by this recording") for size in left)
    assert "of the encoders and not of the tip" in found.describe()


def test_bands_hold_as_many_of_the_samples_left_out_as_they_say():
    found = [calibrate_arm(recorded(1000, seed=seed), name="ours") for seed in range(8)]
    assert np.mean([one.coverage for one in found]) == pytest.approx(0.9, abs=0.03)
    # Few independent samples make wide bands: the deviation is 0.2 mm, so a certain band is 0.66 mm wide.
    few, many = (calibrate_arm(recorded(count), name="ours").tip[0].width for count in (800, 5000))
    assert 0.6 < many < few


def test_too_few_independent_samples_are_refused():
    with pytest.raises(BadInput, match=rf"at least {LEAST_EFFECTIVE:.0f} and 4 are needed. Record more"):
        calibrate_arm(recorded(100, keeps=0.98), name="ours")
    with pytest.raises(BadInput, match="10 samples hold 0"):
        calibrate_arm(recorded(10), name="ours")


def test_a_tracker_shows_the_errors_that_encoders_do_not(monkeypatch):
    still = recorded(2000)
    rng = np.random.default_rng(5)
    off = 1.2 * lasting(rng, 2000, 0.9)  # cables
    turn = rotation_of(np.array([[0.3, -1.0, 2.0]]))[0]
    marker = still.setpoint_mm + off + still.setpoint @ [3.0, -20.0, 12.0]
    tracked = replace(still, marker_mm=marker @ turn.T + [100.0, -300.0, 1300.0])
    found = calibrate_arm(tracked, name="ours")
    assert [one.deviation for one in found.tracked] == pytest.approx([1.2] * 3, rel=0.1)
    assert found.errors.tip_bias_mm == pytest.approx(1.2, rel=0.1)
    assert found.errors.sources["tip_bias_mm"].startswith("Tracker")
    nearly = calibrate_arm(replace(tracked, marker_mm=(marker - 0.999 * off) @ turn.T), name="ours")
    assert [one.deviation for one in nearly.tracked] == pytest.approx([1.2e-3] * 3, rel=0.1)
    assert found.tip == nearly.tip
    with pytest.raises(BadInput, match="by the same number throughout"):
        calibrate_arm(replace(tracked, marker_mm=(marker - off) @ turn.T), name="ours")
    monkeypatch.setattr(arm_calibration, "_FITS", 2)
    with pytest.raises(BadInput, match="cannot be found from these samples"):
        calibrate_arm(tracked, name="ours")


def test_times_that_do_not_increase_are_refused():
    with pytest.raises(BadInput, match="increase"):
        replace(recorded(100), stamps_s=np.zeros(100))
