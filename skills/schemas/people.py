"""Surgeons, suture types and API keys: answers and requests."""

from datetime import date, datetime
from typing import Annotated, Literal

from pydantic import AliasChoices, AwareDatetime, Field

from skills.fields import Slug
from skills.schemas import Given, Handedness, SkillLevel
from skills.schemas.requests import OWNER, Name, Schema, SlugField, Text, shown
from skills.settings import Role


class Consent(Given):
    """The uses that a surgeon agreed to, and their last day."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class Surgeon(Given):
    """A surgeon, known by a pseudonym."""

    surgeon: Slug = Field(validation_alias=AliasChoices("surgeon", "slug"))
    skill_level: SkillLevel | None
    handedness: Handedness | None
    protocol: str | None
    consent: Consent | None
    created_at: datetime


class ConsentIn(Schema):
    """The uses that a surgeon agreed to, and their last day."""

    uses: list[Literal["training", "export", "atlas"]]
    until: date | None = None


class SurgeonIn(Schema):
    """A surgeon, by pseudonym; never a name.

    Attributes:
        skill_level: The surgeon's experience.
        handedness: The hand that the surgeon prefers.
        protocol: The study's protocol, such as an ethics number.
        consent: The uses that the surgeon agreed to.
    """

    model_config = shown(
        {
            "skill_level": "expert",
            "handedness": "right",
            "consent": {"uses": ["training", "export"], "until": "2099-12-31"},
        },
        {},
    )

    skill_level: SkillLevel | None = None
    handedness: Handedness | None = None
    protocol: Name | None = None
    consent: ConsentIn | None = None


class SutureType(Given):
    """A suture type of the catalogue."""

    suture: Slug = Field(validation_alias=AliasChoices("suture", "slug"))
    name: str
    also_called: list[str]
    family: str
    description: str


class SutureTypeIn(Schema):
    """A suture type of the catalogue."""

    model_config = shown(
        {"name": "Simple running", "also_called": ["continuous"], "family": "running", "description": "One thread."}
    )

    name: Name
    also_called: list[Name] = Field(default_factory=list, max_length=20)
    family: Name
    description: Text = ""


class Key(Given):
    """An API key, as an admin sees it: its owner and permissions; its secret is stored nowhere.

    Attributes:
        key: Its id, the part after `skills_`, which is no secret.
        owner: The owner's name, which events and releases record.
        surgeons: The surgeons that it is restricted to; null: all.
    """

    key: str = Field(pattern=r"^[0-9a-f]{8}$")
    owner: str
    role: Literal["reader", "uploader", "trainer", "releaser", "admin"]
    surgeons: list[Slug] | None
    created_at: datetime
    created_by: str
    expires_at: datetime | None
    revoked_at: datetime | None
    state: Literal["active", "expired", "revoked"]


class NewKey(Key):
    """A key that was just created, with its secret.

    Attributes:
        secret: The value of the header `X-API-Key`; it cannot be shown again.
    """

    secret: str


class KeyIn(Schema):
    """An API key to create."""

    model_config = shown({"owner": "a.laboratory", "role": "reader", "surgeons": ["kestrel"]})

    owner: Annotated[str, Field(pattern=OWNER, description="The owner's name, which events and releases record.")]
    role: Role
    expires_at: AwareDatetime | None = None
    surgeons: Annotated[list[SlugField], Field(min_length=1, max_length=1000)] | None = None
