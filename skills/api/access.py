"""Who asks, and what they may do."""

from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends

Role = Literal["reader", "uploader", "trainer", "releaser", "admin"]


@dataclass(frozen=True)
class Caller:
    """Who asks: the name that events have, the role, and the token that a page's requests must carry, if it is a page."""

    name: str
    role: Role
    csrf: str | None = None


def _caller() -> Caller:
    """Say who asks: without keys, only somebody on this machine can."""
    return Caller("local", "admin")


Asking = Annotated[Caller, Depends(_caller)]
