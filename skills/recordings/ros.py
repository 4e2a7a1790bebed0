"""Read what only rosbags reads: ROS 1 bags, .db3 bags, and MCAP files whose types are given in IDL.

rosbags decodes; every message that matters here is written again as MCAP and read as any other, so that a motion is
checked in one place and comes out the same whatever file it was in. rosbags needs paths: the bytes are copied into a
folder of their own, which is gone afterwards. ROS 1 bags and .db3 files have no checksums: their integrity is "none".
"""

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from skills.errors import NoUsableTopic
from skills.recordings import messages, topics
from skills.recordings.mcap import read_mcap
from skills.recordings.messages import Message
from skills.recordings.refusing import refusing
from skills.recordings.writer import write_messages
from skills.style.recording import Format, Integrity, Recording, TopicInfo

ROS1_MAGIC = b"#ROSBAG V"
DB3_MAGIC = b"SQLite format 3\0"

Suffix = Literal[".bag", ".db3", ".mcap"]
_FORMATS: dict[Suffix, Format] = {".bag": "rosbag1", ".db3": "rosbag2", ".mcap": "mcap"}
_NAMES = {".bag": "ROS 1 bag", ".db3": "SQLite bag (.db3)", ".mcap": "MCAP file"}
_NANO = 1_000_000_000


def read_rosbag(files: Sequence[BinaryIO], suffix: Suffix, integrity: Integrity = "none") -> Recording:
    """Read a dVRK recording through rosbags.

    Args:
        files: The bag, or its parts in order; each is read from its beginning.
        suffix: What they are.
        integrity: What is known of their checksums.

    Raises:
        UnreadableRecording: Truncated, corrupt, or not what the suffix says.
        NoUsableTopic: No topic has the pose of a PSM.
        MixedFrames, BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: See `skills.errors`.
    """
    with ExitStack() as open_files:
        with tempfile.TemporaryDirectory() as folder:
            paths = [_copied(file, Path(folder) / f"part{number}{suffix}") for number, file in enumerate(files)]
            reader = open_files.enter_context(_reading(paths))
        out = open_files.enter_context(tempfile.TemporaryFile())  # what is open stays, and nothing is left lying about
        with _refusing(paths[0]):
            here = _convert(reader, out)
        out.seek(0)
        return replace(read_mcap(out), format=_FORMATS[suffix], integrity=integrity, topics=here)


def convert(paths: Sequence[Path], out: IO[bytes], notes: dict[str, str] | None = None) -> tuple[TopicInfo, ...]:
    """Write what matters of one recording, ROS 1 or ROS 2, as one MCAP file, and say what was in the recording.

    Raises:
        UnreadableRecording: rosbags cannot read it.
    """
    with _reading(paths) as reader, _refusing(paths[0]):
        return _convert(reader, out, notes)


def topics_in(paths: Sequence[Path]) -> tuple[TopicInfo, ...]:
    """Say what is in a recording.

    Raises:
        UnreadableRecording: rosbags cannot read it.
    """
    with _reading(paths) as reader:
        return _topics(reader)


@contextmanager
def _reading(paths: Sequence[Path]) -> Iterator[AnyReader]:
    with ExitStack() as stack:
        with _refusing(paths[0]):
            reader = stack.enter_context(AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY)))
        yield reader


def _refusing(path: Path) -> AbstractContextManager[None]:
    advice = "Copy it again, or convert it with `ros2 bag convert` or `rosbags-convert`."
    return refusing(f"The {_NAMES.get(path.suffix, 'bag')}", advice)


def _convert(reader: AnyReader, out: IO[bytes], notes: dict[str, str] | None = None) -> tuple[TopicInfo, ...]:
    here = _topics(reader)
    if not any(topics.arm_of_pose(topic.name, topic.type) for topic in here):
        said = ", ".join(f"{topic.name} ({topic.type})" for topic in here[:20])
        raise NoUsableTopic(f"No topic has the pose of a PSM. It has {said or 'none at all'}.")
    write_messages(_messages(reader), out, notes)
    return here


def _topics(reader: AnyReader) -> tuple[TopicInfo, ...]:
    counts: Counter[tuple[str, str]] = Counter()
    for connection in reader.connections:
        counts[connection.topic, connection.msgtype] += connection.msgcount
    return tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items()))


def _messages(reader: AnyReader) -> Iterator[Message]:
    wanted = [one for one in reader.connections if topics.meaning(one.topic, one.msgtype) is not None]
    for connection, log_ns, data in reader.messages(connections=wanted):
        write = _WRITERS[connection.msgtype]
        yield write(connection.topic, log_ns, reader.deserialize(data, connection.msgtype))


def _pose(topic: str, log_ns: int, said: Any) -> Message:
    place, turn = said.pose.position, said.pose.orientation
    return _tip(topic, log_ns, said.header, place, turn)


def _transform(topic: str, log_ns: int, said: Any) -> Message:
    """Write a TransformStamped, in which older dVRKs give the tip, as the pose that it is."""
    return _tip(topic, log_ns, said.header, said.transform.translation, said.transform.rotation)


def _tip(topic: str, log_ns: int, header: Any, place: Any, turn: Any) -> Message:
    place_m, turn_xyzw = (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w)
    return messages.pose(topic, _stamp_ns(header), header.frame_id, place_m, turn_xyzw, log_ns=log_ns)


def _joint_state(topic: str, log_ns: int, said: Any) -> Message:
    stamp_ns, frame = _stamp_ns(said.header), said.header.frame_id
    return messages.joint_state(topic, stamp_ns, said.position.tolist(), said.name, frame=frame, log_ns=log_ns)


def _joy(topic: str, log_ns: int, said: Any) -> Message:
    return messages.joy(topic, _stamp_ns(said.header), said.buttons.tolist(), frame=said.header.frame_id, log_ns=log_ns)


_WRITERS: dict[str, Callable[[str, int, Any], Message]] = {
    topics.POSE: _pose,
    topics.TRANSFORM: _transform,
    topics.JOINT_STATE: _joint_state,
    topics.JOY: _joy,
    topics.BOOL: lambda topic, log_ns, said: messages.boolean(topic, log_ns, said.data),
    topics.FLOAT64: lambda topic, log_ns, said: messages.number(topic, log_ns, said.data),
    topics.STRING: lambda topic, log_ns, said: messages.text(topic, log_ns, said.data),
}


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * _NANO + int(header.stamp.nanosec)


def _copied(file: BinaryIO, path: Path) -> Path:
    file.seek(0)
    with path.open("wb") as out:
        shutil.copyfileobj(file, out, 1 << 20)
    return path
