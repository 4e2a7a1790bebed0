"""Query plans of the statements that the library really runs: frequent queries use an index."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy import event, text
from sqlalchemy.orm import Session

from skills.db.session import Database
from skills.jobs.watch import Leases, Watch
from skills.library.operation import jobs
from skills.library.operation.installation import count_jobs
from skills.library.operation.overview import newest_job
from skills.library.operation.styles import matrix, released_styles
from skills.library.people import surgeons, suture_types
from skills.library.plans.playback_pictures import PicturesRequest
from skills.library.policies import answers, learning, releases, retraining, training, versions
from skills.library.recordings import demos, proposals
from skills.schemas.training import RetrainingIn, TrainingIn
from tests import backends
from tests.library import hospital

IN_ORDER = {
    "surgeons",
    "proposals",
    "proposals, further on",
    "demonstrations",
    "demonstrations, further on",
    "what is served",
    "jobs",
}  # no search
STYLE = ("surgeon-0003", "figure-of-eight")
NEWEST_MARK = re.compile(r"ORDER BY demonstration_outcomes\.row DESC\s+LIMIT")  # of one row, not of a page
Plan = list[str]


@pytest.fixture(scope="module", params=backends.BACKENDS)
def filled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    with backends.opened(backends.fresh(request.param, tmp_path_factory.mktemp("hospital"))) as database:
        hospital.fill(database, 5)
        yield database


def newest(session: Session) -> Any:
    return demos.newest_demo(session, surgeons.find_surgeon(session, STYLE[0]).row, STYLE[1])


def served(session: Session) -> Any:
    found = versions.served_release(session, *STYLE)
    return found.policy.learnt, found.policy.covered, found.policy.demonstration


def batch(session: Session) -> Any:
    found = session.scalar(text("SELECT id FROM jobs WHERE kind = 'retraining'"))
    return retraining.find_retraining(session, found)


HOT: dict[str, Callable[[Session], object]] = {
    "a surgeon": lambda s: surgeons.find_surgeon(s, STYLE[0]),
    "surgeons": lambda s: surgeons.list_surgeons(s, 10, None),
    "surgeons, further on": lambda s: surgeons.list_surgeons(s, 10, "surgeon-0002"),
    "demonstrations": lambda s: demos.list_demos(s, 10, None, None, None),
    "demonstrations, further on": lambda s: demos.list_demos(s, 10, 30, None, None),
    "demonstrations of a surgeon": lambda s: demos.list_demos(s, 10, 30, STYLE[0], None),
    "demonstrations of a suture type": lambda s: demos.list_demos(s, 10, 30, None, STYLE[1]),
    "demonstrations of a style": lambda s: demos.list_demos(s, 10, 30, *STYLE),
    "failures of a style": lambda s: demos.list_demos(s, 10, 30, *STYLE, outcome="failure"),
    "what failed of a style or not": lambda s: demos.newest_demos(s, 1, STYLE[1], 10, any_outcome=True),
    "proposals": lambda s: proposals.list_proposals(s, 10, None),
    "proposals, further on": lambda s: proposals.list_proposals(s, 10, 20_000, state="rejected"),
    "a demonstration": lambda s: demos.find_demo(s, newest(s).sha256),
    "what is served": lambda s: versions.list_served(s, 10, 20),
    "a released policy": served,
    "a style's versions": lambda s: versions.list_versions(s, *STYLE, 10, 5),
    "a version": lambda s: versions.find_version(s, *STYLE, 1),
    "a version by its digest": lambda s: versions.find_by_digest(s, versions.served_release(s, *STYLE).policy.sha256),
    "a training": lambda s: training.request_training(s, TrainingIn(surgeon=STYLE[0], suture=STYLE[1]), "test"),
    "a surgeon's stale styles": lambda s: retraining.choose_styles(s, RetrainingIn(surgeon=STYLE[0], only_stale=True)),
    "where what was learnt stands": lambda s: learning.demo_states(s, [1, 2, 3]),
    "what is known already": lambda s: learning.find_stored(s, ["0" * 64, "1" * 64]),
    "what some styles serve": lambda s: releases.served_versions(s, {(1, "simple-running"), (2, "simple-running")}),
    "whether new versions pass the gate": lambda s: releases.release_new(s, {1: None, 2: None}, "test", 30.0),
    "jobs": lambda s: jobs.list_jobs(s, 10, 50, None),
    "jobs of a state": lambda s: jobs.list_jobs(s, 10, 50, "failed"),
    "jobs of a kind": lambda s: jobs.list_jobs(s, 10, 50, None, "playback"),
    "jobs of a kind and a state": lambda s: jobs.list_jobs(s, 10, 50, "failed", "playback"),
    "the newest job for a plan": lambda s: newest_job(s, "playback", "0" * 64),
    "withdrawn demonstrations": lambda s: demos.list_demos(s, 10, 50, None, None, active=False),
    "the newest of equal jobs": lambda s: jobs.newest(s, PicturesRequest(plan="0" * 64, playback="1" * 64)),
    "a batch's styles": lambda s: retraining.list_styles(s, batch(s), 10, 20, None),
    "a batch's styles of a state": lambda s: retraining.list_styles(s, batch(s), 10, 20, "failed"),
    "how far a batch is": lambda s: jobs.count(s, batch(s).row),
}


@pytest.mark.parametrize("what", HOT)
def test_what_is_asked_often_is_answered_by_an_index(filled: Database, what: str):
    with filled.reading() as session, noted(session) as asked:
        HOT[what](session)
        session.flush()
        assert asked
        for statement, values in asked:
            assert wasteful(session, statement, values, walks=what in IN_ORDER) == [], statement


PAGES: dict[str, Callable[[Session, int], object]] = {
    "what is served": lambda s, most: [answers.summarise(one) for one in versions.list_served(s, most, 0)],
    "the styles": lambda s, most: matrix(s, limit=most),
    "the styles to plan with": released_styles,
}


@pytest.mark.parametrize("what", PAGES)
def test_a_longer_page_takes_no_more_statements(filled: Database, what: str):
    numbers = []
    for most in (1, 5):
        with filled.reading() as session, noted(session) as asked:
            PAGES[what](session, most)
            numbers.append(len(asked))
    assert 0 < numbers[0] == numbers[1]


def test_what_a_watch_looks_at_is_found_by_its_state(filled: Database):
    with noted(filled) as asked:
        assert len(Watch(filled, None, "test", Leases(2.0), None)._live()) == hospital.WAITING
    with filled.reading() as session:
        for statement, values in asked:
            assert wasteful(session, statement, values, sorts=True) == []


def test_the_figures_are_counted_in_an_index_alone(filled: Database):
    with filled.reading() as session, noted(session) as asked:
        count_jobs(session)
        counting = [one for one in asked if "count(" in one[0]]
        assert len(counting) == 1
        (plan,) = [plan_of(session, *one) for one in counting]
    assert "ix_jobs_kind" in json.dumps(plan)
    assert "Seq Scan" not in json.dumps(plan)


def test_an_index_that_is_missing_is_noticed(filled: Database):
    with filled.reading() as session, noted(session) as asked:
        session.execute(text("DROP INDEX ix_demonstrations_suture"))  # rolled back at the end of this transaction
        find = suture_types.find_suture_type(session, STYLE[1])
        asked.clear()
        demos.list_demos(session, 10, None, None, find.slug)  # no plan of this query was cached before
        assert [wasteful(session, *one) for one in asked] != [[]]


@contextmanager
def noted(where: Session | Database) -> Iterator[list[tuple[str, Any]]]:
    """Record the SELECT statements that are run, with their values, except the plan queries."""
    engine = where.engine if isinstance(where, Database) else where.get_bind().engine
    asked: list[tuple[str, Any]] = []

    def note(_conn: object, _cursor: object, statement: str, values: Any, _context: object, many: bool) -> None:
        if statement.startswith(("SELECT", "WITH")) and not many:
            asked.append((statement, values))

    event.listen(engine, "before_cursor_execute", note)
    try:
        yield asked
    finally:
        event.remove(engine, "before_cursor_execute", note)


def plan_of(session: Session, statement: str, values: Any) -> Any:
    """Return the query plan; on PostgreSQL with sequential scans of small tables disabled."""
    connection = session.connection()
    if connection.dialect.name == "sqlite":
        return [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)]
    for habit in ("seqscan", "bitmapscan"):
        connection.exec_driver_sql(f"SET LOCAL enable_{habit} = off")
    return connection.exec_driver_sql(f"EXPLAIN (FORMAT JSON) {statement}", values).scalar()


def wasteful(session: Session, statement: str, values: Any, *, walks: bool = False, sorts: bool = False) -> list[str]:
    """Name the steps of a plan that scan a whole table, or sort for one page although an index has the order.

    Args:
        walks: The plan may walk along a table in the order of its key, for one page.
        sorts: The plan may sort.
    """
    paged = "LIMIT" in NEWEST_MARK.sub("", statement)
    plan = plan_of(session, statement, values)
    if isinstance(plan[0], str):
        whole = [step for step in plan if step.startswith("SCAN") and not step.startswith("SCAN anon")]  # a result
        scans = [] if paged and walks else whole
        return scans + [step for step in plan if "ORDER BY" in step and paged and not sorts]
    return list(_wasteful(plan[0]["Plan"], paged and walks, sorts or not paged))


def _wasteful(node: dict[str, Any], walks: bool, sorts: bool) -> Iterator[str]:
    kind = node["Node Type"]
    if kind == "Seq Scan" or (kind.startswith("Index") and "Index Cond" not in node and not walks):
        yield f"{kind} of {node['Relation Name']} by {node.get('Index Name')}"
    if "Sort" in kind and not sorts:
        yield f"{kind} by {node['Sort Key']}"
    for child in node.get("Plans", ()):
        yield from _wasteful(child, walks, sorts)
