"""Request bodies, and the patterns of texts in requests. Lengths are mm, angles rad.

Unknown fields, NaN and infinity are refused. Every pattern has a description in words, for messages.
"""

from typing import Annotated

from pydantic import ConfigDict, Field, StrictInt
from pydantic.config import JsonDict

from skills.fields import Documented

SLUG = r"^[a-z0-9][a-z0-9_-]{0,63}$"
DIGEST = r"^[0-9a-f]{8,64}$"  # in full, or a prefix that no other digest has
JOB = r"^[0-9a-f]{16}$"
KEY = r"^[0-9a-f]{8}$"
OWNER = r"^[A-Za-z0-9][A-Za-z0-9 ._@-]{0,63}$"
FRAME = r"^[A-Za-z0-9_./-]{1,64}$"
ARM = r"^[A-Za-z][A-Za-z0-9_]{0,31}$"
LINE = r"^[^\x00-\x1f\x7f]+$"
LINES = r"^[^\x00-\x08\x0b-\x1f\x7f]*$"
COUNT = r"^\d{0,4}$"

_DESCRIBED = {
    SLUG: "must be 1 to 64 lower-case letters, digits, - and _, and begin with a letter or a digit",
    DIGEST: "must be a digest: 64 of the characters 0-9 and a-f, or at least the first 8 of them",
    JOB: "must be a job's id: 16 of the characters 0-9 and a-f",
    KEY: "must be a key's id: the 8 characters after skills_",
    FRAME: "must be 1 to 64 letters, digits, or _ . / -",
    ARM: "must be 1 to 32 letters, digits or _, and begin with a letter",
    OWNER: "must be 1 to 64 letters, digits, spaces or . _ @ -, and begin with a letter or a digit",
    LINE: "must be one line of text",
    LINES: "must be text without control characters",
    COUNT: "must be a whole number of at most 4 digits",
}


def describe(pattern: str) -> str:
    """Return the description of a pattern in words; every pattern of a request has one."""
    return _DESCRIBED[pattern]


class Schema(Documented):
    """The base class of request bodies: immutable; unknown fields, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


SlugField = Annotated[str, Field(pattern=SLUG)]
DigestField = Annotated[str, Field(pattern=DIGEST)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=LINE)]
Text = Annotated[str, Field(max_length=2000, pattern=LINES)]
Whole = Annotated[StrictInt, Field(ge=0, le=2**31)]
Number = Annotated[float, Field(strict=True)]  # strict, so that true is not accepted as a number
Size = Annotated[Number, Field(ge=0, le=1000)]
Source = Annotated[str, Field(min_length=1, max_length=600, pattern=LINE)]
Coordinate = Annotated[Number, Field(ge=-10_000, le=10_000)]
PointIn = tuple[Coordinate, Coordinate, Coordinate]
Component = Annotated[Number, Field(ge=-1e6, le=1e6)]
QuaternionIn = tuple[Component, Component, Component, Component]


def shown(*examples: JsonDict) -> ConfigDict:
    """Return a configuration with examples for the OpenAPI document; a test sends each of them."""
    return ConfigDict(json_schema_extra={"examples": [*examples]})
