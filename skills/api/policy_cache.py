"""Cache of released policies: encoded once, served from memory, and validated against the database at every request.

The end of a surgeon's consent changes nothing in the database, so its last day is cached with the response.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import date
from threading import Event, Thread
from typing import Any

from fastapi import APIRouter, Response
from fastapi.routing import APIRoute
from sqlalchemy.exc import SQLAlchemyError
from starlette._utils import get_route_path
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from skills.api.authorisation import Needs
from skills.api.encoded_policies import FORMATS, KEPT_BYTES, Encoded
from skills.api.responses import Body, Conditions, negotiate
from skills.db.changes import Unasked, changes_of
from skills.db.session import Database
from skills.db.weighted_cache import WeightedCache
from skills.errors import Busy, SkillsError, UnknownFormat
from skills.library.comparison import neighbours
from skills.library.operation import integrity
from skills.library.operation.history import is_last_signed, sign_history
from skills.library.operation.proofs import first_head
from skills.library.people import consent
from skills.library.policies import versions
from skills.library.policies.releases import NEWEST_RELEASE

Style = tuple[str, str, str]  # surgeon, suture type, and media type of the response, or `POSES`, or `SIGNATURE`

POSES = "pose-style"  # the response is the pose style, as JSON
SIGNATURE = "signature"  # the response is the signature of the others
USUAL = frozenset({b"accept", b"if-none-match"})
READ = USUAL | {b"if-match"}
LONGEST = 500  # a longer header is left to the route
# An erased policy leaves memory within this time; it is not served from the erasure on. A database that was put back to
# an older copy under the running service is noticed within this time; no policy is read from it before.
SWEEP_S = 2.0


@dataclass
class Known:
    """A cached response: a style's policy, its release, and the database version at which both were valid."""

    body: Body
    release: tuple[Any, ...]  # the row of the query `NEWEST_RELEASE`; its last column is the policy's digest
    last_day: date | None  # of the surgeon's consent
    version: int | None

    @property
    def over(self) -> bool:
        """Return whether the last day of consent has passed, so that the policy must not be served."""
        return self.last_day is not None and not consent.today() <= self.last_day


class PolicyCache:
    """The released policies cached by one process. They are the same for all callers, who were authorised before."""

    def __init__(self, database: Database, encoded: Encoded) -> None:
        self._database = database
        self._encoded = encoded
        self.changes = changes_of(database)
        self._known: WeightedCache[Style, Known] = WeightedCache(KEPT_BYTES, lambda known: len(known.body.content))

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Track changes of the database on this event loop; outside this context every request reads the tables."""
        await self.changes.open()
        over = Event()
        sweeper = Thread(target=self._sweep, args=(over,), name="sweep")
        sweeper.start()
        try:
            yield
        finally:
            over.set()
            await asyncio.to_thread(sweeper.join)
            await self.changes.close()

    def cached(self, surgeon: str, suture: str, media_type: str) -> Body | None:
        """Return the current policy of a style from the cache; None if that would need a query that blocks."""
        version = self.changes.version()  # read before the tables, so that a commit in between is not missed
        known = self._known.get((surgeon, suture, media_type))
        if known is None or version is None or known.over:
            return None
        if known.version != version:
            try:
                if self.changes.first(NEWEST_RELEASE, {"surgeon": surgeon, "suture": suture}) != known.release:
                    return None
            except Unasked:
                return None
            known.version = version
        return known.body

    async def body(self, surgeon: str, suture: str, media_type: str) -> Body:
        """Return the current policy of a style, from the cache or else from the database.

        Raises:
            NotFound: The style does not exist, or has no released policy.
            Corrupt: The stored policy does not match the digest that was certified.
        """
        return self.cached(surgeon, suture, media_type) or await self._read(surgeon, suture, media_type)

    async def _read(self, surgeon: str, suture: str, media_type: str) -> Body:
        version = self.changes.version()  # read before the tables, so that a commit in between is not missed
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
        """Read the tables, and where a signature needs it sign the history before.

        Raises:
            Busy: The history cannot be signed now.
        """
        for _ in range(2):
            if (known := self._seen(key)) is not None:
                return known
            sign_history(self._database)
        raise Busy("The history is not signed up to this release yet; try again in a second.")

    def _seen(self, key: Style) -> Known | None:
        """Read the tables, all within one transaction; None where the release is under no signed checkpoint yet."""
        surgeon, suture, media_type = key
        saved = self._database.history.saved_head()
        with self._database.reading() as session:
            self._database.history.compare(session.connection(), saved)
            release = session.execute(NEWEST_RELEASE, {"surgeon": surgeon, "suture": suture}).first()
            known = self._known.get(key)
            if known is not None and release is not None and known.release == tuple(release) and not known.over:
                return Known(known.body, known.release, known.last_day, None)
            served = versions.served_release(session, surgeon, suture)
            assert release is not None, "both look at the same state"
            if media_type == SIGNATURE:
                rows = [("releases", served.row), ("policy_versions", served.policy_row)]
                head = first_head(session.connection(), self._database.history, rows)
                if head is None:
                    return None
                body = self._encoded.signature(served, head, self._database.history)
            elif media_type == POSES:
                body = self._encoded.pose_style(served.policy)
            else:
                body = self._encoded.policy(served.policy, served, media_type)
            return Known(body, tuple(release), consent.last_day(served.policy.surgeon.consent), None)

    def _sweep(self, over: Event) -> None:
        """Compare the database with its saved head, and remove erased policies from memory, periodically."""
        while not over.wait(SWEEP_S):
            with suppress(SkillsError, SQLAlchemyError):  # the database may be readable again at the next sweep
                is_last_signed(self._database)  # sets `History.refused`
                self.forget_erased()
                neighbours.forget_gone(self._database)

    def forget_erased(self) -> None:
        """Remove from memory every policy that is no longer in the database."""
        here = self._encoded.policies() | set(integrity.remembered())
        if not here:
            return
        with self._database.reading() as session:
            gone = versions.missing(session, here)
        integrity.forget(gone)
        self._encoded.forget(gone)
        self._known.forget([key for key, known in self._known.items() if known.release[-1] in gone])


class CachedPolicyMiddleware:
    """ASGI middleware that answers GET of a released policy from the cache: no routing, but the route's authorisation.

    It stands between the authentication and the application. A request that needs a query, has an unusual header or is
    to be refused goes on to the route, which gives the same answers.
    """

    def __init__(self, app: ASGIApp, served: PolicyCache, endpoint: Callable[..., Any], router: APIRouter) -> None:
        """Take the path, and the role that it needs, from the route that a router has for an endpoint."""
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
        """Send the cached response, or pass the request on."""
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
        body = self._served.cached(found["surgeon"], found["suture"], media_type)
        if body is None:
            return None
        # read by the authorisation and by the metrics
        scope["route"], scope["path_params"] = self._route, found.groupdict()
        return Conditions(None, if_none_match).answer(body)

    async def _may(self, scope: Scope) -> bool:
        try:
            for needed in self._needs:
                await needed(Request(scope))
        except SkillsError:
            return False
        return True


def _asked(headers: list[tuple[bytes, bytes]]) -> tuple[str, str | None] | None:
    """Return the negotiated media type and If-None-Match; None if a header is unusual, repeated or too long."""
    found: dict[bytes, bytes] = {}
    for name, value in headers:
        if name in READ:
            if name not in USUAL or name in found or len(value) > LONGEST:
                return None
            found[name] = value
    said = {name: value.decode("latin-1") for name, value in found.items()}
    try:
        return negotiate(said.get(b"accept", "*/*"), *FORMATS), said.get(b"if-none-match")
    except UnknownFormat:
        return None
