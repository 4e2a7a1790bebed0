"""Recordings as values: the motion of the arms, its time stamps and its frames.

    Recording
    ├── Motion      the tip of one arm, one per pose topic
    ├── Joints      the measured joints of one arm
    ├── Signal      one number over time, a jaw's angle or a pedal
    ├── Column      a column of a table, and what it was read as
    ├── Label       a named interval: a stage of the session, a gesture
    └── Topic       a topic of the file, used or not
    --base_frames--> BaseFrame   the pose of an arm's base in the frame of another of its topics
    --identifications--> ArmIdentification   arm, instrument and base that joints and poses of an arm show together

Motions, joints and signals are checked in their constructors (`skills.demonstration.motion`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from skills.arrays import Floats, Ints
from skills.demonstration.bases import BaseFrame, identified_arms, paired_bases, shown_bases
from skills.demonstration.identification import ArmIdentification, Identification, stated_instrument
from skills.demonstration.motion import (
    Joints,
    Motion,
    Signal,
    equal_samples,
    recorded_joints,
    recorded_motion,
    recorded_signal,
)
from skills.errors import NoUsableTopic, UnreadableRecording
from skills.fields import Count, schema
from skills.remedies import did_you_mean

__all__ = [
    "BaseFrame",
    "Column",
    "Format",
    "Integrity",
    "Joints",
    "Label",
    "Motion",
    "Recording",
    "Signal",
    "Topic",
    "base_frames",
    "equal_samples",
    "recorded_joints",
    "recorded_motion",
    "recorded_signal",
]
ARMS_LIMIT, MOTIONS_LIMIT = 16, 200  # ours: a da Vinci has three PSMs; every pair of arms and of motions is compared

Format = Literal["mcap", "csv", "jigsaws", "rosbag2", "rosbag1", "lerobot"]
Integrity = Literal["full", "partial", "none"]


@dataclass(frozen=True)
class Label:
    """A named interval, both ends included, in the recording's own nanoseconds.

    `kind` is "stage" (of a session, from a recorder's tags) or "gesture" (of JIGSAWS, such as "G6").
    """

    name: str
    kind: Literal["stage", "gesture"]
    start_ns: int
    end_ns: int


@schema
@dataclass(frozen=True)
class Topic:
    """One topic of a file: its name, its message type and its number of messages."""

    name: str
    type: str
    messages: Count


@schema
@dataclass(frozen=True)
class Column:
    """A column of a table, and what it was read as.

    Attributes:
        name: Its name in the header.
        quantity: Such as "x", "q3" or "PSM1 qw"; "" for a column that is not used.
        unit: Its unit; "" where it has none.
    """

    name: str
    quantity: str
    unit: str


@dataclass(frozen=True, eq=False)
class Recording:
    """The content of one file, as far as this package uses it.

    Attributes:
        format: The format of the file.
        integrity: Whether checksums cover every pose ("full"), some ("partial") or none ("none").
        motions: One per pose topic of a PSM, at least one.
        jaws: Arm and its jaw's angle in rad.
        clutch: The console's clutch pedal.
        topics: All topics of the file, used or not.
        joints: Measured joints of PSMs and MTMs.
        masters: Motions of the tips of MTMs; nothing is learnt from them.
        grippers: MTM and its gripper's angle in rad.
        pedals: Topic and state of every pedal, the clutch included: 0 released, 1 pressed, 2 a quick tap.
        following: Teleoperation, such as "MTMR_PSM1", and whether it drove its PSM: 0 or 1.
        scales: Teleoperation and its motion scale.
        tools: Arm and its instrument as the console names it, such as "LARGE_NEEDLE_DRIVER:400006".
        labels: Named intervals, in order of time.
        notes: Metadata of the file, name and value, such as the digest of the file that it was made from.
        left_out: Topics that were not usable, and the fault of each; no demonstration depends on any of them.
        columns: The columns of a table.
        setpoints: Commanded poses of the tips of PSMs; nothing is learnt from them, and none is a motion.
        jaw_setpoints: Arm and the commanded angle of its jaw in rad.
    """

    format: Format
    integrity: Integrity
    motions: tuple[Motion, ...]
    jaws: tuple[tuple[str, Signal], ...] = ()
    clutch: Signal | None = None
    topics: tuple[Topic, ...] = ()
    joints: tuple[Joints, ...] = ()
    masters: tuple[Motion, ...] = ()
    grippers: tuple[tuple[str, Signal], ...] = ()
    pedals: tuple[tuple[str, Signal], ...] = ()
    following: tuple[tuple[str, Signal], ...] = ()
    scales: tuple[tuple[str, Signal], ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    labels: tuple[Label, ...] = ()
    notes: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    columns: tuple[Column, ...] = ()
    setpoints: tuple[Motion, ...] = ()
    jaw_setpoints: tuple[tuple[str, Signal], ...] = ()

    def __post_init__(self) -> None:
        if not self.motions:
            raise NoUsableTopic(f"No topic has the pose of a PSM.{_listed(self.topics)}")
        if len(self.motions) > MOTIONS_LIMIT or len(self.arms) > ARMS_LIMIT:
            raise UnreadableRecording(
                f"The recording has {len(self.motions)} motions of {len(self.arms)} arms; at most {MOTIONS_LIMIT} of "
                f"{ARMS_LIMIT} are read. Keep the topics of the arms that hand the needle over.",
                motions=len(self.motions),
                arms=len(self.arms),
            )

    @property
    def is_timed(self) -> bool:
        """Whether the file itself has times: a table may have none."""
        return not self.columns or any(column.quantity == "t" for column in self.columns)

    @property
    def origin_ns(self) -> int:
        """The earliest stamp of the motions: second 0 of every segment."""
        return min(int(motion.stamps_ns[0]) for motion in self.motions)

    @property
    def duration_s(self) -> float:
        """Time from the earliest stamp of the motions to the latest."""
        return (max(int(motion.stamps_ns[-1]) for motion in self.motions) - self.origin_ns) / 1e9

    @cached_property
    def bases(self) -> tuple[BaseFrame, ...]:
        """The poses of the arms' bases, see `base_frames`; computed once."""
        paired = paired_bases(self.motions)
        known = {(base.arm, base.frame) for base in paired}
        shown = shown_bases(self.identifications, self.motions)
        return *paired, *(base for base in shown if (base.arm, base.frame) not in known)

    @cached_property
    def identifications(self) -> tuple[ArmIdentification, ...]:
        """The arms and instruments that joints and poses show together; computed once."""
        return tuple(identified_arms(self.motions, self.joints, dict(self.tools), timed=self.is_timed))

    def identification_of(self, motion: Motion) -> Identification | None:
        """Return what the joints show of a motion; None if they were not recorded beside it."""
        return next((one.found for one in self.identifications if one.is_of(motion.arm, motion.topic)), None)

    def base_under(self, motion: Motion) -> BaseFrame | None:
        """Return the base of a motion's arm in the frame of the motion, if joints show it and it is another frame."""
        found = self.identification_of(motion)
        if motion.states_base or found is None or found.verdict != "identified":
            return None
        shown = shown_bases(self.identifications, self.motions)
        return next((base for base in shown if base.is_of(motion)), None)

    def instrument_on(self, arm: str) -> str | None:
        """Return the instrument of an arm: the one that its joints show, or else the one that the recording states.

        Returns:
            Its number in the dVRK's files, such as "400006", of which constants may not be known; None if it is neither
            shown nor stated.
        """
        shown = [one.found for one in self.identifications if one.arm == arm and one.found.verdict == "identified"]
        if shown:
            return min(shown, key=lambda found: found.residual_mm).instrument
        return stated_instrument(dict(self.tools).get(arm, ""))

    @property
    def arms(self) -> tuple[str, ...]:
        """The names of the arms that have a motion, sorted."""
        return tuple(sorted({motion.arm for motion in self.motions}))

    def jaw_of(self, arm: str) -> Signal | None:
        """Return the jaw signal of an arm, or None if it was not recorded."""
        return dict(self.jaws).get(arm)

    def setpoint_of(self, motion: Motion) -> Motion | None:
        """Return the setpoints of a motion: of the same arm in the same frame; None if there are none.

        Poses of one arm in its base and in another frame may name the same frame, so what their topics say of it must
        be the same too.
        """
        place = motion.arm, motion.frame, motion.states_base
        return next((one for one in self.setpoints if (one.arm, one.frame, one.states_base) == place), None)

    def without_setpoints(self, faults: Mapping[str, str]) -> "Recording":
        """Return it without the setpoints on some topics, and with the fault of each in `left_out`."""
        return replace(
            self,
            setpoints=tuple(one for one in self.setpoints if one.topic not in faults),
            jaw_setpoints=tuple((arm, one) for arm, one in self.jaw_setpoints if one.topic not in faults),
            left_out=tuple((dict(self.left_out) | dict(faults)).items()),
        )

    def jaw_setpoint_of(self, arm: str) -> Signal | None:
        """Return the setpoints of an arm's jaw, or None if they were not recorded."""
        return dict(self.jaw_setpoints).get(arm)

    def motion_of(self, *, arm: str | None = None, topic: str | None = None) -> Motion:
        """Choose a motion by its topic, or else the arm's `local/measured_cp`, then `measured_cp`, then any other.

        Raises:
            NoUsableTopic: There is no such arm or topic, or there are several arms and none is named.
        """
        fitting = [m for m in self.motions if arm in (None, m.arm) and topic in (None, m.topic)]
        if not fitting:
            here = ", ".join(f"{m.topic} of {m.arm}" for m in self.motions)
            asked = " and ".join(x for x in (arm and f"arm {arm}", topic and f"topic {topic}") if x)
            near = did_you_mean(arm, self.arms) if arm is not None and arm not in self.arms else []
            near = near or did_you_mean(topic or "", [m.topic for m in self.motions])
            raise NoUsableTopic(
                f"The recording has no pose for {asked}. It has poses for {here}.", *near, arm=arm, topic=topic
            )
        arms = sorted({m.arm for m in fitting})
        if len(arms) > 1:
            raise NoUsableTopic(f"The recording has several arms: {', '.join(arms)}. Name one.", arms=arms)
        return min(fitting, key=preference)

    def seconds(self, stamps_ns: Ints) -> Floats:
        """Convert stamps to seconds since `origin_ns`; integers are subtracted first, so that no nanosecond is lost."""
        return (stamps_ns - self.origin_ns) / 1e9


def base_frames(recording: Recording) -> tuple[BaseFrame, ...]:
    """Return the poses of the bases of arms in other frames, in mm.

    They are found from poses of an arm in both frames (`paired_bases`), and otherwise from its joints (`shown_bases`).
    """
    return recording.bases


def preference(motion: Motion) -> tuple[int, str]:
    """Prefer the pose relative to the arm's own remote centre: camera and set-up joints do not move it."""
    known = [f"/{motion.arm}/local/measured_cp", f"/{motion.arm}/measured_cp"]
    return (known.index(motion.topic) if motion.topic in known else len(known), motion.topic)


def _listed(topics: tuple[Topic, ...]) -> str:
    if not topics:
        return ""
    return " It has " + ", ".join(f"{topic.name} ({topic.type})" for topic in topics[:20]) + "."
