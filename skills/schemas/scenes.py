"""Requests: scenes, of tissue and obstacles, and their costs."""

from dataclasses import fields
from typing import Annotated, Any

from pydantic import Field, create_model

from skills.gridworld.hazards import SceneCosts
from skills.gridworld.scene import MOST_BODIES, MOST_HEIGHTS, Scene
from skills.learning.policy import Learner
from skills.schemas.requests import FRAME, Coordinate, Number, PointIn, Schema, Whole


def settings_schema(of: type[Learner] | type[SceneCosts], name: str, **more: Any) -> Any:
    """Return a schema with the settings of a class, numbers or words of a `Literal`; the class checks their values."""
    kinds: dict[Any, Any] = {int: Whole, float: Number}
    settings: dict[str, Any] = {f.name: (kinds.get(f.type, f.type), f.default) for f in fields(of)}
    return create_model(name, __base__=Schema, __doc__=of.__doc__, **settings, **more)


SceneCostsIn: Any = settings_schema(SceneCosts, "SceneCostsIn")


class BoxIn(Schema):
    """A box that must not be entered, along the axes of the frame."""

    low_mm: PointIn
    high_mm: PointIn


class CapsuleIn(Schema):
    """A cylinder with round ends, such as a link of the other arm."""

    a_mm: PointIn
    b_mm: PointIn
    radius_mm: Annotated[Number, Field(gt=0, le=10_000)]


class TissueIn(Schema):
    """Heights above a plane, bilinear between the points of a regular map; [[0]] is the plane itself (docs/scenes.md).

    `normal` points out of the tissue, `along` is the direction of the map's rows.
    """

    at_mm: PointIn
    normal: PointIn
    along: PointIn
    step_mm: Annotated[Number, Field(gt=0, le=10_000)] = 1.0
    heights_mm: Annotated[
        list[Annotated[list[Coordinate], Field(min_length=1, max_length=MOST_HEIGHTS)]],
        Field(min_length=1, max_length=MOST_HEIGHTS),
    ] = Field(default=[[0.0]])


class SceneIn(Schema):
    """What must not be touched, in the frame of the demonstration, as `Scene.as_json` writes it (docs/scenes.md)."""

    frame: Annotated[str, Field(pattern=FRAME)]
    boxes: Annotated[list[BoxIn], Field(max_length=MOST_BODIES)] = Field(default=[])
    capsules: Annotated[list[CapsuleIn], Field(max_length=MOST_BODIES)] = Field(default=[])
    tissue: TissueIn | None = None
    margin_mm: Annotated[Number, Field(ge=0, le=10_000)] = 0.0

    @property
    def value(self) -> Scene:
        """The scene as a value of the domain."""
        return Scene.of_json(self.model_dump())
