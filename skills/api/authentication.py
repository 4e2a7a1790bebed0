"""Authentication of requests: middleware that checks host, origin and credentials before a request is processed.

The checks, in this order:

    host         the Host header must be a name of this service, because another site's name can be made to resolve to
                 its address (DNS rebinding)
    origin       a request that changes anything must not come from a page of another site (Origin, Sec-Fetch-Site)
    credentials  an API key; else the user named by an authenticating proxy; else the cookie of a sign-in; else, on
                 loopback with no proxy configured and no key ever created, a local user with the role admin
    rate         the limits of the key: requests per second, and bytes uploaded per day; wrong keys per address

The permissions that a route needs are declared in its decorator (`skills.api.authorisation`).

Each limit is a token bucket: it holds the amount that may be used at once and is refilled at a constant rate. The
buckets are in memory: they are full again after a restart, and several processes behind one address would each allow
the full rate; `skills serve` is one process. Jobs are counted in the database, for all processes together
(`skills.library.operation.jobs.refuse_too_many`).
"""

import asyncio
import hmac
import secrets
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar
from urllib.parse import quote

from anyio import CapacityLimiter, to_thread
from fastapi import Response
from sqlalchemy.orm import Session
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Receive, Scope, Send

from skills.api.authorisation import LOCAL, Caller
from skills.api.problems import answer_to
from skills.db import now
from skills.db.changes import WeightedCache
from skills.db.history import History
from skills.db.session import Database
from skills.errors import Busy, NotAllowed, NotSignedIn, SkillsError, TooMany, WrongHost
from skills.library.operation.locks import SIGN_INS
from skills.library.people.keys import SHAPE, Holder, digest_of, holders_of, is_keyless, is_owner
from skills.library.people.sign_ins import SignInLifetime, csrf_of, note_use, signed_in
from skills.remedies import Action, Remedy
from skills.settings import Settings

COOKIE = "skills_sign_in"
PROXY_SECRET = b"x-skills-proxy-secret"
SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
WEB_SOCKET = "WebSocket"  # a request to open one has no method here
OPEN = frozenset({"/healthz", "/openapi.json", "/docs", "/sign-in"})  # they reveal nothing of the stored data
OPEN_BELOW = "/static/"
# also for callers who were authenticated before the database failed
SAYS_WHAT_IS_WRONG = frozenset({"/readyz", "/metrics"})
# its route reads the CSRF token from the form body, for a browser without scripts
TOKEN_IN_FORM = frozenset({"/sign-out"})
WRONG_S = 10.0  # for so long a wrong key is refused without a query: no later key can equal it
GATHERED_S = 0.25  # delay after which unknown keys of a rate-limited address are looked up with one query
REMEMBERED_S = 1.0  # cache lifetime of a look-up: a key revoked by another process works at most this long
LOOKUPS = 4  # threads in a separate pool: a look-up must not wait for uploads that are being read
PATIENCE_MS = 2000
KEPT = 4096
HOW = Remedy(Action.SHOW_KEY)
ONCE = frozenset({b"host", b"origin", b"sec-fetch-site", b"authorization", b"x-api-key", b"x-csrf-token", PROXY_SECRET})

T = TypeVar("T")


def is_open(path: str) -> bool:
    """Return whether a path needs no authentication."""
    return path in OPEN or path.startswith(OPEN_BELOW)


@dataclass(frozen=True)
class _Remembered:
    """Cached result of looking up a key or cookie; `caller` and `holder` are None if it is not valid."""

    caller: Caller | None
    holder: Holder | None
    began: float  # when the look-up began


class Access:
    """Authentication of callers by key, cookie, proxy or loopback; one instance for each application.

    `own_key` authenticates this process at its own service; it is never shown or logged.
    """

    def __init__(self, database: Database, settings: Settings) -> None:
        self.own_key = secrets.token_urlsafe(32)
        self.limits = RateLimits(settings)
        self.lasts = SignInLifetime(settings.sign_in_idle_s, settings.sign_in_s)
        self._own_digest = digest_of(self.own_key)
        self._database = database
        # a separate pool, which slow requests cannot exhaust
        self._asked = Database.of(settings, patience_ms=PATIENCE_MS)
        self._settings = settings
        self._known: WeightedCache[str, _Remembered] = WeightedCache(KEPT)
        # wrong keys, with the time until which each is refused without a query
        self._wrong: WeightedCache[str, float] = WeightedCache(KEPT)
        self._changed = 0.0  # cache entries older than this are invalid
        self._keys = _Together(lambda keys: self._ask(holders_of, keys))
        self._cookies = _Together(lambda cookies: self._ask(signed_in, cookies, self.lasts))
        self._lookups = CapacityLimiter(LOOKUPS)
        self._keyless = not settings.beyond_loopback and settings.proxy_header is None
        self._keyless_until = 0.0

    async def by_key(self, text: str, address: str, *, stale: bool = False, counted: bool = True) -> Caller:
        """Return the caller to whom a key belongs.

        Args:
            text: The key as it was sent.
            address: The client's IP address, for the limit on wrong keys.
            stale: Accept an expired cache entry if the database is busy.
            counted: Count the request against the key's rate limit.

        Raises:
            NotSignedIn: The key is not valid, was revoked, or has expired.
            TooMany: The key exceeds its rate limit, or its address sent too many wrong keys.
        """
        digest = digest_of(text)
        if hmac.compare_digest(digest, self._own_digest):
            return LOCAL
        known = self._known.get(digest)
        # a text without the form of a key needs no query
        if SHAPE.fullmatch(text) and not self._is_fresh(known):
            began = time.monotonic()
            try:
                holder = await self._find(self._keys, text, digest, address, known is None)
            except Busy:
                if known is None or not stale:
                    raise
            else:
                known = self._remember(digest, holder, None, began)
        if known is None:
            raise NotSignedIn("This is not a key of suture-skills: keys begin with skills_.", HOW)
        return self._let_in(known, "The key is unknown to this service, revoked or expired.", counted)

    async def by_cookie(self, cookie: str, address: str, *, counted: bool = True) -> Caller | None:
        """Return the caller who is signed in with a cookie, or None if the cookie is not valid."""
        digest = f"cookie {digest_of(cookie)}"  # a prefix, so that a key is never accepted as a cookie or the reverse
        known = self._known.get(digest)
        if known is None or not self._is_fresh(known):
            began = time.monotonic()
            try:
                found = await self._find(self._cookies, cookie, digest, address, known is None)
            except TooMany:
                return None
            if found is not None and found[1] and counted:
                with suppress(Busy):  # then the next look-up notes the use
                    await self.write(lambda session: note_use(session, cookie))
            known = self._remember(digest, found and found[0], csrf_of(cookie), began)
        over = "The key of this sign-in has expired."
        return None if known.caller is None else self._let_in(known, over, counted)

    def by_proxy(self, person: bytes | None, secret: bytes | None) -> Caller | None:
        """Return the caller whom an authenticating proxy names, or None if it names none.

        Raises:
            NotSignedIn: The secret is not the proxy's, or no proxy is configured.
        """
        expected = self._settings.proxy_secret
        if self._settings.proxy_header is None or expected is None:
            if secret is not None:
                raise NotSignedIn(
                    "The request has the secret of a proxy, but this service has none configured; set "
                    "SKILLS_PROXY_HEADER."
                )
            return None
        if person is None and secret is None:
            return None
        if not hmac.compare_digest(secret or b"", expected.get_secret_value().encode()):
            raise NotSignedIn(
                "Only the configured proxy may name the caller, and this request does not have its secret."
            )
        if person is None:
            return None
        name = person.decode("latin-1")
        if not is_owner(name):
            raise NotSignedIn("The name that the proxy sent is not valid; use 1 to 64 letters, digits, spaces or ._@-.")
        return Caller(name, self._settings.proxy_role, key=f"proxy {name}")

    async def locally(self, *, stale: bool = False) -> Caller | None:
        """Return the local caller if no key is needed, else None.

        None is needed on loopback, without a configured proxy, as long as no key was ever created.

        With `stale`, a busy database is tolerated and the last known answer is used.
        """
        if self._keyless and time.monotonic() > self._keyless_until:
            began = time.monotonic()
            try:
                self._keyless = await self._ask(is_keyless)
                self._keyless_until = began + REMEMBERED_S
            except Busy:
                if not (stale and self._keyless_until):
                    raise
        return LOCAL if self._keyless else None

    async def write(self, change: Callable[[Session], T]) -> T:
        """Run a change of sign-ins in a transaction, in a thread; call `forget` after one that ends a sign-in."""

        def write() -> T:
            with self._database.writing([SIGN_INS]) as session:
                return change(session)

        return await to_thread.run_sync(write)

    def close(self) -> None:
        """Close the database connections."""
        self._asked.close()

    def forget(self) -> None:
        """Invalidate the cached look-ups, because this process created or revoked a key, or ended a sign-in.

        Entries stay in the cache: a known key is looked up again as known, and does not count as an unknown one.
        """
        self._changed, self._keyless_until = time.monotonic(), 0.0

    def _is_fresh(self, known: _Remembered | None) -> bool:
        """Return whether a cached look-up is valid; a key revoked elsewhere works for at most `REMEMBERED_S`."""
        return known is not None and self._changed < known.began and time.monotonic() <= known.began + REMEMBERED_S

    async def _find(self, asked: "_Together[T]", text: str, digest: str, address: str, stranger: bool) -> T | None:
        """Look up a key or cookie; unknown ones beyond the limit of their address are looked up in batches.

        A valid key is always found: a caller who shares an address with somebody who guesses keys waits for one batch,
        once.

        Raises:
            Busy: The database cannot be queried.
            TooMany: The key is wrong, and so were too many before it.
        """
        if not stranger:
            return (await asked.find([text])).get(text)
        if time.monotonic() < (self._wrong.get(digest) or 0.0):
            return None
        wait_s = self.limits.stranger(address)
        found = (await (asked.find([text]) if wait_s == 0 else asked.wait_for(text))).get(text)
        if found is not None:
            if wait_s == 0:
                self.limits.acquainted(address)
            return found
        self._wrong.put(digest, time.monotonic() + WRONG_S)
        if wait_s > 0:
            raise TooMany("Too many wrong keys came from this address; wait.", wait_s)
        return None

    def _remember(self, digest: str, holder: Holder | None, csrf: str | None, began: float) -> _Remembered:
        """Cache the result of a look-up that began at `began`; an invalid key is removed from the cache."""
        if holder is None:
            self._known.forget([digest])
            return _Remembered(None, None, began)
        caller = Caller(holder.owner, holder.role, csrf, holder.key, holder.surgeons, holder.only)
        known = _Remembered(caller, holder, began)
        self._known.put(digest, known)
        return known

    def _let_in(self, known: _Remembered, otherwise: str, counted: bool) -> Caller:
        if known.caller is None or known.holder is None or not known.holder.counts(now()):
            raise NotSignedIn(otherwise, HOW)
        if counted:
            self.limits.request(known.holder.key)
        return known.caller

    async def _ask(self, question: Callable[..., T], *about: object) -> T:
        def ask() -> T:
            with self._asked.reading() as session:
                return question(session, *about)

        return await to_thread.run_sync(ask, limiter=self._lookups)


class _Together(Generic[T]):
    """Look-ups of keys or cookies: `find` queries now, `wait_for` joins the next batch, one each `GATHERED_S`."""

    def __init__(self, look: Callable[[list[str]], Awaitable[dict[str, T]]]) -> None:
        self.find = look
        self._waiting: set[str] = set()
        self._gathering: asyncio.Task[dict[str, T]] | None = None

    async def wait_for(self, text: str) -> dict[str, T]:
        """Wait for the next batch, and return everything that it found."""
        self._waiting.add(text)
        if self._gathering is None:
            self._gathering = asyncio.create_task(self._gather())
        return await asyncio.shield(self._gathering)  # a disconnecting client must not cancel the batch for the others

    async def _gather(self) -> dict[str, T]:
        await asyncio.sleep(GATHERED_S)
        texts, self._waiting, self._gathering = list(self._waiting), set(), None
        return await self.find(texts)


class Gate:
    """ASGI middleware that refuses unauthenticated requests, and sets `scope["caller"]` for the routes."""

    def __init__(self, app: ASGIApp, access: Access, settings: Settings, history: History) -> None:
        self.app = app
        self._access = access
        self._history = history
        self._names = settings.host_names
        self._person = None if settings.proxy_header is None else settings.proxy_header.lower().encode()
        self._once = ONCE if self._person is None else ONCE | {self._person}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with the problem document of its refusal."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        try:
            headers = self._read(scope)
            _refuse_wrong_host(headers, self._names)
            # No same-origin policy holds for WebSockets, so the origin of one is checked as that of a change.
            _refuse_foreign(scope.get("method", WEB_SOCKET), headers)
            if not is_open(path := _path(scope)):
                if self._history.refused is not None and path not in SAYS_WHAT_IS_WRONG:
                    raise self._history.refused  # before a key is looked up, among those of another database
                scope["caller"] = await self._caller(scope, headers)
                # a stream repeats the check while it is open; without the scope, which would be a reference cycle
                scope["ask_again"] = self.ask_again
        except SkillsError as error:
            await _refusal(scope, error)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    async def ask_again(self, scope: Scope) -> Caller:
        """Authenticate a request once more, without counting it.

        Raises:
            NotSignedIn: Its credentials are no longer valid.
        """
        return await self._caller(scope, self._read(scope), counted=False)

    def _read(self, scope: Scope) -> dict[bytes, bytes]:
        """Return the headers by name.

        Raises:
            NotAllowed: A header that decides about the caller appears twice.
        """
        headers: dict[bytes, bytes] = {}
        for name, value in scope["headers"]:
            if name in headers and name in self._once:
                raise NotAllowed("A header that identifies the caller or the host was sent twice; send it once.")
            headers[name] = value
        return headers

    async def _caller(self, scope: Scope, headers: dict[bytes, bytes], *, counted: bool = True) -> Caller:
        """Return the caller of a request.

        Raises:
            NotSignedIn: There are no valid credentials.
            NotAllowed: A request with a cookie does not carry the CSRF token of its page.
        """
        # first, because it refuses a request that pretends to come from the proxy, whatever else it carries
        proxied = self._access.by_proxy(headers.get(self._person) if self._person else None, headers.get(PROXY_SECRET))
        key, stale = _key(headers), _path(scope) in SAYS_WHAT_IS_WRONG
        address = scope["client"][0] if scope.get("client") else ""
        if key is not None:
            return await self._access.by_key(key, address, stale=stale, counted=counted)
        if proxied is not None:
            if counted:
                self._access.limits.request(str(proxied.key))
            return proxied
        cookie = cookie_parser(headers.get(b"cookie", b"").decode("latin-1")).get(COOKIE)
        caller = await self._access.by_cookie(cookie, address, counted=counted) if cookie else None
        if caller is not None:
            if scope.get("method", "GET") not in SAFE and _path(scope) not in TOKEN_IN_FORM:
                refuse_without_token(caller, headers.get(b"x-csrf-token", b"").decode("latin-1"))
            return caller
        caller = await self._access.locally(stale=stale)
        if caller is None:
            raise NotSignedIn("This service requires a key, and the request has none.", HOW)
        return caller


def refuse_without_token(caller: Caller, token: str) -> None:
    """Check the CSRF token of a request that is authenticated by a cookie.

    Raises:
        NotAllowed: The token is missing, or is not that of this sign-in.
    """
    if not caller.csrf or not hmac.compare_digest(token.encode(), caller.csrf.encode()):
        raise NotAllowed(
            "The request lacks the page's token (X-CSRF-Token), or it is out of date; load the page again."
        )


def _key(headers: dict[bytes, bytes]) -> str | None:
    """Return the API key of a request, or None if it has none.

    Raises:
        NotSignedIn: There are two keys, or the Authorization scheme is not Bearer.
    """
    bearer, plain = headers.get(b"authorization"), headers.get(b"x-api-key")
    if bearer is None:
        return None if plain is None else plain.decode("latin-1")
    kind, _, key = bearer.decode("latin-1").partition(" ")
    if kind.lower() != "bearer" or plain is not None:
        raise NotSignedIn("The request has two keys, or one in a form that this service does not support.", HOW)
    return key.strip()


def _refuse_wrong_host(headers: dict[bytes, bytes], names: frozenset[str]) -> None:
    """Refuse a request for another host name: a site could resolve its own name to this service, and act as its user.

    Raises:
        WrongHost: The Host header is not a name of this service.
    """
    host = headers.get(b"host", b"").decode("latin-1").lower()
    name = host[: host.rfind("]") + 1] if host.startswith("[") else host.partition(":")[0]
    if name not in names:
        raise WrongHost("The host name of the request is not one of this service; list it in SKILLS_HOSTS.")


def _refuse_foreign(method: str, headers: dict[bytes, bytes]) -> None:
    """Refuse a change that a page of another site requests through the browser of a signed-in user.

    Raises:
        NotAllowed: Origin or Sec-Fetch-Site names another site.
    """
    if method in SAFE:
        return
    origin, site = headers.get(b"origin"), headers.get(b"sec-fetch-site")
    foreign = site not in (None, b"same-origin", b"none")
    if origin is not None:
        foreign = foreign or origin.partition(b"://")[2].lower() != headers[b"host"].lower()
    if foreign:
        raise NotAllowed(
            "The request comes from a page of another site; only this service's own pages and programs may send it."
        )


def _refusal(scope: Scope, error: SkillsError) -> Response:
    """Return the problem document of an error; a browser that is not signed in is redirected to the sign-in page."""
    accept = next((value for name, value in scope["headers"] if name == b"accept"), b"")
    if isinstance(error, NotSignedIn) and scope.get("method") in ("GET", "HEAD") and accept.startswith(b"text/html"):
        asked = _path(scope) + ("?" + scope["query_string"].decode("latin-1") if scope["query_string"] else "")
        where = f"{scope.get('root_path', '')}/sign-in" + ("" if asked == "/" else f"?next={quote(asked)}")
        return Response(status_code=303, headers={"Location": where, "Cache-Control": "no-store"})
    return answer_to(error)


def _path(scope: Scope) -> str:
    """Return the request's path as the routes know it, without the prefix of a reverse proxy."""
    path: str = scope["path"]
    prefix: str = scope.get("root_path", "")
    return path.removeprefix(prefix) if path.startswith(f"{prefix}/") else path


BURST_S = 2.0  # a web page sends all of its requests at once
DAY_S = 86_400.0
# Unknown keys and cookies that are looked up at once, per address and in all: 256 bits cannot be guessed, but the
# look-ups load the database. Further ones are looked up in batches, not refused: an address may be a hospital's.
BAD_AT_ONCE, BAD_PER_S = 20, 20 / 60
BAD_OF_ALL_AT_ONCE, BAD_OF_ALL_PER_S = 200, 10.0
# keys and addresses with a bucket; the least recently used bucket is dropped, and is full when it is created anew
MOST = 4096


class Bucket:
    """A token bucket of capacity `most`, refilled by `per_s` each second."""

    def __init__(self, most: float, per_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._per_s, self._clock = most, per_s, clock
        self._left, self._at = most, clock()

    def take(self, amount: float) -> float:
        """Take an amount and return 0; if there is not enough, take nothing and return the seconds until there is."""
        at = self._clock()
        self._left = min(self._most, self._left + (at - self._at) * self._per_s)
        self._at = at
        if amount <= self._left:
            self._left -= amount
            return 0.0
        return (amount - self._left) / self._per_s


class RateLimits:
    """The token buckets of all keys, and of addresses that send wrong keys."""

    def __init__(self, settings: Settings, clock: Callable[[], float] = time.monotonic) -> None:
        per_s, per_day = settings.key_requests_per_s, settings.key_upload_bytes_per_day
        self._requests = _Buckets(lambda: Bucket(max(1.0, per_s * BURST_S), per_s, clock))
        self._bytes = _Buckets(lambda: Bucket(per_day, per_day / DAY_S, clock))
        self._wrong = _Buckets(lambda: Bucket(BAD_AT_ONCE, BAD_PER_S, clock))
        self._wrong_of_all = Bucket(BAD_OF_ALL_AT_ONCE, BAD_OF_ALL_PER_S, clock)

    def request(self, key: str) -> None:
        """Count a request.

        Raises:
            TooMany: The key exceeds its requests per second.
        """
        self._refuse(
            self._requests.of(key).take(1), "This key sends too many requests; wait, and send fewer per second."
        )

    def upload(self, key: str, size: int) -> None:
        """Count bytes of an upload.

        Raises:
            TooMany: The key exceeds its upload bytes per day.
        """
        self._refuse(
            self._bytes.of(key).take(size), "This key has used up its upload allowance of a day; continue later."
        )

    def stranger(self, address: str) -> float:
        """Count an unknown key or cookie before its look-up; return 0, or the seconds until the next is allowed.

        If the result is not 0, nothing is counted; if the look-up succeeds, `acquainted` returns the token.
        """
        wait_s = self._wrong.of(address).take(1)
        if wait_s == 0 and (wait_s := self._wrong_of_all.take(1)) > 0:
            self._wrong.of(address).take(-1)
        return wait_s

    def acquainted(self, address: str) -> None:
        """Return the token that `stranger` took, for a key that proved to be valid."""
        self._wrong.of(address).take(-1)
        self._wrong_of_all.take(-1)

    @staticmethod
    def _refuse(wait_s: float, why: str) -> None:
        if wait_s > 0:
            raise TooMany(why, wait_s)


class _Buckets:
    """A bucket for each name, created at its first use."""

    def __init__(self, new: Callable[[], Bucket]) -> None:
        self._new = new
        self._kept: WeightedCache[str, Bucket] = WeightedCache(MOST)

    def of(self, name: str) -> Bucket:
        bucket = self._kept.get(name)
        if bucket is None:
            bucket = self._new()
            self._kept.put(name, bucket)
        return bucket
