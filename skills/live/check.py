"""A check of an arm on a bus, by listening alone: topics, types, frames, units, rates, clocks, and who commands it.

    Bus, arm --listen_to--> Heard --check--> ArmReport: what was found, and what is wrong with its remedy

Nothing is published. The limits are ours, with their reasons; a figure that cannot be computed is a fault.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from skills.arrays import Floats
from skills.errors import BadInput
from skills.fields import Count, Figure, schema
from skills.kinematics import (
    DEFAULT_INSTRUMENT,
    INSERTION,
    INSTRUMENTS,
    JOINTS,
    forward,
    instrument_of,
    matrix_of,
)
from skills.live.bus import Bus, Writer
from skills.live.interface import (
    ARM_PREFIXES,
    TELEOPERATION,
    BusTopic,
    SaidJoints,
    SaidPose,
    SaidState,
    Value,
    commands,
    decode,
    measured,
)

LEAST_HZ = 50.0  # a tip at 100 mm/s moves by 2 mm between two poses; the dVRK has 100 to 200
GAP_S = 0.05  # without a pose for longer, whoever follows stops
AGE_S = 0.1  # between stamp and reception on clocks that agree; a bus takes some ms
REACH_MM = 500.0  # of a tip from its remote centre: insertion ends at 240 mm, and a camera sees no further
APART_MM, APART_DEG = 1.0, 2.0  # between pose and joints; another shaft is 18 mm off, backlash of encoders below 0.1
UNIT = 1e-3  # of a quaternion's length, which is sent with all digits
_REACHES = 1.2  # joints may be as much of their limits: an arm stands a little beyond before it is homed
POSES = ("measured_cp", "local/measured_cp")
_MISSING = {
    "local/measured_cp": "Update to dVRK 2.2 or later: without it no pose can be carried into the frame of servo_cp."
}
Kind = TypeVar("Kind", SaidPose, SaidJoints, SaidState)


@dataclass(frozen=True)
class Heard:
    """What was heard of an arm.

    Attributes:
        arm: Its name.
        seconds: How long it was listened to.
        said: By the names of CRTK the messages in the order of reception: when, in s of a monotonic clock and in ns of
            this machine's clock, and the value, or None if it is not of the type.
        teleoperated: What was said last of teleoperation; None: nothing.
        writers: All writers on the bus.
    """

    arm: str
    seconds: float
    said: Mapping[str, Sequence[tuple[float, int, Value | None]]]
    teleoperated: bool | None
    writers: Sequence[Writer]


@schema
@dataclass(frozen=True)
class Finding:
    """A fault of an arm's interface: the topic, what is wrong, and what helps."""

    topic: str
    fault: str
    remedy: str

    def __str__(self) -> str:
        """Return it as two sentences."""
        return f"{self.topic}: {self.fault} {self.remedy}"


@schema
@dataclass(frozen=True)
class HeardTopic:
    """One topic of an arm as it was heard: messages, their rate, the longest gap, and the age of a stamp, in s."""

    topic: str
    messages: Count
    rate_hz: Figure
    gap_s: Figure
    age_s: Figure


@schema
@dataclass(frozen=True)
class ArmReport:
    """What an arm's interface is like.

    Attributes:
        arm: Its name.
        instrument: Number of the instrument that was stated.
        seconds: How long it was listened to.
        frame: The frame of `measured_cp`, in which `servo_cp` is.
        streams: The topics that were heard.
        findings: What is wrong; nothing, if it may be followed.
    """

    arm: str
    instrument: str
    seconds: float
    frame: str
    streams: tuple[HeardTopic, ...]
    findings: tuple[Finding, ...]


def listen_to(bus: Bus, arm: str, seconds: float = 3.0, *, poll_s: float = 0.002) -> Heard:
    """Listen to an arm, and publish nothing.

    Args:
        bus: The bus.
        arm: Name of the arm, such as PSM1.
        seconds: How long.
        poll_s: Pause between two looks, which is how exactly receptions are timed.
    """
    topics = measured(arm)
    takes = {name: bus.listen(topic) for name, topic in topics.items()}
    teleoperation, teleoperated = bus.listen(TELEOPERATION), None
    said: dict[str, list[tuple[float, int, Value | None]]] = {name: [] for name in topics}
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        now_ns = time.time_ns()
        for name, take in takes.items():
            said[name] += [(one.received_s, now_ns, value_from(topics[name], one.data)) for one in take()]
        for one in teleoperation():
            teleoperated = value_from(TELEOPERATION, one.data) is True
        time.sleep(poll_s)
    return Heard(arm, seconds, said, teleoperated, bus.writers())


def value_from(topic: BusTopic, data: bytes) -> Value | None:
    """Return a message as a value, or None if its bytes are none of the topic's type."""
    try:
        return decode(topic.type, data)
    except BadInput:
        return None


def check(heard: Heard, instrument: str = DEFAULT_INSTRUMENT) -> ArmReport:
    """Say what is wrong with an arm's interface.

    Args:
        heard: What was heard of it.
        instrument: Number of its instrument.
    """
    findings = [*_of_topics(heard), *_of_state(heard), *_of_times(heard), *_of_values(heard)]
    if not findings:
        findings += _of_kinematics(heard, instrument)
    poses = values_of(heard, "measured_cp", SaidPose)
    return ArmReport(
        arm=heard.arm,
        instrument=instrument,
        seconds=heard.seconds,
        frame=poses[-1].frame if poses else "",
        streams=tuple(_stream(heard, name) for name, said in heard.said.items() if said),
        findings=(*findings, *_of_commanders(heard)),
    )


def values_of(heard: Heard, name: str, kind: type[Kind]) -> list[Kind]:
    """Return what was heard on a topic, by its name of CRTK, of one kind of value."""
    return [value for _, _, value in heard.said[name] if isinstance(value, kind)]


def _stream(heard: Heard, name: str) -> HeardTopic:
    said = heard.said[name]
    times = np.array([one[0] for one in said])
    stamps = [(now_ns - value.stamp_ns) / 1e9 for _, now_ns, value in said if isinstance(value, SaidPose | SaidJoints)]
    return HeardTopic(
        topic=measured(heard.arm)[name].name,
        messages=len(said),
        rate_hz=(len(said) - 1) / float(np.ptp(times)) if len(said) > 1 and np.ptp(times) > 0 else None,
        gap_s=float(np.diff(times).max()) if len(said) > 1 else None,
        age_s=float(np.median(stamps)) if stamps else None,
    )


def _of_topics(heard: Heard) -> Iterator[Finding]:
    """Find topics that are missing, of another type, or of two sources."""
    if not any(one.topic.startswith(f"/{heard.arm}/") for one in heard.writers):
        arms = sorted({one.topic.split("/")[1] for one in heard.writers if one.topic[1:].startswith(ARM_PREFIXES)})
        there = f"There are {', '.join(arms)}." if arms else "No arm is on this bus: check domain and interface."
        yield Finding(f"/{heard.arm}", "Nobody publishes anything of it.", there)
        return
    for name, topic in measured(heard.arm).items():
        writers = [one for one in heard.writers if one.topic == topic.name]
        others = sorted({one.type for one in writers} - {topic.type})
        if others:
            yield Finding(
                topic.name,
                f"It is of the type {', '.join(others)}, not {topic.type}.",
                "A dVRK before 2.2 has other types: update it, or bridge it.",
            )
        elif not writers:
            yield Finding(
                topic.name, "Nobody publishes it.", _MISSING.get(name, "Start it in the arm's configuration.")
            )
        elif len({one.writer for one in writers}) > 1:
            yield Finding(topic.name, f"{len(writers)} publish it.", "Stop all but the arm's own.")
        elif not heard.said[name] and not topic.event:
            yield Finding(topic.name, "It is announced, and nothing came.", "Start the arm's publishers.")
        elif any(value is None for _, _, value in heard.said[name]):
            yield Finding(topic.name, "A message is not of its type.", "Check who publishes it.")


def _of_state(heard: Heard) -> Iterator[Finding]:
    """Find a state that is not heard, or that is not one in which an arm may be moved."""
    topic = measured(heard.arm)["operating_state"].name
    states = values_of(heard, "operating_state", SaidState)
    writers = [one for one in heard.writers if one.topic == topic]
    if writers and not all(one.keeps for one in writers):
        remedy = "Publish it transient local (latched), as the dVRK does."
        yield Finding(topic, "It is not kept for those who come later.", remedy)
    elif writers and not states:
        yield Finding(topic, "It is announced, and nothing came.", "Restart the arm's publisher.")
    elif states and (states[-1].state != "ENABLED" or not states[-1].is_homed):
        homed = "homed" if states[-1].is_homed else "not homed"
        yield Finding(topic, f"The arm is {states[-1].state} and {homed}.", "Enable and home it at the console.")


def _of_times(heard: Heard) -> Iterator[Finding]:
    """Find streams that are slow, interrupted, old, or of a clock that stands or goes back."""
    for name in (*POSES, "measured_js"):
        said = heard.said[name]
        if len(said) < 2:
            continue
        topic, one = measured(heard.arm)[name].name, _stream(heard, name)
        stamps_ns = np.array([value.stamp_ns for _, _, value in said if isinstance(value, SaidPose | SaidJoints)])
        if not (one.rate_hz is not None and one.rate_hz >= LEAST_HZ):
            remedy = f"Publish at least {LEAST_HZ:g}, 100 to 200 as the dVRK does."
            yield Finding(topic, f"{_figure(one.rate_hz)} messages came per second.", remedy)
        elif not (one.gap_s is not None and one.gap_s <= GAP_S):
            remedy = f"At most {1e3 * GAP_S:g} ms may lie between two: relieve the machine or the network."
            yield Finding(topic, f"Nothing came for {1e3 * (one.gap_s or 0):.0f} ms.", remedy)
        if len(stamps_ns) > 1 and not (np.diff(stamps_ns) > 0).all():
            yield Finding(topic, "Its stamps repeat or go back.", "Stamp each message as it is measured.")
        elif not (one.age_s is not None and abs(one.age_s) <= AGE_S):
            yield Finding(
                topic,
                f"Its stamps are {_figure(one.age_s)} s old as they come.",
                "Set the clocks of both machines by one source (chrony), or find what delays it.",
            )


def _of_values(heard: Heard) -> Iterator[Finding]:
    """Find frames, lengths, angles and counts that cannot be those of a PSM."""
    for name in (*POSES, "setpoint_cp"):
        poses, topic = values_of(heard, name, SaidPose), measured(heard.arm)[name].name
        if not poses:
            continue
        frames = sorted({one.frame for one in poses})
        if len(frames) > 1 or not frames[0]:
            what = f"Its frame changes: {', '.join(frames)}." if len(frames) > 1 else "It names no frame."
            yield Finding(topic, what, "Publish every pose in one named frame; configure the camera before.")
        lengths = np.linalg.norm([one.rotation_xyzw for one in poses], axis=1)
        if not (np.abs(lengths - 1.0) <= UNIT).all():
            yield Finding(topic, f"A quaternion has length {_worst(lengths, 1.0)}, not 1.", "Check the publisher.")
        far_mm = 1e3 * np.linalg.norm([one.position_m for one in poses], axis=1)
        if not (far_mm <= REACH_MM).all():
            yield Finding(
                topic,
                f"A position is {_worst(far_mm, 0.0)} mm from the origin, if its unit is m.",
                "Publish metres, in a frame near the patient.",
            )
    yield from _of_joints(heard)


def _of_joints(heard: Heard) -> Iterator[Finding]:
    joints, topic = values_of(heard, "measured_js", SaidJoints), measured(heard.arm)["measured_js"].name
    counts = Counter(len(one.position) for one in joints)
    if joints and set(counts) != {len(JOINTS)}:
        yield Finding(topic, f"It has {', '.join(map(str, sorted(counts)))} joints, not 6.", "Name a PSM.")
    elif joints:
        rows, tool = in_mm(joints), instrument_of(DEFAULT_INSTRUMENT)
        reach = _REACHES * np.maximum(np.abs(tool.lower), np.abs(tool.upper))
        beyond = ~(np.abs(rows) <= reach)
        if beyond.any():
            joint = int(beyond.any(axis=0).argmax())
            unit = "m" if joint == INSERTION else "rad"
            value = rows[beyond[:, joint].argmax(), joint] * (1e-3 if joint == INSERTION else 1.0)
            remedy = "Publish rad, and the insertion in m."
            yield Finding(topic, f"{JOINTS[joint]} is {value:.3g} {unit}, which no PSM has.", remedy)


def in_mm(joints: Sequence[SaidJoints]) -> Floats:
    """Return joints as rows of `kinematics.JOINTS`, rad and mm, shape (T, 6)."""
    rows = np.array([one.position for one in joints], np.float64).reshape(-1, len(JOINTS))
    rows[:, INSERTION] *= 1e3
    return rows


def _of_kinematics(heard: Heard, instrument: str) -> Iterator[Finding]:
    """Find a pose in the base that is not that of the joints with the stated instrument."""
    poses, joints = values_of(heard, "local/measured_cp", SaidPose), values_of(heard, "measured_js", SaidJoints)
    topic, stamps_ns = measured(heard.arm)["local/measured_cp"].name, np.array([one.stamp_ns for one in poses])
    rows = in_mm(joints)
    after = np.searchsorted(stamps_ns, [one.stamp_ns for one in joints]).clip(0, len(poses) - 1)
    seen = [poses[k] for k in after.tolist()]  # a period later at most, in which an arm moves by less than the limit
    mm, deg = _off(rows, seen, instrument)
    if not (mm <= APART_MM and deg <= APART_DEG):
        fitting = [one for one in INSTRUMENTS if all(np.array(_off(rows, seen, one)) <= (APART_MM, APART_DEG))]
        yield Finding(
            topic,
            f"It is {mm:.1f} mm and {deg:.1f} degrees from where the joints of a {instrument} have their tip.",
            f"The instrument is {' or '.join(fitting)}: name it." if fitting else "Check arm, tool and base frame.",
        )


def _off(rows: Floats, poses: Sequence[SaidPose], instrument: str) -> tuple[float, float]:
    """Return the median distance, mm, and angle, degrees, of poses from those of joints."""
    tip_mm, turned = forward(rows, instrument)
    seen = matrix_of(np.array([one.rotation_xyzw for one in poses]))
    far = np.linalg.norm(1e3 * np.array([one.position_m for one in poses]) - tip_mm, axis=1)
    chord = np.linalg.norm((seen - turned).reshape(len(rows), -1), axis=1) / np.sqrt(8.0)
    return float(np.median(far)), float(np.median(np.degrees(2 * np.arcsin(np.minimum(chord, 1.0)))))


def _of_commanders(heard: Heard) -> Iterator[Finding]:
    """Find others who command the arm."""
    for topic in commands(heard.arm).values():
        if any(one.topic == topic.name and not one.is_ours for one in heard.writers):
            yield Finding(topic.name, "Somebody else publishes it.", "Stop that program: two would pull at one arm.")
    if heard.teleoperated:
        yield Finding(TELEOPERATION.name, "Teleoperation is on.", "Switch it off at the console.")


def _figure(value: float | None) -> str:
    return "no" if value is None else f"{value:.3g}"


def _worst(values: Floats, usual: float) -> str:
    """Return the value that is furthest from the usual one, NaN before all."""
    return f"{values[np.nan_to_num(np.abs(values - usual), nan=np.inf).argmax()]:.3g}"
