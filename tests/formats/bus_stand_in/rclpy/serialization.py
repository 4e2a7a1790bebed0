"""A stand-in for rclpy's serialisation."""

from rosbags.typesys import Stores, get_typestore

_STORE = get_typestore(Stores.ROS2_HUMBLE)


def deserialize_message(data: bytes, kind: str):
    return _STORE.deserialize_cdr(data, kind)
