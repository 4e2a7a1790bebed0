"""The cache of policies by itself: which requests it answers, and when it asks the tables again."""

from datetime import date, timedelta

import pytest

from skills.api.policy_cache import LONGEST, Known, _asked
from skills.api.responses import JSON, NPZ
from skills.library.operation import integrity
from skills.library.people import consent
from skills.library.people.catalogue import find_surgeon, put_surgeon
from skills.library.policies.releases import withdraw_all
from tests.api.service import KESTREL, POLICY, Service
from tests.api.test_served import read_and_kept, seeing

TODAY = date(2031, 3, 31)
NPZ_BYTES = NPZ.encode()


@pytest.mark.parametrize(
    ("headers", "found"),
    [
        ([], (JSON, None)),
        ([(b"accept", NPZ_BYTES)], (NPZ, None)),
        ([(b"accept", NPZ_BYTES), (b"if-none-match", b'"a"')], (NPZ, '"a"')),
        ([(b"host", b"a"), (b"host", b"b"), (b"x-many", b"c" * 9000)], (JSON, None)),
        ([(b"if-none-match", b"a" * LONGEST)], (JSON, "a" * LONGEST)),
        ([(b"if-none-match", b"a" * (LONGEST + 1))], None),
        ([(b"accept", NPZ_BYTES), (b"accept", NPZ_BYTES)], None),
        ([(b"if-none-match", b'"a"'), (b"if-none-match", b'"b"')], None),
        ([(b"if-match", b'"a"')], None),
        ([(b"accept", b"text/html")], None),
    ],
)
def test_a_request_with_unusual_headers_is_left_to_the_route(headers, found):
    assert _asked(headers) == found


@pytest.mark.parametrize(
    ("last_day", "over"),
    [(None, False), (TODAY + timedelta(days=1), False), (TODAY, False), (TODAY - timedelta(days=1), True)],
)
def test_a_response_is_over_after_the_last_day_of_consent(last_day, over, monkeypatch):
    monkeypatch.setattr(consent, "today", lambda: TODAY)
    assert Known(None, (1, "a digest"), last_day, 1).over is over


def test_a_commit_that_changes_no_release_is_looked_at_once(trained: Service, monkeypatch):
    seeing(trained)
    body = read_and_kept(trained, JSON)
    cache, asked = trained.app.state.served, []
    first = cache.changes.first

    def counted(*given):
        asked.append(given)
        return first(*given)

    monkeypatch.setattr(cache.changes, "first", counted)
    for commits in (1, 2):
        with trained.database.writing() as session:
            put_surgeon(session, "heron", {}, "test")
        for _ in range(3):
            assert trained.http.portal.call(cache.cached, *KESTREL.values(), JSON) is body
        assert len(asked) <= commits
    assert asked


def test_what_is_cached_is_asked_for_without_reading_the_tables(trained: Service, monkeypatch):
    seeing(trained)
    read_and_kept(trained, JSON)
    tag = trained.http.get(POLICY).headers["etag"]
    monkeypatch.setattr(type(trained.app.state.served), "_look", lambda *_: pytest.fail("the tables were read"))
    for headers, status in (({}, 200), ({"If-None-Match": tag}, 304)):
        assert trained.http.get(POLICY, headers=headers).status_code == status


def test_nothing_is_cached_while_changes_cannot_be_seen(trained: Service, monkeypatch):
    seeing(trained)
    read_and_kept(trained, JSON)
    cache = trained.app.state.served
    monkeypatch.setattr(cache.changes, "version", lambda: None)
    assert trained.http.portal.call(cache.cached, *KESTREL.values(), JSON) is None
    with trained.database.writing() as session:
        withdraw_all(session, find_surgeon(session, "kestrel"), "test")
    assert trained.http.get(POLICY).status_code == 404
    assert not [key for key, _ in cache._known.items()]


def test_the_body_is_kept_when_the_tables_say_that_it_is_the_same(trained: Service, monkeypatch):
    seeing(trained)
    body = read_and_kept(trained, JSON)
    cache = trained.app.state.served
    monkeypatch.setattr(cache.changes, "version", lambda: None)  # so that the tables are read
    for _ in range(2):
        assert trained.http.portal.call(cache.body, *KESTREL.values(), JSON) is body


def test_what_is_still_in_the_database_is_not_forgotten(trained: Service):
    body = read_and_kept(trained, JSON)
    cache = trained.app.state.served
    cache.forget_erased()  # whatever other services of this process remembered is forgotten
    ((_, known),) = cache._known.items()
    assert known.body == body
    assert integrity.remembered() == [known.release[-1]]
