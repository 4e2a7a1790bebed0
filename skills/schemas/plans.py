"""Plans, their motion, and the verdict on it: the requests, and the responses.

The verdict on a plan consists of gates, figures, and Monte Carlo probabilities of success in worlds that differ from
the plan. A figure is null if it could not be measured; a gate with such a figure has failed.
"""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, StrictInt

from skills.fields import Count, Point, Quaternion, Sha256, Slug
from skills.gridworld.scene import Scene
from skills.kinematics import INSTRUMENTS, JAW_TIP_MM
from skills.planning.automatic_segments import HandTask, SegmentKind
from skills.planning.handoff import Enters
from skills.planning.plan import (
    MAX_OUTSIDE_MM,
    MAX_PASSES,
    MAX_TIP_OFFSET_MM,
    RATE_HZ,
    A2Target,
    Departure,
    SuturePoint,
    Turning,
)
from skills.planning.trajectory import MAX_SPEED_MM_S, Seam, Transfer
from skills.schemas import Given, PolicyName
from skills.schemas.requests import Component, Coordinate, Name, Number, PointIn, QuaternionIn, Schema, SlugField, shown
from skills.schemas.scenes import SceneIn


class SuturePointIn(Schema):
    """The position of a pass's goal, and the rotation of its grid world about this position."""

    position_mm: PointIn
    rotation_xyzw: QuaternionIn = (0.0, 0.0, 0.0, 1.0)

    @property
    def value(self) -> SuturePoint:
        """The suture point as a value of the domain."""
        return SuturePoint(self.position_mm, self.rotation_xyzw)


class BaseIn(Schema):
    """The position and rotation of PSM_M's base, its remote centre, in the base frame of the demonstrated arm."""

    position_mm: PointIn
    rotation_xyzw: QuaternionIn


class PsmMIn(Schema):
    """The arm that takes the needle, in the frame of the arm that was demonstrated.

    Attributes:
        approach: Its direction towards the needle; left out, the demonstrated one.
        base: Left out, the demonstrated one; where that is not known, PSM_M is in no scene or bag.
        source: Where these numbers come from; the plan repeats it.
    """

    approach: tuple[Component, Component, Component] | None = None
    base: BaseIn | None = None
    instrument: Annotated[str, Field(pattern=f"^({'|'.join(INSTRUMENTS)})$")] | None = None
    enters: Enters = "after_A1"
    source: Name | None = None


class PlanIn(Schema):
    """A plan: grid worlds of a style, stacked at suture points.

    Attributes:
        version: The policy version; by default the released one.
        arm: Refused if it is not the demonstrated one.
        frame: Refused if it is not the frame of the demonstration.
        instrument: Refused if it is not the demonstrated one.
        orientation: recorded: the jaw turns as the surgeon's along the pass; constant: it is held as in the
            demonstration's first sample, and the answer states the departure. By default recorded where it was.
        a2: recorded: A2 ends in the demonstrated hand-off, in the poses of both arms; paper: PSM_A turns across PSM_M's
            approach. By default recorded where both poses were, unless psm_m gives another approach.
        psm_m: Left out, it is taken from the demonstration where that has PSM_M's pose.
        scene: Tissue and obstacles in the frame of the arm, against which the verdict compares the motion. Left out, it
            is the scene that the policy was learnt in.
        tissue_mm: Height of level tissue, along z of the arm's frame: it is that of the scene. No motion is exported
            without tissue, of this, of the scene, or of the policy's.
        handoff: none asks for a plan that hands nothing over: A1 alone. Without it a plan is refused for which neither
            psm_m nor the demonstration says where PSM_M is.
    """

    model_config = shown(
        {
            "surgeon": "kestrel",
            "suture": "simple-running",
            "suture_points": [{"position_mm": [5.0, 55.0, -125.0]}],
            "handoff": "none",
        }
    )

    surgeon: SlugField
    suture: SlugField
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None
    suture_points: Annotated[list[SuturePointIn], Field(min_length=1, max_length=MAX_PASSES)]
    starts_mm: Annotated[list[PointIn | None], Field(max_length=MAX_PASSES)] | None = Field(
        default=None,
        description="Start of each pass; null is the demonstrated start, moved with the grid. "
        f"Up to {MAX_OUTSIDE_MM:g} mm outside a pass's grid world a transfer leads into it.",
    )
    arm: Name | None = None
    frame: Name | None = None
    instrument: Name | None = None
    speed_mm_s: Annotated[Number, Field(gt=0, le=1000)] = Field(
        default=20.0,
        description="Greatest speed of the tip: the surgeon's tempo is slowed to it, all along the pass alike. At most "
        f"{MAX_SPEED_MM_S:g}.",
    )
    orientation: Turning | None = None
    a2: A2Target | None = None
    rate_hz: Annotated[Number, Field(ge=RATE_HZ[0], le=RATE_HZ[1])] = Field(
        default=200.0, description=f"Samples per second, {RATE_HZ[0]:g} to {RATE_HZ[1]:g}."
    )
    tip_offset_mm: Annotated[Number, Field(ge=0, le=MAX_TIP_OFFSET_MM)] = Field(
        default=0.0,
        description=f"How far down the jaw's approach from its hinge suture points and starts are meant; "
        f"{JAW_TIP_MM:g} for the finger tips.",
    )
    psm_m: PsmMIn | None = None
    scene: SceneIn | None = None
    tissue_mm: Coordinate | None = None
    handoff: Literal["none"] | None = None


class Sources(Given):
    """The sources of PSM_M's values."""

    approach: str
    base: str | None


class PsmM(Given):
    """The arm that takes the needle, in the frame of the arm that hands it over.

    Attributes:
        enters: start or after_A1.
    """

    approach: Point
    base_mm: Point | None
    base_xyzw: Quaternion | None
    instrument: str
    enters: str
    from_: Sources = Field(alias="from")


class Pass(Given):
    """One grid world of a plan: its placement, and the path in it.

    Attributes:
        jaw_xyzw: The jaw at the start of A1.
        turn_deg: Greatest angle of the jaw from its start during A1.
        target_xyzw: The jaw after A2; null where A1 alone is planned.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    start_mm: Point
    states: list[int]
    path_mm: list[Point]
    jaw_xyzw: Quaternion
    turn_deg: float
    target_xyzw: Quaternion | None
    transfer: Transfer | None


class Timetable(Given):
    """A plan as a function of time.

    Attributes:
        duration_s: From the first sample to the last, with the pauses between passes.
        seconds_by_phase: Samples of each phase divided by `rate_hz`, without pauses: of a pass a sample more than it
            lasts.
        tempo: The part of the surgeon's tempo in A1, at most 1; null where none is followed.
        jaw: recorded along A1, or constant.
    """

    rate_hz: float
    samples: Count
    duration_s: float
    seconds_by_phase: dict[str, float]
    speed_used_mm_s: float
    tempo: float | None
    jaw: str
    peak_joint_speed_ratio: float
    peak_joint_acceleration_ratio: float
    deviation_mm: float
    psm_m_moves: bool
    seams: list[Seam]


Role = Literal["PSM_A", "PSM_M"]  # PSM_A hands the needle over, PSM_M takes it


class ArmStart(Given):
    """Where an arm must stand before a segment.

    Attributes:
        moves: Whether it moves in the segment; if not, it must stand there all the same.
        frame: Its own base, in which the pose is.
        position_mm: The jaw's hinge.
    """

    arm: str
    role: Role
    moves: bool
    frame: str
    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float


class PlanSegment(Given):
    """A segment that the arms do by themselves, and what must be true before it.

    Attributes:
        name: Its folder in the replay bag.
        from_ns: Its first stamp, on the one clock of the bag's setpoints.
        by_hand: What the surgeon does before it, without a limit of time: M1 inserts the needle, M2 grasps it again.
        teleoperated: The arms that the surgeon teleoperates meanwhile; in all segments no arm is.
        needle_held_by: Before it; null where that is not planned.
    """

    name: str
    kind: SegmentKind
    pass_index: Count
    from_ns: Count
    to_ns: Count
    by_hand: list[HandTask]
    teleoperated: list[str]
    needle_held_by: Role | None
    arms: list[ArmStart]


class SegmentIndex(Given):
    """The automatic segments of a plan in their order; between two of them an execution may wait.

    Attributes:
        position_tolerance_mm: How far an arm may stand from its place before a segment.
    """

    plan: Sha256
    position_tolerance_mm: float
    rotation_tolerance_rad: float
    jaw_tolerance_rad: float
    segments: list[PlanSegment]


class PlanScene(Given):
    """The scene of a plan, in the frame of the arm; it does not move with the passes.

    Attributes:
        learnt_sha256: Of the scene that the policy was learnt in; null: in none.
        differs: The differences from that scene, in words; empty if there are none.
    """

    sha256: Sha256
    learnt_sha256: Sha256 | None
    differs: list[str]
    scene: Scene


class PlanDescription(Given):
    """What a plan does, without its digests.

    Attributes:
        orientation: recorded: turns as the surgeon's; demonstrated: constant, the demonstration's first; or assumed
            tool-down, which is constant too.
        departure: Of a constant orientation from the recorded one; null where there is none.
        a2: recorded: ends in the demonstrated hand-off; or paper. Null without a hand-off.
        path: fitted, or cell centres.
        scene: Tissue and obstacles; null: none was stated, and nothing is compared with them.
    """

    arm: str
    frame: str
    instrument: str
    orientation: str
    departure: Departure | None
    a2: str | None
    path: str
    psm_m: PsmM | None
    scene: PlanScene | None
    speed_mm_s: float
    tip_offset_mm: float
    passes: list[Pass]
    trajectory: Timetable

    @property
    def psm_m_moves(self) -> bool:
        """Whether it moves PSM_M too; its base must be known for that."""
        return self.psm_m is not None and self.trajectory.psm_m_moves


class Plan(PlanDescription):
    """Grid worlds stacked at suture points.

    Attributes:
        hands_over: Whether a hand-off is planned: A2 towards PSM_M.
        description: What the plan does and what it leaves out.
    """

    id: Sha256
    sha256: Sha256
    surgeon: Slug
    suture: Slug
    policy: PolicyName
    hands_over: bool
    description: str
    created_at: datetime


class PlanSummary(Given):
    """A plan in a list.

    Attributes:
        playback: Its newest playback; null where it was not played.
        feasible: Of that playback.
    """

    id: Sha256
    surgeon: Slug
    suture: Slug
    policy: PolicyName
    passes: Count
    hands_over: bool
    playback: Sha256 | None
    feasible: bool | None
    created_at: datetime


class Trajectory(Given):
    """The motion of a plan, sampled: `rows` of `columns`, whose names contain their units."""

    rate_hz: float
    columns: list[str]
    rows: list[list[float]]
