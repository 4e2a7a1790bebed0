"""Topic names and message types of a dVRK recording, and the quantities that they carry.

dVRK 2.2 and later publish the tip as PoseStamped, earlier versions as TransformStamped; both in metres, with the time
of measurement in the header. The topics follow the CRTK conventions (dVRK documentation, "Arms" and "Console"); they
may be below any namespace, as in `/CRTK/psm2/measured_cp`. dVRK 1.x has other names: `position_cartesian_current`,
`position_cartesian_local_current`, `state_joint_current`, `state_jaw_current` and `state_gripper_current`.

Only measured motions are learnt from. Setpoints of a PSM's tip and jaw are read beside them, because a dataset may have
them as its actions; they are never motions. Setpoints of joints (`setpoint_js`) are no part of a recording: known
recorders take `setpoint_cp` beside them, and as poses they would need the instrument; `skills calibrate-arm --servo`
alone reads them. Other commands (`servo_cp`, `move_cp` and the
like) are not used, nor are poses of other things (`T_b_w`, the base of an arm in a simulator's world).
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum, auto

from skills.demonstration.recording import Topic

POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POINT = "geometry_msgs/msg/PointStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
JOY = "sensor_msgs/msg/Joy"
BOOL = "std_msgs/msg/Bool"
FLOAT64 = "std_msgs/msg/Float64"
STRING = "std_msgs/msg/String"
OPERATING_STATE = "crtk_msgs/msg/OperatingState"

CLUTCH_TOPICS = ("/console/clutch", "/footpedals/clutch")  # the first one present is used
RELEASED, PRESSED, QUICK_TAP = 0, 1, 2  # buttons[0] of a pedal

_PSM = re.compile(r"PSM\d*", re.IGNORECASE)
_MTM = re.compile(r"MTM[LR]?\d*", re.IGNORECASE)
_PAIR = re.compile(r"MTM[LR]?\d*_PSM\d*", re.IGNORECASE)
_COMMANDS = re.compile(r"setpoint|desired|goal|servo|move|T_b_w")
_SETPOINTS = ("setpoint_cp", "position_cartesian_desired", "position_cartesian_local_desired")  # dVRK 2, and before
_OLDER_NAMES = {  # of joint states in dVRK 1.x
    "state_joint_current": "/measured_js",
    "state_jaw_current": "/jaw/measured_js",
    "state_jaw_desired": "/jaw/setpoint_js",
    "state_gripper_current": "/gripper/measured_js",
    "state_joint_desired": "/setpoint_js",
}
_OLDER = re.compile(rf"/({'|'.join(_OLDER_NAMES)})$")
_POSES = frozenset(f"geometry_msgs/msg/{name}" for name in ("Pose", "Transform", "PoseWithCovarianceStamped"))
_CONSOLE = ("clutch", "camera", "operator_present")


class TopicKind(Enum):
    """The quantity that a topic carries."""

    MOTION = auto()  # pose of a PSM's tip
    MASTER = auto()  # pose of an MTM's tip
    JOINTS = auto()  # measured joint positions of a PSM or an MTM
    JAW = auto()
    GRIPPER = auto()
    PEDAL = auto()
    FOLLOWING = auto()  # true while an MTM drives its PSM
    SCALE = auto()
    TOOL = auto()
    SETPOINT = auto()  # commanded pose of a PSM's tip
    JAW_SETPOINT = auto()


@dataclass(frozen=True)
class Meaning:
    """The quantity that a topic carries, and its source.

    `owner` is an arm such as "PSM2", a teleoperation such as "MTMR_PSM1", or the topic of a pedal.
    """

    kind: TopicKind
    owner: str


def meaning(topic: str, message_type: str) -> Meaning | None:
    """Return the meaning of a topic of this message type; None where it is not used here."""
    if message_type in (POSE, TRANSFORM):
        return _of_pose(topic)
    if message_type == JOINT_STATE and (known := _OLDER.search(topic)):
        topic = topic[: known.start()] + _OLDER_NAMES[known[1]]
    if message_type == JOINT_STATE and topic.endswith("/measured_js"):
        return _of_joints(topic)
    if message_type == JOINT_STATE and topic.endswith("/jaw/setpoint_js"):
        return _about(TopicKind.JAW_SETPOINT, _named(_PSM, topic))
    if message_type in (JOY, BOOL) and _is_pedal(topic):
        return Meaning(TopicKind.PEDAL, topic)
    if message_type == BOOL and topic.endswith("/following"):
        return _about(TopicKind.FOLLOWING, _named(_PAIR, topic))
    if message_type == FLOAT64 and topic.endswith("/scale"):
        return _about(TopicKind.SCALE, _named(_PAIR, topic))
    if message_type == STRING and topic.endswith("/tool_type"):
        return _about(TopicKind.TOOL, _named(_PSM, topic))
    return None


def arm_of_pose(topic: str, message_type: str) -> str | None:
    """Return the PSM whose tip pose a topic carries, None for any other topic.

    `/PSM2/local/measured_cp` and `/CRTK/psm2/measured_cp` are poses of a PSM; `/SUJ/PSM2/...` is the passive arm that
    carries it.
    """
    said = meaning(topic, message_type)
    return said.owner if said is not None and said.kind is TopicKind.MOTION else None


def is_setpoint(topic: str, message_type: str) -> bool:
    """Return whether a topic carries setpoints of a PSM's tip or jaw; no recording is refused for them."""
    said = meaning(topic, message_type)
    return said is not None and said.kind in (TopicKind.SETPOINT, TopicKind.JAW_SETPOINT)


def not_understood(counted: Iterable[Topic]) -> Iterator[tuple[str, str]]:
    """Yield the topics with poses or joints of an arm that are neither read nor known as commands, with the reason."""
    for one in counted:
        message_type = one.type.replace("/", "/msg/") if one.type.count("/") == 1 else one.type
        arm = _named(_PSM, one.name) or _named(_MTM, one.name)
        of_kind = message_type in {POSE, TRANSFORM, JOINT_STATE} | _POSES
        last = one.name.rsplit("/", 1)[-1]
        if one.messages and of_kind and arm and not _COMMANDS.search(last) and meaning(one.name, message_type) is None:
            yield one.name, f"not read: {last} of {message_type} is no topic of {arm} that is known"


def counted(counts: Counter[tuple[str, str]]) -> tuple[Topic, ...]:
    """Return topics, sorted, from the number of messages by name and type."""
    return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))


def _of_pose(topic: str) -> Meaning | None:
    """Return the meaning of a topic of poses."""
    name = topic.rsplit("/", 1)[-1]
    if name in _SETPOINTS:
        return _about(TopicKind.SETPOINT, _named(_PSM, topic))
    if _COMMANDS.search(name):
        return None
    return _about(TopicKind.MOTION, _named(_PSM, topic)) or _about(TopicKind.MASTER, _named(_MTM, topic))


def _of_joints(topic: str) -> Meaning | None:
    """Return the meaning of a topic of measured joint states."""
    psm, mtm = _named(_PSM, topic), _named(_MTM, topic)
    part = topic.split("/")[-2]
    if part == "jaw":
        return _about(TopicKind.JAW, psm)
    if part == "gripper":
        return _about(TopicKind.GRIPPER, mtm)
    return Meaning(TopicKind.JOINTS, part) if part in (psm, mtm) else None


def _is_pedal(topic: str) -> bool:
    *_, group, name = ["", "", *topic.split("/")]
    return group == "footpedals" or (group == "console" and name in _CONSOLE)


def _about(kind: TopicKind, owner: str | None) -> Meaning | None:
    return None if owner is None else Meaning(kind, owner)


def _named(pattern: re.Pattern[str], topic: str) -> str | None:
    """Return the first component of a topic that matches the pattern.

    Topics of a passive arm (SUJ) have no match, because the pose of the passive arm is not that of the PSM's tip.
    """
    names = topic.split("/")
    if "SUJ" in names:
        return None
    return next((name for name in names if pattern.fullmatch(name)), None)
