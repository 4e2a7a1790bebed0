"""Response models of recordings and demonstrations."""

from dataclasses import dataclass
from datetime import datetime
from typing import Literal, get_args

from pydantic import Field

from skills.demonstration.identification import ArmIdentification
from skills.demonstration.partner import Partner
from skills.demonstration.quality import MotionReport
from skills.demonstration.recording import BaseFrame, Column, Format, Topic
from skills.demonstration.segments import Segment, TakenSegment
from skills.fields import Count, Fraction, Point, Quaternion, Sha256, Slug, schema
from skills.gridworld.grid import PathReport
from skills.gridworld.reward import RewardLevels
from skills.schemas import ChosenGrid, DemoOutcome, Given, ProposalState


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
class Quality:
    """The recording quality of a motion.

    Attributes:
        equal_samples: Samples that repeat the pose of the sample before to the last bit, as they do where a recorder is
            faster than its source.
    """

    arm: str
    topic: str
    duration_s: float
    rate_hz: float | None
    longest_gap_s: float
    extent_mm: Point
    equal_samples: Count


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
    """The parts of a raw file, and the proposed hand-offs."""

    notes: dict[str, str]
    topics: list[Topic]
    motions: list[Motion]
    segments: list[Segment]
    counts: RecordingCounts
    labels: list[Label]
    tools: dict[str, str] = Field(description="The instrument of each arm, where the file names it.")
    joints: list[JointStates]
    masters: list[Master]
    pedals: list[Pedal]
    following: list[Following]
    scales: list[Scale]
    left_out: list[LeftOut]
    dropped: list[Dropped] = Field(description="Topics with samples whose stamps went back.")
    setpoints: list[Setpoints] = Field(description="Commanded poses and jaws; nothing is learnt from them.")
    base_frames: list[BaseFrame]
    identifications: list[ArmIdentification] = Field(description="What joints recorded beside poses show.")


class RecordingContent(ContentLists):
    """The content of a raw file, its quality, and the proposed hand-offs."""

    duration_s: float
    quality: list[Quality]


class Described(ContentLists):
    """The content of a raw file with its identity, and the proposed hand-offs."""

    sha256: Sha256
    size_bytes: Count
    media_type: str
    format: str = Field(description=f"One of {', '.join(get_args(Format))}.")
    integrity: Literal["full", "partial", "none"] = Field(description="How much of it a checksum vouches for.")


class Recording(Described):
    """A raw file as it was uploaded: its content, its quality, and the proposed hand-offs."""

    id: Sha256
    duration_s: float
    quality: list[Quality]
    created_at: datetime


class Proposal(Given):
    """A proposed hand-off of a recording, and what was decided on it."""

    recording: Sha256
    number: int = Field(description="Its number in the recording, counted from 1.")
    state: ProposalState = Field(
        description="accepted: a demonstration was cut there, which shares at least half of the longer of the two."
    )
    arm: str
    start_s: float = Field(description="Seconds since the recording's `origin_ns`.")
    end_s: float
    handover_s: float = Field(description="Transition from A1 to A2.")
    found_by: str = Field(description="The source: stage, gesture, transfer, jaw or motion.")
    reasons: list[str]
    confidence: Fraction | None = Field(
        description="Probability that the needle was given to another arm; null unless found by a transfer."
    )
    surgeon: Slug | None = Field(
        description="Of its demonstration, else the only one that the recording was uploaded for."
    )
    suture: Slug | None = Field(description="Of its demonstration; null if there is none.")
    demo: Sha256 | None = Field(description="The demonstration, active or withdrawn.")
    outcome: DemoOutcome | None = Field(description="Of the demonstration.")
    note: str | None = Field(description="Why it was rejected, or the reason of the outcome.")
    created_at: datetime = Field(description="Of the recording.")


class RecordingSummary(Given):
    """A recording in a list."""

    id: Sha256
    sha256: Sha256
    size_bytes: Count
    format: str
    duration_s: float
    arms: list[str]
    segments: Count = Field(description="Number of proposed hand-offs.")
    demos: Count = Field(description="Number of active demonstrations cut out of it.")
    created_at: datetime


@schema
@dataclass(frozen=True)
class PreviewedQuality:
    """The quality of a motion; durations and rate are null where the samples have no times.

    Attributes:
        equal_samples: Samples that repeat the pose of the sample before to the last bit.
    """

    arm: str
    topic: str
    duration_s: float | None
    rate_hz: float | None
    longest_gap_s: float | None
    extent_mm: Point
    equal_samples: Count


class RecordingPreview(Described):
    """The content of a raw file as it would be read; nothing of it is stored."""

    timed: bool = Field(description="Whether the samples have times; a table without them is stored only with a rate.")
    duration_s: float | None
    quality: list[PreviewedQuality]
    columns: list[Column] = Field(description="The columns of a table, used or not; empty of any other file.")


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
    """The marks of a scene, in the order of their numbers, entries before exits."""

    arm: str | None = Field(description="null where a frame was named that is no arm's.")
    frame: str
    points: tuple[SuturePoint, ...]


@schema
@dataclass(frozen=True, kw_only=True)
class DemoReport(PathReport, MotionReport):
    """Measurements of a demonstration, and advice.

    Attributes:
        duplicate_stamps: Samples of the entire recorded motion that carried the stamp of the sample before.
        backward_stamps: Samples of the entire recorded motion that were dropped because their stamp went back.
        equal_samples: Samples of the demonstration that repeat the pose of the sample before to the last bit.
        grid: The grid world of its path.
        partner: The arm that takes the needle; null if it was not recorded.
        advice: Sentences to the surgeon.
    """

    duplicate_stamps: Count
    backward_stamps: Count
    equal_samples: Count
    grid: ChosenGrid
    partner: Partner | None


class DatasetEpisode(Given):
    """The origin of an episode of a dataset, which names none of this itself."""

    recording: Sha256
    demos: list[Sha256] = Field(description="The exported demonstrations in it; one, unless it is a whole recording.")


class DatasetEpisodes(Given):
    """The origins of a dataset's episodes, in the order of their numbers."""

    whole: bool = Field(description="Whether each episode is a whole recording.")
    episodes: list[DatasetEpisode]


class Demonstration(Given):
    """One hand-off cut out of a recording, with its measurements."""

    id: Sha256
    sha256: Sha256
    recording: Sha256
    surgeon: Slug
    suture: Slug
    arm: str
    topic: str
    frame: str
    instrument: str
    start_s: float
    end_s: float
    segment: TakenSegment = Field(description="Which part of the recording was taken.")
    session: Slug | None
    hysteresis: float = Field(description="Cells.")
    state: Literal["active", "withdrawn"]
    outcome: DemoOutcome | None = Field(default=None, description="What became of the hand-off; null: not known.")
    outcome_reason: str | None = Field(default=None, description="Why, in the words of whoever marked it.")
    report: DemoReport
    created_at: datetime
    withdrawn_at: datetime | None


class DemoPath(Given):
    """A demonstration as its states in the grid, and as it was recorded."""

    demo: Sha256
    frame: str
    grid: ChosenGrid
    hysteresis: float
    states: list[int]
    path_mm: list[Point] = Field(description="The centres of the states.")
    stamps_s: list[float]
    recorded_mm: list[Point]


class RewardMap(Given):
    """The rewards of a demonstration other than `other`: `rewards[k]` is that of `states[k]`."""

    demo: Sha256
    sha256: Sha256
    grid: ChosenGrid
    levels: RewardLevels
    states: list[int]
    rewards: list[float]
