"""Errors of arms: their defaults, a laboratory's own, and what is refused."""

import json
from dataclasses import asdict, replace

import pytest
from pydantic import ValidationError

from skills.errors import BadSettings
from skills.library.arm_errors import stated_errors
from skills.schemas.plans import PlaybackIn
from skills.settings import Settings
from skills.verification.arm_errors import CALIBRATED, CALLED, NAMED, SIZES, UNCALIBRATED, ArmErrors
from tests.arms import ARMS

PLAN = "0" * 64


def test_every_size_of_a_default_has_a_source_and_a_calibrated_arm_has_no_greater_one():
    for errors in NAMED.values():
        assert set(errors.sources) == set(SIZES)
    assert all(getattr(CALIBRATED, size) <= getattr(UNCALIBRATED, size) for size in SIZES)
    assert set(CALLED) == set(SIZES) - {"tip_correlation_s"}


def test_errors_are_stated_by_name_or_by_json_and_else_by_the_uncalibrated_default(tmp_path, monkeypatch):
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
