"""The FastAPI application: routes, middleware, one database, one job engine, and errors as problem documents."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from math import inf
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, FastAPI
from fastapi.telemetry import TelemetryConfig
from starlette.datastructures import MutableHeaders
from starlette.middleware.errors import ServerErrorMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skills import __version__
from skills.api.authentication import Access
from skills.api.encoded_policies import Encoded
from skills.api.gate import Gate
from skills.api.job_events import Watching
from skills.api.metrics import Observed, ServiceMetrics
from skills.api.openapi import Json, complete
from skills.api.policy_cache import CachedPolicyMiddleware, PolicyCache
from skills.api.problems import TOO_LARGE, answer_refusals
from skills.api.routes import routes_of
from skills.api.sessions import Sessions
from skills.api.streams import DOWNLOADS_READ
from skills.db.session import Database
from skills.errors import NotReady, SkillsError
from skills.jobs import Engine
from skills.library.operation.history import sign_some_history
from skills.library.people.suture_types import seed_suture_types
from skills.library.plans.arm_errors import stated_errors, stated_servo
from skills.library.recordings.recordings import confined_reader
from skills.logs import request_id
from skills.settings import Settings

log = logging.getLogger(__name__)
DESCRIPTION = (
    "Suture styles as a service: a recorded needle hand-off of a surgeon is discretised, learnt, certified, "
    "served, stacked at suture points and played back in simulation. Lengths are mm. **Research use only; not a "
    "medical device.**"
)

# OpenTelemetry is installed by other libraries. Its exports would contain error messages, which may hold personal data,
# and even the check whether to export takes a tenth of the time of a short response.
NO_TELEMETRY = TelemetryConfig(tracing=False, metrics=False, logs=False, operation_spans=False, auto_configure=False)


def create_app(settings: Settings, *, by_path: bool = False, engine: type[Engine] = Engine) -> FastAPI:
    """Create the application. Its start-up migrates the database and seeds the catalogue.

    Args:
        settings: Those of the installation.
        by_path: Import routes at the first request of their path, for an application that answers one command.
        engine: What is told of jobs.

    Raises:
        BadSettings: The installation states impossible errors of its arms.
    """
    stated_errors(settings.arm_errors)
    stated_servo(settings.servo)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            await to_thread.run_sync(prepare_to_serve, app.state.database, settings)
            async with app.state.served.watching():
                with confined_reader(settings) as app.state.reader:
                    yield
            with suppress(SkillsError):  # what was written after the last signature; the next start signs it otherwise
                await to_thread.run_sync(sign_some_history, app.state.database, inf)
        finally:
            await to_thread.run_sync(app.state.engine.close)
            app.state.access.close()
            app.state.database.close()

    app = Service(
        title="suture-skills",
        version=__version__,
        description=DESCRIPTION,
        lifespan=lifespan,
        telemetry=NO_TELEMETRY,
        docs_url=None,  # the default page loads its scripts from a CDN
        redoc_url=None,
        max_body_size=settings.max_upload_bytes,
    )
    app.state.settings, app.state.by_path = settings, by_path
    app.state.database = Database.of(settings)
    app.state.engine = engine(settings)
    app.state.encoded = Encoded()
    app.state.served = PolicyCache(app.state.database, app.state.encoded)
    app.state.watching = Watching(app.state.database, app.state.served.changes, settings)
    app.state.metrics = ServiceMetrics(app.state.database, settings.lease_s)
    app.state.sessions = Sessions(app.state.database, app.state.served.changes, settings)
    app.state.metrics.sessions.set_function(lambda: app.state.sessions.places.count)
    app.state.equal_uploads = WeakValueDictionary()  # of this moment, by route and digest
    app.state.downloads = CapacityLimiter(DOWNLOADS_READ)
    app.state.access = Access(app.state.database, settings)
    if not by_path:
        # `include_router` would analyse every route again, at the first request of each application: 90 ms.
        app.router.routes.extend(routes_of())
    answer_refusals(app)
    return app


def prepare_database(database: Database, settings: Settings) -> bool:
    """Migrate a database, seed its catalogue if it is empty, and sign its history; return whether it was migrated.

    Raises:
        NotReady: It is not the database that was signed last; nothing was changed.
    """
    migrated = database.migrate()
    database.compare_history()
    with database.writing() as session:
        seed_suture_types(session)
    sign_some_history(database)
    return migrated


def prepare_to_serve(database: Database, settings: Settings) -> None:
    """Prepare a database; if it is not the one that was signed last, serve only the reason, `History.refused`."""
    try:
        prepare_database(database, settings)
    except NotReady as refused:
        if database.history.refused is None:
            raise
        log.critical("Nothing is served or written. %s", refused)


class Service(FastAPI):
    """FastAPI with `Gate`, `Headers` and `Observed` around all responses, including its own 413 and 500 responses."""

    def openapi(self) -> Json:
        """Return the OpenAPI document, built at the first call and cached."""
        if self.openapi_schema is None:
            self.openapi_schema = complete(super().openapi())
        return self.openapi_schema

    def build_middleware_stack(self) -> ASGIApp:
        """Wrap FastAPI's middleware stack in ours.

        `add_middleware` would place ours inside the handlers that answer 413 and 500, so those responses would miss
        them.
        """
        state = self.state
        failing = super().build_middleware_stack()
        assert isinstance(failing, ServerErrorMiddleware)  # the handler of status 500 is outermost, and stays so
        if state.by_path:
            inner: ASGIApp = RoutesByPath(failing.app, self.router)
        else:
            from skills.api.routes import policies

            inner = CachedPolicyMiddleware(failing.app, state.served, policies.get_policy, policies.router)
        failing.app = Gate(inner, state.access, state.settings, state.database.history)
        return Observed(Headers(HeadAsGet(failing)), state.metrics)


UNLESS_SAID = {
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # a URL can contain a surgeon's pseudonym
}
ALWAYS = [
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),  # no other site's page can embed our pictures
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=(), payment=(), usb=()"),
]


class RoutesByPath:
    """ASGI middleware that adds the routes of a path at its first request, so that one command imports few of them."""

    def __init__(self, app: ASGIApp, router: APIRouter) -> None:
        self.app = app
        self._router = router

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Add the routes of the request's path, and pass it on."""
        if scope["type"] == "http":
            routes = self._router.routes
            routes.extend([one for one in routes_of(scope["path"].split("/")[1]) if one not in routes])
        await self.app(scope, receive, send)


class HeadAsGet:
    """ASGI middleware that answers HEAD as GET without the body (RFC 9110, section 9.3.2), on every path with a GET."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on as a GET, and end the response after its headers.

        A generator that streams the body is closed as after a disconnect of the client.
        """
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def headers_only(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        await self.app({**scope, "method": "GET"}, receive, headers_only)


class Headers:
    """ASGI middleware that adds the request id and the security headers to every response."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and add headers to the response.

        A 413 that Starlette writes as plain text is replaced by the problem document.
        """
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        in_plain_text = False

        async def named(message: Message) -> None:
            nonlocal in_plain_text
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if message["status"] == 413 and headers["content-type"] != TOO_LARGE.media_type:
                    in_plain_text, message["headers"] = True, list(TOO_LARGE.raw_headers)
                    headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id.get() or ""
                for name, value in UNLESS_SAID.items():
                    headers.setdefault(name, value)
                message["headers"].extend(ALWAYS)
            elif in_plain_text:
                message["body"] = TOO_LARGE.body
            await send(message)

        await self.app(scope, receive, named)
