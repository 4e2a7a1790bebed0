"""Sessions whose clients reset, stall, flood or stop half way: the service releases everything and serves others."""

import os
import socket
import struct
import subprocess
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx2 as httpx
import pytest
from websockets.sync.client import connect

from skills.client import Client
from skills.serving import FRAMES, SLICE_BYTES
from tests.api.posed import of_pose_style
from tests.api.service import KESTREL, POLICY
from tests.e2e.conftest import Service
from tests.e2e.test_hostile_clients import sockets_at
from tests.waiting import END_S, until

SOME = 10
POSE = b'{"position_mm": [-10, 55, -135], "rotation_xyzw": [0.70710678, 0.70710678, 0, 0]}'


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield a service in a process of its own that serves a pose style, with short timeouts."""
    folder = tmp_path_factory.mktemp("sessions")
    url = of_pose_style("sqlite", folder)
    found = Service(folder, database_url=url, workers=0, heartbeat_s=0.3, session_idle_s=1.0)
    found.start()
    try:
        yield found
    finally:
        assert found.process is not None
        found.process.terminate()
        found.process.wait(END_S)


def gauge(service: Service) -> float:
    text = httpx.get(f"{service.url}/metrics", timeout=END_S).text
    (line,) = [line for line in text.splitlines() if line.startswith("skills_sessions_open ")]
    return float(line.split()[1])


def clients(process: subprocess.Popen[bytes], port: int) -> int:
    """Count the sockets of clients that a service has open."""
    of_port, found = sockets_at(port), 0
    for one in Path(f"/proc/{process.pid}/fd").iterdir():
        try:
            found += os.readlink(one) in of_port
        except FileNotFoundError:  # it was closed meanwhile
            continue
    return found


def opened(service: Service) -> socket.socket:
    """Open a session, and read its first message."""
    connection = socket.create_connection(("127.0.0.1", service.port), END_S)
    key = b64encode(os.urandom(16)).decode()
    head = (f"GET {POLICY}/session HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade")
    rest = (f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", "")
    connection.sendall("\r\n".join(head + rest).encode())
    read = b""
    while b'"limits"' not in read:
        piece = connection.recv(4096)
        assert piece, read
        read += piece
    return connection


def frame(payload: bytes) -> bytes:
    """Return a masked frame; a mask of zeros leaves the payload as it is."""
    return bytes([0x81, 0x80 | len(payload)]) + bytes(4) + payload


def reset(connection: socket.socket) -> None:
    connection.sendall(frame(POSE) * 3)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


def half_a_frame(connection: socket.socket) -> None:
    connection.sendall(frame(POSE)[:20])


def stalled(connection: socket.socket) -> None:
    connection.sendall(frame(POSE))


def flood(connection: socket.socket) -> None:
    try:
        connection.sendall(frame(POSE) * 5000)
    except OSError:  # it was closed meanwhile
        return


def pings(connection: socket.socket) -> None:
    connection.sendall(bytes([0x89, 0x80, 0, 0, 0, 0]) * 5000)


def pieces(connection: socket.socket) -> None:
    """Send a message in empty pieces that never ends."""
    connection.sendall(bytes([0x01, 0x80, 0, 0, 0, 0]) + bytes([0x00, 0x80, 0, 0, 0, 0]) * 5000)


@pytest.mark.parametrize("send", [pings, pieces])
def test_frames_that_never_reach_a_session_are_limited_too(running: Service, send: Callable[[socket.socket], None]):
    until(lambda: gauge(running) == 0)
    connection = opened(running)
    with suppress(OSError):
        send(connection)
    read = b""
    with suppress(ConnectionResetError):
        while piece := connection.recv(4096):
            read += piece
    connection.close()
    assert read.count(b"\x8a\x00") <= FRAMES + SLICE_BYTES // 6, "few pings are answered"
    assert b"At most 5 frames without a message a second" in read
    until(lambda: gauge(running) == 0)


def too_long(connection: socket.socket) -> None:
    connection.sendall(bytes([0x81, 0x80 | 126]) + (5000).to_bytes(2, "big") + bytes(4) + bytes(5000))


def unmasked(connection: socket.socket) -> None:
    connection.sendall(bytes([0x81, len(POSE)]) + POSE)


@pytest.mark.nightly  # by day tests/api/test_sessions.py closes sessions for the same reasons, without a server
@pytest.mark.parametrize("leave", [reset, half_a_frame, stalled, flood, pings, pieces, too_long, unmasked])
def test_sessions_that_go_wrong_leave_nothing_behind(running: Service, leave: Callable[[socket.socket], None]):
    assert running.process is not None
    until(lambda: gauge(running) == 0)
    before = clients(running.process, running.port)
    gone = [opened(running) for _ in range(SOME)]
    for one in gone:
        leave(one)
    with connect(f"ws://127.0.0.1:{running.port}{POLICY}/session") as beside:  # another client is served meanwhile
        beside.recv()
        beside.send(POSE.decode())
        assert '"inside":true' in str(beside.recv())
    until(lambda: gauge(running) == 0)
    until(lambda: clients(running.process, running.port) <= before)
    for one in gone:
        one.close()
    with Client(running.url) as client:
        assert client.pose_style(**KESTREL).version == 1
