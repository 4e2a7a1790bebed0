"""Look-ups of callers: by API key, by the cookie of a sign-in, by an authenticating proxy, or on loopback.

Each result is cached for a moment, and wrong keys are looked up in batches, so that guesses do not load the database.
"""

import asyncio
import hmac
import secrets
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

from anyio import CapacityLimiter, to_thread
from sqlalchemy.orm import Session

from skills.api.authorisation import LOCAL, Caller
from skills.api.rate_limits import RateLimits
from skills.db import now
from skills.db.session import Database
from skills.db.weighted_cache import WeightedCache
from skills.errors import Busy, NotSignedIn, TooMany
from skills.library.operation.locks import SIGN_INS
from skills.library.people.keys import SHAPE, Holder, digest_of, holders_of, is_keyless, is_owner
from skills.library.people.sign_ins import SignInLifetime, csrf_of, note_use, signed_in
from skills.remedies import Action, Remedy
from skills.settings import Settings

WRONG_S = 10.0  # for so long a wrong key is refused without a query: no later key can equal it
GATHERED_S = 0.25  # delay after which unknown keys of a rate-limited address are looked up with one query
REMEMBERED_S = 1.0  # cache lifetime of a look-up: a key revoked by another process works at most this long
LOOKUPS = 4  # threads in a separate pool: a look-up must not wait for uploads that are being read
PATIENCE_MS = 2000
KEPT = 4096
HOW = Remedy(Action.SHOW_KEY)
T = TypeVar("T")


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
        self._keys = _BatchedLookup(lambda keys: self._ask(holders_of, keys))
        self._cookies = _BatchedLookup(lambda cookies: self._ask(signed_in, cookies, self.lasts))
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

    async def _find(self, asked: "_BatchedLookup[T]", text: str, digest: str, address: str, stranger: bool) -> T | None:
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


class _BatchedLookup(Generic[T]):
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
