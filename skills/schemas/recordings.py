"""Recordings: answers, and what a request states about one."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from skills.demonstration.identification import ArmIdentification
from skills.demonstration.recording import BaseFrame, Column, Format, Topic
from skills.demonstration.segments import Segment
from skills.fields import Count, Point, Quaternion, Sha256, schema
from skills.kinematics import INSTRUMENTS
from skills.schemas import Given
from skills.schemas.requests import ARM, FRAME, LINE, Name, Schema, Text


@schema
@dataclass(frozen=True)
class Motion:
    """One arm's motion on one topic, in one frame."""

    arm: str
    topic: str
    frame: str
    samples: Count
    duplicate_stamps: Count


@schema
@dataclass(frozen=True)
class PreviewedQuality:
    """The recording quality of a motion; durations and rate are null where the samples have no times.

    Attributes:
        equal_samples: Samples that repeat the pose of the sample before to the last bit, as they do where a recorder is
            faster than its source.
    """

    arm: str
    topic: str
    duration_s: float | None
    rate_hz: float | None
    longest_gap_s: float | None
    extent_mm: Point
    equal_samples: Count


@schema
@dataclass(frozen=True)
class Quality(PreviewedQuality):
    """The recording quality of a motion, whose samples have times."""

    duration_s: float
    longest_gap_s: float


@schema
@dataclass(frozen=True)
class Dropped:
    """The number of samples of a topic that were dropped because their stamps went back."""

    topic: str
    backward_stamps: Count


@schema
@dataclass(frozen=True)
class RecordingCounts:
    """The total numbers of items in lists that may be truncated."""

    segments: Count
    labels: Count


@schema
@dataclass(frozen=True)
class Label:
    """A stage or gesture, as annotated."""

    name: str
    kind: str
    start_s: float
    end_s: float


@schema
@dataclass(frozen=True)
class JointStates:
    """The joints of an arm on a topic."""

    arm: str
    topic: str
    joints: Count


@schema
@dataclass(frozen=True)
class Setpoints:
    """The setpoints of an arm's tip or jaw on a topic.

    Attributes:
        frame: The frame of the poses; null for a jaw.
    """

    arm: str
    topic: str
    frame: str | None
    samples: Count


@schema
@dataclass(frozen=True)
class Master:
    """A master's motion."""

    arm: str
    topic: str


@schema
@dataclass(frozen=True)
class Pedal:
    """The number of presses of a pedal, and their total duration."""

    topic: str
    presses: Count
    pressed_s: float


@schema
@dataclass(frozen=True)
class Following:
    """The duration for which a teleoperation drove its arm."""

    teleoperation: str
    following_s: float


@schema
@dataclass(frozen=True)
class Scale:
    """The scale between a master and its arm."""

    teleoperation: str
    least: float
    greatest: float


@schema
@dataclass(frozen=True)
class LeftOut:
    """A topic that was not read."""

    topic: str
    because: str


class ContentLists(Given):
    """The parts of a raw file, and the proposed hand-offs.

    Attributes:
        tools: The instrument of each arm, where the file names it.
        dropped: Topics with samples whose stamps went back.
        setpoints: Commanded poses and jaws; nothing is learnt from them.
        identifications: Arms identified from joints recorded beside poses.
    """

    notes: dict[str, str]
    topics: list[Topic]
    motions: list[Motion]
    segments: list[Segment]
    counts: RecordingCounts
    labels: list[Label]
    tools: dict[str, str]
    joints: list[JointStates]
    masters: list[Master]
    pedals: list[Pedal]
    following: list[Following]
    scales: list[Scale]
    left_out: list[LeftOut]
    dropped: list[Dropped]
    setpoints: list[Setpoints]
    base_frames: list[BaseFrame]
    identifications: list[ArmIdentification]


class RecordingContent(ContentLists):
    """The content of a raw file, its quality, and the proposed hand-offs."""

    duration_s: float
    quality: list[Quality]


class Described(Given):
    """The content of a raw file with its identity, and the proposed hand-offs.

    Attributes:
        integrity: The part of it that checksums cover.
    """

    sha256: Sha256
    size_bytes: Count
    media_type: str
    format: str = Field(description=f"One of {', '.join(get_args(Format))}.")
    integrity: Literal["full", "partial", "none"]


class Recording(Described, RecordingContent):
    """A raw file as it was uploaded: its content, its quality, and the proposed hand-offs."""

    id: Sha256
    created_at: datetime


class RecordingSummary(Given):
    """A recording in a list.

    Attributes:
        segments: Number of proposed hand-offs.
        demos: Number of active demonstrations cut out of it.
    """

    id: Sha256
    sha256: Sha256
    size_bytes: Count
    format: str
    duration_s: float
    arms: list[str]
    segments: Count
    demos: Count
    created_at: datetime


class RecordingPreview(Described, ContentLists):
    """The content of a raw file as it would be read; nothing of it is stored.

    Attributes:
        timed: Whether the samples have times; a table without them is stored only with a rate.
        columns: The columns of a table, used or not; empty of any other file.
    """

    timed: bool
    duration_s: float | None
    quality: list[PreviewedQuality]
    columns: list[Column]


@schema
@dataclass(frozen=True)
class SuturePoint:
    """A mark of a simulator's scene, in an arm's base frame.

    Attributes:
        name: Such as "Exit1".
        kind: The needle goes in at an entry, and comes out at an exit.
        is_goal: Whether it is proposed as a pass's goal: an exit is.
        position_mm: Position.
        rotation_xyzw: Rotation, with the simulator's axes.
        turn_xyzw: Rotation from the first mark of its kind to this one: it turns a grid world that was demonstrated
            there so that it fits here.
    """

    name: str
    kind: Literal["entry", "exit"]
    is_goal: bool
    position_mm: Point
    rotation_xyzw: Quaternion
    turn_xyzw: Quaternion


class SuturePoints(Given):
    """The marks of a scene, in the order of their numbers, entries before exits.

    Attributes:
        arm: null where a frame was named that is no arm's.
    """

    arm: str | None
    frame: str
    points: tuple[SuturePoint, ...]


class TableIn(Schema):
    """Statements about a recording that it does not make itself, most of them about a table (docs/tables.md).

    Attributes:
        rate_hz: Samples per second, of a table without times.
        frame: The frame of the poses in a table or a LeRobot dataset; base, the default for a table of one arm: the
            arm's base.
        column: A column under another name, of a table as x_mm=NAME, or as x=NAME with a unit (docs/tables.md).
        unit: The unit of columns that name none, of lengths, angles or times.
        decimal: The decimal mark; point by default.
        table_arm: The arm of a table; PSM by default.
        instrument: The instrument with which a table's joints become poses.
    """

    rate_hz: Annotated[float, Field(gt=0, le=10_000)] | None = None
    frame: Annotated[str, Field(pattern=FRAME)] | None = None
    column: Annotated[list[Annotated[str, Field(max_length=200, pattern=LINE)]], Field(max_length=30)] | None = None
    unit: Annotated[list[Literal["m", "mm", "rad", "deg", "s", "ms", "us", "ns"]], Field(max_length=3)] | None = None
    decimal: Literal["point", "comma"] | None = None
    table_arm: Annotated[str, Field(pattern=ARM)] | None = None
    instrument: Annotated[str, Field(pattern=f"^({'|'.join(INSTRUMENTS)})$")] | None = None

    @property
    def options(self) -> dict[str, Any]:  # keyword arguments
        """The arguments of `read_recording` that are stated."""
        return self.model_dump(include={*TableIn.model_fields}, exclude_none=True)


class StatedIn(TableIn):
    """Statements of a folder's owner about recordings for `skills recording table` (docs/recordings.md)."""

    source: Text = ""
    episode: Name | None = None
    tool: list[Name] | None = None
