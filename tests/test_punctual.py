"""Connections that wait for no client for ever, over a small application on loopback."""

import socket
import threading
import time
from collections.abc import Iterator

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from skills import punctual
from skills.punctual import PunctualConnection

HEAD_S = 0.4


async def deaf(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer without reading the body."""
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(punctual, "HEAD_S", HEAD_S)
        config = uvicorn.Config(deaf, port=0, http=PunctualConnection, lifespan="off", log_level="critical")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run)
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield server.servers[0].sockets[0].getsockname()[1]
        server.should_exit = True
        thread.join()


@pytest.fixture
def sent(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as sent:
        yield sent


def closed_after_s(sent: socket.socket) -> float:
    began = time.monotonic()
    while sent.recv(65536):
        pass
    return time.monotonic() - began


@pytest.mark.parametrize("begun", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: 1"])
def test_a_head_that_does_not_come_is_not_waited_for(sent, begun):
    sent.sendall(begun)
    assert HEAD_S * 0.8 < closed_after_s(sent) < HEAD_S + 1.0


def test_a_head_that_trickles_is_not_waited_for(sent):
    sent.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
    began = time.monotonic()
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        trickle(sent)
    assert time.monotonic() - began < HEAD_S + 1.0


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
    assert HEAD_S * 0.8 < closed_after_s(sent) < HEAD_S + 1.0


def test_a_body_that_nobody_reads_is_not_waited_for(sent):
    sent.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n0")
    assert closed_after_s(sent) < HEAD_S + 1.0


def test_a_body_that_comes_after_its_answer_leaves_the_connection_open(sent):
    for _ in range(2):
        sent.sendall(b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\n01")
        time.sleep(HEAD_S / 4)
        sent.sendall(b"23")
        assert sent.recv(65536).endswith(b"ok")
        time.sleep(HEAD_S * 1.5)
