"""Write a recording as the MCAP file that a dVRK's recorder would have written.

Profile ros2, CDR messages with ros2msg schemas, zstd chunks with checksums. Positions go out in metres, stamps in whole
nanoseconds; the log time of a message is its stamp. The same recording gives the same bytes with the same versions of
the mcap libraries.
"""

import io
from collections.abc import Iterator
from typing import Any

from mcap.records import Schema
from mcap_ros2.writer import Writer

from skills.errors import BadRecording
from skills.recordings import topics
from skills.style.recording import Motion, Recording, Signal

_NANO = 1_000_000_000
_RULE = "=" * 80
_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
DEFINITIONS = {
    topics.POSE: f"""std_msgs/Header header
geometry_msgs/Pose pose
{_RULE}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_RULE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_HEADER}""",
    topics.JOINT_STATE: f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
    topics.JOY: f"""std_msgs/Header header
float32[] axes
int32[] buttons
{_HEADER}""",
}

Event = tuple[int, str, str, dict[str, Any]]  # stamp in ns, topic, type, message


def write_mcap(recording: Recording) -> bytes:
    """Return the recording as the bytes of an MCAP file.

    Args:
        recording: Every motion needs an orientation, as a PoseStamped has one; stamps count from 1970.

    Raises:
        BadRecording: A motion without orientation, or a stamp before 1970.
    """
    if recording.origin_ns < 0:
        raise BadRecording("A message needs a stamp after 1970; give the recording one before writing.")
    file = io.BytesIO()
    writer = Writer(file)
    schemas: dict[str, Schema] = {}
    sent: dict[str, int] = {}
    for stamp_ns, topic, message_type, message in sorted(_events(recording), key=lambda event: event[:2]):
        if message_type not in schemas:
            schemas[message_type] = writer.register_msgdef(message_type, DEFINITIONS[message_type])
        sent[topic] = sent.get(topic, -1) + 1
        writer.write_message(topic, schemas[message_type], message, log_time=stamp_ns, sequence=sent[topic])
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def _events(recording: Recording) -> Iterator[Event]:
    for motion in recording.motions:
        yield from _poses(motion)
    for arm, jaw in recording.jaws:
        topic = f"/{arm}/jaw/measured_js"
        for stamp_ns, value in _samples(jaw):
            message = {"name": ["jaw"], "position": [value], "velocity": [], "effort": []}
            yield stamp_ns, topic, topics.JOINT_STATE, _stamped(stamp_ns, "", message)
    if recording.clutch is not None:
        for stamp_ns, value in _samples(recording.clutch):
            message = {"axes": [], "buttons": [int(value)]}
            yield stamp_ns, topics.CLUTCH_TOPICS[0], topics.JOY, _stamped(stamp_ns, "", message)


def _poses(motion: Motion) -> Iterator[Event]:
    if motion.rotation_xyzw is None:
        raise BadRecording(f"{motion.topic} has no orientation, and a pose message needs one; add it before writing.")
    topic = motion.topic if motion.topic.startswith("/") else f"/{motion.arm}/local/measured_cp"
    places = (motion.tip_mm / 1000.0).tolist()  # the recording speaks metres
    for stamp_ns, (x, y, z), turn in zip(motion.stamps_ns.tolist(), places, motion.rotation_xyzw.tolist(), strict=True):
        orientation = dict(zip("xyzw", turn, strict=True))
        message = {"pose": {"position": {"x": x, "y": y, "z": z}, "orientation": orientation}}
        yield stamp_ns, topic, topics.POSE, _stamped(stamp_ns, motion.frame, message)


def _samples(signal: Signal) -> Iterator[tuple[int, float]]:
    return zip(signal.stamps_ns.tolist(), signal.values.tolist(), strict=True)


def _stamped(stamp_ns: int, frame: str, message: dict[str, Any]) -> dict[str, Any]:
    stamp = {"sec": stamp_ns // _NANO, "nanosec": stamp_ns % _NANO}
    return {"header": {"stamp": stamp, "frame_id": frame}, **message}
