"""HTTP timeouts: connections never wait for a client for ever, tested with a small application on loopback."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from skills import serving
from skills.serving import connections
from skills.settings import Settings
from tests.waiting import END_S, crowded, until

HEAD_S = 1.0  # half of it passes between two requests, and a busy machine may add as much
PATIENCE_S = 0.5
BYTES_PER_S = 100_000
LARGE = 8 << 20  # more than the buffers of both ends of a connection
SMALL_BUFFER = 1 << 16
answered: list[str] = []  # the paths of the requests that the application has finished


async def deaf(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer without reading the body: /large in one piece, /pieces in pieces, else in two bytes."""
    size = LARGE if scope["path"] in ("/large", "/pieces") else 2
    piece = SMALL_BUFFER if scope["path"] == "/pieces" else size
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % size)]})
    for begin in range(0, size, piece):
        body = b"ok" if size == 2 else bytes(piece)
        await send({"type": "http.response.body", "body": body, "more_body": begin + piece < size})
    answered.append(scope["path"])


@pytest.fixture(scope="module")
def server() -> Iterator[uvicorn.Server]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serving, "HEAD_S", HEAD_S)
        patch.setattr(serving, "LOOK_S", PATIENCE_S / 10)
        patient = Settings(download_patience_s=PATIENCE_S, download_bytes_per_s=BYTES_PER_S)
        config = uvicorn.Config(deaf, port=0, http=connections(patient), lifespan="off", log_level="critical")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run)
        thread.start()
        until(lambda: server.started)
        yield server
        server.should_exit = True
        thread.join()


@pytest.fixture
def port(server: uvicorn.Server) -> int:
    until(lambda: not server.server_state.connections)
    return server.servers[0].sockets[0].getsockname()[1]


@pytest.fixture
def sent(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=END_S) as sent:
        yield sent


def closed_after_s(sent: socket.socket) -> float:
    began = time.monotonic()
    while sent.recv(65536):
        pass
    return time.monotonic() - began


@pytest.mark.parametrize("begun", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: 1"])
def test_a_head_that_does_not_come_is_not_waited_for(sent, begun):
    sent.sendall(begun)
    assert HEAD_S * 0.8 < closed_after_s(sent) < HEAD_S + crowded()


def test_a_head_that_trickles_is_not_waited_for(sent):
    sent.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
    began = time.monotonic()
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        trickle(sent)
    assert time.monotonic() - began < HEAD_S + crowded()


def trickle(sent: socket.socket) -> None:
    for _ in range(100):
        sent.sendall(b"x-y: z\r\n")
        time.sleep(0.05)


def test_a_second_head_is_waited_for_as_long(sent):
    request = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
    for _ in range(3):
        sent.sendall(request)
        assert sent.recv(65536).endswith(b"ok")
        time.sleep(HEAD_S / 2)
    sent.sendall(request[:20])
    assert HEAD_S * 0.8 < closed_after_s(sent) < HEAD_S + crowded()


def test_a_body_that_nobody_reads_is_not_waited_for(sent):
    sent.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n0")
    assert closed_after_s(sent) < HEAD_S + crowded()


def test_a_body_that_comes_after_its_answer_leaves_the_connection_open(sent):
    for _ in range(2):
        sent.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\n01")
        time.sleep(HEAD_S / 4)
        sent.sendall(b"23")
        assert sent.recv(65536).endswith(b"ok")
        time.sleep(HEAD_S * 1.5)


def ask(port: int, path: str, *lines: str) -> socket.socket:
    """Request a path with a small receive buffer, so that the server has to wait for its reader."""
    sent = socket.socket()
    sent.settimeout(END_S)
    sent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SMALL_BUFFER)
    sent.connect(("127.0.0.1", port))
    sent.sendall("\r\n".join([f"GET {path} HTTP/1.1", "Host: localhost", *lines, "", ""]).encode())
    return sent


def read_at(sent: socket.socket, bytes_per_s: float, at_most: int = 2 * LARGE) -> int:
    """Read steadily until the end, and count: without an end of its own the server has cut the connection."""
    began, read = time.monotonic(), 0
    with suppress(ConnectionResetError):
        while read < at_most and (piece := sent.recv(16384)):
            read += len(piece)
            time.sleep(max(0.0, read / bytes_per_s - (time.monotonic() - began)))
    return read


@pytest.mark.parametrize("lines", [(), ("Connection: close",)])
@pytest.mark.parametrize("path", ["/large", "/pieces"])
def test_a_client_that_stops_reading_is_not_waited_for(server, port, path, lines):
    with ask(port, path, *lines) as sent:
        assert sent.recv(1000).startswith(b"HTTP/1.1 200")
        assert PATIENCE_S * 0.8 < until(lambda: not server.server_state.connections) < 2 * PATIENCE_S + crowded()
        assert answered.pop() == path
        assert 0 < read_at(sent, 1e9) < LARGE


def test_a_client_that_reads_too_slowly_is_not_waited_for(server, port):
    with ask(port, "/pieces", "Connection: close") as sent:
        assert sent.recv(1000).startswith(b"HTTP/1.1 200")
        piece = BYTES_PER_S // 500  # a tenth of the rate, and less: `until` polls 50 times a second
        until(lambda: not server.server_state.connections or not sent.recv(piece))
        assert not server.server_state.connections
        assert 0 < read_at(sent, 1e9) < LARGE


@pytest.mark.parametrize("path", ["/large", "/pieces"])
def test_a_client_that_reads_slowly_but_fast_enough_is_waited_for(port, path):
    enough = 5 * BYTES_PER_S
    with ask(port, path) as sent:
        assert read_at(sent, enough, at_most=3 * PATIENCE_S * enough) >= 3 * PATIENCE_S * enough
        assert read_at(sent, 1e9, at_most=LARGE - int(4 * PATIENCE_S * enough)) > LARGE / 2


def test_a_client_that_read_fast_and_then_stops_is_granted_no_more_for_it(server, port):
    with ask(port, "/pieces") as sent:
        read_at(sent, 1e9, at_most=LARGE // 2)
        assert until(lambda: not server.server_state.connections) < 2 * PATIENCE_S + crowded()
