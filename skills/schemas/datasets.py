"""Datasets of demonstrations: answers and requests."""

from typing import Annotated, Literal, Self

from pydantic import Field, StrictBool, StrictInt, model_validator

from skills.fields import Sha256
from skills.schemas import Given
from skills.schemas.requests import ARM, DigestField, Name, Schema, SlugField, Text, shown


class DatasetIn(Schema):
    """A dataset to export: the demonstrations, the part of their recordings, and the contents of its README.

    Without `demos`, all demonstrations are meant that fit the filters and the outcomes.

    Attributes:
        demos: These demonstrations, by their digests; by default all that fit the filters.
        surgeons: Only of these surgeons.
        without_surgeons: Of all but these surgeons, such as one without consent; a whole recording that shows one of
            them is refused.
        sutures: Only of these suture types.
        outcomes: success leaves out demonstrations that are marked recovery or failure; any exports them in the splits
            recovery and failure.
        whole: Exports whole recordings, where all surgeons in them consent; otherwise an episode is the interval of one
            hand-off.
        version: The version of LeRobot's format.
        fps: Frames per second, at most the rate of the recordings.
        split: The group that is in one split only: all of a surgeon, or all of a recording.
        arms: The arms of every episode; left out, those that all of the recordings have.
        name: The dataset's title.
        licence: Its licence, such as CC-BY-4.0.
        description: Its contents, for its README.
        procedure: The procedure of its collection, for its README.
    """

    model_config = shown(
        {"surgeons": ["kestrel"], "licence": "CC-BY-4.0", "name": "Running sutures"},
        {"demos": ["0123456789abcdef" * 4], "whole": True, "version": "v3.0", "fps": 50, "split": "session"},
    )

    demos: Annotated[list[DigestField], Field(min_length=1, max_length=1000)] | None = None
    surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
    without_surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
    sutures: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
    outcomes: Literal["success", "any"] = "success"
    whole: StrictBool = False
    version: Literal["v2.1", "v3.0"] = "v2.1"
    fps: Annotated[StrictInt, Field(ge=1, le=1000)] = 30
    split: Literal["surgeon", "session"] = "surgeon"
    arms: Annotated[list[Annotated[str, Field(pattern=ARM)]], Field(min_length=1, max_length=10)] | None = None
    name: Name = "Needle hand-offs"
    licence: Name = "unknown"
    description: Text = "Not stated."
    procedure: Text = "Not stated."

    @model_validator(mode="after")
    def _named_or_filtered(self) -> Self:
        filters = self.surgeons, self.without_surgeons, self.sutures
        if self.demos is not None and any(one is not None for one in filters):
            raise ValueError("name demonstrations in demos, or filter them by surgeons and sutures, but not both")
        if self.arms is not None and len({arm.lower() for arm in self.arms}) < len(self.arms):
            raise ValueError("name each arm once")
        return self


class DatasetEpisode(Given):
    """The origin of an episode of a dataset, which names none of this itself.

    Attributes:
        demos: The exported demonstrations in it; one, unless it is a whole recording.
    """

    recording: Sha256
    demos: list[Sha256]


class DatasetEpisodes(Given):
    """The origins of a dataset's episodes, in the order of their numbers.

    Attributes:
        whole: Whether each episode is a whole recording.
    """

    whole: bool
    episodes: list[DatasetEpisode]
