"""The words of a dVRK recording: which topic says what, and of which type.

dVRK 2.2 and later publish the tip as PoseStamped, earlier versions as TransformStamped; both in metres, with the stamp
of the measurement in the header. The topics follow the CRTK conventions (dVRK documentation, "Arms" and "Console").
"""

import re

POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
JOY = "sensor_msgs/msg/Joy"

CLUTCH_TOPICS = ("/console/clutch", "/footpedals/clutch")  # the first that is there is used
RELEASED, PRESSED, QUICK_TAP = 0, 1, 2  # buttons[0] of a clutch

_ARM = re.compile(r"PSM\d*", re.IGNORECASE)


def arm_of_pose(topic: str, message_type: str) -> str | None:
    """Return the PSM whose tip a topic tells, None for any other topic.

    `/PSM2/local/measured_cp` and `/CRTK/psm2/measured_cp` are a PSM's; `/SUJ/PSM2/...` is what carries it.
    """
    if message_type not in (POSE, TRANSFORM):
        return None
    return _arm_in(topic)


def arm_of_jaw(topic: str, message_type: str) -> str | None:
    """Return the PSM whose measured jaw angle a topic tells, None for any other topic."""
    if message_type != JOINT_STATE or not topic.endswith("/jaw/measured_js"):
        return None
    return _arm_in(topic)


def is_clutch(topic: str, message_type: str) -> bool:
    """Say whether a topic tells the clutch pedal."""
    return topic in CLUTCH_TOPICS and message_type == JOY


def _arm_in(topic: str) -> str | None:
    names = topic.split("/")
    if "SUJ" in names:
        return None
    return next((name for name in names if _ARM.fullmatch(name)), None)
