"""The topics of an arm on the dVRK, and their messages as values; declared once, for every bus.

    bytes (CDR) --decode--> SaidPose, SaidJoints, SaidState, SaidPedal, bool or str

Names, types and meanings are those of CRTK (collaborative-robotics.github.io) as sawIntuitiveResearchKit 2.2 and later
have them. Lengths are metres and angles radians, as on the bus. Bytes are CDR, little-endian, as in ROS 2 and in bags.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from skills.errors import BadInput
from skills.formats.topics import BOOL, JOINT_STATE, JOY, OPERATING_STATE, POSE, STRING, TRANSFORM

ARM_PREFIXES = ("PSM", "MTM", "ECM")


@dataclass(frozen=True)
class BusTopic:
    """A topic and its message type.

    Attributes:
        name: The name in ROS, such as /PSM1/measured_cp.
        type: The type in ROS 2, such as geometry_msgs/msg/PoseStamped.
        event: Whether it is said once, at each change, and kept for those who come later (latched, transient local).
            Whoever listens without asking for that hears nothing of an arm that is homed already.
    """

    name: str
    type: str
    event: bool = False


class SaidPose(NamedTuple):
    """A pose: stamp in ns, frame, position in m, unit quaternion x y z w."""

    stamp_ns: int
    frame: str
    position_m: tuple[float, ...]
    rotation_xyzw: tuple[float, ...]


class SaidJoints(NamedTuple):
    """Joints: stamp in ns, names, positions in rad and m, velocities, efforts in Nm and N; empty where not given."""

    stamp_ns: int
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


class SaidState(NamedTuple):
    """An arm's state: DISABLED, ENABLED, PAUSED or FAULT; whether it is homed, and whether it is busy with a move."""

    stamp_ns: int
    state: str
    is_homed: bool
    is_busy: bool


class SaidPedal(NamedTuple):
    """A pedal: 1 pressed, 0 released, 2 a quick tap."""

    stamp_ns: int
    pressed: int


Value = SaidPose | SaidJoints | SaidState | SaidPedal | bool | str


def measured(arm: str) -> dict[str, BusTopic]:
    """Return what an arm says of itself, by the names of CRTK."""
    types = {
        "measured_cp": POSE,
        "local/measured_cp": POSE,
        "setpoint_cp": POSE,
        "measured_js": JOINT_STATE,
        "setpoint_js": JOINT_STATE,
        "jaw/measured_js": JOINT_STATE,
    }
    found = {name: BusTopic(f"/{arm}/{name}", kind) for name, kind in types.items()}
    return found | {"operating_state": BusTopic(f"/{arm}/operating_state", OPERATING_STATE, event=True)}


def commands(arm: str) -> dict[str, BusTopic]:
    """Return what moves an arm, by the names of CRTK."""
    kinds = {"servo_cp": POSE, "move_cp": POSE, "servo_jp": JOINT_STATE, "move_jp": JOINT_STATE}
    kinds |= {"jaw/servo_jp": JOINT_STATE, "jaw/move_jp": JOINT_STATE}
    return {name: BusTopic(f"/{arm}/{name}", kind) for name, kind in kinds.items()}


TELEOPERATION = BusTopic("/console/teleop/enabled", BOOL, event=True)


class _Bytes:
    """A CDR message that is read from its beginning; each number is aligned to its own size (OMG CDR)."""

    def __init__(self, data: bytes) -> None:
        if data[:2] != b"\0\1":
            raise BadInput("A message on the bus is not little-endian CDR.")
        self.data, self.at = memoryview(data)[4:], 0

    def numbers(self, code: str, count: int = 1) -> tuple[float, ...]:
        size = struct.calcsize(code)
        self.at += -self.at % size if count else 0
        found = struct.unpack_from(f"<{count}{code}", self.data, self.at)
        self.at += size * count
        return found

    def sequence(self, code: str) -> tuple[float, ...]:
        return self.numbers(code, self.length())

    def length(self) -> int:
        return int(self.numbers("I")[0])

    def text(self) -> str:
        size = self.length()
        (found,) = struct.unpack_from(f"{size}s", self.data, self.at)
        self.at += size
        return bytes(found).rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        (seconds,), (ns,) = self.numbers("i"), self.numbers("I")
        return int(seconds) * 1_000_000_000 + int(ns), self.text()


def _pose(one: _Bytes) -> SaidPose:
    return SaidPose(*one.header(), one.numbers("d", 3), one.numbers("d", 4))


def _joints(one: _Bytes) -> SaidJoints:
    stamp_ns, _ = one.header()
    names = tuple(one.text() for _ in range(one.length()))
    return SaidJoints(stamp_ns, names, one.sequence("d"), one.sequence("d"), one.sequence("d"))


def _state(one: _Bytes) -> SaidState:
    stamp_ns, _ = one.header()
    return SaidState(stamp_ns, one.text(), bool(one.numbers("?")[0]), bool(one.numbers("?")[0]))


def _pedal(one: _Bytes) -> SaidPedal:
    stamp_ns, _ = one.header()
    one.sequence("f")
    pressed = one.sequence("i")
    return SaidPedal(stamp_ns, int(pressed[0]) if pressed else 0)


DECODERS: dict[str, Callable[[_Bytes], Value]] = {
    POSE: _pose,
    JOINT_STATE: _joints,
    OPERATING_STATE: _state,
    JOY: _pedal,
    BOOL: lambda one: bool(one.numbers("?")[0]),
    STRING: _Bytes.text,
}
KNOWN = (*DECODERS, TRANSFORM)  # of a dVRK before 2.2, whose poses are refused by name


def decode(kind: str, data: bytes) -> Value:
    """Return a message as a value.

    Args:
        kind: Its type in ROS 2.
        data: Its CDR bytes.

    Raises:
        BadInput: The type is none of `DECODERS`, or the bytes are none of it.
    """
    if kind not in DECODERS:
        raise BadInput(f"A message of the type {kind} cannot be read here.")
    try:
        return DECODERS[kind](_Bytes(data))
    except struct.error:
        raise BadInput(f"A message on the bus is shorter than its type {kind}.") from None
