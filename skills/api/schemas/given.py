"""What the service answers, as models: its routes are described by them, and its client reads with them.

Lengths are mm, angles rad, durations s, moments UTC; frames are named. All of it is pure: the standard library and
pydantic alone. The parts of the things below are in the modules that they come from.
"""

from datetime import date, datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field

from skills.api.schemas.atlas import Atlas
from skills.api.schemas.card import PolicyCard
from skills.api.schemas.keyed import Key, NewKey
from skills.api.schemas.learnt import (
    Job,
    NextStep,
    Policy,
    PolicySummary,
    RetrainedStyle,
    Retraining,
    Rollout,
    Version,
)
from skills.api.schemas.planned import Comparison, Plan, Playback, Trajectory
from skills.api.schemas.recorded import Demonstration, DemoPath, Recording, RewardMap, SuturePoints
from skills.api.schemas.score import Score
from skills.api.schemas.shapes import Count, Given, Page, Slug

__all__ = [
    "Alive",
    "Atlas",
    "Comparison",
    "Consent",
    "DemoPath",
    "Demonstration",
    "Job",
    "Key",
    "NewKey",
    "NextStep",
    "Page",
    "Plan",
    "Playback",
    "Policy",
    "PolicyCard",
    "PolicySummary",
    "Problem",
    "Ready",
    "Recording",
    "RetrainedStyle",
    "Retraining",
    "RewardMap",
    "Rollout",
    "Score",
    "Surgeon",
    "SuturePoints",
    "SutureType",
    "Trajectory",
    "Version",
    "WrongField",
]


class WrongField(Given):
    """One field of a request that is refused."""

    where: str
    why: str


class Problem(Given):
    """What was refused, after RFC 9457; some kinds say more in fields of their own."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="The kind, which never changes.")
    title: str
    status: int = Field(ge=400, le=599)
    detail: str = Field(description="What is wrong, and what to do next.")
    errors: list[WrongField] | None = Field(default=None, description="The fields of the request that are refused.")
    numbers: dict[str, Any] | None = Field(default=None, description="The numbers of the sentence, to compute with.")
    case: str | None = Field(default=None, description="Of a mistake of ours: report it.")


class Consent(Given):
    """What a surgeon agreed to, and until when."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class Surgeon(Given):
    """A surgeon, known by a pseudonym."""

    surgeon: Slug
    skill_level: Literal["novice", "intermediate", "expert"] | None
    handedness: Literal["right", "left", "ambidextrous"] | None
    protocol: str | None
    consent: Consent | None
    created_at: datetime


class SutureType(Given):
    """A suture type of the catalogue."""

    suture: Slug
    name: str
    also_called: list[str]
    family: str
    description: str


class Alive(Given):
    """The process answers."""

    status: Literal["ok"]
    use: str


class Ready(Given):
    """The installation can work."""

    status: Literal["ready"]
    workers: Count
