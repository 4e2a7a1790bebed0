"""Pose styles: the next pose, the poses along one phase, and the messages of sessions."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, StrictInt

from skills.demonstration.partner import Partner
from skills.fields import Count, Fraction, Point, Quaternion, Sha256, Slug
from skills.learning.tube_certificate import TubeCertificate, TubeClearance
from skills.schemas import Given, PolicyName
from skills.schemas.requests import PointIn, QuaternionIn, Schema, shown


class PartnerPose(Given):
    """A pose of the other arm, PSM_M, as it was demonstrated relative to the hand-off, for one phase.

    No tube is certified for it: nothing is proven of how near that arm is to it, nor to the arm that follows the pose
    style, nor of how far it moves in a tick. The caller checks the distance between the arms.

    Attributes:
        position_mm: Of its tip, in the frame of the pose style.
        jaw_rad: null where its jaw was not recorded.
    """

    arm: str
    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float | None


class PartnerPath(Given):
    """The motion of the other arm, PSM_M, at the phases of the pose style, as demonstrated relative to the hand-off.

    No tube is certified for it: the caller checks the distance between the arms. Its steps are not limited, and it is
    neither refused nor changed beside a scene.

    Attributes:
        position_mm: Of its tip, in the frame of the pose style.
        jaw_rad: null where its jaw was not recorded.
        scene: How near it comes to the scene that the version was learnt in, of which a part may be this arm itself;
            negative or 0 where it touches.
    """

    arm: str
    position_mm: list[Point]
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None
    scene: TubeClearance | None = None


class PoseAnswer(Given):
    """The next pose for a pose that was reached.

    Outside the tube the certificate proves nothing: a client stops there, or brings the hand back by other means.

    Attributes:
        phase: After this tick; to be sent with the pose that is reached then.
        elapsed_s: Time of that phase from the start of the motion.
        share_left: Share of the style that follows that phase.
        off_mm: Distance of the pose that was sent from that of its phase.
        inside: Whether the pose that was sent lies in the tube.
        finished: Whether the last pose was reached.
        partner_pose: Where the other arm was demonstrated to be at `phase`; no tube is certified for it, so check the
            distance between the arms. null where its motion was not learnt.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float | None
    phase: Count
    elapsed_s: float
    share_left: Fraction
    off_mm: float
    off_rad: float
    inside: bool
    finished: bool
    partner_pose: PartnerPose | None = None


class NextPose(PoseAnswer, PolicyName):
    """The next pose of the pose style, to be reached within `tick_s`."""

    frame: str
    tick_s: float


class SessionPose(PoseAnswer):
    """The next pose of a session.

    Attributes:
        newer_version: Another version that was released since; the session keeps its own.
        late_ms: How long the pose waited in the service, if longer than `late_ms` of the limits; otherwise null. An
            answer after its tick is worse for a robot than none.
    """

    newer_version: int | None
    late_ms: float | None


class SessionLimits(Given):
    """What a session allows; more closes it.

    Attributes:
        burst: Messages at once.
        idle_s: Without a message for so long it is closed.
        late_ms: A pose that took longer says how long.
        stays_late_s: Poses that are late for so long close sessions, the youngest first.
    """

    rate_hz: float
    burst: float
    message_bytes: int
    idle_s: float
    late_ms: float
    stays_late_s: float


class SessionOpening(PolicyName):
    """The first message of a session: the version that it is pinned to, the tube, and the limits.

    Attributes:
        tick_s: Time between two phases.
        scene: The distance of the path from the scene that the version was learnt in; the tube is narrower.
    """

    arm: str
    frame: str
    phases: int
    tick_s: float
    tube: TubeCertificate
    scene: TubeClearance | None = None
    limits: SessionLimits


class PoseStyle(PolicyName):
    """The poses of a hand along one phase, learnt from the demonstrations of a policy version.

    Phase k of N is the share k / (N - 1) of the time; the lists have an entry for each. The motion lies at the start
    and the goal pose of one demonstration. `tube` certifies the rule by which `POST .../next` follows it.

    Attributes:
        jaw_rad: null where a demonstration has no jaw.
        spread_mm: Standard deviation of the demonstrations about the path.
        turn_share: Where the orientations are between the shortest turn from start to goal, 0, and the mean of the
            demonstrations, 1; below 1 they turn in unlike ways.
        tick_s: Time between two phases.
        scene: The distance of the path from the scene that the version was learnt in; the tube is narrower.
        partner: The other arm as it took the needle, where that was recorded.
        partner_motion: The other arm's motion at the same phases, where every demonstration's recording has it all
            along; no tube is certified for it.
    """

    format: Literal["suture-skills pose style 1"]
    surgeon: Slug
    suture: Slug
    arm: str
    frame: str
    demos: list[Sha256]
    position_mm: list[Point]
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None
    elapsed_s: list[float]
    spread_mm: list[float]
    spread_rad: list[float]
    turn_share: float = 1.0
    tick_s: float
    tube: TubeCertificate
    scene: TubeClearance | None = None
    partner: Partner | None
    partner_motion: PartnerPath | None = None
    created_at: datetime


class NextIn(Schema):
    """A position in mm, in the policy's frame, and the phase in which it was reached; null: the start of a pass.

    With an orientation it is a pose, and the pose style answers; the phases are then those of the pose style.
    """

    model_config = shown({"position_mm": [-10.0, 55.0, -135.0]}, {"position_mm": [-15.0, 55.0, -130.0], "phase": 1})

    position_mm: PointIn
    rotation_xyzw: QuaternionIn | None = None
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class PoseIn(Schema):
    """A message of a session: a pose that was reached, and its phase; null: that of the answer before."""

    position_mm: PointIn
    rotation_xyzw: QuaternionIn
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None
