"""Maps of the suture points at which a style can be planned: request and answer."""

from typing import Annotated, Literal

from pydantic import Field, StrictInt

from skills.fields import Count, Slug
from skills.kinematics import JAW_TIP_MM
from skills.planning.plan import MAX_TIP_OFFSET_MM, A2Target, Turning
from skills.schemas import Given, PolicyName
from skills.schemas.plans import PlanIn, PsmMIn, SuturePointIn
from skills.schemas.requests import Coordinate, Number, PointIn, QuaternionIn, Schema, SlugField, shown
from skills.schemas.scenes import SceneIn
from skills.verification.reach import MAX_PLACES, ReachPlace

MAX_ROTATIONS = 48


Length = Annotated[Number, Field(ge=0, le=400)]


class ReachIn(Schema):
    """A map of the suture points at which a style can be planned: a box of places, and rotations of the grid world.

    Attributes:
        version: The policy version; by default the released one.
        centre_mm: Middle of the box, in the frame of the arm; left out, the demonstrated goal.
        size_mm: Edges of the box.
        rotations_xyzw: Rotations of the grid world about each place, as of a suture point.
        orientation: As in a plan; so are all that follow.
        a2: As in a plan.
        psm_m: As in a plan.
        scene: As in a plan.
        tissue_mm: Height of level tissue along z of the arm's frame, as in a plan.
        handoff: none maps A1 alone, without a hand-off.
    """

    model_config = shown(
        {"surgeon": "kestrel", "suture": "simple-running", "size_mm": [40.0, 40.0, 0.0], "handoff": "none"}
    )

    surgeon: SlugField
    suture: SlugField
    version: Annotated[StrictInt, Field(ge=1, le=2**31)] | None = None
    centre_mm: PointIn | None = None
    size_mm: tuple[Length, Length, Length] = (80.0, 80.0, 0.0)
    step_mm: Annotated[Number, Field(ge=1, le=100)] = Field(
        default=8.0, description=f"Distance of the places, of which there are at most {MAX_PLACES}."
    )
    rotations_xyzw: Annotated[list[QuaternionIn], Field(min_length=1, max_length=MAX_ROTATIONS)] = Field(
        default=[(0.0, 0.0, 0.0, 1.0)]
    )
    orientation: Turning | None = None
    a2: A2Target | None = None
    tip_offset_mm: Annotated[Number, Field(ge=0, le=MAX_TIP_OFFSET_MM)] = Field(
        default=0.0, description=f"{JAW_TIP_MM:g} for the finger tips."
    )
    psm_m: PsmMIn | None = None
    scene: SceneIn | None = None
    tissue_mm: Coordinate | None = None
    handoff: Literal["none"] | None = None

    def plan_at(self, position_mm: PointIn) -> PlanIn:
        """Return the request of a plan with one pass at this place for each rotation."""
        alike = {name: getattr(self, name) for name in PlanIn.model_fields if name in type(self).model_fields}
        points = [SuturePointIn(position_mm=position_mm, rotation_xyzw=turned) for turned in self.rotations_xyzw]
        return PlanIn.model_construct(**alike, suture_points=points)


class Reach(Given):
    """Where a style can be planned.

    `places` has all positions of the first rotation, x slowest and z fastest, then those of the second, and so on.

    Attributes:
        counts: Number of places along x, y and z.
    """

    surgeon: Slug
    suture: Slug
    policy: PolicyName
    arm: str
    frame: str
    step_mm: float
    counts: tuple[Count, Count, Count]
    rotations: Count
    places: list[ReachPlace]
    description: str
