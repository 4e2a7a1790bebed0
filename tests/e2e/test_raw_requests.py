"""Requests on raw sockets that no client library sends: refused or dropped in time, nothing stored or left open."""

import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import httpx2 as httpx
import numpy as np
import pytest

from tests.api.service import CSV
from tests.e2e.conftest import Service, running
from tests.e2e.test_hostile_uploads import others_are_served, rows
from tests.library import cases
from tests.waiting import END_S, crowded

# A service of its own, for requests that uvicorn refuses; by day tests/e2e/test_hostile_clients.py stalls and aborts.
pytestmark = pytest.mark.nightly
LIMIT = 1_000_000
PATIENCE_S = 1.0
TABLE = cases.hand_off()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    limits = {"max_upload_bytes": LIMIT, "upload_patience_s": PATIENCE_S, "upload_bytes_per_s": 100_000}
    with running(tmp_path_factory.mktemp("raw"), workers=0, **limits) as service:
        with connected(service) as sent:  # the first reader of an upload opens files that stay
            sent.sendall(head("Content-Length: 9", "Connection: close") + b"not,a\n1,2"[:9])
            assert 400 <= status(sent) < 500
        yield service


@pytest.fixture
def untouched(service: Service) -> Iterator[None]:
    before, files = rows(service), open_files(service)
    yield
    assert rows(service) == before
    deadline = time.monotonic() + END_S
    while open_files(service) > files and time.monotonic() < deadline:
        time.sleep(0.1)
    assert open_files(service) <= files


def open_files(service: Service) -> int:
    """Count the service's open connections, and the bodies spooled to files."""
    opened = Path(f"/proc/{service.process.pid}/fd")
    where = []
    for one in opened.iterdir():
        with suppress(FileNotFoundError):  # it was closed meanwhile
            where.append(str(one.readlink()))
    return sum(not place.startswith(str(service.database)) for place in where)  # a pool keeps its own


def connected(service: Service) -> socket.socket:
    return socket.create_connection(("127.0.0.1", service.port), timeout=END_S)


def head(*more: str, path: str = "/recordings") -> bytes:
    lines = [f"POST {path} HTTP/1.1", "Host: localhost", f"Content-Type: {CSV}", *more, "", ""]
    return "\r\n".join(lines).encode()


def status(sent: socket.socket) -> int:
    """Return a response's status, 0 if the connection is closed without one."""
    try:
        answer = sent.recv(65536)
    except ConnectionResetError:
        return 0
    return int(answer.split(b" ", 2)[1]) if answer else 0


def test_a_body_declared_too_large_is_refused_before_it_is_sent(service, untouched):
    with connected(service) as sent:
        began = time.monotonic()
        sent.sendall(head(f"Content-Length: {LIMIT + 1}"))
        assert status(sent) == 413
        assert time.monotonic() - began < 0.5 * crowded()


def test_a_client_that_asks_first_is_told_not_to_send_it(service, untouched):
    with connected(service) as sent:
        sent.sendall(head(f"Content-Length: {LIMIT + 1}", "Expect: 100-continue"))
        assert status(sent) == 413


def test_a_body_without_length_is_stopped_at_the_limit(service, untouched):
    with connected(service) as sent:
        sent.sendall(head("Transfer-Encoding: chunked"))
        piece = b"%x\r\n" % 65536 + bytes(65536) + b"\r\n"
        for _ in range(LIMIT // 65536 + 2):
            sent.sendall(piece)
        assert status(sent) == 413


@pytest.mark.parametrize(
    "lines",
    [
        ("Transfer-Encoding: chunked", "Content-Length: 10"),
        ("Content-Length: 10", "Transfer-Encoding: chunked"),
        ("Content-Length: 10", "Content-Length: 11"),
        ("Content-Length: -1",),
        ("Content-Length: ten",),
        ("Content-Length: 10000000000000000000000000",),
        ("Transfer-Encoding: chunked, identity",),
        ("Transfer-Encoding: gzip",),
    ],
)
def test_a_length_that_can_be_read_in_two_ways_is_refused(service, untouched, lines):
    with connected(service) as sent:
        sent.sendall(head(*lines) + b"0\r\n\r\n0123456789")
        assert status(sent) in (0, 400, 411, 413, 501)


def test_a_sender_that_goes_away_at_any_of_30_places_leaves_nothing(service, untouched):
    whole = head(f"Content-Length: {len(TABLE)}") + TABLE
    for length in np.linspace(1, len(whole) - 1, 30).astype(int).tolist():
        with connected(service) as sent:
            sent.sendall(whole[:length])


def test_a_short_body_that_is_then_ended_leaves_nothing(service, untouched):
    with connected(service) as sent:
        sent.sendall(head(f"Content-Length: {len(TABLE) + 1}") + TABLE)
        sent.shutdown(socket.SHUT_WR)
        assert status(sent) in (0, 408, 422)


def test_a_body_that_does_not_come_is_not_waited_for(service, untouched):
    with connected(service) as sent:
        began = time.monotonic()
        sent.sendall(head(f"Content-Length: {len(TABLE)}") + TABLE[:10])
        assert status(sent) == 408
        assert PATIENCE_S * 0.9 < time.monotonic() - began < PATIENCE_S + crowded()
        while sent.recv(65536):  # the problem's body, then the end
            pass


def test_a_body_that_trickles_is_not_waited_for(service, untouched):
    with connected(service) as sent:
        sent.sendall(head(f"Content-Length: {len(TABLE)}"))
        sent.settimeout(0.1)
        began, answer = time.monotonic(), 0
        while not answer and time.monotonic() - began < END_S:
            sent.sendall(b"0")
            try:
                answer = status(sent)
            except TimeoutError:
                continue
        assert answer == 408


def test_a_body_that_comes_slowly_but_fast_enough_is_taken(service):
    table = cases.table(cases.points_mm(samples=700))  # 100 kB: a second at the required rate
    with connected(service) as sent:
        sent.sendall(head(f"Content-Length: {len(table)}") + table[:-10])
        time.sleep(1.3 * PATIENCE_S)
        sent.sendall(table[-10:])
        assert status(sent) == 201


def test_100_senders_that_stall_do_not_keep_others_from_being_served(service, untouched):
    stalled = [connected(service) for _ in range(100)]
    with httpx.Client(base_url=service.url, timeout=END_S) as http, others_are_served(http):
        for sent in stalled:
            sent.sendall(head(f"Content-Length: {len(TABLE)}") + TABLE[:100])
        with ThreadPoolExecutor(10) as threads:
            answers = list(threads.map(status, stalled))
    for sent in stalled:
        sent.close()
    assert set(answers) == {408}
