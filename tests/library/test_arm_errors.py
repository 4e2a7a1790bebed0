"""The errors of a laboratory's arm, from a table of joints and from a bag, by the command too."""

import io
import json
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.dynamics import Servo
from skills.errors import BadInput, BadRecording, BadSettings, NoUsableTopic
from skills.fields import as_json, parse_json
from skills.formats import bag_writer as messages
from skills.formats.bag_writer import Message, write_messages
from skills.kinematics import forward, quaternion_of
from skills.library.plans.arm_errors import read_measured, read_states, stated_errors, stated_servo
from skills.verification.arm_calibration import MeasuredArm, calibrate_arm
from skills.verification.arm_errors import SIZES, UNCALIBRATED
from skills.verification.arm_slip import measure_slip
from skills.verification.error_draws import rotation_of
from tests.formats.bags import sample_folder
from tests.verification.test_arm_errors import lasting, recorded
from tests.verification.test_servo_fit import OWN, Simulated, fitted, simulated

NAMES = [f"{kind}_q{k}" for kind in ("measured", "setpoint") for k in range(1, 7)]


def table(file: Path, rows: int = 30, names: list[str] = NAMES, cell: str = "0.1") -> Path:
    file.write_text("\n".join([",".join(names), *[",".join(["0.1"] * (len(names) - 1) + [cell])] * rows]))
    return file


MARKER_MM = [3.0, -20.0, 12.0]  # in the tool frame
CABLES_MM = 1.2


def seen(count: int) -> MeasuredArm:
    """Return an arm that cables put off by 1.2 mm along each axis, as its encoders and a tracker see it."""
    made = recorded(count)
    off = CABLES_MM * lasting(np.random.default_rng(5), count, 0.98)
    marker = made.setpoint_mm + off + made.setpoint @ MARKER_MM
    turn = rotation_of(np.array([[0.3, -1.0, 2.0]]))[0]
    return replace(made, marker_mm=marker @ turn.T + [100.0, -300.0, 1300.0])


def tracked_bag(file: Path, count: int = 4000, late_ns: int = 0) -> Path:
    """Write a bag with the marker's pose at 50 Hz, half a period beside the arm's; for 5 s it is lost, for 1 s NaN."""
    marker_mm = seen(count).marker_mm
    said = poses(count)
    for k in range(0, count - 1, 2):
        at_ns = 10**15 + k * 10**7 + 5 * 10**6 + late_ns
        place = (marker_mm[k] + marker_mm[k + 1]) / 2000 if not 2000 <= k < 2100 else [np.nan] * 3
        if not 1000 <= k < 1500:
            said.append(messages.pose("/NDI/tool/measured_cp", at_ns, "NDI", tuple(place), (0, 0, 0, 1)))
    return written(file, said)


def bag(file: Path, count: int = 1500, setpoints: bool = True) -> Path:
    """Write a bag with an arm's poses, with or without its setpoints."""
    return written(file, poses(count, setpoints))


def poses(count: int, setpoints: bool = True) -> list[Message]:
    """Return an arm's poses at 100 Hz, with its setpoints 1 ms before each of them."""
    made = recorded(count)
    said: list[Message] = []
    for topic, tips, jaws, before_ns in (
        ("/PSM1/measured_cp", made.measured_mm, made.measured, 0),
        ("/PSM1/setpoint_cp", made.setpoint_mm, made.setpoint, 10**6),
    ):
        if setpoints or "measured" in topic:
            for k, (tip, turn) in enumerate(zip(tips / 1000, quaternion_of(jaws), strict=True)):
                at_ns = 10**15 + k * 10**7 - before_ns
                said.append(messages.pose(topic, at_ns, "PSM1_base", tuple(tip), tuple(turn)))
    return said


def written(file: Path, said: list[Message]) -> Path:
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
    assert "of the encoders and not of the tip" in found.describe()


def test_a_published_recording_slips_in_small_cells_alone():
    measured = read_measured(sample_folder() / "calibration" / "raw_sensor_rosbag_09_traj3.csv")
    small, paper = measure_slip(measured, 0.5), measure_slip(measured, 5.0)
    assert small.slip == pytest.approx(0.565, abs=0.01) and 5 < small.effective < 7
    assert paper.slip == 0.0 and paper.interval[1] == pytest.approx(0.41, abs=0.01)
    assert paper.tip_elsewhere == pytest.approx(0.176, abs=0.01)  # of the tip, by the tracker


def test_a_bag_gives_what_was_put_in(tmp_path: Path):
    found = calibrate_arm(read_measured(bag(tmp_path / "arm.mcap")), name="ours")
    assert found.samples >= 1499
    assert found.errors.tip_noise_mm == pytest.approx(0.2, rel=0.15)
    assert found.errors.tip_correlation_s == pytest.approx(-0.01 / np.log(0.9), rel=0.3)
    assert found.errors.tip_bias_mm == UNCALIBRATED.tip_bias_mm
    with pytest.raises(BadRecording, match="no setpoints of PSM1"):
        read_measured(bag(tmp_path / "alone.mcap", 400, setpoints=False))


def test_a_trackers_topic_in_a_bag_shows_the_tips_constant_error(tmp_path: Path):
    file = tracked_bag(tmp_path / "arm.mcap")
    measured = read_measured(file, tracker="/NDI/tool/measured_cp")
    # Not where the marker was lost, or beyond the tracker's first and last position.
    assert measured.marker_mm is not None and 3380 < len(measured.marker_mm) < 3400
    lost = (measured.stamps_s > 10.01) & (measured.stamps_s < 15.0)
    assert not lost.any() and np.isfinite(measured.marker_mm).all()
    found = calibrate_arm(measured, name="ours")
    assert found.errors.tip_bias_mm == pytest.approx(CABLES_MM, rel=0.25)
    assert found.errors.tip_noise_mm == pytest.approx(0.2, rel=0.15)
    assert "The tracker shows the tip's" in found.describe()
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--tracker", "/NDI/tool/measured_cp"])
    assert ran.exit_code == 0 and "tip, tracked z mm" in ran.output


def test_between_a_trackers_positions_the_marker_is_interpolated(tmp_path: Path):
    count = 400
    measured = read_measured(tracked_bag(tmp_path / "arm.mcap", count), tracker="/NDI/tool/measured_cp")
    exactly = seen(count).marker_mm[np.round(measured.stamps_s * 100).astype(int)]
    assert np.abs(measured.marker_mm - exactly).max() < 2.0 and np.abs(measured.marker_mm - exactly).mean() < 0.3


def test_a_tracker_that_cannot_be_used_is_refused(tmp_path: Path):
    file = tracked_bag(tmp_path / "arm.mcap", 300, late_ns=3600 * 10**9)
    with pytest.raises(BadRecording, match="one clock"):
        read_measured(file, tracker="/NDI/tool/measured_cp")
    with pytest.raises(NoUsableTopic, match="such messages on /NDI/tool/measured_cp, /PSM1/measured_cp"):
        read_measured(file, tracker="/NDI/tool/measured_cq")
    with pytest.raises(BadInput, match="omit the topic"):
        read_measured(table(tmp_path / "joints.csv"), tracker="/NDI/tool/measured_cp")
    folder = tmp_path / "folder.zip"
    with zipfile.ZipFile(folder, "w") as out:
        out.write(file, "bag/bag_0.mcap")
    with pytest.raises(BadInput, match=r"ROS 1 bag, a \.db3 or an MCAP"):
        read_measured(folder, tracker="/NDI/tool/measured_cp")


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
        ({"cell": "x"}, "Row 2, column setpoint_q6: not a number"),
        ({"cell": "nan"}, "NaN"),
        ({"rows": 0}, "a header and no rows"),
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
    assert json.loads(ran.output)["samples"] >= 1499 and "slip" not in json.loads(ran.output)
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--cell", "5"])
    assert ran.exit_code == 0 and "In cells of 5 mm" in ran.output and "--setting slip=0`" in ran.output
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--cell", "5", "--json"])
    assert json.loads(ran.output)["slip"]["slip"] == 0.0
    assert CliRunner().invoke(app, ["calibrate-arm", str(file), "--cell", "0"]).exit_code == 1
    few = CliRunner().invoke(app, ["calibrate-arm", str(table(tmp_path / "few.csv"))])
    assert few.exit_code == 1
    assert CliRunner().invoke(app, ["calibrate-arm", str(tmp_path / "none.bag")]).exit_code == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "JSON"),
        ('{"velocitys": true}', "velocitys"),
        ('{"play": [[0, 0]]}', "play"),
        ('{"most_mm": 0}', "most_mm"),
    ],
)
def test_a_servo_that_is_no_servo_is_refused(text, words):
    with pytest.raises(BadSettings, match=words):
        stated_servo(text)


def test_the_servo_of_the_page_is_one():
    page = (Path(__file__).parents[2] / "docs/execution.md").read_text()
    stated = stated_servo(page.partition("```json\n")[2].partition("```")[0])
    assert stated == Servo(velocities=False, gravity_compensated=True, most_mm=1.0)
    for name in (field.name for field in fields(Servo) if field.name != "step_s"):
        assert f"`{name}`" in page


def test_a_servo_is_stated_or_not():
    assert stated_servo("") is None
    assert stated_servo('{"velocities": false, "most_mm": 1.5}') == Servo(velocities=False, most_mm=1.5)


# ---- the servo ------------------------------------------------------------------------------------------------------


def states_bag(file: Path, made: Simulated, arm: str = "PSM1", setpoints: bool = True) -> Path:
    """Write measured_js and, half a ms later, setpoint_js of a simulated arm; what is NaN is not recorded."""
    said: list[Message] = []
    for kind, states, late_ns in (("measured_js", made.measured, 0), ("setpoint_js", made.setpoints, 500_000)):
        if setpoints or kind == "measured_js":
            for at_s, rows in zip(made.stamps_s, states, strict=True):
                joints, speeds, efforts = ([] if np.isnan(row[0]) else row.tolist() for row in rows)
                at_ns = 10**18 + round(at_s * 1e9) + late_ns
                topic = f"/{arm}/{kind}"
                said.append(messages.joint_state(topic, at_ns, joints, velocities=speeds, efforts=efforts))
    return written(file, said)


def ran_servo(file: Path, to: Path, *more: str) -> tuple[int, str]:
    ran = CliRunner().invoke(app, ["calibrate-arm", str(file), "--servo", str(to), *more], env={"COLUMNS": "200"})
    return ran.exit_code, ran.output


def test_a_bag_with_efforts_becomes_the_servo_of_a_file(tmp_path: Path):
    made, to = simulated(3, 5, gravity_compensated=True, **OWN), tmp_path / "servo.json"
    file = states_bag(tmp_path / "arm.mcap", made)
    stamps_s, measured, setpoints = read_states(file)
    np.testing.assert_allclose(stamps_s, made.stamps_s, atol=1e-9)
    np.testing.assert_array_equal(measured, made.measured)
    np.testing.assert_array_equal(setpoints, made.setpoints)
    code, output = ran_servo(file, to)
    found, servo, _ = fitted(made)
    assert code == 0 and "wrist_yaw" in output and "as_published" in output and "left as by default" in output
    stated = parse_json(Servo, json.loads(to.read_text()))
    assert stated == servo and stated != Servo() and stated.gravity_compensated
    code, output = ran_servo(file, to, "--json")
    document = json.loads(output)
    assert code == 0 and document["servo"] == json.loads(json.dumps(as_json(servo)))
    assert [one["fitted"] for one in document["quantities"]] == [one.fitted for one in found]


def test_a_bag_without_efforts_has_the_static_part_and_says_what_to_record(tmp_path: Path):
    file = states_bag(tmp_path / "arm.mcap", simulated(3, 5, efforts=False, gravity_compensated=True, **OWN), "PSM2")
    code, output = ran_servo(file, tmp_path / "servo.json")
    assert code == 0 and output.count("compensation") >= 3 and "stiffness" not in output.partition("All is")[0]
    assert "There are no efforts" in output and "ros2 bag record" in output
    assert parse_json(Servo, json.loads((tmp_path / "servo.json").read_text())).stiffness == Servo().stiffness


def test_without_setpoints_or_joints_the_sentence_says_what_to_record(tmp_path: Path):
    made, to = simulated(3, 5, **OWN), tmp_path / "servo.json"
    for file in (states_bag(tmp_path / "joints.mcap", made, setpoints=False), bag(tmp_path / "poses.mcap", 50)):
        code, output = ran_servo(file, to)
        assert code == 1 and "ros2 bag record /PSM1/measured_js /PSM1/setpoint_js" in output and not to.exists()
    two = states_bag(tmp_path / "without-a-suffix", made)
    with zipfile.ZipFile(tmp_path / "folder.zip", "w") as out:
        out.write(two, "bag/bag_0.mcap")
    (tmp_path / "other.csv").write_text("time,x\n0,1\n")
    for name in ("folder.zip", "other.csv"):
        with pytest.raises(BadInput, match=r"ROS 1 bag, a \.db3 or an MCAP"):
            read_states(tmp_path / name)
    with pytest.raises(NoUsableTopic, match="not of one --arm"):
        read_states(two, arm="PSM3")
    assert len(read_states(two, arm="PSM1")[0]) == len(made.stamps_s)
    for more in (["--to", "x.json"], ["--tracker", "/NDI"], ["--cell", "5"]):
        assert "Omit --to, --tracker and --cell" in ran_servo(two, to, *more)[1]


def test_a_table_of_joints_has_the_static_part(tmp_path: Path):
    stamps_s, measured, setpoints = read_states(table(tmp_path / "joints.csv"))
    assert stamps_s.tolist() == list(range(30)) and (measured[:, 0] == 0.1).all() and (setpoints[:, 0] == 0.1).all()
    assert (measured[:, 1] == 0).all() and np.isnan(measured[:, 2]).all() and np.isnan(setpoints[:, 1:]).all()
    timed, still, _ = read_states(table(tmp_path / "joints.csv"), rate_hz=50.0)
    assert timed[-1] == pytest.approx(29 / 50) and np.isnan(still[:, 1]).all()


@pytest.mark.needs("recordings")
def test_the_command_fits_a_published_recording_and_table(tmp_path: Path):
    folder, to = sample_folder() / "calibration", tmp_path / "servo.json"
    code, output = ran_servo(folder / "raw_sensor_rosbag_09_traj3.csv", to)
    assert code == 0 and "1.096" in output and "There are no efforts" in output
    stated = json.loads(to.read_text())
    assert stated["gravity_compensated"] and stated["compensation"][0][:2] == [1.055, 0.8456]
    code, output = ran_servo(folder / "pitch_exp_traj_02_test_cropped.bag", to)  # one of its stamps goes back
    assert code == 0 and json.loads(to.read_text())["stiffness"][2] == 8000.0
