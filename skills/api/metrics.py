"""`/metrics`, for Prometheus: requests by route, and at each scrape the figures of the installation."""

import platform
from collections.abc import Iterator

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Histogram, Info, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import QueuePool

from skills import __version__
from skills.db.schema import revisions
from skills.db.session import Database
from skills.errors import SkillsError
from skills.library.condition import Condition, condition_of

BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
CONTENT_TYPE = CONTENT_TYPE_LATEST


class Metrics:
    """The metrics of one application."""

    def __init__(self, database: Database, lease_s: float) -> None:
        self._registry = CollectorRegistry()
        self._requests = Histogram(
            "skills_request_seconds",
            "Requests, from their first byte to the last of their answer.",
            ("method", "route", "status"),
            buckets=BUCKETS_S,
            registry=self._registry,
        )
        self._known: dict[tuple[str, str, int], Histogram] = {}
        about = {"version": __version__, "schema": revisions()[0], "python": platform.python_version()}
        Info("skills_build", "What runs here.", registry=self._registry).info(about)
        ProcessCollector(registry=self._registry)
        self._registry.register(Installation(database, lease_s))

    def seen(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request."""
        key = (method, route, status)
        one = self._known.get(key)
        if one is None:
            one = self._known[key] = self._requests.labels(method, route, str(status))
        one.observe(seconds)

    def text(self) -> bytes:
        """Write all metrics in the format that is scraped."""
        return generate_latest(self._registry)


class Installation(Collector):
    """What the database knows, read when it is asked for."""

    def __init__(self, database: Database, lease_s: float) -> None:
        self._database = database
        self._lease_s = lease_s

    def describe(self) -> list[Metric]:
        """Name nothing beforehand: that would read the database when the application is made."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read the figures; where the database cannot be read, say just that."""
        try:
            with self._database.reading() as session:
                found = condition_of(session, self._lease_s)
        except (SkillsError, SQLAlchemyError):
            yield GaugeMetricFamily("skills_database_up", "Whether the database can be read.", 0)
            return
        yield GaugeMetricFamily("skills_database_up", "Whether the database can be read.", 1)
        yield from _figures(found)
        pool = self._database.engine.pool
        assert isinstance(pool, QueuePool)
        yield GaugeMetricFamily("skills_database_connections_in_use", "Of this process.", pool.checkedout())
        yield GaugeMetricFamily(
            "skills_database_connections_open", "Of this process.", pool.checkedin() + pool.checkedout()
        )


def _figures(found: Condition) -> Iterator[Metric]:
    jobs = GaugeMetricFamily("skills_jobs", "Jobs that there are.", labels=("kind", "state"))
    for labels, count in sorted(found.jobs.items()):
        jobs.add_metric(labels, count)
    yield jobs
    took = GaugeMetricFamily("skills_job_seconds", "Of the jobs that ended last.", labels=("kind", "quantile"))
    for kind, quantiles in sorted(found.seconds.items()):
        for quantile, seconds in quantiles.items():
            took.add_metric((kind, str(quantile)), seconds)
    yield took
    yield GaugeMetricFamily(
        "skills_oldest_queued_seconds", "How long the first in the queue waits.", found.oldest_queued_s
    )
    yield GaugeMetricFamily("skills_workers", "Workers that showed within their lease that they live.", found.workers)
    yield GaugeMetricFamily("skills_database_bytes", "Size of the database.", found.database_bytes)
    if found.last_event_at is not None:
        last = found.last_event_at.timestamp()
        yield GaugeMetricFamily("skills_last_event_timestamp_seconds", "When the last event was written.", last)
