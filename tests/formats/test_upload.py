"""A session's folder on the user's disk, prepared for upload."""

import hashlib
import io
import json
import struct
import time
import tracemalloc
import zipfile
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from skills.errors import BadInput, UnreadableRecording
from skills.formats import read_recording, write_mcap
from skills.formats.bag_writer import DEFINITIONS, Message, messages_of, write_bag, write_messages
from skills.formats.upload import copy_without_pictures, find_bag, prepare_upload, topics_of
from tests.formats.bags import START_NS, STEP_NS, assert_same, recording
from tests.formats.others import db3, rosbag1

PICTURE = "sensor_msgs/msg/Image"
CAMERA = "/camera/image_raw"
TAGS = {"stages": [{"name": "A1", "start": {"cpu_ts": START_NS}, "end": {"cpu_ts": START_NS + STEP_NS}}]}


@pytest.fixture(autouse=True)
def pictures_can_be_written(monkeypatch):
    monkeypatch.setitem(DEFINITIONS, PICTURE, "uint8[] data\n")


def with_pictures(said, size=100_000):
    """Return the messages, and a picture at each tenth of them."""
    body = b"\x00\x01\x00\x00" + struct.pack("<I", size) + bytes(range(256)) * (size // 256) + bytes(size % 256)
    pictures = [Message(message.log_ns, CAMERA, PICTURE, body) for message in said[::10]]
    return sorted([*said, *pictures], key=lambda message: message.log_ns)


def mcap(said) -> bytes:
    out = io.BytesIO()
    write_messages(said, out)
    return out.getvalue()


def sent_from(path: Path) -> tuple[str, bytes]:
    with prepare_upload(find_bag(path)) as file:
        return file.name, file.read_bytes()


@pytest.fixture
def session(tmp_path):
    """Return a session with a bag in two parts with pictures, its tags, and a video."""
    said = with_pictures(messages_of(recording()))
    bag = tmp_path / "20260101_101010_suturing" / "rosbag_1"
    bag.mkdir(parents=True)
    middle = START_NS + 20 * STEP_NS
    (bag / "x_9.mcap").write_bytes(mcap([message for message in said if message.log_ns < middle]))
    (bag / "x_10.mcap").write_bytes(mcap([message for message in said if message.log_ns >= middle]))
    (bag.parent / "stereo.mp4").write_bytes(bytes(1_000_000))
    (bag.parent / "stereo_tags.json").write_text(json.dumps(TAGS))
    return bag.parent


def test_pictures_stay_at_home_and_parts_become_one(session):
    name, data = sent_from(session)
    assert (name, len(data) < 20_000) == ("session.zip", True)
    got = read_recording(io.BytesIO(data))
    assert_same(got, recording(), tolerance_mm=1e-12)
    assert CAMERA not in [topic.name for topic in got.topics]
    assert [(label.name, label.start_ns) for label in got.labels] == [("A1", START_NS)]


def test_what_it_was_made_from_is_noted_in_it(session):
    notes = dict(read_recording(io.BytesIO(sent_from(session)[1])).notes)
    parts = [
        hashlib.sha256((session / "rosbag_1" / name).read_bytes()).hexdigest() for name in ("x_9.mcap", "x_10.mcap")
    ]
    assert [notes["original sha256 of part 1"], notes["original sha256 of part 2"]] == parts
    assert notes["left out"] == f"{CAMERA} ({PICTURE})"


def test_nothing_of_the_sessions_names_travels(session):
    _, data = sent_from(session)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.namelist() == ["bag/bag.mcap", "session_tags.json"]
    assert b"stereo" not in data and b"20260101" not in data


def test_the_same_session_gives_the_same_bytes(session):
    assert sent_from(session) == sent_from(session)


def test_a_bag_without_pictures_goes_as_it_is(tmp_path):
    file = tmp_path / "bag.mcap"
    file.write_bytes(write_mcap(recording()))
    for path in (file, tmp_path):
        assert sent_from(path) == ("bag.mcap", file.read_bytes())


def test_one_file_with_pictures_goes_without_them(tmp_path):
    file = tmp_path / "bag.mcap"
    file.write_bytes(mcap(with_pictures(messages_of(recording()))))
    name, data = sent_from(file)
    assert (name, len(data) < 20_000) == ("bag.mcap", True)
    got = read_recording(io.BytesIO(data))
    assert_same(got, recording(), tolerance_mm=1e-12)
    assert (got.integrity, dict(got.notes)["original sha256"]) == (
        "full",
        hashlib.sha256(file.read_bytes()).hexdigest(),
    )


@pytest.mark.parametrize(
    "write", [lambda said, folder: rosbag1(said, folder / "one.bag"), lambda said, folder: db3(said, folder / "one")]
)
def test_bags_that_only_rosbags_reads_lose_their_pictures_too(tmp_path, monkeypatch, write):
    path = write(messages_of(recording()), tmp_path)
    assert sent_from(path)[0] in ("one.bag", "one.db3")
    monkeypatch.setattr("skills.formats.upload.PICTURES", {"sensor_msgs/msg/Joy"})
    name, data = sent_from(path)
    got = read_recording(io.BytesIO(data))
    assert (name, len(got.motion_of().stamps_ns)) == ("bag.mcap", 40)
    assert (len(dict(got.notes)["original sha256"]), dict(got.notes)["left out"]) == (
        64,
        "/console/clutch (sensor_msgs/msg/Joy)",
    )


def test_a_file_that_the_recorder_packed_as_a_whole_is_unpacked_first(tmp_path):
    (tmp_path / "x.mcap.zstd").write_bytes(zstandard.compress(write_mcap(recording())))
    name, data = sent_from(tmp_path)
    assert name == "bag.mcap"
    assert_same(read_recording(io.BytesIO(data)), recording(), tolerance_mm=1e-12)


def test_a_folder_of_a_bag_written_here_goes_as_its_file(tmp_path):
    with zipfile.ZipFile(io.BytesIO(write_bag(messages_of(recording()), "plan"))) as archive:
        archive.extractall(tmp_path)
    name, data = sent_from(tmp_path)
    assert (name, data) == ("plan.mcap", (tmp_path / "plan" / "plan.mcap").read_bytes())
    metadata = tmp_path / "plan" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 40", "message_count: 41"))
    with pytest.raises(UnreadableRecording, match="lists 41 messages"):
        sent_from(tmp_path)


def test_what_is_no_bag_is_refused_by_name_or_goes_as_it_is(tmp_path, session):
    table = tmp_path / "table.mcap"
    table.write_text("t_s,x_m,y_m,z_m\n0,0,0,0\n")
    assert sent_from(table)[1] == table.read_bytes()  # the service detects its format
    (tmp_path / "empty").mkdir()
    (session / "more").mkdir()
    (session / "more" / "y.mcap").write_bytes(write_mcap(recording()))
    for path, message in (
        (tmp_path / "empty", "no .mcap"),
        (tmp_path / "nothing", "neither a file nor a folder"),
        (session, "2 folders with bags"),
    ):
        with pytest.raises(BadInput, match=message):
            find_bag(path)


def test_a_damaged_original_is_noticed_before_anything_is_sent(session):
    part = session / "rosbag_1" / "x_10.mcap"
    whole = part.read_bytes()
    for bad in (whole[:-100], whole[: len(whole) // 2], whole[:300] + bytes([whole[300] ^ 1]) + whole[301:]):
        part.write_bytes(bad)
        with pytest.raises(UnreadableRecording, match=r"x_10\.mcap is truncated or corrupt"):
            sent_from(session)


def test_a_chunk_that_readers_pass_over_is_noticed(session):
    part = session / "rosbag_1" / "x_9.mcap"
    data = bytearray(part.read_bytes())
    at = 8
    while data[at] != 0x06:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    data[at] = 0xF6  # the opcode of an unknown record
    part.write_bytes(data)
    with pytest.raises(UnreadableRecording, match="but has 0"):
        sent_from(session)


def test_a_file_without_a_summary_is_read_through(tmp_path):
    out = io.BytesIO()
    writer = Writer(out, use_statistics=False, compression=CompressionType.LZ4)
    writer.start(profile="ros2")
    schema = writer.register_schema(PICTURE, "ros2msg", b"uint8[] data\n")
    channel = writer.register_channel(CAMERA, "cdr", schema)
    for k in range(3):
        writer.add_message(channel, START_NS + k, b"\x00\x01\x00\x00\x00\x00\x00\x00", START_NS + k)
    writer.finish()
    path = tmp_path / "x.mcap"
    path.write_bytes(out.getvalue())
    assert [(topic.name, topic.messages) for topic in topics_of(path)] == [(CAMERA, 3)]


def test_a_large_bag_is_streamed(tmp_path):
    """200 MB of pictures are streamed in less memory than a tenth of it, and at more than 20 MB a second."""
    path = tmp_path / "large.mcap"
    said = messages_of(recording())
    picture = with_pictures(said[:1], size=2_000_000)[1]
    with path.open("wb") as file:
        write_messages([*said, *[picture] * 100], file)
    tracemalloc.start()
    began = time.process_time()
    with (tmp_path / "out.mcap").open("wb") as out:
        copy_without_pictures([path], out, {})
    took, (_, peak) = time.process_time() - began, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 << 20
    assert took < 10
    assert (tmp_path / "out.mcap").stat().st_size < 20_000
