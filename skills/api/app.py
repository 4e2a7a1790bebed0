"""The application: our calls, with one database, one engine, and problems for answers to what goes wrong."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import to_thread
from fastapi import FastAPI
from fastapi.telemetry import TelemetryConfig
from starlette.datastructures import MutableHeaders
from starlette.middleware.errors import ServerErrorMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skills import __version__
from skills.api.answers import Encoded
from skills.api.documented import complete
from skills.api.gate import Access, Gate
from skills.api.metrics import Metrics
from skills.api.observed import Observed
from skills.api.problems import TOO_LARGE, answer_refusals
from skills.api.routes import (
    atlas,
    atlas_pages,
    cards,
    catalogue,
    demos,
    keys,
    operating,
    pages,
    pictures,
    plans,
    policies,
    reference,
    retrainings,
    scores,
    sign_in,
    suture_points,
    trainings,
    trajectories,
)
from skills.api.served import AtHand, Served
from skills.confined.limits import Limits
from skills.db.session import Database
from skills.jobs.engine import Engine
from skills.library.catalogue import seed_catalogue
from skills.logs import request_id
from skills.recordings.confined import ConfinedReader
from skills.settings import Settings

DESCRIPTION = (
    "Suture styles as a service: a surgeon's recorded needle hand-off, discretised, learnt, certified, served, stacked "
    "at suture points and played back in simulation. Lengths are mm. **Research use only; not a medical device.**"
)

# OpenTelemetry came with other libraries: what it would send holds the words of errors, and asking whether it shall
# send anything takes a tenth of the time of a short answer.
NO_TELEMETRY = TelemetryConfig(tracing=False, metrics=False, logs=False, operation_spans=False, auto_configure=False)


def create_app(settings: Settings) -> FastAPI:
    """Make the application; its database is migrated and its catalogue seeded when it starts."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        await to_thread.run_sync(prepare_database, app.state.database)
        async with app.state.served.watching():
            with confined_reader(settings) as app.state.reader:
                yield
        await to_thread.run_sync(app.state.engine.close)
        app.state.access.close()
        app.state.database.close()

    app = Service(
        title="suture-skills",
        version=__version__,
        description=DESCRIPTION,
        lifespan=lifespan,
        telemetry=NO_TELEMETRY,
        docs_url=None,  # the stock page loads its scripts from elsewhere
        redoc_url=None,
        max_body_size=settings.max_upload_bytes,
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.settings = settings
    app.state.database = Database(settings.database_url)
    app.state.engine = Engine(settings)
    app.state.encoded = Encoded()
    app.state.served = Served(app.state.database, app.state.encoded)
    app.state.metrics = Metrics(app.state.database, settings.lease_s)
    app.state.access = Access(app.state.database, settings)
    for part in (catalogue.router, demos.uploads, demos.router, trainings.router, policies.router, plans.router):
        app.include_router(part)
    app.include_router(trajectories.router)
    app.include_router(suture_points.router)
    app.include_router(pictures.router)
    app.include_router(retrainings.router)
    app.include_router(cards.router)
    app.include_router(atlas.router)
    app.include_router(scores.router)
    app.include_router(operating.router)
    app.include_router(reference.router)
    app.include_router(pages.router)
    app.include_router(atlas_pages.router)
    app.include_router(sign_in.router)
    app.include_router(keys.router)
    answer_refusals(app)
    return app


def prepare_database(database: Database) -> None:
    """Migrate a database, and seed its catalogue where that is empty."""
    database.migrate()
    with database.writing() as session:
        seed_catalogue(session)


def confined_reader(settings: Settings) -> ConfinedReader:
    """Make the reader of what people send, under the limits of the settings."""
    limits = Limits(
        memory_bytes=settings.reading_memory_bytes,
        wall_s=settings.reading_wall_s,
        cpu_s=settings.reading_cpu_s,
        file_bytes=settings.reading_file_bytes,
        children=False,
    )
    return ConfinedReader(limits, answer_bytes=settings.reading_answer_bytes, at_once=settings.readers)


class Service(FastAPI):
    """FastAPI with the gate, `Headers` and `Observed` around everything, its own answers to failures included."""

    def openapi(self) -> dict[str, Any]:
        """Describe every call, once."""
        if self.openapi_schema is None:
            self.openapi_schema = complete(super().openapi())
        return self.openapi_schema

    def build_middleware_stack(self) -> ASGIApp:
        """Put these outermost: middleware that is added stands inside of what answers 413 and 500."""
        state = self.state
        failing = super().build_middleware_stack()
        assert isinstance(failing, ServerErrorMiddleware)  # what answers 500 is outermost, and stays so
        at_hand = AtHand(failing.app, state.served, policies.get_policy, policies.router)
        failing.app = Gate(at_hand, state.access, state.settings)
        return Observed(Headers(failing), state.metrics.seen)


UNLESS_SAID = {
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # an address can hold a pseudonym
}
ALWAYS = [
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),  # no other site's page shows our pictures
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=(), payment=(), usb=()"),
]


class Headers:
    """Give every answer its request's id, and forbid a browser to make more of it than it is."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and add to the answer's headers."""
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
