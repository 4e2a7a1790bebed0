"""Schemas of everything that crosses HTTP, declared once and used by the API and the client.

Answers and requests of a noun are in one module: `people`, `recordings`, `demos`, `datasets`, `comparison`, `scores`.
The base class of requests and the types of their fields are in `requests`; requests are strict, unknown fields are
refused. A part that is a value of the domain is declared there, as a dataclass with `skills.fields.schema`.

Fields are described in the section Attributes of a class's docstring (`skills.fields.Documented`), unless a number of
the code is part of the description.

A use case returns the model of its answer; rows store parts of it as typed columns of JSON (`skills.db.AsJson`).

Lengths are mm; the frame of a position is in a field of its own.
"""

from importlib import import_module
from reprlib import Repr
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import ConfigDict, Field

from skills.fields import Documented, Sha256

if TYPE_CHECKING:  # those of the client
    # isort: off
    from skills.schemas import cards as cards, comparison as comparison, datasets as datasets, demos as demos
    from skills.schemas import operation as operation, people as people, plans as plans, playbacks as playbacks
    from skills.schemas import policies as policies, pose_styles as pose_styles, reach as reach
    from skills.schemas import recordings as recordings, responses as responses, results as results, scores as scores
    from skills.schemas import timelines as timelines, training as training
    # isort: on


def __getattr__(noun: str) -> ModuleType:
    """Import a module of schemas at its first use: a call of the client needs those of its noun alone."""
    try:
        return import_module(f"{__name__}.{noun}")
    except ModuleNotFoundError as error:
        raise AttributeError(noun) from error


SHORT = Repr()
# Limits of `repr` in a notebook.
SHORT.maxlist, SHORT.maxtuple, SHORT.maxdict = 4, 4, 12
SHORT.maxstring, SHORT.maxother = 100, 300


class Given(Documented):
    """The base class of responses: a client ignores fields that it does not know yet.

    `Model.model_validate(row)` makes one of a row of the database.

    A schema is built at its first use, so that importing all of them is cheap.
    """

    model_config = ConfigDict(
        extra="ignore", frozen=True, defer_build=True, from_attributes=True, validate_by_name=True,
        validate_by_alias=True, serialize_by_alias=True,
    )  # fmt: skip

    @classmethod
    def from_attributes_of(cls, source: object, **more: Any) -> Self:
        """Return an answer with the attributes of a row or value that have the names of its fields, except for `more`.

        Args:
            source: It has an attribute of every field that is not in `more`.
            more: The other fields.
        """
        names = cls.model_fields.keys() - more.keys()
        return cls.model_validate({name: getattr(source, name) for name in names} | more)

    def __repr_str__(self, join_str: str) -> str:
        """Return the fields in a few lines: a policy has tens of thousands of actions, which would flood a notebook."""
        return join_str.join(f"{name}={SHORT.repr(value)}" for name, value in self.__repr_args__())


T = TypeVar("T")

SkillLevel = Literal["novice", "intermediate", "expert"]
Handedness = Literal["right", "left", "ambidextrous"]
DemoOutcome = Literal["success", "recovery", "failure"]
OutcomeAsked = Literal["success", "recovery", "failure", "unknown"]
ProposalDecision = Literal["open", "rejected"]
ProposalState = Literal[ProposalDecision, "accepted"]
VersionNumber = Annotated[int, Field(ge=1)]


class Page(Given, Generic[T]):
    """One page of a list.

    Attributes:
        next: The `cursor` of the next page; null where this is the last.
    """

    items: list[T]
    next: int | str | None


class PolicyName(Given):
    """The version number and digest of a policy version."""

    version: VersionNumber
    sha256: Sha256
