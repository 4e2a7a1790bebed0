"""Prometheus metrics, and one log line for each request.

`/metrics` exports a histogram of requests by method, route and status, and at each scrape the figures of the
installation from the database. Requests are counted and logged by route, never by path, which may hold a pseudonym.
"""

import logging
import platform
import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from random import Random
from threading import Lock, Thread
from time import perf_counter

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import QueuePool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skills import __version__
from skills.db.revisions import revisions
from skills.db.session import Database
from skills.errors import SkillsError
from skills.library.operation.installation import InstallationFigures, count_jobs, figures_of_installation
from skills.logs import log_fields, request_id

MANY_JOBS = 100_000  # ours: counting them takes 10 to 20 ms
BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
CONTENT_TYPE = CONTENT_TYPE_LATEST
Jobs = dict[tuple[str, str], int]  # their number by kind and state


class ServiceMetrics:
    """The metrics of one application."""

    def __init__(self, database: Database, lease_s: float) -> None:
        self._registry = CollectorRegistry()
        self._requests = Histogram(
            "skills_request_seconds",
            "Duration of requests, from the first byte to the last byte of the response.",
            ("method", "route", "status"),
            buckets=BUCKETS_S,
            registry=self._registry,
        )
        self._in_progress = 0  # a plain number, because a gauge takes a lock at every change
        gauge = Gauge(
            "skills_requests_in_progress", "Requests whose response is not complete yet.", registry=self._registry
        )
        gauge.set_function(lambda: self._in_progress)
        self.sessions = Gauge("skills_sessions_open", "Sessions of pose styles.", registry=self._registry)
        self._known: dict[tuple[str, str, int], Histogram] = {}
        build = Info("skills_build", "Version, database schema and Python of this process.", registry=self._registry)
        build.info({"version": __version__, "schema": revisions()[0], "python": platform.python_version()})
        ProcessCollector(registry=self._registry)
        self._registry.register(Installation(database, lease_s))

    def begun(self) -> None:
        """Count the start of a request; only the event loop's thread calls this and `seen`."""
        self._in_progress += 1

    def seen(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count the end of a request, with its duration in seconds."""
        self._in_progress -= 1
        key = (method, route, status)
        # cached, because `labels` validates its arguments and takes a lock at every call
        one = self._known.get(key)
        if one is None:
            one = self._known[key] = self._requests.labels(method, route, str(status))
        one.observe(seconds)

    def text(self) -> bytes:
        """Return all metrics in the Prometheus text format."""
        return generate_latest(self._registry)


class Installation(Collector):
    """Prometheus collector of the figures in the database, queried at each scrape."""

    def __init__(self, database: Database, lease_s: float) -> None:
        self._database = database
        self._lease_s = lease_s
        self._jobs: Jobs | None = None
        self._counting = Lock()

    def describe(self) -> list[Metric]:
        """Return no descriptions; without this, registration would call `collect` and query the database."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield the figures; if the database cannot be read, only `skills_database_up` 0 and the connection counts."""
        pool = self._database.engine.pool
        assert isinstance(pool, QueuePool)
        in_use, open_ = pool.checkedout(), pool.checkedin() + pool.checkedout()
        yield GaugeMetricFamily("skills_database_connections_in_use", "Of this process.", in_use)
        yield GaugeMetricFamily("skills_database_connections_open", "Of this process.", open_)
        try:
            with self._database.reading() as session:
                found = figures_of_installation(session, self._lease_s)
            jobs = self._jobs_counted()
        except (SkillsError, SQLAlchemyError):
            yield GaugeMetricFamily("skills_database_up", "Whether the database can be read.", 0)
            return
        yield GaugeMetricFamily("skills_database_up", "Whether the database can be read.", 1)
        family = GaugeMetricFamily(
            "skills_jobs", "Number of jobs; of very many that of the scrape before.", labels=("kind", "state")
        )
        for labels, count in sorted(jobs.items()):
            family.add_metric(labels, count)
        yield family
        yield from _figures(found)

    def _jobs_counted(self) -> Jobs:
        """Return the number of jobs by kind and state; of many, as counted after the last scrape."""
        known = self._jobs
        if known is None:
            return self._count()
        if self._counting.acquire(blocking=False):
            Thread(target=self._count_again, daemon=True).start()
        return known

    def _count(self) -> Jobs:
        """Count the jobs, and remember the result for the next scrape if they are many."""
        with self._database.reading() as session:
            jobs = count_jobs(session)
        self._jobs = jobs if sum(jobs.values()) >= MANY_JOBS else None
        return jobs

    def _count_again(self) -> None:
        try:
            with suppress(SkillsError, SQLAlchemyError):  # the next scrape reports that the database cannot be read
                self._count()
        finally:
            self._counting.release()


def _figures(found: InstallationFigures) -> Iterator[Metric]:
    took = GaugeMetricFamily("skills_job_seconds", "Duration of the jobs that ended last.", labels=("kind", "quantile"))
    for kind, quantiles in sorted(found.seconds.items()):
        for quantile, seconds in quantiles.items():
            took.add_metric((kind, str(quantile)), seconds)
    yield took
    for name, meaning, value in (
        ("oldest_queued_seconds", "Waiting time of the oldest queued job.", found.oldest_queued_s),
        ("workers", "Workers that renewed their lease in time.", found.workers),
        ("database_bytes", "Size of the database.", found.database_bytes),
        ("history_faults", "Faults that the last verification found.", found.faults_found),
        ("history_verified_timestamp_seconds", "Time of the last verification of the history.", found.verified_at),
        ("last_event_timestamp_seconds", "Time at which the last event was written.", found.last_event_at),
    ):
        if value is not None:
            number = value.timestamp() if isinstance(value, datetime) else value
            yield GaugeMetricFamily(f"skills_{name}", meaning, number)


METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"})
# requested every few seconds by monitoring, so logged at level debug
PROBES = frozenset({"/healthz", "/readyz", "/metrics"})
NO_ROUTE, NO_METHOD, NO_ANSWER = "none", "other", 0
# The id of a trace or a UUID. Freer text could be somebody's name, and the id is logged.
GIVEN = re.compile(rb"[0-9a-f]{8}[0-9a-f-]{0,56}")

log = logging.getLogger("skills.api.request")


class Observed:
    """ASGI middleware that sets the request id, and records method, route, status and duration of each request."""

    def __init__(self, app: ASGIApp, metrics: ServiceMetrics) -> None:
        self.app = app
        self._metrics = metrics
        self._drawn = Random().getrandbits  # an id is not a secret: 64 pseudo-random bits, without a system call each

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; record and log it after its response."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        status = NO_ANSWER

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        token = request_id.set(_given(scope) or f"{self._drawn(64):016x}")
        began = perf_counter()
        self._metrics.begun()
        try:
            await self.app(scope, receive, noted)
        finally:
            seconds = perf_counter() - began
            method = scope["method"] if scope["method"] in METHODS else NO_METHOD
            route = getattr(scope.get("route"), "path", NO_ROUTE)
            self._metrics.seen(method, route, status, seconds)
            level = logging.DEBUG if route in PROBES else logging.INFO
            if log.isEnabledFor(level):
                log_fields(
                    log, "request", level, method=method, route=route, status=status, ms=round(seconds * 1000, 2)
                )
            request_id.reset(token)


def _given(scope: Scope) -> str | None:
    """Return the X-Request-ID of the caller if it has the form of a trace id or UUID, else None."""
    for name, value in scope["headers"]:
        if name == b"x-request-id" and GIVEN.fullmatch(value):
            return str(value, "ascii")
    return None
