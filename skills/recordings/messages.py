"""The ROS 2 messages that are written here: their definitions, their hashes, and their bytes.

Bytes are CDR as ROS 2 sends it: a header of four bytes (little-endian), then every number aligned to its own size,
counted from the end of that header; a text is its length with the closing zero, then its bytes (OMG CDR; ROS 2 design,
"Serialization"). Positions are metres, angles radians, stamps nanoseconds.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from skills.recordings.topics import BOOL, FLOAT64, JOINT_STATE, JOY, POSE, STRING

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
    POSE: f"""std_msgs/Header header
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
    JOINT_STATE: f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
    JOY: f"""std_msgs/Header header
float32[] axes
int32[] buttons
{_HEADER}""",
    BOOL: "bool data\n",
    FLOAT64: "float64 data\n",
    STRING: "string data\n",
}
HASHES = {  # REP 2016; of ROS 2 Jazzy
    POSE: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    JOINT_STATE: "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    JOY: "RIHS01_0d356c79cad3401e35ffeb75a96a96e08be3ef896b8b83841d73e890989372c5",
    BOOL: "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    FLOAT64: "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    STRING: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


@dataclass(frozen=True, slots=True)
class Message:
    """One message on its way into a file: when it was logged, on which topic, of which type, and its bytes."""

    log_ns: int
    topic: str
    type: str
    data: bytes


def pose(
    topic: str,
    stamp_ns: int,
    frame: str,
    place_m: Sequence[float],
    turn_xyzw: Sequence[float],
    *,
    log_ns: int | None = None,
) -> Message:
    """Write a tip's pose; without `log_ns`, here and below, a message is logged at its own stamp."""
    body = _Body()
    body.header(stamp_ns, frame)
    body.put("7d", *place_m, *turn_xyzw)
    return Message(stamp_ns if log_ns is None else log_ns, topic, POSE, bytes(body.data))


def joint_state(
    topic: str,
    stamp_ns: int,
    positions: Sequence[float],
    names: Sequence[str] = (),
    *,
    velocities: Sequence[float] = (),
    frame: str = "",
    log_ns: int | None = None,
) -> Message:
    """Write the positions of joints, rad or m, and their velocities where they are given; nothing of their efforts."""
    body = _Body()
    body.header(stamp_ns, frame)
    body.put("I", len(names))
    for name in names:
        body.text(name)
    body.numbers("d", positions)
    body.numbers("d", velocities)
    body.numbers("d", ())
    return Message(stamp_ns if log_ns is None else log_ns, topic, JOINT_STATE, bytes(body.data))


def joy(topic: str, stamp_ns: int, buttons: Sequence[int], *, frame: str = "", log_ns: int | None = None) -> Message:
    """Write a pedal's state: `buttons[0]` is 0 released, 1 pressed, 2 a quick tap."""
    body = _Body()
    body.header(stamp_ns, frame)
    body.numbers("f", ())
    body.numbers("i", buttons)
    return Message(stamp_ns if log_ns is None else log_ns, topic, JOY, bytes(body.data))


def boolean(topic: str, log_ns: int, value: bool) -> Message:
    """Write a yes or no, which has no stamp of its own."""
    body = _Body()
    body.put("?", value)
    return Message(log_ns, topic, BOOL, bytes(body.data))


def number(topic: str, log_ns: int, value: float) -> Message:
    """Write a number, which has no stamp of its own."""
    body = _Body()
    body.put("d", value)
    return Message(log_ns, topic, FLOAT64, bytes(body.data))


def text(topic: str, log_ns: int, value: str) -> Message:
    """Write a text, which has no stamp of its own."""
    body = _Body()
    body.text(value)
    return Message(log_ns, topic, STRING, bytes(body.data))


class _Body:
    """A message's bytes, growing."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")  # plain CDR, little-endian

    def put(self, code: str, *values: float) -> None:
        """Add numbers of one size, aligned to it."""
        size = struct.calcsize(code[-1])
        self.data.extend(bytes(-(len(self.data) - 4) % size))
        self.data += struct.pack("<" + code, *values)

    def text(self, value: str) -> None:
        """Add a text."""
        data = value.encode() + b"\0"
        self.put("I", len(data))
        self.data += data

    def numbers(self, code: str, values: Sequence[float]) -> None:
        """Add a sequence: how many, then they."""
        self.put("I", len(values))
        if values:
            self.put(f"{len(values)}{code}", *values)

    def header(self, stamp_ns: int, frame: str) -> None:
        """Add a std_msgs/Header."""
        self.put("i", stamp_ns // _NANO)
        self.put("I", stamp_ns % _NANO)
        self.text(frame)
