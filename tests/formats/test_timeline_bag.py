"""Timelines as MCAP files: read by another library, and refused as a recording."""

import io

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from skills.errors import NoUsableTopic
from skills.formats import read_recording
from skills.formats.bag_writer import timeline_mcap
from skills.verification.timeline import timeline_of_recording
from tests.verification.timelines import two_arms


def test_a_viewers_file_has_the_poses_in_metres_and_says_that_it_is_to_look_at():
    timeline = timeline_of_recording(two_arms(3.0))
    data = timeline_mcap(timeline, "recordings/abc")
    reader = make_reader(io.BytesIO(data), decoder_factories=[DecoderFactory()])
    (notes,) = reader.iter_metadata()
    assert notes.metadata["use"] == "to look at; not for execution" and notes.metadata["source"] == "recordings/abc"
    seen: dict[str, list] = {}
    for _, channel, message, said in reader.iter_decoded_messages():
        seen.setdefault(channel.topic, []).append((message.log_time, said))
    assert set(seen) >= {
        "/shown/arm_PSM1/pose",
        "/shown/arm_PSM2/joints",
        "/shown/arm_PSM1/jaw",
        "/shown/stage",
        "/shown/Outer_bodies_apart",
    }
    assert all(topic.startswith("/shown/") for topic in seen)
    stamp_ns, pose = seen["/shown/arm_PSM2/pose"][100]  # every second row
    assert stamp_ns == 1_000_000_000 and pose.header.frame_id == "ECM"
    assert pose.pose.position.x == pytest.approx(timeline.arms[1].tip_mm[200, 0] / 1000)
    assert seen["/shown/arm_PSM1/joints"][0][1].position[2] == pytest.approx(timeline.arms[0].joints[0, 2] / 1000)
    assert [said.data for _, said in seen["/shown/stage"]] == ["grasping", "driving", "hand-off"]
    assert timeline_mcap(timeline, "recordings/abc") == data
    with pytest.raises(NoUsableTopic):
        read_recording(io.BytesIO(data))
