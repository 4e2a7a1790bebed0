"""All responses of the service, as models: routes declare them, and the client parses with them.

Lengths are mm, angles rad, durations s, moments UTC; frames are named. The models depend on the standard library and
pydantic alone. Their parts are in the modules from which they are imported here.
"""

from datetime import date, datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field

from skills.fields import Count, Slug
from skills.schemas.base import Given, Handedness, Page, SkillLevel
from skills.schemas.comparison import Atlas, Score
from skills.schemas.plans import Comparison, Plan, Playback, Trajectory
from skills.schemas.policies import (
    Job,
    NextStep,
    Policy,
    PolicyCard,
    PolicySummary,
    RetrainedStyle,
    Retraining,
    Rollout,
    Version,
)
from skills.schemas.recordings import Demonstration, DemoPath, Recording, RewardMap, SuturePoints

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


class Key(Given):
    """An API key, as an admin sees it: its owner and permissions; its secret is stored nowhere."""

    key: str = Field(pattern=r"^[0-9a-f]{8}$", description="Its id, the part after `skills_`, which is no secret.")
    owner: str = Field(description="Whose it is; events and releases bear this name.")
    role: Literal["reader", "uploader", "trainer", "releaser", "admin"]
    surgeons: list[Slug] | None = Field(description="The surgeons that it is restricted to; null: all.")
    created_at: datetime
    created_by: str
    expires_at: datetime | None
    revoked_at: datetime | None
    state: Literal["active", "expired", "revoked"]


class NewKey(Key):
    """A key that was just created, with its secret."""

    secret: str = Field(description="What to show as `X-API-Key`; nobody can show it again.")


class WrongField(Given):
    """One field of a request that is refused."""

    where: str
    why: str


class Problem(Given):
    """An error response, after RFC 9457; some kinds have additional fields."""

    # Unlike other responses: some kinds of errors have fields of their own, which a client must see.
    model_config = ConfigDict(extra="allow")

    type: str = Field(description="The kind, which never changes.")
    title: str
    status: int = Field(ge=400, le=599)
    detail: str = Field(description="What is wrong, and what to do next.")
    reason: str | None = Field(default=None, description="What is wrong, alone.")
    remedies: list[str | dict[str, str | int]] | None = Field(
        default=None, description="What to do next as data: sentences, and actions with their values."
    )
    errors: list[WrongField] | None = Field(default=None, description="The fields of the request that are refused.")
    numbers: dict[str, Any] | None = Field(default=None, description="The numbers of the sentence, to compute with.")
    case: str | None = Field(default=None, description="Of a mistake of ours: report it.")


class Consent(Given):
    """The uses that a surgeon agreed to, and their last day."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class Surgeon(Given):
    """A surgeon, known by a pseudonym."""

    surgeon: Slug
    skill_level: SkillLevel | None
    handedness: Handedness | None
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
    """The liveness of the process."""

    status: Literal["ok"]
    use: str


class Ready(Given):
    """The readiness of the installation for work."""

    status: Literal["ready"]
    workers: Count
