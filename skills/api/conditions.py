"""Conditional requests (RFC 9110, section 13): what a client has, and what it last saw."""

import hashlib
from typing import Annotated, Any

import orjson
from fastapi import Header

from skills.errors import PreconditionFailed

Condition = Annotated[str | None, Header(max_length=2000)]


def tag_of(content: bytes) -> str:
    """Name bytes by their digest."""
    return f'"{hashlib.sha256(content).hexdigest()}"'


def names(header: str, tag: str) -> bool:
    """Say whether a list of tags, or `*`, names one; a proxy may have made it weak."""
    return any(one.strip().removeprefix("W/") in (tag, "*") for one in header.split(","))


def refuse_changed(said: Any, if_match: str | None, if_none_match: str | None = None) -> None:
    """Refuse to change a thing that is not what the client last saw.

    Args:
        said: What a GET of it answers now; None where there is none.
        if_match: It must be one of these.
        if_none_match: It must be none of these; `*` means that there must be none at all.

    Raises:
        PreconditionFailed: It is otherwise.
    """
    tag = None if said is None else tag_of(orjson.dumps(said))
    if if_match is not None and (tag is None or not names(if_match, tag)):
        raise PreconditionFailed("It is not what If-Match names any more; look at it, then decide again.")
    if if_none_match is not None and tag is not None and names(if_none_match, tag):
        raise PreconditionFailed("There is one already that If-None-Match names; look at it, then decide again.")
