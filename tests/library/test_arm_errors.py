"""The errors of a laboratory's arm, from a table of joints and from a bag, by the command too."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.errors import BadInput, BadRecording
from skills.formats import bag_writer as messages
from skills.formats.bag_writer import Message, write_messages
from skills.kinematics import forward, quaternion_of
from skills.library.arm_errors import read_measured, stated_errors
from skills.verification.arm_errors import SIZES, UNCALIBRATED, calibrate_arm
from tests.formats.bags import sample_folder
from tests.verification.test_measured_errors import recorded

NAMES = [f"{kind}_q{k}" for kind in ("measured", "setpoint") for k in range(1, 7)]


def table(file: Path, rows: int = 30, names: list[str] = NAMES, cell: str = "0.1") -> Path:
    file.write_text("\n".join([",".join(names), *[",".join(["0.1"] * (len(names) - 1) + [cell])] * rows]))
    return file


def bag(file: Path, count: int = 1500, setpoints: bool = True) -> Path:
    """Write an arm's poses at 100 Hz, with its setpoints 1 ms before each of them."""
    made = recorded(count)
    said: list[Message] = []
    for topic, tips, jaws, before_ns in (
        ("/PSM1/measured_cp", made.measured_mm, made.measured, 0),
        ("/PSM1/setpoint_cp", made.setpoint_mm, made.setpoint, 10**6),
    ):
        if setpoints or "measured" in topic:
            for k, (tip, turn) in enumerate(zip(tips / 1000, quaternion_of(jaws), strict=True)):
                at_ns = 10**15 + k * 10**7 - before_ns
                said.append(messages.pose(topic, at_ns, "PSM1_base", tuple(tip), tuple(turn), log_ns=at_ns))
    with io.BytesIO() as out:
        write_messages(sorted(said, key=lambda one: one.log_ns), out)
        file.write_bytes(out.getvalue())
    return file


def test_a_published_recording_has_bands_that_hold_what_they_say():
    measured = read_measured(sample_folder() / "calibration" / "raw_sensor_rosbag_09_traj3.csv")
    found = calibrate_arm(measured, name="a published arm")
    assert found.samples == 507
    assert 30 < found.effective < 50
    assert 0.85 <= found.coverage <= 0.95
    assert [one.width for one in found.tip] == pytest.approx([1.05, 0.61, 0.46], abs=0.02)
    assert [one.assumed_width for one in found.tip] == pytest.approx([1.5] * 3, abs=0.01)
    assert [one.assumed_coverage for one in found.tip] == [1.0] * 3
    # The tracker's rest is an uncalibrated arm's: 2.4 mm on average, where 2.96 was measured elsewhere.
    assert found.errors.tip_bias_mm == pytest.approx(1.47, abs=0.05)
    assert np.mean([one.assumed_coverage for one in found.tracked]) < 0.5
    assert np.mean([one.coverage for one in found.tracked]) == pytest.approx(0.9, abs=0.05)
    assert "of the encoders and not of the tip" in found.in_words


def test_a_bag_gives_what_was_put_in(tmp_path: Path):
    found = calibrate_arm(read_measured(bag(tmp_path / "arm.mcap")), name="ours")
    assert found.samples >= 1499
    assert found.errors.tip_noise_mm == pytest.approx(0.2, rel=0.15)
    assert found.errors.tip_correlation_s == pytest.approx(-0.01 / np.log(0.9), rel=0.3)
    assert found.errors.tip_bias_mm == UNCALIBRATED.tip_bias_mm
    with pytest.raises(BadRecording, match="no setpoints of PSM1"):
        read_measured(bag(tmp_path / "alone.mcap", 50, setpoints=False))


def test_a_table_is_read_as_the_joints_that_it_has(tmp_path: Path):
    read = read_measured(table(tmp_path / "joints.csv"), rate_hz=50.0)
    (tip,), (jaw,) = forward([[0.1, 0.1, 100.0, 0.1, 0.1, 0.1]])
    np.testing.assert_allclose(read.measured_mm, np.tile(tip, (30, 1)))
    np.testing.assert_allclose(read.setpoint, np.tile(jaw, (30, 1, 1)))
    assert read.stamps_s.tolist() == pytest.approx(np.arange(30) / 50)
    assert read_measured(table(tmp_path / "joints.csv")).stamps_s is None


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"names": NAMES[:-1]}, "no column setpoint_q6"),
        ({"cell": "x"}, "Row 2 of the table has a cell that is no number"),
        ({"cell": "nan"}, "NaN"),
        ({"rows": 0}, "0 samples hold"),
        ({}, "by the same number throughout"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(tmp_path: Path, given, why):
    with pytest.raises(BadInput, match=why):
        calibrate_arm(read_measured(table(tmp_path / "joints.csv", **given)), name="ours")


def test_the_command_writes_errors_that_a_playback_takes(tmp_path: Path):
    file, to = bag(tmp_path / "arm.mcap"), tmp_path / "arms.json"
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--name", "bench 3", "--to", str(to)])
    assert ran.exit_code == 0, ran.output
    assert "of the encoders and not of the tip" in ran.output
    stated = stated_errors(to.read_text())
    assert (stated.name, set(stated.sources)) == ("bench 3", set(SIZES))
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--json"])
    assert json.loads(ran.output)["samples"] >= 1499
    few = CliRunner().invoke(app, ["calibrate-arm", str(table(tmp_path / "few.csv"))])
    assert few.exit_code == 1
    assert CliRunner().invoke(app, ["calibrate-arm", str(tmp_path / "none.bag")]).exit_code == 1
