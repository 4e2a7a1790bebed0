"""What is released: encoded once, kept in memory, and given at every request only if nothing has changed since."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Response
from fastapi.routing import APIRoute
from sqlalchemy.exc import SQLAlchemyError
from starlette._utils import get_route_path
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from skills.api.access import Needs
from skills.api.answers import KEPT_BYTES, Body, Encoded, answer, negotiate
from skills.db.changes import Unasked, changes_of
from skills.db.session import Database
from skills.errors import SkillsError, UnknownFormat
from skills.library import policies, verified
from skills.library.kept import Kept
from skills.library.releases import SERVED

Style = tuple[str, str, str]  # surgeon, suture type, and the media type that it is asked as

USUAL = frozenset({b"accept", b"if-none-match"})
READ = USUAL | {b"if-match"}
LONGEST = 500  # what is longer, the route looks at
SWEEP_S = 2.0  # for so long at most what was erased is still in memory; it is given no more from the first


@dataclass
class Known:
    """What a style serves, the release that it is, and the version of the database of which that is known."""

    body: Body
    release: tuple[Any, ...]  # as `SERVED` has it, the policy's digest last
    version: int | None


class Served:
    """The released policies of one process, for whoever may have them: nothing here depends on who asks."""

    def __init__(self, database: Database, encoded: Encoded) -> None:
        self._database = database
        self._encoded = encoded
        self._changes = changes_of(database)
        self._known: Kept[Style, Known] = Kept(KEPT_BYTES, lambda known: len(known.body.content))

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """See the changes of the database, on this event loop; outside of it, the tables are read at every request."""
        await self._changes.open()
        sweeping = asyncio.create_task(self._sweep())
        try:
            yield
        finally:
            sweeping.cancel()
            with suppress(asyncio.CancelledError):
                await sweeping
            await self._changes.close()

    def at_hand(self, surgeon: str, suture: str, media_type: str) -> Body | None:
        """Find what a style serves at this moment, if that can be told without waiting for anything."""
        version = self._changes.version()  # before the tables
        known = self._known.get((surgeon, suture, media_type))
        if known is None or version is None:
            return None
        if known.version != version:
            try:
                if self._changes.first(SERVED, {"surgeon": surgeon, "suture": suture}) != known.release:
                    return None
            except Unasked:
                return None
            known.version = version
        return known.body

    async def body(self, surgeon: str, suture: str, media_type: str) -> Body:
        """Find what a style serves at this moment.

        Raises:
            NotFound: Nothing; or there is no such style.
            Corrupt: What is stored is not what was certified.
        """
        return self.at_hand(surgeon, suture, media_type) or await self._read(surgeon, suture, media_type)

    async def _read(self, surgeon: str, suture: str, media_type: str) -> Body:
        version = self._changes.version()  # before the tables
        key = (surgeon, suture, media_type)
        try:
            known = await asyncio.to_thread(self._look, key)
        except SkillsError:
            self._known.forget([key])
            raise
        known.version = version
        self._known.put(key, known)
        return known.body

    def _look(self, key: Style) -> Known:
        """Read the tables: all of them as they are at one moment."""
        surgeon, suture, media_type = key
        with self._database.reading() as session:
            release = session.execute(SERVED, {"surgeon": surgeon, "suture": suture}).first()
            known = self._known.get(key)
            if known is not None and release is not None and known.release == tuple(release):
                return Known(known.body, known.release, None)
            served = policies.policy_of(session, surgeon, suture)
            assert release is not None, "both look at the same state"
            return Known(self._encoded.policy(served.policy, served.release, media_type), tuple(release), None)

    async def _sweep(self) -> None:
        """Let go of whatever is erased, though nobody asks for it any more."""
        while True:
            await asyncio.sleep(SWEEP_S)
            with suppress(SkillsError, SQLAlchemyError):  # a database that cannot be read now can be the next time
                await asyncio.to_thread(self.forget_erased)

    def forget_erased(self) -> None:
        """Let go of whatever is no longer in the database."""
        here = self._encoded.policies() | set(verified.remembered())
        if not here:
            return
        with self._database.reading() as session:
            gone = policies.missing(session, here)
        verified.forget(gone)
        self._encoded.forget(gone)
        self._known.forget([key for key, known in self._known.items() if known.release[-1] in gone])


class AtHand:
    """The shortest way to what is at hand: past all of the routing, but not past what the route needs of a caller.

    It stands inside the gate and outside the application. A request for which something must be looked up, or that
    asks for anything out of the ordinary, or that is to be refused, goes on to the route, which gives the same answers.
    """

    def __init__(self, app: ASGIApp, served: Served, endpoint: Callable[..., Any], router: APIRouter) -> None:
        """Take the path, and what is needed, from the route that a router has for an endpoint."""
        self.app = app
        self._served = served
        (self._route,) = (
            one
            for one in router.routes
            if isinstance(one, APIRoute) and one.endpoint is endpoint and one.include_in_schema
        )
        self._needs = [one.dependency for one in self._route.dependencies if isinstance(one.dependency, Needs)]
        assert len(self._needs) == len(self._route.dependencies) > 0, "nothing else is asked here"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send what is at hand, or pass the request on."""
        answered = self._find(scope) if scope["type"] == "http" and scope["method"] in ("GET", "HEAD") else None
        if answered is not None and await self._may(scope):
            await answered(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def _find(self, scope: Scope) -> Response | None:
        found = self._route.path_regex.match(get_route_path(scope))
        asked = None if found is None else _asked(scope["headers"])
        if found is None or asked is None:
            return None
        media_type, if_none_match = asked
        body = self._served.at_hand(found["surgeon"], found["suture"], media_type)
        if body is None:
            return None
        scope["route"], scope["path_params"] = self._route, found.groupdict()  # by which it is judged and counted
        return answer(body, if_none_match)

    async def _may(self, scope: Scope) -> bool:
        try:
            for needed in self._needs:
                await needed(Request(scope))
        except SkillsError:
            return False
        return True


def _asked(headers: list[tuple[bytes, bytes]]) -> tuple[str, str | None] | None:
    """Read the headers of a usual request: the media type that is chosen, and If-None-Match; None: it is another."""
    found: dict[bytes, bytes] = {}
    for name, value in headers:
        if name in READ:
            if name not in USUAL or name in found or len(value) > LONGEST:
                return None
            found[name] = value
    have = found.get(b"if-none-match")
    try:
        return negotiate(found.get(b"accept", b"*/*").decode("latin-1")), None if have is None else have.decode(
            "latin-1"
        )
    except UnknownFormat:
        return None
