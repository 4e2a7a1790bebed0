"""Read the table of one pose topic as the dVRK's recorders extract it from a bag.

    # Topic: /PSM1/local/measured_cp
    # Type: geometry_msgs/msg/PoseStamped
    timestamp,header.frame_id,header.stamp.nanosec,header.stamp.sec,pose.orientation.w,...

Columns are the message's fields by their dotted names, in any order: metres, a unit quaternion, the header's stamp.
`timestamp`, when the message was received, and whatever else there is are not used. A table has no checksum: integrity
"none".
"""

import csv
import io
from array import array
from typing import BinaryIO, TextIO

import numpy as np

from skills.errors import BadColumns, MixedFrames, NoUsableTopic, UnreadableRecording
from skills.recordings import topics
from skills.style._arrays import Floats, Ints
from skills.style.recording import Recording, TopicInfo, recorded_motion

FIRST = "# Topic:"

_SECOND = "# Type:"
_HEADER_LINE = 3
_FRAME, _SEC, _NANOSEC = "header.frame_id", "header.stamp.sec", "header.stamp.nanosec"
_PLACES = {
    topics.POSE: ("pose.position.", "pose.orientation."),
    topics.TRANSFORM: ("transform.translation.", "transform.rotation."),
}


def read_extract(file: BinaryIO) -> Recording:
    """Read one arm's motion from the table of its pose topic.

    Args:
        file: The file, at its beginning; UTF-8, comma-separated.

    Raises:
        NoUsableTopic: The topic is no pose of a PSM.
        BadColumns: A column is missing or doubled.
        UnreadableRecording: A row of another length, a cell that is no number, no rows.
        MixedFrames, NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: See `skills.errors`.
    """
    text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
    try:
        topic, kind = text.readline().removeprefix(FIRST).strip(), text.readline().removeprefix(_SECOND).strip()
        arm = topics.arm_of_pose(topic, kind)
        if arm is None:
            raise NoUsableTopic(f"The table is of {topic[:200]} ({kind[:200]}), which is no pose of a PSM.")
        stamps_ns, poses, frames = _samples(text, _PLACES[kind])
    except (csv.Error, UnicodeDecodeError) as error:
        raise UnreadableRecording(f"The table is no comma-separated UTF-8 text: {error}. Extract it again.") from error
    finally:
        text.detach()  # the file is the caller's
    if len(frames) > 1:
        raise MixedFrames(f"{topic} gives poses in {len(frames)} frames; record them apart.", frames=frames[:20])
    motion = recorded_motion(
        arm=arm,
        topic=topic,
        frame=frames[0],
        stamps_ns=stamps_ns,
        tip_mm=1000.0 * poses[:, :3],  # the recorders speak metres
        rotation_xyzw=poses[:, 3:],
    )
    return Recording(format="csv", integrity="none", motions=(motion,), topics=(TopicInfo(topic, kind, len(poses)),))


def _samples(text: TextIO, parts: tuple[str, str]) -> tuple[Ints, Floats, list[str]]:
    """Return stamps, shape (T,), places and turns, shape (T, 7), and the frames that are named."""
    rows = csv.reader(text, strict=True)
    columns = _columns(next(rows, []), parts)
    stamps, numbers, frames = array("q"), array("d"), dict[str, None]()
    for row in rows:
        try:
            sec, nanosec, frame, *pose = (row[column] for column in columns)
            stamps.append(int(sec) * 1_000_000_000 + int(nanosec))
            numbers.extend(map(float, pose))
        except (ValueError, IndexError, OverflowError):
            line = rows.line_num + _HEADER_LINE - 1
            raise UnreadableRecording(f"Row {line} is no pose with a stamp; extract the bag again.", row=line) from None
        frames[frame] = None
    if not stamps:
        raise UnreadableRecording("The table has a header and no rows.")
    return np.frombuffer(stamps, dtype=np.int64), np.frombuffer(numbers).reshape(-1, 7), list(frames)


def _columns(header: list[str], parts: tuple[str, str]) -> list[int]:
    """Return where the stamp, the frame, the place and the turn stand."""
    place, turn = parts
    names = [_SEC, _NANOSEC, _FRAME, *(place + axis for axis in "xyz"), *(turn + axis for axis in "xyzw")]
    wrong = [name for name in names if header.count(name) != 1]
    if wrong:
        raise BadColumns(f"The table does not have the column {wrong[0]} once; extract the bag again.", missing=wrong)
    return [header.index(name) for name in names]
