import io
import json
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from skills.errors import MixedFrames, NoUsableTopic, UnreadableRecording
from skills.recordings import messages, read_recording, write_mcap
from skills.recordings.writer import messages_of, write_messages
from skills.style.recording import Label
from tests.recordings.bags import LOCAL, START_NS, STEP_NS, assert_same, pose_bag, recording, sample_folder, straight
from tests.recordings.others import assert_all_the_same, folder_members, rosbag2, whole, zipped


def read(members):
    return read_recording(io.BytesIO(zipped(members)))


def written(said) -> bytes:
    out = io.BytesIO()
    write_messages(said, out)
    return out.getvalue()


def halves(middle: int = 20) -> tuple[bytes, bytes]:
    """The recording in two files, as a recorder splits it."""
    said = messages_of(recording())
    cut = START_NS + middle * STEP_NS
    return written([m for m in said if m.log_ns < cut]), written([m for m in said if m.log_ns >= cut])


def metadata(files: list[str], counts: dict[str, int]) -> bytes:
    """What rosbag2 of ROS 2 Humble writes, QoS in one long text."""
    listed = "".join(f"    - {name}\n" for name in files)
    qos = '"- history: 3\\n  depth: 0\\n  reliability: 1\\n  name: x\\n"'
    topics = "".join(
        f"    - topic_metadata:\n        name: {name}\n        type: x\n        serialization_format: cdr\n"
        f"        offered_qos_profiles: {qos}\n      message_count: {count}\n"
        for name, count in counts.items()
    )
    return (
        f"rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
        f"  message_count: {sum(counts.values())}\n  topics_with_message_count:\n{topics}"
        f'  compression_format: ""\n  relative_file_paths:\n{listed}  files:\n    - path: {files[0]}\n'
    ).encode()


COUNTS = {LOCAL: 40, "/PSM2/jaw/measured_js": 40, "/console/clutch": 3}


def test_a_real_bag_folder_says_what_its_file_says():
    folder = sample_folder() / "rosbag2"
    with (folder / "rosbag2.mcap").open("rb") as file:
        alone = read_recording(file)
    for within in ("", "session_1/rosbag2/"):
        got = read(folder_members(folder, within))
        assert_same(got, alone)
        assert (got.topics, got.format, got.integrity) == (alone.topics, "rosbag2", "full")


def test_a_bag_in_two_files_is_joined_in_the_order_of_its_metadata():
    first, second = halves()
    got = read(
        {"b/x_0.mcap": first, "b/x_1.mcap": second, "b/metadata.yaml": metadata(["x_0.mcap", "x_1.mcap"], COUNTS)}
    )
    assert_same(got, recording(), tolerance_mm=1e-12)
    assert {topic.name: topic.messages for topic in got.topics} == COUNTS


def test_everything_of_a_recording_survives_being_split():
    want, middle = replace(whole(), notes=()), START_NS + 5 * STEP_NS
    said = messages_of(want)
    first, second = (
        written([message for message in said if (message.log_ns < middle) == early]) for early in (True, False)
    )
    assert_all_the_same(read({"x_0.mcap": first, "x_1.mcap": second}), want)


def test_without_metadata_the_order_is_that_of_time():
    first, second = halves()
    assert_same(read({"b.mcap": first, "a.mcap": second}), recording(), tolerance_mm=1e-12)


def test_a_part_that_is_missing_is_noticed():
    first, second = halves()
    known = metadata(["x_0.mcap", "x_1.mcap"], COUNTS)
    with pytest.raises(UnreadableRecording, match=r"'x_1\.mcap', which is not there"):
        read({"x_0.mcap": first, "metadata.yaml": known})
    with pytest.raises(UnreadableRecording, match=r"not 'x_2\.mcap', which is there"):
        read({"x_0.mcap": first, "x_1.mcap": second, "x_2.mcap": second, "metadata.yaml": known})


def test_metadata_that_count_other_messages_are_noticed():
    data = write_mcap(recording())
    with pytest.raises(UnreadableRecording, match=rf"says 41 messages of {LOCAL}, the bag has 40"):
        read({"x.mcap": data, "metadata.yaml": metadata(["x.mcap"], COUNTS | {LOCAL: 41})})
    with pytest.raises(UnreadableRecording, match="says 0 messages of /console/clutch"):
        read({"x.mcap": data, "metadata.yaml": metadata(["x.mcap"], {LOCAL: 40, "/PSM2/jaw/measured_js": 40})})


def test_two_parts_in_two_frames_are_refused():
    later = [message | {"header": message["header"] | {"stamp": {"sec": 1_760_000_009, "nanosec": 0}}}
             for message in straight(1, frame="ECM")]  # fmt: skip
    with pytest.raises(MixedFrames):
        read({"x_0.mcap": pose_bag(straight()), "x_1.mcap": pose_bag(later)})


def test_a_part_without_an_arm_is_refused_with_what_to_do():
    clutch = written([messages.joy("/console/clutch", START_NS, [1])])
    with pytest.raises(NoUsableTopic, match=r"'x_1.mcap'.*skills recording add FOLDER"):
        read({"x_0.mcap": pose_bag(straight()), "x_1.mcap": clutch})


def test_a_file_that_the_recorder_packed_as_a_whole_is_read():
    packed = zstandard.compress(write_mcap(recording()))
    got = read({"x.mcap.zstd": packed, "metadata.yaml": metadata(["x.mcap.zstd"], COUNTS)})
    assert_same(got, recording(), tolerance_mm=1e-12)
    with pytest.raises(UnreadableRecording):
        read({"x.mcap.zstd": packed[:500]})


def test_a_file_that_unpacks_to_too_much_is_refused(monkeypatch):
    monkeypatch.setattr("skills.recordings.bag.UNZSTD_BYTES", 1 << 20)
    with pytest.raises(UnreadableRecording, match="1048576"):
        read({"x.mcap.zstd": zstandard.compress(bytes(64 << 20))})


def test_another_librarys_folder_is_read(tmp_path):
    folder = rosbag2(messages_of(recording()), tmp_path / "session")
    assert_same(read(folder_members(folder)), recording(), tolerance_mm=1e-12)


def test_the_stages_of_a_session_become_labels():
    at = START_NS + 5 * STEP_NS
    tags = {"stages": [{"name": "hand-off", "start": {"cpu_ts": at}, "end": {"cpu_ts": at + STEP_NS}}], "tags": {}}
    members = {"s/rosbag/x.mcap": write_mcap(recording()), "s/session_tags.json": json.dumps(tags).encode()}
    got = read(members | {"s/index.json": b'{"videos": [], "rosbag": {"name": "x"}}', "s/camera.mp4": bytes(100)})
    assert got.labels == (Label("hand-off", "stage", at, at + STEP_NS),)
    np.testing.assert_array_equal(got.motion_of().stamps_ns, recording().motion_of().stamps_ns)
