"""Large recordings, made quickly: messages of one topic are rows of one array, since only their numbers differ.

`four_arms` is a lab's typical session: two PSMs and two MTMs, each with its pose in two frames, its joints with
velocities and efforts, its jaw or gripper, and the pedals now and then. `one_arm` is one pose topic of any length.
"""

import struct
from collections.abc import Sequence
from functools import cache

import numpy as np

from skills.formats import topics
from tests.formats import records
from tests.formats.bags import START_NS
from tests.formats.definitions import DEFINITIONS
from tests.formats.records import Part

CHUNK_BYTES = 768 << 10  # the default of rosbag2's MCAP writer
JITTER_NS = 200_000


@cache
def four_arms(seconds: float = 60.0, rate_hz: float = 200.0, compression: str = "zstd") -> bytes:
    """Return a session's recording."""
    rng = np.random.default_rng(7)
    file = _File()
    for arm, grip in (("PSM1", "jaw"), ("PSM2", "jaw"), ("MTML", "gripper"), ("MTMR", "gripper")):
        stamps_ns = even_stamps(int(seconds * rate_hz), rate_hz, rng)
        joints = [f"{arm}_{name}" for name in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")]
        for topic, frame in (("local/measured_cp", f"{arm}_base"), ("measured_cp", "ECM")):
            file.add(f"/{arm}/{topic}", topics.POSE, stamps_ns, pose_rows(stamps_ns, frame, rng))
        file.add(f"/{arm}/measured_js", topics.JOINT_STATE, stamps_ns, joint_rows(stamps_ns, joints, rng))
        file.add(f"/{arm}/{grip}/measured_js", topics.JOINT_STATE, stamps_ns, joint_rows(stamps_ns, [grip], rng))
    for pedal in ("/console/clutch", "/console/operator_present", "/footpedals/camera"):
        stamps_ns = even_stamps(int(seconds) + 1, 1.0, rng)
        file.add(pedal, topics.JOY, stamps_ns, joy_rows(stamps_ns))
    return file.data(compression)


@cache
def one_arm(samples: int, rate_hz: float = 200.0, compression: str = "zstd") -> bytes:
    """Return a long recording of one arm's poses, moving back and forth."""
    rng = np.random.default_rng(8)
    stamps_ns = even_stamps(samples, rate_hz, rng)
    file = _File()
    file.add("/PSM2/local/measured_cp", topics.POSE, stamps_ns, pose_rows(stamps_ns, "PSM2_base", rng))
    return file.data(compression)


def with_unused(chunks: int) -> bytes:
    """Return a recording of a few poses and many MB of unused content: pictures in chunks, and an attachment."""
    short = records.parts_of(one_arm(200))
    picture = records.channel(9, 0, "/camera/image")
    image = np.random.default_rng(9).integers(0, 256, 1 << 20).astype(np.uint8).tobytes()
    pictures = records.split(chunks * records.chunk(picture + records.message(9, START_NS, image), compression=""))
    attachment = Part(records.ATTACHMENT, bytes(16) + records.text("a") + records.text("b") + bytes(chunks << 20))
    return records.resealed([*short[:-3], *pictures, attachment, *short[-3:]])


def even_stamps(count: int, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    """Return stamps as a timer gives them, with jitter; shape (count,)."""
    return START_NS + (np.arange(count) * (1e9 / rate_hz)).astype(np.int64) + rng.integers(0, JITTER_NS, count)


def pose_rows(stamps_ns: np.ndarray, frame: str, rng: np.random.Generator) -> np.ndarray:
    """Return PoseStamped messages of a tip that moves back and forth with tremor; shape (N, bytes)."""
    seconds = (stamps_ns - START_NS) / 1e9
    place = 0.02 * np.sin(seconds[:, None] * (0.5, 0.61, 0.37)) + (0.0, 0.05, -0.12)
    turn = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (len(seconds), 1)) + rng.normal(0, 1e-3, (len(seconds), 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    numbers = np.concatenate([place + rng.normal(0, 1e-5, place.shape), turn], axis=1)
    return rows(_header(frame), stamps_ns, numbers)


def joint_rows(stamps_ns: np.ndarray, names: Sequence[str], rng: np.random.Generator) -> np.ndarray:
    """Return JointState messages with positions, velocities and efforts; shape (N, bytes)."""
    start = _aligned(_header(""), 4) + struct.pack("<I", len(names))
    for name in names:
        start = _aligned(start, 4) + struct.pack("<I", len(name) + 1) + name.encode() + b"\0"
    places = []
    for _ in range(3):
        start = _aligned(_aligned(start, 4) + struct.pack("<I", len(names)), 8)
        places.append(slice(len(start), len(start) + 8 * len(names)))
        start += bytes(8 * len(names))
    made = rows(start, stamps_ns, np.zeros((len(stamps_ns), 0)))
    steps = np.arange(len(made))[:, None] / 300.0 + np.arange(len(names))
    for place in places:
        values = 0.1 * np.sin(steps) + rng.normal(0, 1e-5, steps.shape)
        made[:, place] = values.view(np.uint8).reshape(len(made), -1)
    return made


def joy_rows(stamps_ns: np.ndarray) -> np.ndarray:
    """Return Joy messages of a pedal that goes down and up; shape (N, bytes)."""
    made = rows(_aligned(_header(""), 4) + struct.pack("<IIi", 0, 1, 0), stamps_ns, np.zeros((len(stamps_ns), 0)))
    made[1::2, -4] = 1
    return made


def rows(start: bytes, stamps_ns: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Write stamps into copies of a message's start, and append the numbers; shape (N, bytes)."""
    start = _aligned(start, 8) if numbers.shape[1] else start
    made = np.tile(np.frombuffer(start, np.uint8), (len(stamps_ns), 1))
    made[:, 4:8] = (stamps_ns // 10**9).astype("<i4")[:, None].view(np.uint8)
    made[:, 8:12] = (stamps_ns % 10**9).astype("<u4")[:, None].view(np.uint8)
    return np.concatenate([made, np.ascontiguousarray(numbers).view(np.uint8).reshape(len(made), -1)], axis=1)


def _header(frame: str) -> bytes:
    return b"\0\1\0\0" + bytes(8) + struct.pack("<I", len(frame) + 1) + frame.encode() + b"\0"


def _aligned(data: bytes, size: int) -> bytes:
    return data + bytes(-(len(data) - 4) % size)


class _File:
    """A file under construction, with messages of several topics."""

    def __init__(self) -> None:
        self._types: dict[str, int] = {}
        self._definitions: list[bytes] = []
        self._messages: list[tuple[int, bytes]] = []

    def add(self, topic: str, message_type: str, stamps_ns: np.ndarray, messages: np.ndarray) -> None:
        """Add the messages of one topic, logged a little after their stamps."""
        if message_type not in self._types:
            self._types[message_type] = len(self._types) + 1
            self._definitions.append(records.schema(self._types[message_type], message_type, DEFINITIONS[message_type]))
        number = sum(record[0] == records.CHANNEL for record in self._definitions) + 1
        self._definitions.append(records.channel(number, self._types[message_type], topic))
        head = struct.pack("<BQHI", records.MESSAGE, 22 + messages.shape[1], number, 0)
        log_ns = (stamps_ns + 50_000)[:, None].astype("<u8").view(np.uint8)
        heads = np.tile(np.frombuffer(head, np.uint8), (len(messages), 1))
        whole = np.concatenate([heads, log_ns, log_ns, messages], axis=1)
        self._messages += zip((stamps_ns + 50_000).tolist(), map(bytes, whole), strict=True)

    def data(self, compression: str) -> bytes:
        """Write all messages into chunks, in the order of their log time."""
        self._messages.sort(key=lambda message: message[0])
        chunks, waiting, size = [], list(self._definitions), 0
        for _, message in self._messages:
            waiting.append(message)
            size += len(message)
            if size >= CHUNK_BYTES:
                chunks.append(records.chunk(b"".join(waiting), compression=compression))
                waiting, size = [], 0
        chunks.append(records.chunk(b"".join(waiting), compression=compression))
        body = records.split(records.header() + b"".join(chunks))
        return records.resealed([*body, Part(records.DATA_END, bytes(4)), Part(records.STATISTICS, b"")])
