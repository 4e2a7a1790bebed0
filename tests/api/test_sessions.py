"""Sessions of pose styles: poses in, next poses out, and the reasons for which one is refused or closed."""

import asyncio
import json
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from threading import get_ident
from time import monotonic, sleep
from typing import Any

import pytest
from sqlalchemy import event
from starlette.testclient import WebSocketDenialResponse, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from skills.api import sessions
from skills.api.sessions import (
    BURST,
    BUSY,
    ERASED,
    FLOODED,
    FORBIDDEN,
    IDLE,
    NO_JSON,
    NO_TEXT,
    SIGNED_OUT,
    UNREADABLE,
    UNWATCHED,
    WITHDRAWN,
)
from skills.errors import Busy, TooMany
from skills.library.people.erasure import erase_surgeon
from skills.library.people.keys import create_key, revoke_key
from skills.library.policies.releases import release
from skills.library.policies.versions import find_version
from tests import backends
from tests.api.posed import of_both_arms, of_pose_style
from tests.api.service import KESTREL, POLICY, Service, serving
from tests.library import cases
from tests.waiting import END_S, crowded, until

SESSION = f"ws://localhost{POLICY}/session"


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy machine take its time to read the database."""
    for name in ("UNKNOWN_S", "UNREAD_S", "STAYS_LATE_S", "MESSAGE_S"):
        monkeypatch.setattr(sessions, name, 0.0 if name == "MESSAGE_S" else END_S)


@pytest.fixture(params=backends.BACKENDS)
def posed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Service]:
    """Yield a service that serves a pose style, with a second version that is not released."""
    url = of_pose_style(request.param, tmp_path)
    with serving(url, key_sessions=2) as service:
        yield service
        until(lambda: service.app.state.sessions.places.count == 0)
    backends.drop(url)


def opened(service: Service, key: str | None = None) -> AbstractContextManager[WebSocketTestSession]:
    return service.http.websocket_connect(SESSION, headers={"Authorization": f"Bearer {key}"} if key else {})


def a_key(service: Service, *surgeons: str) -> tuple[str, str]:
    """Create a key of a reader, and return its id and its text."""
    with service.database.writing() as session:
        row, text = create_key(session, "lab", "reader", "test", surgeons=list(surgeons) or None)
        return row.id, text


def start_of(service: Service) -> dict[str, Any]:
    style = service.http.get(f"{POLICY}/pose-style").json()
    return {name: style[name][0] for name in ("position_mm", "rotation_xyzw")}


def closed(socket: WebSocketTestSession) -> tuple[int, str]:
    """Return the code and the reason with which the service closes a session; answers before are left out."""
    while True:
        try:
            socket.receive_text()
        except WebSocketDisconnect as ended:
            return ended.code, ended.reason


def denied(answer: WebSocketDenialResponse, status: int) -> None:
    """Assert that a session was refused before it was opened, with a problem document."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == status


def test_a_session_follows_the_poses_as_next_does(posed: Service):
    hand, phase = start_of(posed), None
    with opened(posed) as socket:
        opening = socket.receive_json()
        assert (opening["version"], opening["frame"], opening["phases"]) == (1, "PSM2_base", 101)
        limits = {"rate_hz": 100.0, "burst": 50.0, "message_bytes": 4096, "idle_s": 30.0}
        assert opening["limits"] == limits | {"late_ms": 10.0, "stays_late_s": END_S}
        for _ in range(20):
            socket.send_json(hand)
            answer = socket.receive_json()
            asked = posed.http.post(f"{POLICY}/next", json=hand | {"phase": phase}).json()
            assert answer.pop("late_ms") is None or crowded() > 1
            assert answer == {name: asked[name] for name in answer if name in asked} | {"newer_version": None}
            hand, phase = {name: answer[name] for name in hand}, answer["phase"]
    assert phase == 20


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_a_session_has_the_other_arm_as_next_does(backend: str, tmp_path: Path):
    url = of_both_arms(backend, tmp_path)
    with serving(url) as service:
        hand, phase = start_of(service), None
        there = service.http.get(f"{POLICY}/pose-style").json()["partner_motion"]
        with opened(service) as socket:
            socket.receive_json()
            for _ in range(5):
                socket.send_json(hand)
                answer = socket.receive_json()
                asked = service.http.post(f"{POLICY}/next", json=hand | {"phase": phase}).json()
                hand, phase = {name: answer[name] for name in hand}, answer["phase"]
                other = {"arm": "PSM1", **{name: there[name][phase] for name in (*hand, "jaw_rad")}}
                assert answer["partner_pose"] == asked["partner_pose"] == other
        until(lambda: service.app.state.sessions.places.count == 0)
    backends.drop(url)


def test_a_message_that_is_no_pose_is_answered_and_the_session_stays(posed: Service):
    hand = start_of(posed)
    wrong = [
        {},
        {"position_mm": [0, 0], "rotation_xyzw": [0, 0, 0, 1]},
        hand | {"rotation_xyzw": [0, 0, 0, 2]},
        hand | {"position_mm": [0, 0, True]},
        hand | {"phase": 101},
        hand | {"faster": 1},
    ]
    with opened(posed) as socket:
        socket.receive_json()
        for message in wrong:
            socket.send_json(message)
            assert [*socket.receive_json()] == ["error"], message
        socket.send_text(json.dumps(hand).replace("-135.0", "1e999"))
        assert [*socket.receive_json()] == ["error"]
        socket.send_json(hand)
        assert socket.receive_json()["phase"] == 1


@pytest.mark.parametrize("text", ["", "{", "[]", "1", '{"phase": NaN}', '{"phase": 1, "phase": 2}', "[" * 4000])
def test_what_is_no_object_of_json_closes_the_session(posed: Service, text: str):
    with opened(posed) as socket:
        socket.send_text(text)
        assert closed(socket)[0] == NO_JSON


def test_bytes_and_a_flood_close_the_session(posed: Service):
    with opened(posed) as socket:
        socket.send_bytes(b"{}")
        assert closed(socket)[0] == NO_TEXT
    with opened(posed) as socket:
        for _ in range(20 * int(BURST)):
            socket.send_text("{}")
        assert closed(socket)[0] == FLOODED


def test_a_withdrawal_closes_the_session_with_the_reason(posed: Service):
    with opened(posed) as socket:
        posed.client.withdraw(**KESTREL)
        assert closed(socket) == (WITHDRAWN, "The release was withdrawn.")
    with pytest.raises(WebSocketDenialResponse) as refused, opened(posed):
        pass
    denied(refused.value, 404)


def test_an_erasure_and_the_end_of_consent_close_the_session(posed: Service):
    with opened(posed) as socket:
        with posed.database.writing() as session:
            cases.agree(session, {"uses": ["atlas"]})
        assert closed(socket)[0] in (WITHDRAWN, FORBIDDEN)
    with posed.database.writing() as session:
        cases.agree(session, {"uses": ["training"]})
        release(session, find_version(session, "kestrel", cases.SUTURE, 1), "test")
    with opened(posed) as socket:
        with posed.database.writing() as session:
            erase_surgeon(session, "kestrel", "test")
        assert closed(socket) == (ERASED, "The style was erased.")


def test_sessions_close_where_a_withdrawal_would_not_be_seen(posed: Service, monkeypatch: pytest.MonkeyPatch):
    def unread(*_: object) -> None:
        raise Busy("The database is busy.")

    monkeypatch.setattr(sessions, "UNREAD_S", 0.3)
    monkeypatch.setattr(sessions, "_look", unread)
    with opened(posed) as socket:
        assert closed(socket) == (BUSY, UNREADABLE)


def test_no_pose_is_given_while_the_database_is_unread(posed: Service, monkeypatch: pytest.MonkeyPatch):
    hand, look, unread = start_of(posed), sessions._look, [Busy("The database is busy.")]

    def fails(*given: Any) -> Any:
        if unread:
            raise unread[0]
        return look(*given)

    with opened(posed) as socket:
        socket.receive_json()
        monkeypatch.setattr(sessions, "_look", fails)
        monkeypatch.setattr(posed.app.state.sessions._changes, "version", lambda: None)
        monkeypatch.setattr(sessions, "UNKNOWN_S", 0.3)

        def asked() -> dict[str, Any]:
            socket.send_json(hand)
            answer: dict[str, Any] = socket.receive_json()
            return answer

        until(lambda: asked() == {"error": sessions.UNREAD})
        unread.clear()
        until(lambda: "error" not in asked())


def test_a_late_answer_says_so_and_the_youngest_sessions_are_closed(posed: Service, monkeypatch: pytest.MonkeyPatch):
    hand = start_of(posed)
    with opened(posed) as first, opened(posed) as second:
        for socket in (first, second):
            socket.receive_json()
        monkeypatch.setattr(sessions, "LATE_S", -1.0)
        monkeypatch.setattr(sessions, "STAYS_LATE_S", 0.3)
        for socket in (first, second):
            socket.send_json(hand)
            assert socket.receive_json()["late_ms"] >= 0.0
        assert closed(second) == (BUSY, sessions.LATE)
        monkeypatch.setattr(sessions, "LATE_S", END_S)
        first.send_json(hand)
        assert first.receive_json()["late_ms"] is None


def test_a_session_for_which_the_processor_has_no_time_is_refused(posed: Service, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(posed.app.state.sessions._capacity, "_message_s", sessions.SHARE / sessions.RATE_HZ)
    with opened(posed) as socket:
        socket.receive_json()
        with pytest.raises(WebSocketDenialResponse) as refused, opened(posed):
            pass
        denied(refused.value, 429)
        assert float(refused.value.headers["retry-after"]) == sessions.AGAIN_S
        assert "no time for another session" in refused.value.json()["detail"]


def test_the_capacity_is_measured_and_admitted_sessions_count_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sessions, "WINDOW_S", 0.05)

    async def admitted() -> list[int]:
        capacity, found = sessions.Capacity(), []
        measuring = asyncio.create_task(capacity.measure())
        for message_s in (0.001, 0.0001):
            capacity._message_s, number = message_s, 0
            with suppress(TooMany):
                while True:
                    capacity.admit()
                    number += 1
            found.append(number)
            before_s = capacity._message_s
            began_s = monotonic()
            while monotonic() - began_s < 0.5:
                capacity.messages += 1000
                await asyncio.sleep(0.001)
            assert capacity._message_s < before_s / 2, "a thousand messages in a millisecond take less"
            assert capacity._load > 0
            assert sum(capacity._admitted) == 0
        measuring.cancel()
        return found

    few, many = asyncio.run(admitted())
    assert few == round(sessions.SHARE / 0.1)
    assert few < many <= round(sessions.SHARE / 0.01), "less the load of the first ones"


def test_a_new_release_is_told_and_changes_nothing(posed: Service):
    hand = start_of(posed)
    with opened(posed) as socket:
        assert socket.receive_json()["version"] == 1
        posed.client.release(**KESTREL, version=2)

        def newer() -> int | None:
            socket.send_json(hand | {"phase": 0})
            found: int | None = socket.receive_json()["newer_version"]
            return found

        until(lambda: newer() == 2)
    with opened(posed) as socket:
        assert socket.receive_json()["version"] == 2


def test_sessions_end_where_their_watcher_fails(posed: Service, monkeypatch: pytest.MonkeyPatch, caplog):
    def fails(*_: object) -> None:
        raise TypeError("planted")

    monkeypatch.setattr(sessions, "_look", fails)
    with opened(posed) as socket:
        assert closed(socket) == (BUSY, UNWATCHED)
    assert "a watcher of sessions failed" in caplog.text


def test_a_revoked_key_closes_its_session_and_no_other(posed: Service):
    (first, one), (_, other) = a_key(posed), a_key(posed, "kestrel")
    hand = {"position_mm": [-10, 55, -135], "rotation_xyzw": [0.5**0.5, 0.5**0.5, 0, 0]}
    with opened(posed, one) as socket, opened(posed, other) as beside:
        with posed.database.writing() as session:
            revoke_key(session, first, "test")
        assert closed(socket)[0] == SIGNED_OUT
        beside.receive_json()
        beside.send_json(hand)
        assert beside.receive_json()["inside"]


def test_who_may_not_open_one_is_refused_before_it_opens(posed: Service):
    posed.client.put_surgeon("heron")
    (_, key), (_, theirs) = a_key(posed), a_key(posed, "heron")
    for headers, status in (
        ({"Authorization": f"Bearer {theirs}"}, 404),
        ({"Authorization": "Bearer skills_nothing"}, 401),
        ({"Authorization": f"Bearer {key}", "Origin": "http://elsewhere.org"}, 403),
        ({"Authorization": f"Bearer {key}", "Host": "elsewhere.org"}, 400),
    ):
        with pytest.raises(WebSocketDenialResponse) as refused, posed.http.websocket_connect(SESSION, headers=headers):
            pass
        denied(refused.value, status)
    with opened(posed, key), opened(posed, key):
        with pytest.raises(WebSocketDenialResponse) as refused, opened(posed, key):
            pass
        denied(refused.value, 429)


def test_a_session_that_nobody_uses_is_closed(tmp_path: Path):
    with serving(of_pose_style("sqlite", tmp_path), session_idle_s=0.3) as service, opened(service) as socket:
        assert closed(socket) == (IDLE, "No message for 0.3 s.")


def test_commits_of_others_do_not_make_sessions_read_in_a_thread(tmp_path: Path):
    with serving(of_pose_style("sqlite", tmp_path)) as service, opened(service) as socket:
        socket.receive_json()
        sleep(3 * sessions.WATCH_S)  # the first look
        threads: list[int] = []
        event.listen(service.database.engine, "checkout", lambda *_: threads.append(get_ident()))
        other = sqlite3.connect(service.database.engine.url.database, isolation_level=None)
        other.execute("CREATE TABLE beats (n INTEGER)")
        for n in range(10):
            other.execute("INSERT INTO beats VALUES (?)", (n,))
            sleep(sessions.WATCH_S / 2)
        other.close()
        assert threads == []
        service.client.withdraw(**KESTREL)
        assert closed(socket)[0] == WITHDRAWN
        assert threads
