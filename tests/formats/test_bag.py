import io
import json
import time
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from skills.demonstration.recording import Label
from skills.errors import MixedFrames, NoUsableTopic, UnreadableRecording
from skills.formats import bag_writer, read_recording, write_mcap
from skills.formats.bag_folder import Metadata, read_metadata
from skills.formats.bag_writer import messages_of, write_messages
from skills.formats.parsed import parse
from skills.formats.upload import find_bag, prepare_upload
from tests.formats.bags import LOCAL, START_NS, STEP_NS, assert_same, pose_bag, recording, sample_folder, straight
from tests.formats.others import assert_all_the_same, folder_members, rosbag2, whole, zipped


def read(members):
    return read_recording(io.BytesIO(zipped(members)))


def written(said) -> bytes:
    out = io.BytesIO()
    write_messages(said, out)
    return out.getvalue()


def halves(middle: int = 20) -> tuple[bytes, bytes]:
    """Return the recording in two files, as a recorder splits it."""
    said = messages_of(recording())
    cut = START_NS + middle * STEP_NS
    return written([m for m in said if m.log_ns < cut]), written([m for m in said if m.log_ns >= cut])


def metadata(files: list[str], counts: dict[str, int]) -> bytes:
    """Return metadata as rosbag2 of ROS 2 Humble writes it, with QoS in one long text."""
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
    with pytest.raises(UnreadableRecording, match=r"'x_1\.mcap', which is missing"):
        read({"x_0.mcap": first, "metadata.yaml": known})
    with pytest.raises(UnreadableRecording, match=r"no file 'x_2\.mcap', which is in the bag"):
        read({"x_0.mcap": first, "x_1.mcap": second, "x_2.mcap": second, "metadata.yaml": known})


def test_metadata_that_count_other_messages_are_noticed():
    data = write_mcap(recording())
    with pytest.raises(UnreadableRecording, match=rf"lists 41 messages of {LOCAL}, the bag has 40"):
        read({"x.mcap": data, "metadata.yaml": metadata(["x.mcap"], COUNTS | {LOCAL: 41})})
    with pytest.raises(UnreadableRecording, match="lists 0 messages of /console/clutch"):
        read({"x.mcap": data, "metadata.yaml": metadata(["x.mcap"], {LOCAL: 40, "/PSM2/jaw/measured_js": 40})})


PLAIN = metadata(["x.mcap"], COUNTS).decode()


@pytest.mark.parametrize(
    "text",
    [
        "%YAML 1.2\n---\n" + PLAIN,
        PLAIN + "...\n%TAG !a! tag:a\n",
        PLAIN + "  custom_data: &a [0]\n  more: *a\n",
        PLAIN + "  custom_data: &a [*a]\n",
        PLAIN + "  custom_data: " + "[" * 20 + "]" * 20 + "\n",
        PLAIN + "  custom_data: [" + "0," * 100_000 + "]\n",
        PLAIN + "  custom_data: " + "x" * (1 << 20) + "\n",
        PLAIN + "---\n" + PLAIN,
        PLAIN.replace("message_count: 40\n", "message_count: -40\n"),
        PLAIN.replace("message_count: 40\n", "message_count: [40]\n"),
        PLAIN.replace("message_count: 40\n", f"message_count: {10**18}\n"),
        PLAIN.replace("topic_metadata", "metadata"),
        PLAIN.replace("- x.mcap", "- [x.mcap]"),
        PLAIN.replace("    - x.mcap\n", ""),
        "- " + PLAIN.replace("\n", "\n  "),
        "a: [\n",
        "",
    ],
    ids=[
        *("directive", "late directive", "alias", "alias of itself", "depth", "parts", "characters", "two documents"),
        *("negative", "list", "digits", "no topics", "file list", "no files", "no mapping", "cut", "empty"),
    ],
)
def test_metadata_that_are_no_bags_or_a_bomb_are_refused(text):
    with pytest.raises(UnreadableRecording, match=r"^metadata\.yaml .*Move it away"):
        read_metadata(text)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN + "  custom_data: " + "[" * 10 + "]" * 10 + "\n",
        PLAIN + "  custom_data: " + "1:" * 100_000 + "1\n",  # a number to the base 60 costs 2 s with other loaders
        PLAIN.replace("- x.mcap", "- 'x.mcap'  # the only one"),
        PLAIN.replace("    - x.mcap", "  - x.mcap"),
        PLAIN.replace("\n    - x.mcap", " [folder/x.mcap]"),
        PLAIN.replace("\n", "\r\n"),
    ],
    ids=["some depth", "a number to the base 60", "quoted", "not indented", "in brackets", "of Windows"],
)
def test_metadata_are_read_in_any_style_of_yaml(text):
    assert read_metadata(text) == Metadata(("x.mcap",), COUNTS)


def test_the_largest_metadata_are_read_or_refused_soon():
    """Lists of texts are the slowest contents; a thousand topics are still read."""
    many = {f"/PSM1/topic_{k}": k for k in range(1000)}
    for text in (metadata(["x.mcap"], many).decode(), PLAIN + "  custom_data: [" + "0," * 99_000 + "]\n"):
        began = time.process_time()
        assert read_metadata(text).files == ("x.mcap",)
        assert time.process_time() - began < 3.0
    assert read_metadata(metadata(["x.mcap"], many).decode()).counts == many
    tags = "".join(f"%TAG !a{k}! tag:a\n" for k in range(50_000))  # 4 s in libyaml
    began = time.process_time()
    with pytest.raises(UnreadableRecording):
        read_metadata(tags + "---\n" + PLAIN)
    assert time.process_time() - began < 0.5


def test_two_parts_in_two_frames_are_refused():
    later = [message | {"header": message["header"] | {"stamp": {"sec": 1_760_000_009, "nanosec": 0}}}
             for message in straight(1, frame="ECM")]  # fmt: skip
    with pytest.raises(MixedFrames):
        read({"x_0.mcap": pose_bag(straight()), "x_1.mcap": pose_bag(later)})


def test_a_part_without_an_arm_is_a_part_as_any_other():
    clutch = written([bag_writer.joy("/console/clutch", START_NS, [1])])
    assert read({"x_0.mcap": pose_bag(straight()), "x_1.mcap": clutch}).clutch.values.tolist() == [1.0]
    with pytest.raises(NoUsableTopic):
        read({"x_0.mcap": clutch, "x_1.mcap": clutch})


def split(tmp_path, first, second):
    """Return a recording in two files as read from a zip, and as the client joins the same folder."""
    members = {"b/b_0.mcap": written(first), "b/b_1.mcap": written(second)}
    for name, data in members.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    with prepare_upload(find_bag(tmp_path / "b")) as path, path.open("rb") as file:
        return read(members), read_recording(file)


@pytest.mark.parametrize("late_ms", [0, 20, 50, 80])
def test_a_zip_and_a_folder_of_a_split_bag_say_the_same(tmp_path, late_ms):
    """Messages around the split are in the other part, as a recorder with a cache writes them."""
    said, cut = messages_of(recording()), START_NS + 20 * STEP_NS
    presses = [bag_writer.joy("/footpedals/coag", cut + k * STEP_NS, [k % 2]) for k in range(-9, 10, 3)]
    rng = np.random.default_rng(late_ms)
    late_ns = {id(one): int(rng.integers(-late_ms, late_ms + 1)) * 1_000_000 for one in (*said, *presses)}
    every = sorted([*said, *presses], key=lambda one: one.log_ns)
    parts = [[one for one in every if (one.log_ns + late_ns[id(one)] < cut) == early] for early in (True, False)]
    zipped_up, joined = split(tmp_path, *parts)
    assert_same(zipped_up, recording(), tolerance_mm=1e-12)
    assert_same(joined, zipped_up)
    for got in (zipped_up, joined):
        assert dict(got.pedals)["/footpedals/coag"].stamps_ns.tolist() == [one.log_ns for one in presses]


@pytest.mark.parametrize("pressed", [0, 1])
def test_a_pedal_that_is_repeated_in_a_part_is_dropped_and_counted(tmp_path, pressed):
    said, cut = messages_of(recording()), START_NS + 20 * STEP_NS
    first = bag_writer.joy("/footpedals/coag", START_NS + 3, [1 - pressed])
    last = bag_writer.joy("/footpedals/coag", START_NS + 8 * STEP_NS, [pressed])
    again = [replace(first, log_ns=cut), replace(last, log_ns=cut + 1)]
    early, late = ([one for one in said if (one.log_ns < cut) == is_early] for is_early in (True, False))
    for got in split(tmp_path, sorted([*early, first, last], key=lambda one: one.log_ns), [*again, *late]):
        pedal = dict(got.pedals)["/footpedals/coag"]
        assert (pedal.values.tolist(), pedal.backward_stamps) == ([1 - pressed, pressed], 2)
        assert [(one.topic, one.backward_stamps) for one in parse(got).about.dropped] == [("/footpedals/coag", 2)]


def test_a_pedal_received_late_is_put_in_its_order():
    base, pedal = messages_of(recording()), "/console/camera"
    at = [START_NS + k * STEP_NS for k in (10, 4, 20)]  # the second was measured 60 ms before the first
    said = [replace(bag_writer.joy(pedal, stamp, [k % 2]), log_ns=START_NS + k) for k, stamp in enumerate(at)]
    got = dict(read({"b.mcap": written([*base, *said])}).pedals)[pedal]
    assert (got.stamps_ns.tolist(), got.values.tolist(), got.backward_stamps) == (sorted(at), [1.0, 0.0, 0.0], 0)
    far = replace(bag_writer.joy(pedal, START_NS - 10**9, [1]), log_ns=START_NS + 9)
    assert pedal in dict(read({"b.mcap": written([*base, *said, far])}).left_out)


def test_a_file_that_the_recorder_packed_as_a_whole_is_read():
    packed = zstandard.compress(write_mcap(recording()))
    got = read({"x.mcap.zstd": packed, "metadata.yaml": metadata(["x.mcap.zstd"], COUNTS)})
    assert_same(got, recording(), tolerance_mm=1e-12)
    with pytest.raises(UnreadableRecording):
        read({"x.mcap.zstd": packed[:500]})


def test_a_file_that_unpacks_to_too_much_is_refused(monkeypatch):
    monkeypatch.setattr("skills.formats.bag_folder.UNZSTD_BYTES", 1 << 20)
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
