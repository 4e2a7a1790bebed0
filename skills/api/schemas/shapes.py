"""What the models of answers are made of. Lengths are mm; the frame of a place is named beside it."""

from reprlib import Repr
from typing import Annotated, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field

SHORT = Repr()
SHORT.maxlist, SHORT.maxtuple, SHORT.maxdict = 4, 4, 12
SHORT.maxstring, SHORT.maxother = 100, 300


class Given(BaseModel):
    """What all answers have in common: a client passes over a field that it does not know yet.

    A schema is built when it is first used, so that importing all of them costs little.
    """

    model_config = ConfigDict(
        extra="ignore", frozen=True, defer_build=True, validate_by_name=True, validate_by_alias=True,
        serialize_by_alias=True,
    )  # fmt: skip

    def __repr_str__(self, join_str: str) -> str:
        """Say it in a few lines: a policy has tens of thousands of actions, and a notebook shows what it is given."""
        return join_str.join(f"{name}={SHORT.repr(value)}" for name, value in self.__repr_args__())


T = TypeVar("T")

Slug = Annotated[str, Field(description="Lower-case letters, digits, - and _.")]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$", description="SHA-256, in hex.")]
Point = tuple[float, float, float]
Quaternion = Annotated[tuple[float, float, float, float], Field(description="x, y, z, w; of length 1.")]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]


class Page(Given, Generic[T]):
    """One page of a list."""

    items: list[T]
    next: int | str | None = Field(description="The `cursor` of the next page; null where this is the last.")


class Grid(Given):
    """A grid world: the centre of the state (ix * ny + iy) * nz + iz is `origin_mm + cell_mm * (ix, iy, iz)`."""

    origin_mm: Point = Field(description="Centre of the state 0.")
    cell_mm: float
    shape: tuple[int, int, int] = Field(description="Cells along x, y and z.")


class ChosenGrid(Grid):
    """A demonstration's grid world, and whether it is the paper's or was fitted to the path."""

    chosen: str = Field(description="paper or fit.")


class PolicyName(Given):
    """Which policy version."""

    version: int = Field(ge=1)
    sha256: Sha256
