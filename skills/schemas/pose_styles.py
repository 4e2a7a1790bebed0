"""Pose styles: the next pose, the poses along one phase, and the messages of sessions."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, StrictInt

from skills.demonstration.partner import Partner
from skills.fields import Count, Point, Quaternion, Sha256, Slug
from skills.learning.tube_certificate import TubeCertificate, TubeClearance
from skills.schemas import Given, PolicyName
from skills.schemas.requests import Component, PointIn, Schema, shown


class PartnerPose(Given):
    """A pose of the other arm, PSM_M, as it was demonstrated relative to the hand-off, for one phase.

    No tube is certified for it: nothing is proven of how near that arm is to it, nor to the arm that follows the pose
    style, nor of how far it moves in a tick. The caller checks the distance between the arms.
    """

    arm: str
    position_mm: Point = Field(description="Of its tip, in the frame of the pose style.")
    rotation_xyzw: Quaternion
    jaw_rad: float | None = Field(description="null where its jaw was not recorded.")


class PartnerPath(Given):
    """The motion of the other arm, PSM_M, at the phases of the pose style, as demonstrated relative to the hand-off.

    No tube is certified for it: the caller checks the distance between the arms. Its steps are not limited, and it is
    neither refused nor changed beside a scene.
    """

    arm: str
    position_mm: list[Point] = Field(description="Of its tip, in the frame of the pose style.")
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None = Field(description="null where its jaw was not recorded.")
    scene: TubeClearance | None = Field(
        default=None,
        description="How near it comes to the scene that the version was learnt in, of which a part may be this arm "
        "itself; negative or 0 where it touches.",
    )


class PoseAnswer(Given):
    """The next pose for a pose that was reached.

    Outside the tube the certificate proves nothing: a client stops there, or brings the hand back by other means.
    """

    position_mm: Point
    rotation_xyzw: Quaternion
    jaw_rad: float | None
    phase: Count = Field(description="After this tick; to be sent with the pose that is reached then.")
    elapsed_s: float = Field(description="Time of that phase from the start of the motion.")
    off_mm: float = Field(description="Distance of the pose that was sent from that of its phase.")
    off_rad: float
    inside: bool = Field(description="Whether the pose that was sent lies in the tube.")
    finished: bool = Field(description="Whether the last pose was reached.")
    partner_pose: PartnerPose | None = Field(
        default=None,
        description="Where the other arm was demonstrated to be at `phase`; no tube is certified for it, so check the "
        "distance between the arms. null where its motion was not learnt.",
    )


class NextPose(PoseAnswer, PolicyName):
    """The next pose of the pose style, to be reached within `tick_s`."""

    frame: str
    tick_s: float


class SessionPose(PoseAnswer):
    """The next pose of a session."""

    newer_version: int | None = Field(description="Another version that was released since; the session keeps its own.")


class SessionLimits(Given):
    """What a session allows; more closes it."""

    rate_hz: float
    burst: float = Field(description="Messages at once.")
    message_bytes: int
    idle_s: float = Field(description="Without a message for so long it is closed.")


class SessionOpening(PolicyName):
    """The first message of a session: the version that it is pinned to, the tube, and the limits."""

    arm: str
    frame: str
    phases: int
    tick_s: float = Field(description="Time between two phases.")
    tube: TubeCertificate
    scene: TubeClearance | None = Field(
        default=None,
        description="The distance of the path from the scene that the version was learnt in; the tube is narrower.",
    )
    limits: SessionLimits


class PoseStyle(PolicyName):
    """The poses of a hand along one phase, learnt from the demonstrations of a policy version.

    Phase k of N is the share k / (N - 1) of the time; the lists have an entry for each. The motion lies at the start
    and the goal pose of one demonstration. `tube` certifies the rule by which `POST .../next` follows it.
    """

    format: Literal["suture-skills pose style 1"]
    surgeon: Slug
    suture: Slug
    arm: str
    frame: str
    demos: list[Sha256]
    position_mm: list[Point]
    rotation_xyzw: list[Quaternion]
    jaw_rad: list[float] | None = Field(description="null where a demonstration has no jaw.")
    elapsed_s: list[float]
    spread_mm: list[float] = Field(description="Standard deviation of the demonstrations about the path.")
    spread_rad: list[float]
    turn_share: float = Field(
        default=1.0,
        description="Where the orientations are between the shortest turn from start to goal, 0, and the mean of the "
        "demonstrations, 1; below 1 they turn in unlike ways.",
    )
    tick_s: float = Field(description="Time between two phases.")
    tube: TubeCertificate
    scene: TubeClearance | None = Field(
        default=None,
        description="The distance of the path from the scene that the version was learnt in; the tube is narrower.",
    )
    partner: Partner | None = Field(description="The other arm as it took the needle, where that was recorded.")
    partner_motion: PartnerPath | None = Field(
        default=None,
        description="The other arm's motion at the same phases, where every demonstration's recording has it all "
        "along; no tube is certified for it.",
    )
    created_at: datetime


class NextIn(Schema):
    """A position in mm, in the policy's frame, and the phase in which it was reached; null: the start of a pass.

    With an orientation it is a pose, and the pose style answers; the phases are then those of the pose style.
    """

    model_config = shown(
        {"position_mm": [-10.0, 55.0, -135.0]},
        {"position_mm": [-15.0, 55.0, -130.0], "phase": 1},
    )

    position_mm: PointIn
    rotation_xyzw: tuple[Component, Component, Component, Component] | None = None
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None


class PoseIn(Schema):
    """A message of a session: a pose that was reached, and its phase; null: that of the answer before."""

    position_mm: PointIn
    rotation_xyzw: tuple[Component, Component, Component, Component]
    phase: Annotated[StrictInt, Field(ge=0, le=10**6)] | None = None
