"""Tables under other names, units and marks: read as the caller says, and refused with a question where unclear."""

import io

import numpy as np
import pytest

from skills import errors
from skills.demonstration.recording import Column
from skills.formats import read_recording
from skills.kinematics import INSERTION, INSTRUMENTS, angle_between, forward, matrix_of
from tests.formats import written
from tests.formats.bags import sample_folder

XYZ = ("x=PosX", "y=PosY", "z=PosZ")
ROWS = "0;1.5;50.25;-120\n10;2.5;50.25;-120\n20;3.5;50.25;-120\n"


def read(text, **how):
    if any(one[0] in "xyz" for one in how.get("column", ())):
        how = {"frame": "base", **how}
    return read_recording(io.BytesIO(text.encode()), **how)


def wanted():
    return np.loadtxt(io.StringIO(written.positions()), delimiter=";", skiprows=1)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_columns_are_read_under_the_names_that_the_caller_gives(separator):
    text = written.positions(separator=separator)
    recording = read(text, column=XYZ, unit=["mm"], rate_hz=100.0, table_arm="PSM2")
    motion = recording.motion_of()
    np.testing.assert_array_equal(motion.tip_mm, wanted())
    assert (motion.arm, motion.frame, motion.stamps_ns[1]) == ("PSM2", "PSM2_base", 10_000_000)
    assert recording.columns[0] == Column("PosX", "x", "mm")


def test_positions_under_other_names_need_a_frame():
    how = {"column": XYZ, "unit": ["mm"], "rate_hz": 100.0}
    with pytest.raises(errors.BadColumns, match="in which frame its positions are"):
        read(written.positions(), **how, frame=None)
    assert read(written.positions(), **how, frame="ECM").motion_of().frame == "ECM"
    assert read("t_s,x_mm,y_mm,z_mm\n0,0,50,-120\n1,1,50,-120\n").motion_of().frame == "PSM_base"


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read_if_stated_and_questioned_otherwise(separator):
    text = written.positions(separator=separator, comma=True)
    how = {"column": XYZ, "unit": ["mm"], "rate_hz": 100.0}
    np.testing.assert_array_equal(read(text, **how, decimal="comma").motion_of().tip_mm, wanted())
    with pytest.raises(errors.UnreadableRecording, match="is it the decimal mark"):
        read(text, **how)


@pytest.mark.parametrize("cell", ["1.234,5", "1,234,567", "1.5"])
def test_a_point_beside_decimal_commas_is_refused(cell):
    text = f"t_ms;x_mm;y_mm;z_mm\n0;1,5;50;-120\n10;{cell};50;-120\n"
    with pytest.raises(errors.UnreadableRecording, match="Row 3, column x_mm"):
        read(text, decimal="comma")


@pytest.mark.parametrize(("unit", "step_ns"), [("s", 10**10), ("ms", 10**7), ("us", 10**4)])
def test_times_are_read_in_the_unit_that_the_caller_gives(unit, step_ns):
    text = "Time;x_mm;y_mm;z_mm\n" + ROWS
    for how in ({"column": [f"t_{unit}=Time"]}, {"column": ["t=Time"], "unit": [unit]}):
        assert np.diff(read(text, **how).motion_of().stamps_ns).tolist() == [step_ns] * 2


def test_nanoseconds_are_exact_and_times_of_another_unit_questioned():
    times = [1760000000123456789, 1760000000133456790]
    text = "t_ns,x_m,y_m,z_m\n" + "".join(f"{t},0,0,-0.1\n" for t in times)
    assert read(text).motion_of().stamps_ns.tolist() == times
    with pytest.raises(errors.ImplausibleMotion, match="In ms they would give 100 poses per second"):
        read("Time;x_mm;y_mm;z_mm\n" + ROWS + "30;4.5;50.25;-120\n", column=["t_ns=Time"])
    with pytest.raises(errors.BadColumns, match="after the year 2096; give milliseconds"):
        read(text.replace("t_ns", "t_ms"))


def test_units_in_names_and_beside_them_say_the_same():
    turns = "roll_deg,pitch_deg,yaw_deg,jaw_deg"
    degrees = read(f"t_s,x_m,y_m,z_m,{turns}\n0,0,0,-0.1,90,0,180,30\n")
    radians = read(f"t_s,x_m,y_m,z_m,{turns.replace('deg', 'rad')}\n0,0,0,-0.1,{np.pi / 2},0,{np.pi},{np.pi / 6}\n")
    np.testing.assert_allclose(degrees.motion_of().rotation_xyzw, radians.motion_of().rotation_xyzw, atol=1e-15)
    assert degrees.jaw_of("PSM").values[0] == pytest.approx(np.pi / 6, abs=1e-15)


def test_columns_that_are_not_mapped_are_not_used_and_listed():
    text = "t_s,PosX,PosY,PosZ,note,q1\n0,1,50,-120,a note,?\n0.01,2,50,-120,,?\n"
    recording = read(text, column=[f"{axis}_mm=Pos{axis.upper()}" for axis in "xyz"])
    assert recording.motion_of().tip_mm[:, 0].tolist() == [1.0, 2.0]
    assert [one.name for one in recording.columns if not one.quantity] == ["note", "q1"]


HEAD = "Time;PosX;PosY;PosZ\n"


@pytest.mark.parametrize(
    ("how", "error", "question"),
    [
        ({"column": XYZ, "rate_hz": 100.0}, errors.BadSettings, "In which unit is the column 'PosX'"),
        ({"column": ["x_m=PosX", *XYZ[1:]], "unit": ["mm"], "rate_hz": 1.0}, errors.BadSettings, "which is it"),
        ({"column": XYZ, "unit": ["mm", "m"], "rate_hz": 1.0}, errors.BadSettings, "contradict"),
        ({"column": XYZ, "unit": ["mm", "deg"], "rate_hz": 1.0}, errors.BadSettings, "belongs to no mapped column"),
        ({"column": XYZ, "unit": ["inch"], "rate_hz": 1.0}, errors.BadSettings, "unit 'inch' is unknown"),
        ({"column": [*XYZ, "x=PosY"], "unit": ["mm"], "rate_hz": 1.0}, errors.BadSettings, "second time"),
        ({"column": [*XYZ, "qx=PosY"], "unit": ["mm"], "rate_hz": 1.0}, errors.BadSettings, "second time"),
        ({"column": [*XYZ[:2], "z=Posz"], "unit": ["mm"], "rate_hz": 1.0}, errors.BadColumns, "Did you mean 'PosZ'"),
        ({"column": ["PosX"], "rate_hz": 1.0}, errors.BadSettings, "not of the form"),
        ({"column": ["w=PosX"], "rate_hz": 1.0}, errors.BadSettings, "not of the form"),
        ({"column": XYZ[:2], "unit": ["mm"], "rate_hz": 1.0}, errors.BadColumns, "z_mm is missing"),
        ({"column": [*XYZ, "t_ms=Time"], "unit": ["mm"], "rate_hz": 1.0}, errors.BadColumns, "use one of them"),
        ({"column": XYZ, "unit": ["mm"]}, errors.BadColumns, "no column t_s"),
        ({"unit": ["mm"]}, errors.BadColumns, "unknown column 'Time'"),
        ({"column": XYZ, "unit": ["mm"], "rate_hz": 1.0, "instrument": "1"}, Exception, "instrument '1' is unknown"),
    ],
)
def test_what_is_ambiguous_is_refused_with_the_question(how, error, question):
    with pytest.raises(error, match=question):
        read(HEAD + ROWS, **how)


@pytest.mark.parametrize(
    ("text", "how", "error", "message"),
    [
        ("x_mm;y_mm,z_mm\n1;2,3\n", {"rate_hz": 1.0}, errors.BadColumns, "both commas and semicolons"),
        ("x_mm,a,a\n1,2,3\n", {"column": ["y_mm=a"], "rate_hz": 1.0}, errors.BadColumns, "'a' twice"),
        ("t_s,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad\n0,0,0,-100,0,0,90\n", {}, errors.NotAQuaternion, "more than a turn"),
        ("t_s,x_mm,y_mm,z_mm,rx_rad,ry_rad\n0,0,0,-100,0,0\n", {}, errors.BadColumns, "rz_rad is missing"),
        ("t_s,q1_rad,q2_rad,q3_m\n0,0,0,0.1\n", {}, errors.BadColumns, "q4_rad is missing"),
        ("t_s;x_mm;y_mm;z_mm\n0;1;2;3;4\n", {}, errors.UnreadableRecording, "Row 2 has 5 cells"),
        ("t_s;x_mm;y_mm;z_mm\n0;1;2;np.float64(3\n", {}, errors.UnreadableRecording, "column z_mm: not a number"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(text, how, error, message):
    with pytest.raises(error, match=message):
        read(text, **how)


@pytest.mark.parametrize("option", [{"column": ["x_mm=a"]}, {"unit": ["mm"]}, {"table_arm": "PSM1"}])
def test_a_bag_takes_no_option_of_a_table(option):
    bag = (sample_folder() / "old_transform_stamped.mcap").read_bytes()
    with pytest.raises(errors.BadSettings, match=f"omit {next(iter(option))}"):
        read_recording(io.BytesIO(bag), **option)


def test_quoted_names_may_contain_separators_and_stamps_go_back():
    text = '"Pos X, mm";"Pos Y, mm";"Pos Z, mm";t_s\n' + "".join(f"{k};50;-120;{k * 0.01}\n" for k in range(200))
    text = text.replace("100;50;-120;1.0\n", "100;50;-120;0.98\n")
    column = [f"{axis}_mm=Pos {axis.upper()}, mm" for axis in "xyz"]
    motion = read(text, column=column).motion_of()
    assert (motion.backward_stamps, len(motion.stamps_ns)) == (1, 199)
    with pytest.raises(errors.BackwardStamps):
        read("t_s,x_mm,y_mm,z_mm\n0,1,50,-120\n1,1,50,-120\n0.99,1,50,-120\n")


# ---- joints


def test_joints_alone_become_poses_with_a_stated_instrument():
    text = written.joints()
    with pytest.raises(errors.NoUsableTopic, match="the instrument that was on the arm"):
        read(text, rate_hz=30.0)
    recording = read(text, rate_hz=30.0, instrument="400006", table_arm="PSM2")
    (joints,), motion = recording.joints, recording.motion_of()
    wanted = written.sample("kestrel").motion_of()
    np.testing.assert_allclose(motion.tip_mm, wanted.tip_mm[::7][: len(motion.tip_mm)], atol=1e-6)
    assert angle_between(matrix_of(motion.rotation_xyzw), matrix_of(wanted.rotation_xyzw[::7])).max() < 1e-6
    assert (motion.frame, joints.arm, recording.tools) == ("PSM2_base", "PSM2", (("PSM2", "400006"),))
    assert recording.identifications == ()  # the poses were computed from the joints, and show nothing about them
    assert recording.instrument_on("PSM2") == "400006"
    with pytest.raises(errors.MixedFrames, match="PSM2_base"):
        read(text, rate_hz=30.0, instrument="400006", table_arm="PSM2", frame="ECM")


def test_joints_in_other_units_are_refused_or_named():
    text = written.joints()
    head, _, rows = text.partition("\n")
    degrees = np.loadtxt(io.StringIO(rows), delimiter=",")
    degrees[:, [0, 1, 3, 4, 5]] *= 180 / np.pi
    rows = "\n".join(",".join(map(repr, row)) for row in degrees.tolist())
    with pytest.raises(errors.NotMetres, match="no joint of a PSM is"):
        read(f"{head}\n{rows}", rate_hz=30.0, instrument="400006")
    named = read(f"{head.replace('rad', 'deg')}\n{rows}", rate_hz=30.0, instrument="400006")
    np.testing.assert_allclose(
        named.motion_of().tip_mm, read(text, rate_hz=30.0, instrument="400006").motion_of().tip_mm, atol=1e-9
    )
    with pytest.raises(errors.NotMetres, match="inside the cannula"):
        read(
            text.replace("q3_m", "q3_mm"), rate_hz=30.0, instrument="400006", column=["q1_rad=q2_rad", "q2_rad=q1_rad"]
        )


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_joints_beyond_the_limits_of_the_arm_are_refused(instrument):
    tool = INSTRUMENTS[instrument]
    joints = (tool.lower + tool.upper) / 2
    joints[INSERTION] = tool.upper[INSERTION] + 11.0
    cells = ",".join(repr(value) for value in joints.tolist())
    with pytest.raises(errors.NotMetres, match=f"beyond the limits .* with {instrument}"):
        read(f"q1_rad,q2_rad,q3_mm,q4_rad,q5_rad,q6_rad\n{cells}\n", rate_hz=30.0, instrument=instrument)


@pytest.mark.needs("recordings")
@pytest.mark.parametrize(
    ("name", "rows", "off_mm", "instrument"),
    [
        ("classic_tool_fixed.csv", 4506, 0.0532, "400006"),
        ("raw_sensor_rosbag_09_traj3.csv", 507, 0.0532, "400006"),
        ("Si_tool_fixed.csv", 4473, 50.9, "420006-Classic"),
    ],
)
def test_real_tables_agree_with_the_kinematics_and_need_a_rate(name, rows, off_mm, instrument):
    table = (sample_folder() / "calibration" / name).read_bytes()
    with pytest.raises(errors.BadColumns, match="rate_hz"):
        read_recording(io.BytesIO(table))
    recording = read_recording(io.BytesIO(table), untimed=True)
    assert not recording.is_timed
    (joints,), motion = recording.joints, recording.motion_of()
    assert len(motion.tip_mm) == len(joints.positions) == rows
    tip_mm, rotation = forward(joints.positions)
    assert np.linalg.norm(tip_mm - motion.tip_mm, axis=1).max() < off_mm
    assert angle_between(rotation, matrix_of(motion.rotation_xyzw)).max() < 0.02
    assert recording.columns[0].quantity == ""
    (one,) = recording.identifications
    assert (one.found.verdict, one.found.instrument) == ("identified", instrument)
    assert one.found.greatest_mm < 0.072
