import gzip
import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills import errors
from skills.formats import read_recording
from skills.formats.columns import OUTSIDE_MM, quaternion_of_rpy
from skills.formats.tables import ReadingOptions, read_table
from skills.kinematics import INSERTION, INSTRUMENTS, forward
from tests.by_day import examples


def read(text, **how):
    return read_recording(io.BytesIO(text.encode()), **how)


def test_a_table_in_metres_and_one_in_millimetres_say_the_same():
    metres = read("t_s,x_m,y_m,z_m\n0,0.001,0.05,-0.12\n0.01,0.002,0.05,-0.12\n").motion_of()
    millimetres = read("t_s,x_mm,y_mm,z_mm\n0,1,50,-120\n0.01,2,50,-120\n").motion_of()
    np.testing.assert_allclose(metres.tip_mm, millimetres.tip_mm, rtol=0, atol=1e-12)
    assert metres.stamps_ns.tolist() == [0, 10_000_000]


def test_seconds_since_1970_keep_their_nanoseconds():
    stamps = (
        read("t_s,x_m,y_m,z_m\n1760000000.123456789,0,0,-0.1\n1760000000.123456790,0,0,-0.1\n").motion_of().stamps_ns
    )
    assert stamps.tolist() == [1760000000123456789, 1760000000123456790]


def test_jaw_clutch_and_frame_come_along():
    text = "t_s,x_mm,y_mm,z_mm,jaw_rad,clutch\n0,0,0,0,0.9,0\n1,5,0,0,0.5,1\n2,9,0,0,0.1,0\n"
    recording = read(text, frame="camera")
    motion, jaw, clutch = recording.motion_of(), recording.jaw_of("PSM"), recording.clutch
    assert (motion.arm, motion.frame) == ("PSM", "camera")
    assert (jaw.values.tolist(), clutch.values.tolist()) == ([0.9, 0.5, 0.1], [0.0, 1.0, 0.0])
    assert jaw.stamps_ns.tolist() == clutch.stamps_ns.tolist() == [0, 10**9, 2 * 10**9]
    assert (recording.format, recording.integrity) == ("csv", "none")


def test_the_frame_is_the_remote_centres_unless_another_is_given():
    assert read("t_s,x_m,y_m,z_m\n0,0,0,-0.1\n").motion_of().frame == "PSM_base"


def test_the_papers_header_needs_a_rate():
    text = "Rot R, Rot P, Rot Y, Pos X, Pos Y, Pos Z \n0,0,0,0.01,0.02,0.03\n0,0,0,0.02,0.02,0.03\n"
    motion = read(text, rate_hz=500.0).motion_of()
    assert motion.stamps_ns.tolist() == [0, 2_000_000]
    assert motion.tip_mm[0].tolist() == [10.0, 20.0, 30.0]
    with pytest.raises(errors.BadColumns, match="rate_hz"):
        read(text)


def test_roll_pitch_yaw_turn_about_fixed_axes_x_then_y_then_z():
    roll, pitch, yaw = 0.3, -0.7, 2.1
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    by_hand = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    ((x, y, z, w),) = quaternion_of_rpy("table", np.array([[roll, pitch, yaw]]))
    matrix = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    np.testing.assert_allclose(matrix, by_hand, rtol=0, atol=1e-15)


@examples(50)
@given(
    st.lists(
        st.tuples(st.integers(1, 10**12), *[st.floats(-1000, 1000)] * 3),
        min_size=1,
        max_size=12,
    )
)
def test_any_table_is_read_to_the_last_digit(rows):
    stamps = np.cumsum([row[0] for row in rows]).tolist()
    lines = [f"{t // 10**9}.{t % 10**9:09d},{x!r},{y!r},{z!r}" for t, (_, x, y, z) in zip(stamps, rows, strict=True)]
    text = "\n".join(["t_s,x_mm,y_mm,z_mm", *lines])
    motion = read_table(io.BytesIO(text.encode()), ReadingOptions(frame="camera")).motion_of()
    assert motion.stamps_ns.tolist() == stamps
    assert motion.tip_mm.tolist() == [list(row[1:]) for row in rows]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("t_s,x_m,y_m,z_m,label\n0,0,0,0,a\n", errors.BadColumns, "'label'"),
        ("t_s,x_m,x_m,y_m,z_m\n0,0,0,0,0\n", errors.BadColumns, "'x_m' twice"),
        ("t_s,x_m,Pos X,y_m,z_m\n0,0,0,0,0\n", errors.BadColumns, "'x_m' twice"),
        ("t_s,x_m,y_m,z_m,x_mm,y_mm,z_mm\n0,0,0,0,0,0,0\n", errors.BadColumns, "twice"),
        ("t_s,x_m,y_mm,z_m\n0,0,0,0\n", errors.BadColumns, "y_m is missing"),
        ("t_s,x_m,y_m\n0,0,0\n", errors.BadColumns, "z_m is missing"),
        ("t_s,x_m,y_m,z_m,qx,qy,qz\n0,0,0,0,0,0,0\n", errors.BadColumns, "qw is missing"),
        ("t_s,x_m,y_m,z_m,qx,qy,qz,qw,roll_rad,pitch_rad,yaw_rad\n", errors.BadColumns, "twice"),
        ("x_m,y_m,z_m\n0,0,0\n", errors.BadColumns, "t_s"),
        ("t_s,jaw_rad\n0,0\n", errors.NoUsableTopic, "no position"),
        ("t_s,x_m,y_m,z_m\n", errors.UnreadableRecording, "no rows"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,0\n", errors.UnreadableRecording, "Row 3 has 3 cells"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n\n1,0,0,0\n", errors.UnreadableRecording, "Row 3 has 0 cells"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,?,0\n", errors.UnreadableRecording, "Row 3, column y_m"),
        ("t_s,x_m,y_m,z_m\n0,0,1_0,0\n", errors.UnreadableRecording, "Row 2, column y_m"),
        ("t_s,x_m,y_m,z_m\n0,0,nan,0\n", errors.NotFinite, "Row 2, column y_m"),
        ("t_s,x_m,y_m,z_m\n0,0,0,1e999\n", errors.NotFinite, "Row 2, column z_m"),
        ("t_s,x_m,y_m,z_m\n0,0,0,0\n0.5,0,0,0\n0.4,0,0,0\n", errors.BackwardStamps, r"at 0\.500 s"),
        ("t_s,x_m,y_m,z_m\n1760000000123,0,0,0\n", errors.BadColumns, "seconds"),
        ("t_s,x_m,y_m,z_m\n0,12,50,-120\n1,13,50,-120\n", errors.NotMetres, "120 m"),
        ("t_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,1,1,0,0\n", errors.NotAQuaternion, "length 1.41"),
        ('t_s,x_m,y_m,z_m\n0,0,0,"0\n', errors.UnreadableRecording, "CSV|comma-separated"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused_with_its_place(text, error, message):
    with pytest.raises(error, match=message):
        read(text)


def in_inches(tip_mm):
    rows = [f"{k / 100},{x / 25.4:.4f},{y / 25.4:.4f},{z / 25.4:.4f}" for k, (x, y, z) in enumerate(tip_mm)]
    return "\n".join(["t_s,x_mm,y_mm,z_mm", *rows])


def test_inches_in_millimetre_columns_are_refused_in_the_whole_workspace():
    for instrument in INSTRUMENTS.values():
        joints = np.random.default_rng(5).uniform(instrument.lower, instrument.upper, (200, 6))
        joints[:, INSERTION] = instrument.upper[INSERTION]
        with pytest.raises(errors.NotMetres, match=r"inside the cannula.*not in inches"):
            read(in_inches(forward(joints, instrument.name)[0]))
    with pytest.raises(errors.NotMetres, match=r"at most 4\.72 mm from the remote centre \(at 0\.010 s\)"):
        read(in_inches([(0, 0, -100), (0, 0, -120), (0, 0, -110)]))


def test_paths_outside_the_cannula_or_only_starting_inside_are_accepted():
    for instrument in INSTRUMENTS.values():
        joints = np.random.default_rng(6).uniform(instrument.lower, instrument.upper, (200, 6))
        joints[:, INSERTION] = instrument.cannula_mm
        assert (np.linalg.norm(forward(joints, instrument.name)[0], axis=1) > OUTSIDE_MM).all()
    assert len(read("t_s,x_mm,y_mm,z_mm\n0,0,0,-5\n1,0,0,-20\n").motion_of().tip_mm) == 2


def test_small_numbers_in_another_frame_may_be_millimetres():
    assert len(read(in_inches([(0, 0, -100), (0, 0, -120)]), frame="ECM").motion_of().tip_mm) == 2


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_a_rate_that_is_none_is_refused(rate_hz):
    with pytest.raises(errors.BadSettings):
        read("x_m,y_m,z_m\n0,0,0\n", rate_hz=rate_hz)


def test_a_time_said_twice_is_refused():
    with pytest.raises(errors.BadColumns, match="use one"):
        read("t_s,x_m,y_m,z_m\n0,0,0,0\n", rate_hz=100.0)


def test_a_table_without_a_header_is_told_so():
    with pytest.raises(errors.BadColumns, match="no header: its first row has numbers"):
        read_recording(io.BytesIO(b"-0.01,0.055,-0.135\n-0.01,0.05,-0.13\n"), rate_hz=30.0)


def test_an_absurd_exponent_costs_neither_time_nor_memory():
    assert read("t_s,x_m,y_m,z_m\n1e-999999999,0,0,-0.1\n").motion_of().stamps_ns.tolist() == [0]
    with pytest.raises(errors.NotFinite):
        read("t_s,x_m,y_m,z_m\n1e999999999,0,0,0\n")


def test_the_callers_file_stays_open():
    file = io.BytesIO(b"t_s,x_m,y_m,z_m\n0,0,0,-0.1\n")
    read_table(file)
    assert not file.closed


@pytest.mark.parametrize(
    "content",
    [
        gzip.compress(b"t_s,x_m,y_m,z_m\n0,0,0,0\n", mtime=0),
        b"<!DOCTYPE html><html>, </html>",
        b'{"t_s": [0], "x_m": [1]}',
        b'[{"t_s": 0}, 1]',
        b"0.1 0.2 0.3\n0.1 0.2 0.3\n",
        bytes(100),
        b"PK\x05\x06" + bytes(18),
        b"\x89PNG\r\n\x1a\n" + bytes(40),
    ],
)
def test_content_of_another_kind_is_an_unknown_format(content):
    with pytest.raises(errors.UnknownFormat):
        read_recording(io.BytesIO(content))


def test_an_empty_file_is_unreadable():
    with pytest.raises(errors.UnreadableRecording, match="empty"):
        read_recording(io.BytesIO(b""))
