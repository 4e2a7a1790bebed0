"""What people send in place of a plain recording is read, or named with the command that helps."""

import io
import json
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.writer import Writer

from skills import errors
from skills.formats import read_recording, write_mcap
from skills.formats.bag_writer import messages_of
from skills.formats.lerobot.cut import choose_episodes, cut_episode, find_dataset
from skills.formats.upload import find_bag, prepare_upload
from tests.formats import lerobots, others
from tests.formats.bags import recording
from tests.formats.others import zipped
from tests.formats.test_pace import read, stroke, table

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:%s\nsize 48211\n" % (b"5d" * 32)
EPISODE = "data/chunk-000/episode_000000.parquet"
COUNT = 80


def plain(**more):
    return table(*stroke(COUNT), **more)


def same(text, **how):
    """Assert that a table says what the plain one says."""
    got, want = read(text, **how).motion_of(), read(plain()).motion_of()
    np.testing.assert_array_equal(got.stamps_ns, want.stamps_ns)
    np.testing.assert_array_equal(got.tip_mm, want.tip_mm)


# ---- tables ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "written",
    {
        "sep=": lambda text: "sep=,\n" + text,
        "quoted sep=": lambda text: '"sep=,"\r\n' + text.replace("\n", "\r\n"),
        "of numpy": lambda text: "# " + text,
        "without a space": lambda text: "#" + text,
        "separators after rows": lambda text: (
            "\n".join(f"{row}," if k else row for k, row in enumerate(text.splitlines())) + "\n"
        ),
        "separators after all": lambda text: text.replace("\n", ",\n"),
        "separators of semicolons": lambda text: text.replace(",", ";").replace("\n", ";\n"),
        "an index": lambda text: (
            "\n".join(f"{k - 1 if k else ''},{row}" for k, row in enumerate(text.splitlines())) + "\n"
        ),
        "an index read again": lambda text: (
            "\n".join(f"{k - 1 if k else 'Unnamed: 0'},{row}" for k, row in enumerate(text.splitlines())) + "\n"
        ),
    }.items(),
    ids=lambda one: one[0],
)
def test_tables_of_spreadsheets_and_libraries_are_read(written):
    same(written[1](plain()))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_the_unicode_text_of_spreadsheets_is_read(encoding):
    text = plain().replace(",", "\t")
    data = text.encode(encoding)
    mark = {"utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff"}.get(encoding, b"")
    same(mark + data)
    with pytest.raises(errors.UnknownFormat):
        read(mark + data[:-1])


@pytest.mark.parametrize("zone", [UTC, timezone(timedelta(hours=-7)), None])
@pytest.mark.parametrize("between", ["T", " "])
def test_times_of_iso_8601_are_read_exactly(zone, between):
    seconds, _ = stroke(COUNT)
    begin = datetime(2026, 3, 29, 1, 59, 59, 500_000, tzinfo=zone)
    times = [(begin + timedelta(seconds=round(at, 6))).isoformat(between, "microseconds") for at in seconds.tolist()]
    rows = plain().splitlines()
    text = "\n".join([rows[0], *(f"{at},{row.partition(',')[2]}" for at, row in zip(times, rows[1:], strict=True)), ""])
    stamps_ns = read(text).motion_of().stamps_ns
    first = begin.replace(tzinfo=zone or UTC)
    assert stamps_ns[0] == int(first.timestamp()) * 10**9 + 500_000_000
    assert (np.diff(stamps_ns) == 10_000_000).all()
    with pytest.raises(errors.UnreadableRecording, match="Row 3, column t_s: not a number"):
        read(text.replace(times[1], "2026-02-30" + times[1][10:]))


@pytest.mark.parametrize("cell", ["1.76E+09", "1.7600e+9", "1.76e+09"])
def test_times_that_lost_their_digits_are_named(cell):
    rows = plain().splitlines()
    text = "\n".join([rows[0], *(f"{cell},{row.partition(',')[2]}" for row in rows[1:]), ""])
    with pytest.raises(errors.UnreadableRecording, match=r"Row 2, column t_s.*has lost its last digits"):
        read(text)


def test_other_encodings_exports_and_arrays_are_named():
    degrees = plain().replace("t_s,", "t_s,\u00b0,").replace("\n", ",1\n").encode("cp1252")
    with pytest.raises(errors.UnknownFormat, match="iconv -f WINDOWS-1252"):
        read(degrees)
    with pytest.raises(errors.UnknownFormat, match="OptiTrack"):
        read("Format Version,1.24,Take Name,take 4,Capture Frame Rate,120\n\n,,Type,Rigid Body\n")
    with io.BytesIO() as out:
        np.save(out, np.zeros((4, 4)))
        with pytest.raises(errors.UnknownFormat, match=r"numpy\.savetxt"):
            read(out.getvalue())
    with pytest.raises(errors.BadColumns, match="no header"):
        read(plain().partition("\n")[2])


# ---- pointers and files that were not closed ---------------------------------------------------------------------


def test_pointers_of_git_lfs_are_named_wherever_they_are(tmp_path):
    files = lerobots.episode()
    zips = (
        {"b/b_0.mcap": POINTER},
        files | {EPISODE: POINTER},
        files | {"meta/info.json": POINTER},
        {"b/b.db3": POINTER},
    )
    for data in (POINTER, *map(zipped, zips)):
        with pytest.raises(errors.UnreadableRecording, match="git lfs pull"):
            read(data, frame="ECM")
    with find_dataset(lerobots.write(files | {EPISODE: POINTER}, tmp_path / "ds")) as dataset:
        (episode,) = choose_episodes(dataset, None)
        with pytest.raises(errors.UnreadableRecording, match="git lfs pull"):
            cut_episode(dataset, episode, io.BytesIO())
    for name in ("b_0.mcap", "b_1.mcap"):
        (tmp_path / "b").mkdir(exist_ok=True)
        (tmp_path / "b" / name).write_bytes(POINTER)
    with pytest.raises(errors.UnreadableRecording, match="git lfs pull"), prepare_upload(find_bag(tmp_path / "b")):
        pass


def test_a_parquet_file_without_its_footer_was_not_closed():
    data = lerobots.episode()[EPISODE]
    for cut in (data[:-8], data[: len(data) // 2]):
        with pytest.raises(errors.UnreadableRecording, match="has no footer"):
            read(zipped(lerobots.episode(data=cut)), frame="ECM")
    with pytest.raises(errors.UnreadableRecording, match="truncated or corrupt"):
        read(zipped(lerobots.episode(data=b"no parquet" * 10)), frame="ECM")


def test_a_bag_of_ros_1_without_an_index_is_to_be_indexed(tmp_path):
    data = others.rosbag1(messages_of(recording(20)), tmp_path / "a.bag").read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    with pytest.raises(errors.UnreadableRecording, match="rosbag reindex"):
        read(data[:at] + bytes(8) + data[at + 8 :])


def test_messages_compressed_one_by_one_are_named(tmp_path):
    folder = others.db3(messages_of(recording(20)), tmp_path / "s")
    text = (folder / "metadata.yaml").read_text()
    members = others.folder_members(folder, "s/")
    members["s/metadata.yaml"] = text.replace("compression_mode: ''", "compression_mode: MESSAGE").encode()
    assert b"MESSAGE" in members["s/metadata.yaml"]
    with pytest.raises(errors.UnreadableRecording, match="ros2 bag convert"):
        read(zipped(members))


def test_an_mcap_file_of_a_ros_1_bag_is_named():
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="ros1")
    schema = writer.register_schema("geometry_msgs/PoseStamped", "ros1msg", b"Header header")
    channel = writer.register_channel("/PSM1/measured_cp", "ros1", schema)
    writer.add_message(channel, 1, bytes(80), 1)
    writer.finish()
    with pytest.raises(errors.UnreadableRecording, match=r"ROS 1 bag.*Send the \.bag"):
        read(out.getvalue())


@pytest.mark.parametrize("name", ["S/A_0.MCAP", "S/a_0.Mcap"])
def test_capitals_in_a_name_are_no_other_format(name, tmp_path):
    assert len(read(zipped({name: write_mcap(recording())})).motion_of().stamps_ns) == 40
    (tmp_path / "S").mkdir()
    for part in ("A_0.MCAP", "A_1.MCAP"):
        (tmp_path / "S" / part).write_bytes(write_mcap(recording()))
    with prepare_upload(find_bag(tmp_path / "S")) as file, file.open("rb") as content:
        assert len(read_recording(content).motion_of().stamps_ns) == 40  # the same messages twice


# ---- LeRobot -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["indices", "groups", "one group"])
def test_names_of_features_in_any_form_are_read_also_from_a_cut(form, tmp_path):
    names = lerobots.STATE
    shaped = {
        "indices": {name: k for k, name in enumerate(names)},
        "groups": {"z": names[:7], "a": names[7:]},
        "one group": {"motors": names},
    }[form]
    files = lerobots.episode()
    info = json.loads(files["meta/info.json"])
    info["features"]["observation.state"]["names"] = shaped
    files["meta/info.json"] = json.dumps(info).encode()
    want = read(zipped(lerobots.episode()), frame="ECM").motion_of(arm="PSM2")
    with find_dataset(lerobots.write(files, tmp_path)) as dataset, io.BytesIO() as out:
        (episode,) = choose_episodes(dataset, None)
        cut_episode(dataset, episode, out)
        for data in (zipped(files), out.getvalue()):
            np.testing.assert_array_equal(read(data, frame="ECM").motion_of(arm="PSM2").tip_mm, want.tip_mm)


@pytest.mark.parametrize("lost", [0, 1])
def test_episodes_are_found_though_the_metadata_of_one_are_lost(lost, tmp_path):
    files = lerobots.dataset("v3.0")

    name = "meta/episodes/chunk-000/file-000.parquet"
    places = pq.read_table(io.BytesIO(files[name]))
    keep = [k for k in range(3) if k != lost]
    files[name] = lerobots.parquet(places.take(keep))
    with find_dataset(lerobots.write(with_index(files), tmp_path)) as dataset:
        for episode in choose_episodes(dataset, "all"):
            with io.BytesIO() as out:
                cut_episode(dataset, episode, out)
                assert dict(read(out.getvalue(), frame="ECM").notes)["episode"] == str(episode.number)


def with_index(files):
    """Return a dataset of v3.0 whose rows have their number in the whole dataset, as LeRobot writes it."""

    first, numbered = 0, dict(files)
    for name in sorted(one for one in files if one.startswith("data/")):
        table = pq.read_table(io.BytesIO(files[name]))
        numbers = pa.array(np.arange(first, first + len(table)))
        numbered[name] = lerobots.parquet(table.set_column(table.column_names.index("index"), "index", numbers))
        first += len(table)
    return numbered
