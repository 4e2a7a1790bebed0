"""Who asks, and what they may do: the ladder of roles, and what every route's decorator says that it needs.

`skills.api.gate` finds out who asks, before anything else is done with a request; here it is compared with what the
route needs. What belongs to surgeons whom the caller may not see is kept from them twice: a path with `{surgeon}` is
answered 404 here, and every query leaves out what is not theirs (`skills.db.seen`), so that lists, digests and job ids
are covered without being named.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, Request

from skills.db.seen import Only
from skills.errors import NotAllowed, NotFound, NotSignedIn
from skills.library.keys import LADDER
from skills.settings import Role

__all__ = ["LOCAL", "Asking", "Caller", "Needs", "Role", "erasing_is_for_admins", "needs", "open_to_all"]


@dataclass(frozen=True)
class Caller:
    """Who asks: the name that events have, the role, and, of a page, the token that its requests must carry.

    `key` is what limits count by; None: there are none. `surgeons` are the pseudonyms that the key is restricted to,
    and `only` is the same for queries; None: all.
    """

    name: str
    role: Role
    csrf: str | None = None
    key: str | None = None
    surgeons: frozenset[str] | None = None
    only: Only | None = None

    def must_be(self, role: Role) -> None:
        """Refuse what the caller's role does not allow.

        Raises:
            NotAllowed: It stands lower on the ladder.
        """
        if LADDER.index(self.role) < LADDER.index(role):
            raise NotAllowed(
                f"This needs the role {role}, and the key is a {self.role}'s; ask who runs this for another."
            )


LOCAL = Caller("local", "admin")


@dataclass(frozen=True)
class Needs:
    """What a route needs of its caller: a role, None: nothing at all; `whole`, a key that is not restricted."""

    role: Role | None
    whole: bool = False

    async def __call__(self, request: Request) -> None:
        """Compare it with who asks.

        Raises:
            NotAllowed: The caller's role or restriction does not allow it.
            NotFound: It is about a surgeon whom the caller may not see.
        """
        if self.role is None:
            return
        caller = await _caller(request)
        caller.must_be(self.role)
        if caller.surgeons is None:
            return
        if self.whole:
            raise NotAllowed("This is about the whole installation, and the key is restricted to some surgeons.")
        if request.path_params.get("surgeon", "") not in {"", *caller.surgeons}:
            raise NotFound("There is no such surgeon; GET /surgeons lists them.")


def refuse_release(caller: Caller, wanted: bool) -> None:
    """Leave releasing to releasers, also where it is asked for together with a training.

    Raises:
        NotAllowed: It is wanted, and the caller is none.
    """
    if wanted:
        caller.must_be("releaser")


def needs(role: Role, *, whole: bool = False) -> Any:
    """Declare what a route needs, in its decorator: `dependencies=[needs("trainer")]`."""
    return Depends(Needs(role, whole))


def open_to_all() -> Any:
    """Declare that a route answers anybody; `skills.api.gate.is_open` must know its path too."""
    return Depends(Needs(None))


async def _caller(request: Request) -> Caller:
    """Say who asks; the gate has found it out.

    Raises:
        NotSignedIn: It has not, for it took the path for one that is open to all.
    """
    caller: Caller | None = request.scope.get("caller")
    if caller is None:
        raise NotSignedIn("This needs a key.")
    return caller


async def _erasing(caller: Annotated[Caller, Depends(_caller)], erase: bool = False) -> None:
    """Leave erasing to admins, whatever the route needs besides."""
    if erase:
        caller.must_be("admin")


Asking = Annotated[Caller, Depends(_caller)]
erasing_is_for_admins = Depends(_erasing)
