"""Retries of the client: which requests, when, and for how long; the same in both clients."""

import email.utils
import time
from datetime import UTC, datetime, timedelta

import httpx2 as httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.client import AsyncClient, Client, NotReached, Problem, Retrying
from tests.client.peers import BOTH, Script, Time, answer, asked, refusal
from tests.waiting import crowded

GONE = httpx.RemoteProtocolError("Server disconnected without sending a response.")
CLOSED = httpx.ConnectError("Connection refused")
SLOW = httpx.ReadTimeout("timed out")

both = pytest.mark.parametrize("made", BOTH)


@both
@pytest.mark.parametrize("failure", [GONE, CLOSED, SLOW, refusal(429), refusal(503, **{"retry-after": "1"})], ids=str)
def test_what_failed_for_a_moment_is_asked_again(made, failure):
    script = Script(failure, failure, answer())
    assert made(script, Time())("surgeon", "kestrel").skill_level == "expert"
    assert asked(script) == ["GET /surgeons/kestrel"] * 3


@both
@pytest.mark.parametrize("status", [400, 401, 403, 404, 409, 410, 412, 413, 415, 422, 500, 502, 503])
def test_what_is_refused_for_good_is_refused_at_once(made, status):
    script, passing = Script(refusal(status)), Time()
    with pytest.raises(Problem) as refused:
        made(script, passing)("surgeon", "kestrel")
    assert (refused.value.status, refused.value.kind, len(script.asked), passing.slept) == (status, "busy", 1, [])


@both
@pytest.mark.parametrize(
    ("call", "words"),
    [("release", ("kestrel", "simple-running", 1)), ("withdraw", ("kestrel", "simple-running")), ("make_key", ("me",))],
)
def test_a_release_withdrawal_or_key_call_of_unknown_fate_is_not_retried(made, call, words):
    for unknown in (GONE, SLOW):
        script = Script(unknown, answer())
        with pytest.raises(NotReached):
            made(script, Time())(call, *words)
        assert len(script.asked) == 1
    for nothing_was_done in (CLOSED, refusal(429), refusal(503, **{"retry-after": "0"})):
        script = Script(nothing_was_done, refusal(404))
        with pytest.raises(Problem):
            made(script, Time())(call, *words)
        assert len(script.asked) == 2


@both
def test_any_request_of_ones_own_is_repeated_only_if_it_reads(made):
    for method, times in (("GET", 2), ("POST", 1)):
        script = Script(GONE, answer())
        try:
            made(script, Time())("send", method, "/surgeons")
        except NotReached:
            assert method == "POST"
        assert len(script.asked) == times


@both
def test_pauses_grow_to_a_bound_and_are_left_to_chance_by_half(made):
    passing = Time()
    with pytest.raises(NotReached):
        made(Script(CLOSED), passing, retrying=Retrying(attempts=9, first_s=1, longest_s=4, deadline_s=1e9))("surgeons")
    assert len(passing.slept) == 8
    for slept, full in zip(passing.slept, [1, 2, 4, 4, 4, 4, 4, 4], strict=True):
        assert full / 2 <= slept <= full
    assert len(set(passing.slept)) > 3


@both
def test_the_service_says_when_to_come_back_in_seconds_or_by_a_date(made):
    passing = Time()
    made(Script(refusal(429, **{"retry-after": "7"}), answer()), passing)("surgeon", "kestrel")
    assert passing.slept == [7.0]
    later = email.utils.format_datetime(datetime.now(UTC) + timedelta(seconds=20), usegmt=True)
    passing = Time()
    made(Script(refusal(503, **{"retry-after": later}), answer()), passing)("surgeon", "kestrel")
    assert 15 < passing.slept[0] <= 20


@both
def test_who_is_asked_to_come_back_after_the_deadline_does_not_wait(made):
    passing = Time()
    with pytest.raises(Problem) as refused:
        made(Script(refusal(429, **{"retry-after": "3600"})), passing)("surgeons")
    assert (refused.value.retry_after_s, passing.slept) == (3600.0, [])


@both
def test_at_last_it_says_where_how_often_and_why(made):
    with pytest.raises(NotReached, match=r"http://127.0.0.1:9.* gave no answer in .* 5 attempts"):
        made(Script(CLOSED), Time())("surgeons")


@pytest.mark.parametrize("failure", [CLOSED, refusal(429), refusal(503, **{"retry-after": "2"})], ids=str)
@given(
    attempts=st.integers(1, 40),
    first_s=st.floats(0.001, 100),
    longest_s=st.floats(0.001, 100),
    deadline_s=st.floats(0, 300),
)
def test_no_settings_make_it_wait_beyond_its_deadline_or_ask_more_often(
    failure, attempts, first_s, longest_s, deadline_s
):
    script, passing = Script(failure), Time()
    with pytest.raises((NotReached, Problem)):
        BOTH[0](script, passing, retrying=Retrying(attempts, first_s, longest_s, deadline_s))("surgeons")
    assert passing.now_s <= deadline_s
    assert len(script.asked) <= attempts


def test_an_address_that_nobody_listens_at_is_told_within_seconds():
    from skills.client import Client

    began = time.monotonic()
    with Client("http://127.0.0.1:9", retrying=Retrying(attempts=2)) as client, pytest.raises(NotReached):
        client.surgeons()
    assert time.monotonic() - began < 30 * crowded()


@both
def test_an_address_that_is_none_is_not_tried_again(made):
    script = Script(httpx.UnsupportedProtocol("Request URL is missing an 'http://' or 'https://' protocol."))
    with pytest.raises(NotReached):
        made(script, Time())("surgeons")
    assert len(script.asked) == 1


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_requests_on_its_own_connection_wait_as_long_as_its_calls(kind):
    """Before, `client.http` gave up after the 5 s of httpx, whatever `timeout_s` said."""
    assert kind("http://127.0.0.1:8000").http.timeout == httpx.Timeout(60.0)
    assert kind("http://127.0.0.1:8000", timeout_s=7.0).http.timeout == httpx.Timeout(7.0)


@both
def test_no_answer_names_its_cause_and_counts_its_attempts(made):
    for cause in ("certificate verify failed: self-signed certificate", "Name or service not known"):
        with pytest.raises(NotReached) as failed:
            made(Script(httpx.ConnectError(cause)), Time(), retrying=Retrying(attempts=1))("surgeons")
        assert cause in failed.value.message and "1 attempt " in failed.value.message
