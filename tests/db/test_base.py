"""Times: UTC on every database, whatever their original time zone."""

from datetime import UTC, datetime, timedelta, timezone

import pytest
from sqlalchemy import select
from sqlalchemy.exc import StatementError

from skills.db import now, rfc3339
from skills.db.service_tables import Executor
from skills.db.session import Database

TOKYO = timezone(timedelta(hours=9))


def test_a_moment_of_another_zone_comes_back_as_the_same_moment_in_utc(database: Database):
    moment = datetime(2026, 3, 29, 3, 30, 15, 123456, tzinfo=TOKYO)
    with database.writing() as session:
        session.add(Executor(id="one", beat_at=moment))
    with database.reading() as session:
        back = session.scalars(select(Executor.beat_at)).one()
    assert back == moment
    assert back.tzinfo is UTC
    assert rfc3339(back) == "2026-03-28T18:30:15.123456Z"


def test_moments_compare_in_the_database_as_they_do_in_time(database: Database):
    began = now()
    with database.writing() as session:
        session.add(Executor(id="before", beat_at=began - timedelta(seconds=1)))
        session.add(Executor(id="after", beat_at=(began + timedelta(seconds=1)).astimezone(TOKYO)))
    with database.reading() as session:
        assert session.scalars(select(Executor.id).where(Executor.beat_at > began)).all() == ["after"]


def test_a_moment_without_a_zone_is_our_own_mistake(database: Database):
    with pytest.raises((StatementError, AssertionError), match="time zone"), database.writing() as session:
        session.add(Executor(id="one", beat_at=datetime(2026, 1, 1)))
