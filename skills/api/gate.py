"""The gate: before anything is done with a request, where it was sent to, from where, and by whom.

    name         the Host header must be a name of this service: another site's name may be made to lead here
    site         what changes anything must not come from another site's page (Origin, Sec-Fetch-Site)
    who          a key; else what an authenticating proxy says; else a sign-in's cookie; else, on loopback where no key
                 was ever made, somebody on this machine, who is an admin
    how often    as the key may

What a route needs of who asks, its decorator says (`skills.api.access`).
"""

import hmac
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar
from urllib.parse import quote

from anyio import CapacityLimiter, to_thread
from fastapi import Response
from sqlalchemy.orm import Session
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Receive, Scope, Send

from skills.api.access import LOCAL, Caller
from skills.api.limits import Limits
from skills.api.problems import answer_to
from skills.db.base import now
from skills.db.session import Database
from skills.errors import Busy, NotAllowed, NotSignedIn, SkillsError, WrongHost
from skills.library.kept import Kept
from skills.library.keys import SHAPE, Holder, digest_of, holder_of, is_keyless, is_owner
from skills.library.sign_ins import Lasts, csrf_of, note_use, signed_in
from skills.settings import Settings

COOKIE = "skills_sign_in"
PROXY_SECRET = b"x-skills-proxy-secret"
SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
OPEN = frozenset({"/healthz", "/openapi.json", "/docs", "/sign-in"})  # they say nothing of what is stored
OPEN_BELOW = "/static/"
SAYS_WHAT_IS_WRONG = frozenset({"/readyz", "/metrics"})  # also to whoever was let in before the database went away
TOKEN_IN_FORM = frozenset({"/sign-out"})  # its route looks for the token where a form without script has it
REMEMBERED_S = 1.0  # a key that was looked up is not looked up again for so long: a revoked one works on no longer
LOOKUPS = 4  # threads of their own: a look-up must not wait for uploads that are being read
PATIENCE_MS = 2000
KEPT = 4096
HOW = "Show a key: `Authorization: Bearer KEY` or `X-API-Key: KEY`; people sign in at /sign-in."
ONCE = frozenset({b"host", b"origin", b"sec-fetch-site", b"authorization", b"x-api-key", b"x-csrf-token", PROXY_SECRET})

T = TypeVar("T")


def is_open(path: str) -> bool:
    """Tell whether anybody may ask for a path."""
    return path in OPEN or path.startswith(OPEN_BELOW)


@dataclass(frozen=True)
class _Remembered:
    """Whose a key or cookie was found to be, None: nobody's any more; and until when that is believed."""

    caller: Caller | None
    holder: Holder | None
    until: float


class Access:
    """Who asks. One for each application; `own_key` lets this process in to itself, and is told to nobody."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self.own_key = secrets.token_urlsafe(32)
        self.limits = Limits(settings)
        self.lasts = Lasts(settings.sign_in_idle_s, settings.sign_in_s)
        self._own_digest = digest_of(self.own_key)
        self._database = database
        self._asked = Database(database.url, patience_ms=PATIENCE_MS)  # its connections are not those of slow requests
        self._settings = settings
        self._known: Kept[str, _Remembered] = Kept(KEPT)
        self._lookups = CapacityLimiter(LOOKUPS)
        self._keyless = not settings.beyond_loopback and settings.proxy_header is None
        self._keyless_until = 0.0

    async def by_key(self, text: str, address: str, *, stale: bool = False) -> Caller:
        """Say who shows a key; with `stale` as it was known last, where the database cannot be asked.

        Raises:
            NotSignedIn: The key is none, was revoked, or has run out.
            TooMany: It asks too often, or its address showed too many wrong ones.
        """
        digest = digest_of(text)
        if hmac.compare_digest(digest, self._own_digest):
            return LOCAL
        known = self._known.get(digest)
        if SHAPE.fullmatch(text) and (known is None or time.monotonic() > known.until):
            if known is None:
                self.limits.wrong_key(address)
            began = time.monotonic()
            try:
                holder = await self._ask(holder_of, text)
            except Busy:
                if known is None or not stale:
                    raise
            else:
                if known is None and holder is not None:
                    self.limits.right_key(address)
                known = self._remember(digest, holder, None, began, known is not None)
        if known is None:
            raise NotSignedIn(f"This is no key. {HOW}")
        return self._let_in(known, "The key is none of this service, or was revoked, or has run out.")

    async def by_cookie(self, cookie: str) -> Caller | None:
        """Say who is signed in with a cookie; None: nobody."""
        digest = f"cookie {digest_of(cookie)}"  # a key is no cookie, nor a cookie a key
        known = self._known.get(digest)
        if known is None or time.monotonic() > known.until:
            began = time.monotonic()
            found = await self._ask(signed_in, cookie, self.lasts)
            if found is not None and found[1]:
                with suppress(Busy):  # it is noted at the next look-up, then
                    await self.write(lambda session: note_use(session, cookie))
            known = self._remember(digest, found and found[0], csrf_of(cookie), began, known is not None)
        return None if known.caller is None else self._let_in(known, "The key that was signed in with has run out.")

    def by_proxy(self, person: bytes | None, secret: bytes | None) -> Caller | None:
        """Say whom an authenticating proxy names; None: it names nobody.

        Raises:
            NotSignedIn: It was not the proxy, or no proxy is known here.
        """
        expected = self._settings.proxy_secret
        if self._settings.proxy_header is None or expected is None:
            if secret is not None:
                raise NotSignedIn("No proxy is known here that may say who asks; SKILLS_PROXY_HEADER makes one known.")
            return None
        if person is None and secret is None:
            return None
        if not hmac.compare_digest(secret or b"", expected.get_secret_value().encode()):
            raise NotSignedIn("Only the proxy in front may say who asks, and this did not come from it.")
        if person is None:
            return None
        name = person.decode("latin-1")
        if not is_owner(name):
            raise NotSignedIn(
                "The proxy named nobody by a name that can be one: 1 to 64 letters, digits, spaces or ._@-."
            )
        return Caller(name, self._settings.proxy_role, key=f"proxy {name}")

    async def locally(self, *, stale: bool = False) -> Caller | None:
        """Say whether somebody on this machine needs no key: on loopback, as long as none was ever made."""
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
        """Change keys or sign-ins, and look each up again from then on."""

        def write() -> T:
            with self._database.writing() as session:
                return change(session)

        done = await to_thread.run_sync(write)
        self.forget()
        return done

    def close(self) -> None:
        """Close the connections."""
        self._asked.close()

    def forget(self) -> None:
        """Look every key up again: one was made or revoked in this process."""
        self._known, self._keyless_until = Kept(KEPT), 0.0

    def _remember(self, digest: str, holder: Holder | None, csrf: str | None, began: float, seen: bool) -> _Remembered:
        """Remember whose a key or cookie was when the look-up began; of what never counted nothing is kept."""
        until = began + REMEMBERED_S
        if holder is None:
            nobody = _Remembered(None, None, until)
            if seen:
                self._known.put(digest, nobody)
            return nobody
        caller = Caller(holder.owner, holder.role, csrf, holder.key, holder.surgeons, holder.only)
        known = _Remembered(caller, holder, until)
        self._known.put(digest, known)
        return known

    def _let_in(self, known: _Remembered, otherwise: str) -> Caller:
        if known.caller is None or known.holder is None or not known.holder.counts(now()):
            raise NotSignedIn(f"{otherwise} {HOW}")
        self.limits.request(known.holder.key)
        return known.caller

    async def _ask(self, question: Callable[..., T], *about: object) -> T:
        def ask() -> T:
            with self._asked.reading() as session:
                return question(session, *about)

        return await to_thread.run_sync(ask, limiter=self._lookups)


class Gate:
    """Around the routes: it refuses who may not come in, and tells the routes who does, in `scope["caller"]`."""

    def __init__(self, app: ASGIApp, access: Access, settings: Settings) -> None:
        self.app = app
        self._access = access
        self._names = settings.host_names
        self._person = None if settings.proxy_header is None else settings.proxy_header.lower().encode()
        self._once = ONCE if self._person is None else ONCE | {self._person}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with why it is refused."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        try:
            headers = self._read(scope)
            _refuse_wrong_host(headers, self._names)
            _refuse_foreign(scope["method"], headers)
            if not is_open(_path(scope)):
                scope["caller"] = await self._caller(scope, headers)
        except SkillsError as error:
            await _refusal(scope, error)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _read(self, scope: Scope) -> dict[bytes, bytes]:
        """Read the headers; one that decides who asks must not be there twice.

        Raises:
            NotAllowed: It is.
        """
        headers: dict[bytes, bytes] = {}
        for name, value in scope["headers"]:
            if name in headers and name in self._once:
                raise NotAllowed("A header that says who asks, or of what, was sent twice; send it once.")
            headers[name] = value
        return headers

    async def _caller(self, scope: Scope, headers: dict[bytes, bytes]) -> Caller:
        """Find out who asks.

        Raises:
            NotSignedIn: Nobody that is known here.
            NotAllowed: A page's request does not carry its token.
        """
        proxied = self._access.by_proxy(headers.get(self._person) if self._person else None, headers.get(PROXY_SECRET))
        key, stale = _key(headers), _path(scope) in SAYS_WHAT_IS_WRONG
        if key is not None:
            address = scope["client"][0] if scope.get("client") else ""
            return await self._access.by_key(key, address, stale=stale)
        if proxied is not None:
            self._access.limits.request(str(proxied.key))
            return proxied
        cookie = cookie_parser(headers.get(b"cookie", b"").decode("latin-1")).get(COOKIE)
        caller = await self._access.by_cookie(cookie) if cookie else None
        if caller is not None:
            if scope["method"] not in SAFE and _path(scope) not in TOKEN_IN_FORM:
                refuse_without_token(caller, headers.get(b"x-csrf-token", b"").decode("latin-1"))
            return caller
        caller = await self._access.locally(stale=stale)
        if caller is None:
            raise NotSignedIn(HOW)
        return caller


def refuse_without_token(caller: Caller, token: str) -> None:
    """Refuse what a page's request does not carry its token with.

    Raises:
        NotAllowed: It is not there, or another's.
    """
    if not caller.csrf or not hmac.compare_digest(token.encode(), caller.csrf.encode()):
        raise NotAllowed("A page's request carries its token as X-CSRF-Token; load the page again.")


def _key(headers: dict[bytes, bytes]) -> str | None:
    """Take the key that is shown, if any.

    Raises:
        NotSignedIn: Two are, or it is shown in another way than this service knows.
    """
    bearer, plain = headers.get(b"authorization"), headers.get(b"x-api-key")
    if bearer is None:
        return None if plain is None else plain.decode("latin-1")
    kind, _, key = bearer.decode("latin-1").partition(" ")
    if kind.lower() != "bearer" or plain is not None:
        raise NotSignedIn(HOW)
    return key.strip()


def _refuse_wrong_host(headers: dict[bytes, bytes], names: frozenset[str]) -> None:
    """Refuse a request that was sent to another name: a site may make its own lead here, and would be let in."""
    host = headers.get(b"host", b"").decode("latin-1").lower()
    name = host[: host.rfind("]") + 1] if host.startswith("[") else host.partition(":")[0]
    if name not in names:
        raise WrongHost(
            "This is not a name of this service; SKILLS_HOSTS lists those that it goes by besides its address."
        )


def _refuse_foreign(method: str, headers: dict[bytes, bytes]) -> None:
    """Refuse what another site's page asks this one's user's browser to change."""
    if method in SAFE:
        return
    origin, site = headers.get(b"origin"), headers.get(b"sec-fetch-site")
    foreign = site not in (None, b"same-origin", b"none")
    if origin is not None:
        foreign = foreign or origin.partition(b"://")[2].lower() != headers[b"host"].lower()
    if foreign:
        raise NotAllowed("A page of another site asks for this; only this service's own pages and programs may.")


def _refusal(scope: Scope, error: SkillsError) -> Response:
    """Answer with a problem, or, where somebody wants to see a page and is not signed in, with the way to sign in."""
    accept = next((value for name, value in scope["headers"] if name == b"accept"), b"")
    if isinstance(error, NotSignedIn) and scope["method"] in ("GET", "HEAD") and accept.startswith(b"text/html"):
        asked = _path(scope) + ("?" + scope["query_string"].decode("latin-1") if scope["query_string"] else "")
        where = f"{scope.get('root_path', '')}/sign-in" + ("" if asked == "/" else f"?next={quote(asked)}")
        return Response(status_code=303, headers={"Location": where, "Cache-Control": "no-store"})
    return answer_to(error)


def _path(scope: Scope) -> str:
    """Give the path as the routes have it, without the prefix of a proxy."""
    path: str = scope["path"]
    prefix: str = scope.get("root_path", "")
    return path.removeprefix(prefix) if path.startswith(f"{prefix}/") else path
