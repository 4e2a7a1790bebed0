"""Reader of the extract of one pose topic, as dVRK recorders write it from a bag.

    # Topic: /PSM1/local/measured_cp
    # Type: geometry_msgs/msg/PoseStamped
    timestamp,header.frame_id,header.stamp.nanosec,header.stamp.sec,pose.orientation.w,...

Its columns are the message's fields by their dotted names, in any order: metres, a unit quaternion, the header's stamp.
`timestamp`, the time of reception, and all other columns are not used.

A table has no checksum, so its integrity is "none".
"""

from array import array
from typing import BinaryIO, TextIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.recording import NS_PER_S, Recording, Topic, recorded_motion
from skills.errors import BadColumns, MixedFrames, NoUsableTopic, UnreadableRecording
from skills.formats import topics
from skills.formats.cells import LINE_CHARACTERS, check_whole, csv_rows, open_text

_FIRST = "# Topic:"
_SECOND = "# Type:"
_HEADER_LINE = 3
_FRAME, _SEC, _NANOSEC = "header.frame_id", "header.stamp.sec", "header.stamp.nanosec"
_PLACES = {
    topics.POSE: ("pose.position.", "pose.orientation."),
    topics.TRANSFORM: ("transform.translation.", "transform.rotation."),
}


def is_extract(first_line: str) -> bool:
    """Return whether a text with this first line is an extract."""
    return first_line.startswith(_FIRST)


def read_extract(file: BinaryIO) -> Recording:
    """Read one arm's motion from the extract of its pose topic.

    Args:
        file: The file, at its beginning; UTF-8, comma-separated.

    Returns:
        The recording, in millimetres.

    Raises:
        NoUsableTopic: The topic is not a pose of a PSM.
        BadColumns: A column is missing or duplicate.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows.
        MixedFrames, NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: See `skills.errors`.
    """
    check_whole(file)
    with open_text(file, "Extract") as text:
        first, second = text.readline(LINE_CHARACTERS), text.readline(LINE_CHARACTERS)
        topic, kind = first.removeprefix(_FIRST).strip(), second.removeprefix(_SECOND).strip()
        arm = topics.arm_of_pose(topic, kind)
        if arm is None:
            raise NoUsableTopic(f"The table is of {topic[:200]} ({kind[:200]}), which is not the pose of a PSM.")
        stamps_ns, poses, frames = _samples(text, _PLACES[kind])
    if len(frames) > 1:
        raise MixedFrames(
            f"{topic} has poses in {len(frames)} frames; record each frame on a separate topic.", frames=frames[:20]
        )
    motion = recorded_motion(
        arm=arm,
        topic=topic,
        frame=frames[0],
        stamps_ns=stamps_ns,
        tip_mm=1000.0 * poses[:, :3],  # the recorders write metres
        rotation_xyzw=poses[:, 3:],
    )
    return Recording(format="csv", integrity="none", motions=(motion,), topics=(Topic(topic, kind, len(poses)),))


def _samples(text: TextIO, parts: tuple[str, str]) -> tuple[Ints, Floats, list[str]]:
    """Return stamps, shape (T,), positions and quaternions, shape (T, 7), and the distinct frames."""
    rows = csv_rows(text, first_line=_HEADER_LINE)
    columns = _columns(next(rows, []), parts)
    stamps, numbers, frames = array("q"), array("d"), dict[str, None]()
    for row in rows:
        try:
            sec, nanosec, frame, *pose = (row[column] for column in columns)
            stamps.append(int(sec) * NS_PER_S + int(nanosec))
            numbers.extend(map(float, pose))
            if "_" in "".join((sec, nanosec, *pose)) or not 0 <= int(nanosec) < NS_PER_S:
                raise ValueError(nanosec)  # Python parses 1_000, which no exporter writes
        except (ValueError, IndexError, OverflowError):
            line = rows.line_num + _HEADER_LINE - 1
            raise UnreadableRecording(
                f"Row {line} is not a pose with a stamp; extract the bag again.", row=line
            ) from None
        frames[frame] = None
    if not stamps:
        raise UnreadableRecording("The table has a header and no rows.")
    return np.frombuffer(stamps, dtype=np.int64), np.frombuffer(numbers).reshape(-1, 7), list(frames)


def _columns(header: list[str], parts: tuple[str, str]) -> list[int]:
    """Return the column indices of the stamp, the frame, the position and the quaternion."""
    place, turn = parts
    names = [_SEC, _NANOSEC, _FRAME, *(place + axis for axis in "xyz"), *(turn + axis for axis in "xyzw")]
    wrong = [name for name in names if header.count(name) != 1]
    if wrong:
        raise BadColumns(
            f"The table must have the column {wrong[0]} exactly once; extract the bag again.", missing=wrong
        )
    return [header.index(name) for name in names]
