"""The middleware that checks host, origin and credentials before a request is processed.

The checks, in this order:

    host         the Host header must be a name of this service, because another site's name can be made to resolve to
                 its address (DNS rebinding)
    origin       a request that changes anything must not come from a page of another site (Origin, Sec-Fetch-Site)
    credentials  an API key; else the user named by an authenticating proxy; else the cookie of a sign-in; else, on
                 loopback with no proxy configured and no key ever created, a local user with the role admin
    rate         the limits of the key: requests per second, and bytes uploaded per day; wrong keys per address

The permissions that a route needs are declared in its decorator (`skills.api.authorisation`).
"""

import hmac
from urllib.parse import quote

from fastapi import Response
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Receive, Scope, Send

from skills.api.authentication import HOW, Access
from skills.api.authorisation import Caller
from skills.api.problems import answer_to
from skills.db.history import History
from skills.errors import NotAllowed, NotSignedIn, SkillsError, WrongHost
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
ONCE = frozenset({b"host", b"origin", b"sec-fetch-site", b"authorization", b"x-api-key", b"x-csrf-token", PROXY_SECRET})


def is_open(path: str) -> bool:
    """Return whether a path needs no authentication."""
    return path in OPEN or path.startswith(OPEN_BELOW)


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
