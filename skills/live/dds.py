"""DDS as ROS 2 uses it, without an installation of ROS: names and types of ROS 2 by cyclonedds. Its only importer.

A topic /PSM1/measured_cp is `rt/PSM1/measured_cp`, a type a/msg/B is `a::msg::dds_::B_` (ROS 2 design, "Topic and
Service name mapping to DDS"). Messages stay CDR bytes: the classes below only describe their types to other peers.
Without a named interface the bus is on loopback, and asks for its peers there alone.

It meets the names and types of the specification; no ROS 2 was there to try it with.
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration

from skills.errors import BadSettings
from skills.formats.topics import BOOL, JOINT_STATE, JOY, OPERATING_STATE, POSE, STRING
from skills.live.bus import Seen, Writer
from skills.live.interface import BusTopic

DOMAINS = range(0, 233)  # DDSI-RTPS: ports of a higher one do not exist
DEPTH = 50  # of a reader: a quarter of a second at 200 Hz, in which a busy listener may be late
_MOST = 10_000  # messages in one call
_INTERFACE = re.compile(r"[\w.-]{1,15}")
_CONFIGURATION = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface name="{name}" multicast="{multicast}"/></Interfaces>
<AllowMulticast>{multicast}</AllowMulticast></General><Discovery>{peers}<ParticipantIndex>auto</ParticipantIndex></Discovery></Domain></CycloneDDS>"""
_LOOPBACK = '<Peers><Peer address="127.0.0.1"/></Peers>'


@dataclass
class _Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class _Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: _Time
    frame_id: str


@dataclass
class _Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class _Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class _Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: _Point
    orientation: _Quaternion


@dataclass
class _PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: _Header
    pose: _Pose


@dataclass
class _JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: _Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class _Joy(IdlStruct, typename="sensor_msgs::msg::dds_::Joy_"):
    header: _Header
    axes: sequence[float32]
    buttons: sequence[int32]


@dataclass
class _OperatingState(IdlStruct, typename="crtk_msgs::msg::dds_::OperatingState_"):
    header: _Header
    state: str
    is_homed: bool
    is_busy: bool


@dataclass
class _Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    data: bool


@dataclass
class _String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


class _Sample:
    """CDR bytes where cyclonedds expects a value."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sample_info: Any = None

    def serialize(self, **_: Any) -> bytes:
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, **_: Any) -> "_Sample":
        return cls(data)


_TYPES = {
    POSE: _PoseStamped,
    JOINT_STATE: _JointState,
    JOY: _Joy,
    OPERATING_STATE: _OperatingState,
    BOOL: _Bool,
    STRING: _String,
}


class DdsBus:
    """A bus of ROS 2, one of a process and domain. Close it at the end."""

    def __init__(self, domain: int = 0, interface: str | None = None) -> None:
        """Join a domain.

        Args:
            domain: Its number, ROS_DOMAIN_ID.
            interface: Name of the network interface, such as eth0; None: loopback alone.

        Raises:
            BadSettings: There is no such domain, or the name cannot be that of an interface.
        """
        if domain not in DOMAINS:
            raise BadSettings(f"A domain is a number from 0 to {DOMAINS[-1]}.", given=domain)
        if interface is not None and not _INTERFACE.fullmatch(interface):
            raise BadSettings("That cannot be the name of a network interface; give one such as eth0.")
        out = interface is not None
        named = {"name": interface or "lo", "multicast": str(out).lower(), "peers": "" if out else _LOOPBACK}
        self._domain = Domain(domain, _CONFIGURATION.format(**named))
        self._participant = DomainParticipant(domain)
        self._topics: dict[BusTopic, Any] = {}
        self._spoken: list[Any] = []  # a writer that nobody holds is gone
        self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)

    def listen(self, topic: BusTopic) -> Callable[[], Sequence[Seen]]:
        """Listen to a topic; as `Bus.listen`."""
        kept = Policy.Durability.TransientLocal if topic.event else Policy.Durability.Volatile
        # Best effort hears writers of both kinds, but what was kept comes from a reliable one alone.
        sure = Policy.Reliability.Reliable(duration(seconds=1)) if topic.event else Policy.Reliability.BestEffort
        reader = DataReader(self._participant, self._topic(topic), qos=Qos(kept, sure, Policy.History.KeepLast(DEPTH)))

        def take() -> Sequence[Seen]:
            now_s = time.monotonic()
            return [
                Seen(now_s, one.data, str(one.sample_info.publication_handle))
                for one in reader.take(N=_MOST)
                if isinstance(one, _Sample) and one.sample_info.valid_data
            ]

        return take

    def speak(self, topic: BusTopic) -> Callable[[bytes], None]:
        """Announce a topic, and return what writes to it; as `Bus.speak`."""
        kept = Policy.Durability.TransientLocal if topic.event else Policy.Durability.Volatile
        sure = Policy.Reliability.Reliable(duration(milliseconds=10))
        depth = Policy.History.KeepLast(1 if topic.event else 5)
        writer = DataWriter(self._participant, self._topic(topic), qos=Qos(kept, sure, depth))
        self._spoken.append(writer)
        return lambda data: writer.write(_Sample(data))

    def writers(self) -> Sequence[Writer]:
        """Return all writers that are known now; as `Bus.writers`."""
        ours = self._participant.guid
        return [
            Writer(
                topic=f"/{one.topic_name.removeprefix('rt/')}",
                type=one.type_name.replace("::dds_::", "/").replace("::", "/").removesuffix("_"),
                writer=str(one.key),
                keeps=Policy.Durability.Volatile not in one.qos,
                is_ours=one.participant_key == ours,
            )
            for one in self._found.read(N=_MOST)
            if one.sample_info.valid_data and one.topic_name.startswith("rt/")
        ]

    def close(self) -> None:
        """Leave the bus."""
        del self._found, self._spoken, self._topics, self._participant, self._domain

    def _topic(self, topic: BusTopic) -> Any:
        if topic not in self._topics:
            made: Any = DdsTopic(self._participant, f"rt{topic.name}", _TYPES[topic.type])
            made.data_type = _Sample  # the description was read; bytes stay bytes
            self._topics[topic] = made
        return self._topics[topic]
