"""Authorisation: the roles of callers, and the role that each route declares in its decorator.

`skills.api.authentication` identifies the caller before a request is processed; this module compares the caller with
the requirements of the route. Data of surgeons whom a restricted key may not see is protected twice: a path with
`{surgeon}` is answered 404 here, and every query filters by the key's surgeons (`skills.db.row_visibility`), which also
covers lists, digests and job ids.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends
from fastapi.requests import HTTPConnection

from skills.db.row_visibility import Only
from skills.errors import NotAllowed, NotFound, NotSignedIn
from skills.library.people.keys import LADDER
from skills.remedies import Action, Remedy
from skills.settings import Role

__all__ = ["LOCAL", "Asking", "Caller", "Needs", "Role", "needs", "open_to_all"]


@dataclass(frozen=True)
class Caller:
    """An authenticated caller.

    Attributes:
        name: The name that events record.
        role: The role.
        csrf: For a sign-in to the web page, the token that its requests must carry.
        key: The identity that rate limits count by; None: no limits.
        surgeons: The pseudonyms to which the key is restricted; None: all.
        only: The same restriction for queries; None: all.
    """

    name: str
    role: Role
    csrf: str | None = None
    key: str | None = None
    surgeons: frozenset[str] | None = None
    only: Only | None = None

    def must_be(self, role: Role) -> None:
        """Check that the caller has a role, or a higher one.

        Raises:
            NotAllowed: The caller's role is lower.
        """
        if LADDER.index(self.role) < LADDER.index(role):
            raise NotAllowed(
                f"This needs the role {role}, and the key has the role {self.role}; ask the operator of the "
                "service for another key."
            )


LOCAL = Caller("local", "admin")


@dataclass(frozen=True)
class Needs:
    """FastAPI dependency: the requirements of a route.

    Attributes:
        role: The lowest role that may call it; None: no authentication is needed.
        whole: Refuse keys that are restricted to some surgeons.
    """

    role: Role | None
    whole: bool = False

    async def __call__(self, request: HTTPConnection) -> None:
        """Check the caller of a request against the requirements.

        Raises:
            NotAllowed: The caller's role or restriction does not allow it.
            NotFound: The path names a surgeon whom the caller may not see.
        """
        if self.role is None:
            return
        caller = await _caller(request)
        caller.must_be(self.role)
        if caller.surgeons is None:
            return
        if self.whole:
            raise NotAllowed("This concerns the whole installation, and the key is restricted to some surgeons.")
        if request.path_params.get("surgeon", "") not in {"", *caller.surgeons}:
            # 404 and not 403, so that a restricted key cannot find out which surgeons exist
            raise NotFound(
                "There is no surgeon of this pseudonym among those that the key may see.", Remedy(Action.LIST_SURGEONS)
            )


def refuse_release(caller: Caller, wanted: bool) -> None:
    """Check that a training which also releases is requested by a releaser.

    Raises:
        NotAllowed: `wanted` is true, and the caller's role is below releaser.
    """
    if wanted:
        caller.must_be("releaser")


def needs(role: Role | None, *, whole: bool = False) -> Any:
    """Declare the requirements of a route, as `skills.api.openapi.gives` and its like do in its decorator."""
    return Depends(Needs(role, whole))


def open_to_all() -> Any:
    """Declare a route without authentication; `skills.api.gate.is_open` must list its path too."""
    return Depends(Needs(None))


async def _caller(request: HTTPConnection) -> Caller:
    """Return the caller that the middleware stored in the request's scope.

    Raises:
        NotSignedIn: The middleware stored none, because it treated the path as open.
    """
    caller: Caller | None = request.scope.get("caller")
    if caller is None:
        raise NotSignedIn("This needs a key.")
    return caller


Asking = Annotated[Caller, Depends(_caller)]
