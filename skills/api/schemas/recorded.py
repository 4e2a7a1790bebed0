"""What is answered of recordings and demonstrations."""

from datetime import datetime
from typing import Literal

from pydantic import Field

from skills.api.schemas.shapes import ChosenGrid, Count, Given, Point, Quaternion, Sha256, Share, Slug


class Topic(Given):
    """One topic of a recording."""

    name: str
    type: str
    messages: Count


class Motion(Given):
    """One arm's motion on one topic, in one frame."""

    arm: str
    topic: str
    frame: str
    samples: Count
    duplicate_stamps: Count


class Quality(Given):
    """How well a motion was recorded."""

    arm: str
    topic: str
    duration_s: float
    rate_hz: float | None
    longest_gap_s: float
    extent_mm: Point


class Segment(Given):
    """A hand-off that is proposed, in the form in which a demonstration is asked for, and why."""

    arm: str
    start_s: float
    end_s: float
    handover_s: float
    found_by: str = Field(description="stage, gesture, jaw or motion.")
    reasons: list[str]
    reason: str


class RecordingCounts(Given):
    """How many there are of what may be listed in part."""

    segments: Count
    labels: Count


class Label(Given):
    """A stage or gesture that somebody marked."""

    name: str
    kind: str
    start_s: float
    end_s: float


class JointStates(Given):
    """The joints of an arm on a topic."""

    arm: str
    topic: str
    joints: Count


class Master(Given):
    """A master's motion."""

    arm: str
    topic: str


class Pedal(Given):
    """How often a pedal went down, and for how long."""

    topic: str
    presses: Count
    pressed_s: float


class Following(Given):
    """For how long a teleoperation drove its arm."""

    teleoperation: str
    following_s: float


class Scale(Given):
    """The scale between a master and its arm."""

    teleoperation: str
    least: float
    greatest: float


class LeftOut(Given):
    """A topic that was not read."""

    topic: str
    because: str


class BaseFrame(Given):
    """Where an arm's base is in a frame that it shares with others, as measured on its motion."""

    arm: str
    frame: str
    local_frame: str
    position_mm: Point
    rotation_xyzw: Quaternion
    spread_mm: float
    spread_rad: float


class Recording(Given):
    """A raw file as it was uploaded: what is in it, how good it is, and the hand-offs it seems to hold."""

    id: Sha256
    sha256: Sha256
    size_bytes: Count
    media_type: str
    format: str = Field(description="mcap, csv, jigsaws, rosbag2 or rosbag1.")
    integrity: Literal["full", "partial", "none"] = Field(description="How much of it a checksum vouches for.")
    duration_s: float
    notes: dict[str, str]
    topics: list[Topic]
    motions: list[Motion]
    quality: list[Quality]
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
    base_frames: list[BaseFrame]
    created_at: datetime


class SuturePoint(Given):
    """A mark of a simulator's scene, in an arm's base frame."""

    name: str
    kind: Literal["entry", "exit"]
    is_goal: bool = Field(description="Whether it is proposed as a pass's goal: an exit is.")
    position_mm: Point
    rotation_xyzw: Quaternion
    turn_xyzw: Quaternion = Field(description="The turn to it from the first mark of its kind.")


class SuturePoints(Given):
    """The marks of a scene, in the order of their numbers, entries before exits."""

    arm: str | None = Field(description="null where a frame was named that is no arm's.")
    frame: str
    points: list[SuturePoint]


class Partner(Given):
    """The arm that takes the needle, where it was at `at_s`, in the frame of the arm that was demonstrated."""

    arm: str
    at_s: float
    position_mm: Point
    rotation_xyzw: Quaternion
    approach: Point = Field(description="A direction, of length 1.")
    base_mm: Point | None
    base_xyzw: Quaternion | None
    instrument: str | None


class DemoReport(Given):
    """What was measured of a demonstration, and what to do about it; what an older version did not measure is null."""

    duration_s: float
    samples: Count
    rate_hz: float
    longest_gap_s: float
    path_length_mm: float
    extent_mm: Point
    speed_median_mm_s: float
    speed_peak_mm_s: float
    jerk_rms_mm_s3: float | None = None
    log_dimensionless_jerk: float | None = Field(default=None, description="The nearer to 0 the smoother.")
    spectral_arc_length: float | None = Field(default=None, description="The nearer to 0 the smoother.")
    clutch_presses: Count
    clutched_s: float | None = None
    undriven_s: float | None = None
    idle_share: Share
    a1_s: float | None = Field(default=None, description="When the tip comes to rest at its goal.")
    a1_orientation_change_rad: float | None = None
    a1_turn_negligible: bool | None = Field(default=None, description="Whether it is below 0.35 rad, as in the paper.")
    orientation_change_rad: float | None
    path_states: Count
    revisits: Count
    bridged_cells: Count
    returns: Count | None = None
    discretisation_rmse_mm: Point
    discretisation_rmse_3d_mm: float | None = None
    outside_paper_grid_share: Share | None = None
    advised_hysteresis: float | None = None
    duplicate_stamps: Count | None = None
    grid: ChosenGrid
    partner: Partner | None = None
    advice: list[str] = Field(description="Sentences to the surgeon.")


class Demonstration(Given):
    """One hand-off cut out of a recording, and what was measured of it."""

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
    session: Slug | None
    hysteresis: float = Field(description="Cells.")
    state: Literal["active", "withdrawn"]
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


class RewardLevels(Given):
    """The rewards of Algorithm 1."""

    goal: float
    visited: float
    other: float
    off_grid: float


class RewardMap(Given):
    """The rewards of a demonstration that are not `other`: `rewards[k]` is that of `states[k]`."""

    demo: Sha256
    sha256: Sha256
    grid: ChosenGrid
    levels: RewardLevels
    states: list[int]
    rewards: list[float]
