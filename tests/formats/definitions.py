"""Definitions of the messages that a dVRK's recorder stores: those we write, and the older one of a pose."""

from skills.formats import bag_writer, topics

_RULE = "=" * 80
_POSE = bag_writer.DEFINITIONS[topics.POSE]
_HEADER = _POSE[_POSE.index(f"{_RULE}\nMSG: std_msgs/Header") :]
_QUATERNION = f"{_RULE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"

TRANSFORM = f"""std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_RULE}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_QUATERNION}{_HEADER}"""
DEFINITIONS = {**bag_writer.DEFINITIONS, topics.TRANSFORM: TRANSFORM}
