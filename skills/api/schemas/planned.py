"""What is answered of plans and of their motion."""

from datetime import datetime

from pydantic import Field

from skills.api.schemas.shapes import Count, Given, Point, PolicyName, Quaternion, Sha256, Slug
from skills.api.schemas.verdict import Verdict


class Sources(Given):
    """Where what is known of PSM_M comes from."""

    approach: str
    base: str | None


class PsmM(Given):
    """The arm that takes the needle, in the frame of the arm that hands it over."""

    approach: Point
    base_mm: Point | None
    base_xyzw: Quaternion | None
    instrument: str
    enters: str = Field(description="start or after_A1.")
    from_: Sources = Field(alias="from")


class Transfer(Given):
    """How the arm comes to where A1 begins."""

    length_mm: float
    duration_s: float


class Pass(Given):
    """One grid world of a plan: where it is put, and the way in it."""

    position_mm: Point
    rotation_xyzw: Quaternion
    start_mm: Point
    states: list[int]
    path_mm: list[Point]
    jaw_xyzw: Quaternion
    target_xyzw: Quaternion | None = Field(description="The jaw after A2; null where A1 alone is planned.")
    transfer: Transfer | None


class Seam(Given):
    """What happens between two passes: nothing may."""

    after_pass: Count
    pause_s: float
    leap_mm: float
    leap_deg: float
    joint_leap: float = Field(description="As a part of what a joint may move in one tick.")


class Timetable(Given):
    """A plan in time."""

    rate_hz: float
    samples: Count
    duration_s: float
    seconds_by_phase: dict[str, float]
    speed_used_mm_s: float
    peak_joint_speed_ratio: float
    peak_joint_acceleration_ratio: float
    deviation_mm: float
    psm_m_moves: bool
    seams: list[Seam]


class Plan(Given):
    """Grid worlds stacked at suture points."""

    id: Sha256
    sha256: Sha256
    surgeon: Slug
    suture: Slug
    policy: PolicyName
    arm: str
    frame: str
    instrument: str
    orientation: str = Field(description="demonstrated, or assumed tool-down.")
    path: str = Field(description="fitted, or cell centres.")
    psm_m: PsmM | None
    realignment: bool
    speed_mm_s: float
    tip_offset_mm: float
    passes: list[Pass]
    trajectory: Timetable
    created_at: datetime


class Trajectory(Given):
    """The motion of a plan, sampled: `rows` of `columns`, which say their units."""

    rate_hz: float
    columns: list[str]
    rows: list[list[float]]


class StandingPolicy(PolicyName):
    """The policy version that a plan follows, and whether it is released now."""

    released: bool


class PictureLinks(Given):
    """Where the pictures are; all but the first are drawn after the verdict."""

    picture: str
    animation_mp4: str
    animation_gif: str
    joints: str
    clearance: str


class Playback(Given):
    """The simulator's verdict on a plan."""

    id: Sha256
    sha256: Sha256
    plan: Sha256
    feasible: bool
    report: Verdict
    picture: str
    pictures: PictureLinks
    created_at: datetime
    policy: StandingPolicy


class Comparison(Given):
    """A recorded replay beside a pass of its plan; triples are x, y and z."""

    plan: Sha256
    demo: Sha256
    pass_index: Count = Field(alias="pass")
    mean_mm: float
    max_mm: float
    start_mm: float = Field(description="Between the first samples.")
    end_mm: float = Field(description="Between the last samples.")
    dtw_mean_mm: Point
    rmse_mm: Point
    planned_s: float
    recorded_s: float
    tie_break: str
