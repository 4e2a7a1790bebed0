"""Clients that disconnect, stall or stop half way: the service releases everything and serves others."""

import errno
import os
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import httpx2 as httpx
import pytest
from sqlalchemy import text

from skills.api.uploads import SPOOL_BYTES
from skills.db.session import Database
from skills.library.people.erasure import erase_demo
from tests import backends
from tests.e2e.conftest import Service
from tests.e2e.test_keys_served import wait_until_alive
from tests.library import cases

SOME = 15
ALL = 200
DEADLINE_S = 60.0
SAMPLES = 18_000  # per leg: a table of 3 MB in three chunks, more than the buffers of both ends of a connection
PATIENCE_S = 1.0
BYTES_PER_S = 10_000_000
HEARTBEAT_S = 0.2
SENT_BYTES = 10_000  # of a body before its sender stops
SPOOLED_BYTES = SPOOL_BYTES + SENT_BYTES  # of every fifth body: more than is buffered in memory


@pytest.fixture(scope="module", params=backends.BACKENDS)
def installation(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator["Installation"]:
    folder = tmp_path_factory.mktemp("hostile")
    url = backends.fresh(request.param, folder)
    with closing(Database(url)) as database:
        cases.add_surgeon(database)
        large = cases.table(cases.points_mm(samples=SAMPLES), rate_hz=20_000.0)
        demo = cases.add_demo(database, large)
        spool = folder / "spool"
        spool.mkdir()
        job = cases.ask_training(database)  # no worker takes it
        service = Service(
            folder,
            database_url=url,
            workers=0,
            heartbeat_s=HEARTBEAT_S,
            upload_patience_s=PATIENCE_S,
            upload_bytes_per_s=BYTES_PER_S,
            download_patience_s=PATIENCE_S,
        )
        service.environment["TMPDIR"] = str(spool)
        service.launch()
        try:
            with httpx.Client(base_url=service.url, timeout=DEADLINE_S) as http:
                wait_until_alive(http, service.process)
                yield Installation(service, http, database, spool, demo.sha256, large, job.id)
        finally:
            service.stop()
    backends.drop(url)


class Installation:
    """A service without workers in a separate process, and a large recording in it."""

    def __init__(
        self,
        service: Service,
        http: httpx.Client,
        database: Database,
        spool: Path,
        demo: str,
        recording: bytes,
        job: str,
    ) -> None:
        self.service, self.http, self.database, self.spool = service, http, database, spool
        self.download, self.recording = f"/demos/{demo}/recording", recording
        self.events = f"/jobs/{job}/events"
        self.begun = 0

    def connect(self, received_bytes: int | None = None) -> socket.socket:
        """Connect; with a small receive buffer the service soon has to wait for this side."""
        connection = socket.socket()
        connection.settimeout(DEADLINE_S)
        if received_bytes is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, received_bytes)
        connection.connect(("127.0.0.1", self.service.port))
        return connection

    def ask(self, path: str, *lines: str, method: str = "GET", received_bytes: int | None = None) -> socket.socket:
        """Send the head of a request for a path."""
        connection = self.connect(received_bytes)
        connection.sendall("\r\n".join([f"{method} {path} HTTP/1.1", "Host: localhost", *lines, "", ""]).encode())
        return connection

    def gauge(self, name: str) -> float:
        """Return a gauge of /metrics."""
        found = re.search(rf"^{name} ([0-9.e+]+)$", self.http.get("/metrics").text, re.MULTILINE)
        assert found is not None, name
        return float(found[1])

    def held(self) -> dict[str, float]:
        """Return the service's resources in use, without this test's own request to /metrics."""
        gauges = {
            "connections of the database in use": self.gauge("skills_database_connections_in_use"),
            "requests in progress": self.gauge("skills_requests_in_progress") - 1,
        }
        clients = sockets_at(self.service.port)
        opened = [place for place in self.descriptors() if not place.startswith("socket:") or place in clients]
        return {
            **gauges,
            "descriptors of clients": sum(place in clients for place in opened),
            "descriptors of files": sum(place not in clients for place in opened),
            "files in the temporary folder": self.spooled(),
            "open transactions": self.transactions(),
            "bytes of the write-ahead log": self.logged_bytes(),
        }

    def descriptors(self) -> list[str]:
        """List the service's open files; a pool keeps its own connections to the database, as files or sockets."""
        found = []
        for one in Path(f"/proc/{self.service.process.pid}/fd").iterdir():
            with suppress(FileNotFoundError):  # it was closed meanwhile
                found.append(str(one.readlink()))
        return [place for place in found if not re.search(r"\.sqlite(-wal|-shm)?$", place)]

    def spooled(self) -> int:
        """Count the temporary files: named ones, and unnamed ones that exist while they are open."""
        named = sum(len(found) for _, _, found in os.walk(self.spool))
        return named + sum(place.startswith(str(self.spool)) for place in self.descriptors())

    def logged_bytes(self) -> int:
        """Return the write-ahead log's size after a checkpoint.

        PostgreSQL's is the server's, pinned by transactions only.
        """
        if self.database.engine.dialect.name != "sqlite":
            return 0
        self.database.forget()
        return Path(f"{self.database.engine.url.database}-wal").stat().st_size

    def transactions(self) -> int:
        """Count the transactions that prevent the write-ahead log, or the server's dead rows, from being released."""
        if self.database.engine.dialect.name == "sqlite":
            with self.database.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                blocked, left, moved = connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)").one()
                return int(blocked or left != moved)
        open_ = "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND pid != pg_backend_pid()"
        with self.database.reading() as session:
            return session.scalar(text(f"{open_} AND xact_start IS NOT NULL")) or 0


def sockets_at(port: int) -> set[str]:
    """List the listening side's sockets of a port of this machine, as /proc names them; closed ones have 0."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return {f"socket:[{line[9]}]" for line in lines if line[1].endswith(f":{port:04X}")}


def unread_download(installation: Installation) -> socket.socket:
    """Begin a download that the service cannot complete, because nobody reads it."""
    connection = installation.ask(installation.download, received_bytes=4096)
    assert connection.recv(1000).startswith(b"HTTP/1.1 200")
    return connection


def half_read_download(installation: Installation) -> socket.socket:
    """Read half of a download."""
    connection = installation.ask(installation.download, received_bytes=1 << 16)
    read = 0
    while read < len(installation.recording) // 2:
        piece = connection.recv(1 << 16)
        assert piece
        read += len(piece)
    return connection


def unread_events(installation: Installation) -> socket.socket:
    """Request a job's events, and read no response."""
    return installation.ask(installation.events, received_bytes=4096)


def half_read_events(installation: Installation) -> socket.socket:
    """Read the head of a stream of events and half of the first one."""
    connection = installation.ask(installation.events)
    read = b""
    while b"event: job\ndata: {" not in read:
        piece = connection.recv(20)
        assert piece
        read += piece
    assert read.startswith(b"HTTP/1.1 200")
    return connection


def half_sent_upload(installation: Installation) -> socket.socket:
    """Send half of a recording; every fifth is so large that it is spooled to a file."""
    installation.begun += 1
    size = SPOOLED_BYTES if installation.begun % 5 == 0 else SENT_BYTES
    lines = ("Content-Type: text/csv", f"Content-Length: {2 * size}")
    connection = installation.ask("/recordings", *lines, method="POST")
    with suppress(ConnectionError):  # on a slow machine it is refused already
        connection.sendall(b"t_s,x_mm,y_mm,z_mm\n".ljust(size, b"0"))
    return connection


def reset(connection: socket.socket) -> None:
    """Reset the connection, as a killed process does."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


def end_the_body(connection: socket.socket) -> None:
    """Close the sending side, and wait until the service has finished the request."""
    with suppress(OSError):  # the service has finished already, and closed the connection
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(1 << 16):
            pass
    connection.close()


def wait_for_the_refusal(connection: socket.socket) -> None:
    """Send nothing until the service times out."""
    with closing(connection):
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 408")


def wait_for_the_cut(connection: socket.socket) -> None:
    """Read nothing until the service times out, which ends the connection with an error."""
    wait_until(lambda: connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ECONNRESET)
    connection.close()


def leave_after_signs_of_life(connection: socket.socket) -> None:
    """Read none of the heartbeats, and disconnect after some of them."""
    wait_until(lambda: connection.recv(1 << 16, socket.MSG_PEEK).count(b": the job goes on") > 2)
    reset(connection)


Begin = Callable[[Installation], socket.socket]
Leave = Callable[[socket.socket], None]
CLIENTS: dict[str, tuple[Begin, Leave]] = {
    "download, aborted": (unread_download, reset),
    "download, half read": (half_read_download, socket.socket.close),
    "download, stalled": (unread_download, wait_for_the_cut),
    "events, aborted": (unread_events, reset),
    "events, half read": (half_read_events, socket.socket.close),
    "events, stalled": (unread_events, leave_after_signs_of_life),
    "upload, aborted": (half_sent_upload, reset),
    "upload, half sent": (half_sent_upload, end_the_body),
    "upload, stalled": (half_sent_upload, wait_for_the_refusal),
}


def wait_until(it_is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not it_is_so():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def settles(installation: Installation, before: dict[str, float]) -> None:
    """Wait until the service uses no more of any resource than before.

    It may use less: an earlier request's connection to the database or spooled file may have been open when
    `before` was taken.
    """
    deadline = time.monotonic() + DEADLINE_S
    while more := {
        resource: (before[resource], number)
        for resource, number in installation.held().items()
        if not number <= before[resource]
    }:
        assert time.monotonic() < deadline, more
        time.sleep(0.1)


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("number", [SOME, pytest.param(ALL, marks=pytest.mark.nightly)])
def test_clients_that_go_away_leave_nothing_behind(installation: Installation, client: str, number: int):
    begin, leave = CLIENTS[client]
    before = installation.held()
    gone = [begin(installation) for _ in range(number)]
    wait_until(lambda: installation.gauge("skills_requests_in_progress") - 1 > before["requests in progress"])
    if begin is half_sent_upload:
        wait_until(lambda: installation.spooled() > before["files in the temporary folder"])
    assert installation.http.get("/surgeons").status_code == 200
    wait_until(lambda: installation.transactions() == 0)
    for one in gone:
        leave(one)
    settles(installation, before)


def test_a_recording_that_is_erased_while_it_is_read_ends_as_an_error(installation: Installation):
    demo = cases.add_demo(installation.database, installation.recording.replace(b"0.0002,", b"0.00021,", 1))
    connection = installation.ask(f"/demos/{demo.sha256}/recording", received_bytes=4096)
    head, _, body = connection.recv(4096).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200")

    def erase() -> None:
        with installation.database.writing() as session:
            erase_demo(session, demo.sha256, "local")

    read = len(body)
    with ThreadPoolExecutor(1) as thread:
        erasing = thread.submit(erase)
        while not erasing.done():  # slowly, but above the rate below which it is cut
            read += len(connection.recv(4096))
            time.sleep(0.05)
        erasing.result()
    while piece := connection.recv(1 << 16):
        read += len(piece)
    (length,) = re.findall(rb"content-length: (\d+)", head)
    assert 0 < read < int(length)
    connection.close()
