"""Timelines as MCAP files, for viewers such as Foxglove; a robot has no topic of them.

    Timeline --timeline_mcap--> MCAP file

Topics are `/shown/arm_ARM/pose`, `joints`, `jaw` and `speed` of each arm, `/shown/clutch`, `/shown/stage`, and one for
each trace. Positions are in metres, as in every bag; speeds in mm/s, distances in mm. The first row is at time 0. No
controller listens to them, and `read_recording` uses none of them: such a motion was not checked, or not as it
is written here. The metadata of the file say so.
"""

import io
import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Ints
from skills.formats.writer import Message, boolean, joint_state, number, pose, text, write_messages
from skills.kinematics import INSERTION
from skills.verification.timeline import ArmTrack, Timeline

PREFIX = "/shown"
USE = "to look at; not for execution"
MOST_HZ = 100.0  # ours: a viewer draws no more, and each message takes 10 us to write


def timeline_mcap(timeline: Timeline, source: str) -> bytes:
    """Return the MCAP file of a timeline; the same timeline gives the same bytes.

    Args:
        timeline: The timeline.
        source: Path of the resource from which it was made, for the metadata.
    """
    file = io.BytesIO()
    said = sorted(_messages(timeline), key=lambda message: message.log_ns)  # stable: topics keep their order
    write_messages(said, file, {"use": USE, "kind": timeline.kind, "source": source})
    return file.getvalue()


def _messages(timeline: Timeline) -> Iterator[Message]:
    rows = np.arange(0, timeline.rows, max(1, int(timeline.rate_hz / MOST_HZ)))
    stamps_ns = np.round(rows / timeline.rate_hz * 1e9).astype(np.int64).tolist()
    for arm in timeline.arms:
        yield from _of_arm(arm, rows, stamps_ns)
    for trace in timeline.traces:
        yield from _numbers(_topic(trace.name), stamps_ns, trace.values[rows])
    for begin_s, end_s in timeline.clutch_s:
        for second, down in ((begin_s, True), (end_s, False)):
            yield boolean(f"{PREFIX}/clutch", _ns(timeline, second), down)
    for stage in timeline.stages:
        yield text(f"{PREFIX}/stage", _ns(timeline, stage.start_s), stage.name)


def _of_arm(arm: ArmTrack, rows: Ints, stamps_ns: list[int]) -> Iterator[Message]:
    topic = _topic(f"arm {arm.arm}")
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1)) if arm.rotation_xyzw is None else arm.rotation_xyzw[rows]
    poses = np.hstack([arm.tip_mm[rows] / 1000.0, turns])
    for stamp_ns, row in zip(stamps_ns, poses.tolist(), strict=True):
        if row[0] == row[0]:  # not NaN: the arm was recorded
            yield pose(f"{topic}/pose", stamp_ns, arm.frame, row[:3], row[3:])
    if arm.joints is not None:
        metric = arm.joints[rows].astype(float)
        metric[:, INSERTION] /= 1000.0
        for stamp_ns, row in zip(stamps_ns, metric.tolist(), strict=True):
            if row[0] == row[0]:
                yield joint_state(f"{topic}/joints", stamp_ns, row)
    for name, column in (("jaw", arm.jaw_rad), ("speed", arm.speed_mm_s)):
        if column is not None:
            yield from _numbers(f"{topic}/{name}", stamps_ns, column[rows])


def _numbers(topic: str, stamps_ns: list[int], values: NDArray[np.float32]) -> Iterator[Message]:
    for stamp_ns, value in zip(stamps_ns, values.tolist(), strict=True):
        if value == value:
            yield number(topic, stamp_ns, value)


def _ns(timeline: Timeline, second: float) -> int:
    return max(0, round((second - timeline.start_s) * 1e9))


def _topic(name: str) -> str:
    return f"{PREFIX}/{re.sub(r'[^A-Za-z0-9]+', '_', name).strip('_')}"
