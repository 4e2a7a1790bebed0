import io

import numpy as np
import pytest

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Label
from skills.errors import (
    BadSettings,
    MixedFrames,
    NotAQuaternion,
    NotFinite,
    NotMetres,
    UnknownFormat,
    UnreadableRecording,
)
from skills.formats import read_recording
from skills.formats.jigsaws import HEADER, RATE_HZ, RatedTrial, meta_line, read_meta, trials
from tests.formats.others import zipped
from tests.formats.trials import GESTURES, META, folder, kinematics, text, turning


def read(data, **how):
    return read_recording(io.BytesIO(data), **how)


def matrices(turns):
    x, y, z, w = turns.T
    return np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
        ],
        axis=1,
    )  # fmt: skip


def test_each_arm_is_read_from_its_own_columns():
    table = np.array([[float(cell) for cell in row.split()] for row in text(kinematics()).splitlines()])
    got = read(text(kinematics()))
    assert (got.format, got.integrity, got.arms) == ("jigsaws", "none", ("PSM_left", "PSM_right"))
    for motion, jaw, first in ((got.motions[0], got.jaws[0][1], 57), (got.motions[1], got.jaws[1][1], 38)):
        np.testing.assert_array_equal(motion.tip_mm, 1000.0 * table[:, first : first + 3])
        np.testing.assert_allclose(matrices(motion.rotation_xyzw), table[:, first + 3 : first + 12], rtol=0, atol=2e-6)
        np.testing.assert_array_equal(jaw.values, table[:, first + 18])
    assert [motion.topic for motion in got.motions] == ["columns 58-76", "columns 39-57"]
    assert [motion.arm for motion in got.masters] == ["MTML", "MTMR"]
    np.testing.assert_array_equal(got.masters[1].tip_mm, 1000.0 * table[:, 19:22])
    np.testing.assert_array_equal(dict(got.grippers)["MTML"].values, table[:, 18])


def driven(crossed: bool = True) -> np.ndarray:
    """Return a trial in which each master moves in its own rhythm, and the instruments as the masters do."""
    table, rng = kinematics(), np.random.default_rng(3)
    steps = [np.cumsum(rng.uniform(0, 1e-3, 300)) for _ in range(2)]
    for first, side in ((0, 0), (19, 1), (38, int(crossed)), (57, int(not crossed))):
        table[:, first : first + 3] = (0.01, 0.05, -0.10)
        table[:, first] += steps[side] * (1.0 if first < 38 else 0.5)
    return table


def test_the_left_master_drives_the_left_instrument():
    got = read(text(driven()))
    steps = {motion.arm: np.diff(motion.tip_mm[:, 0]) for motion in (*got.motions, *got.masters)}
    assert np.corrcoef(steps["MTML"], steps["PSM_left"])[0, 1] > 0.99
    assert np.corrcoef(steps["MTMR"], steps["PSM_right"])[0, 1] > 0.99


def test_a_trial_with_exchanged_instruments_is_refused():
    message = r"MTML moves as columns 39-57 do \(correlation of speeds 1\.00\), not as columns 58-76"
    with pytest.raises(UnreadableRecording, match=message):
        read(text(driven(crossed=False)))


def with_names(data: bytes) -> bytes:
    """Return kinematics as the comma-separated copy has them."""
    return "\n".join([HEADER, *(",".join(row.split()) for row in data.decode().splitlines()), ""]).encode()


def test_the_comma_separated_copy_is_the_same_recording():
    data = text(driven())
    mine, theirs = read(data), read(with_names(data))
    assert theirs.format == "jigsaws"
    for one, other in zip((*mine.motions, *mine.masters), (*theirs.motions, *theirs.masters), strict=True):
        np.testing.assert_array_equal(one.tip_mm, other.tip_mm)
        np.testing.assert_array_equal(one.rotation_xyzw, other.rotation_xyzw)
    lines = with_names(data).split(b"\n")
    lines[2] = lines[2].replace(b",", b",x", 1)
    with pytest.raises(UnreadableRecording, match=r"Row 3, column 2: not a number\."):
        read(b"\n".join(lines))


def test_rows_are_a_thirtieth_of_a_second_apart_and_never_drift():
    stamps = read(text(kinematics())).motion_of(arm="PSM_left").stamps_ns
    assert stamps[0] == 0
    assert stamps[30] == 1_000_000_000
    assert np.abs(stamps - np.arange(300) * 1e9 / RATE_HZ).max() <= 0.5


def test_the_frame_is_no_arms_base():
    demo = cut_demo(read(text(kinematics())), arm="PSM_right")
    assert demo.frame == "jigsaws"
    assert not demo.frame.endswith("_base")


@pytest.mark.parametrize("seed", range(5))
def test_any_rotation_becomes_the_quaternion_that_turns_alike(seed):
    turns = np.random.default_rng(seed).normal(size=(200, 4))
    turns[:4] = np.eye(4)  # half turns about each axis, and the identity
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    table = kinematics(200)
    table[:, 41:50] = matrices(turns)
    data = "\n".join(" ".join(repr(float(value)) for value in row) for row in table).encode()
    got = read(data).motion_of(arm="PSM_right").rotation_xyzw
    np.testing.assert_allclose(matrices(got), matrices(turns), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1.0, rtol=0, atol=1e-14)
    assert ((got[1:] * got[:-1]).sum(axis=1) >= -1e-12).all()  # never the far one of q and -q


def test_gestures_become_labels_of_the_frames_they_name():
    data = zipped({"Suturing_B001.txt": text(kinematics()), "transcriptions/Suturing_B001.txt": GESTURES.encode()})
    labels = read(data).labels
    assert [label.name for label in labels] == ["G1", "G6", "G4", "G11"]
    stamps = read(data).motion_of(arm="PSM_left").stamps_ns
    assert labels[1] == Label("G6", "gesture", int(stamps[60]), int(stamps[149]))


PRIMITIVES = (
    "Start Stop Motion Primitive\n0 59 Grasp(L, Needle)\n60 89 Release(R, Needle) Push(Needle, Fabric/Tissue)\n"
)


def test_motion_primitives_become_labels_beside_gestures():
    members = {"Suturing_B001.txt": text(kinematics()), "motion_primitives/Suturing_B001.txt": PRIMITIVES.encode()}
    stamps = read(text(kinematics())).motion_of(arm="PSM_left").stamps_ns
    labels = read(zipped(members)).labels
    assert [(one.name, one.kind) for one in labels] == [
        ("Grasp(L, Needle)", "primitive"),
        ("Push(Needle, Fabric/Tissue)", "primitive"),
        ("Release(R, Needle)", "primitive"),
    ]
    assert (labels[2].start_ns, labels[2].end_ns) == (stamps[60], stamps[89])
    both = read(zipped(members | {"transcriptions/Suturing_B001.txt": GESTURES.encode()})).labels
    assert set(labels) < set(both) and {one.name for one in both} >= {"G1", "G6"}


@pytest.mark.parametrize("line", ["60 300 Grasp(L, Needle)", "60 50 Grasp(L, Needle)", "60 89 Grasp(L)", "60 89"])
def test_a_line_that_is_no_primitive_of_the_trial_is_refused(line):
    members = {"a.txt": text(kinematics()), "b.txt": (PRIMITIVES + "\n" + line).encode()}
    with pytest.raises(UnreadableRecording, match=r"Line 5 of the primitives .* frames from 0 to 299\."):
        read(zipped(members))


def test_motion_primitives_are_found_under_the_names_of_compass(tmp_path):
    root = folder(tmp_path / "data")
    for inside, name in (
        ("data/Suturing/motion_primitives_combined", "Suturing_S02_T01"),
        ("data/Suturing/motion_primitives_L", "Suturing_S03_T02"),
        ("elsewhere/deep", "Suturing_C002"),
        ("elsewhere/deep", "Suturing_S27_T01"),
    ):
        (tmp_path / inside).mkdir(parents=True, exist_ok=True)
        (tmp_path / inside / f"{name}.txt").write_text(PRIMITIVES)
    (tmp_path / "elsewhere" / "Suturing_B001.txt").write_text("a note")
    found = [one.primitives and one.primitives.stem for one in trials(root)]
    assert found == ["Suturing_S02_T01", None]
    assert [one.primitives and one.primitives.stem for one in trials(root, tmp_path / "elsewhere")] == [
        None,
        "Suturing_C002",
    ]


def test_a_zip_of_the_comma_separated_copy_is_read():
    data = with_names(text(driven()))
    members = {"processed/suturing/Suturing_B001.csv": data, "meta_file_Suturing.txt": META.encode()}
    got = read(zipped(members))
    np.testing.assert_array_equal(got.motions[0].tip_mm, read(data).motions[0].tip_mm)
    assert dict(got.notes)["skill"] == "novice"
    assert len(read(zipped({"Suturing_B001.CSV": data})).motions) == 2
    with pytest.raises(UnknownFormat, match="no JIGSAWS kinematics"):
        read(zipped({"table.csv": b"t_s,x_mm,y_mm,z_mm\n0,1,50,-120\n"}))


def test_the_meta_file_says_how_the_trial_was_rated():
    members = {"Suturing_B001.txt": text(kinematics()), "meta_file_Suturing.txt": META.encode()}
    notes = dict(read(zipped(members)).notes)
    assert (notes["skill"], notes["global rating score"], notes["time and motion"]) == ("novice", "13", "1")
    rated = read_meta(META)
    assert rated["Suturing_C002"] == RatedTrial("Suturing_C002", "expert", 27, (5, 4, 5, 4, 5, 4))
    assert all(sum(one.parts) == one.score for one in rated.values())
    line = meta_line(rated["Suturing_B001"])
    assert read_meta(line) == {"Suturing_B001": rated["Suturing_B001"]}
    score = str(rated["Suturing_B001"].score)
    assert read_meta(line.replace(score, f"{score}00000", 1)) == {}, "a number is never cut"


def test_the_trials_of_a_folder_are_found_with_what_belongs_to_them(tmp_path):
    root = folder(tmp_path)
    (root / "Suturing" / "transcriptions" / "Suturing_C002.txt").unlink()
    (root / "Suturing" / "kinematics" / "AllGestures" / "notes.txt").write_text("hello")
    for start in (root, root / "Suturing"):
        one, other = trials(start)
        assert (one.name, one.user, one.rated.skill) == ("Suturing_B001", "B", "novice")
        assert one.transcription is not None
        assert (other.name, other.transcription, other.rated.score) == ("Suturing_C002", None, 27)


def changed(row, column, value):
    lines = text(kinematics(40)).decode().splitlines()
    cells = lines[row - 1].split()
    cells[column - 1 : column] = [value] if value is not None else []
    lines[row - 1] = " ".join(cells)
    return "\n".join(lines).encode()


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (changed(7, 40, "hello"), UnreadableRecording, "Row 7, column 40"),
        (changed(7, 40, None), UnreadableRecording, "Row 7 has 75 cells"),
        (changed(7, 40, "0 0"), UnreadableRecording, "Row 7 has 77 cells"),
        (changed(7, 40, "nan"), NotFinite, "Row 7, column 40"),
        (changed(7, 52, "inf"), NotFinite, "Row 7, column 52"),
        (changed(7, 40, "55.0"), NotMetres, "55 m"),
        (changed(7, 42, "2.0"), NotAQuaternion, "Row 7: the matrix of PSM_right"),
        (text(np.hstack([kinematics(5)[:, 10:], kinematics(5)[:, :10]])), NotAQuaternion, "order of JIGSAWS"),
    ],
)
def test_kinematics_that_cannot_be_meant_are_refused_with_their_place(data, error, message):
    with pytest.raises(error, match=message):
        read(data)


def test_a_reflection_is_no_rotation():
    table = kinematics(5)
    table[:, 60:69] = -turning(np.zeros(5)).reshape(5, 9)
    with pytest.raises(NotAQuaternion):
        read(text(table))


@pytest.mark.parametrize("line", ["61 9999 G6", "0 5 G6", "9 5 G6", "five 6 G6", "61 150", "61 150 G6 G7"])
def test_a_gesture_that_is_none_is_refused(line):
    members = {"t.txt": text(kinematics(40)), "g.txt": f"1 4 G1\n{line}\n".encode()}
    with pytest.raises(UnreadableRecording, match="Line 2"):
        read(zipped(members))


def test_two_trials_in_one_archive_are_refused_with_what_to_do():
    with pytest.raises(UnreadableRecording, match="one trial"):
        read(zipped({"a.txt": text(kinematics(40)), "b.txt": text(kinematics(40))}))
    with pytest.raises(UnreadableRecording, match="one trial with its transcription at a time"):
        read(zipped({f"{k}.txt": b"x" for k in range(20)}))


def test_neither_a_rate_nor_another_frame_is_taken():
    with pytest.raises(BadSettings, match="JIGSAWS"):
        read(text(kinematics(5)), rate_hz=30.0)
    with pytest.raises(MixedFrames, match="jigsaws"):
        read(text(kinematics(5)), frame="PSM1_base")
