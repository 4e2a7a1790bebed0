"""Sessions of a pose style: 100 clients at 100 Hz over loopback against a real server, which admits what it can carry.

Those that it refuses must be told when to come again, those that it admits must be answered in time until their end at
a withdrawal. Then one session floods the server with pings, and the effect on another client is compared with that of
the same bytes over HTTP.

The clients are one process of their own, which writes frames by hand, so that it takes less than the server. The time
of a message counts from the moment at which it was due.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from time import monotonic, perf_counter, sleep
from typing import Any

import httpx2 as httpx
import numpy as np
from rich.table import Table

from skills.db.session import Database
from skills.learning.pose_step import next_pose
from skills.library.policies import releases
from skills.library.policies.pose_styles import poses_of
from skills.library.policies.versions import find_version, served_release
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.api.processes import free_port, wait_until_it_answers
from tests.api.service import KESTREL, MCAP, POLICY, serving
from tests.bench.hail import ROOT
from tests.bench.serving import processor_s
from tests.library.test_pose_styles import turning

CLIENTS, RATE_HZ, SECONDS = 100, 100.0, 10.0
FLOOD_S, PIECE = 8.0, 4096
CALLS = 5000
START = {"position_mm": [-10.0, 55.0, -135.0], "rotation_xyzw": [0.5**0.5, 0.5**0.5, 0.0, 0.0], "phase": 0}
TEXT, CLOSE, PING, MASKED = 0x81, 0x88, 0x89, 0x80
UPLOAD = b"POST /recordings HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/csv\r\nContent-Length: 250000000\r\n\r\n"


def session(table: Table, clients: int = CLIENTS, seconds: float = SECONDS) -> None:
    """Measure a tick in process, then sessions on each back end."""
    for backend in backends.BACKENDS:
        with tempfile.TemporaryDirectory(prefix="skills-session-") as folder:
            url = backends.fresh(backend, Path(folder))
            with serving(url) as service:
                service.client.put_surgeon("kestrel")
                service.client.add_demo(turning(), media_type=MCAP, **KESTREL)
                assert service.train(release=True)["result"]["released"]
            table.add_row(backend, f"load {os.getloadavg()[0]:.1f}", "of the machine before, over a minute")
            database = Database(url)
            if backend == "sqlite":
                in_process(table, database)
            over_loopback(table, database, clients, seconds)
            database.close()
            backends.drop(url)


def in_process(table: Table, database: Database) -> None:
    """Measure `next_pose`."""
    with database.reading() as opened:
        poses = poses_of(served_release(opened, **KESTREL).policy)
    path, limits, took = poses.path, poses.tube.limits, []
    for call in range(CALLS):
        phase = call % 100
        hand = path.tip_mm[phase].tolist(), path.rotation_xyzw[phase].tolist()
        began = perf_counter()
        next_pose(path, *hand, phase, limits)
        took.append(perf_counter() - began)
    table.add_row("  next in process", *percentiles(took))


def over_loopback(table: Table, database: Database, clients: int, seconds: float) -> None:
    """Measure sessions, then withdraw the release and measure when each is closed."""
    settings = Settings(database_url=database.url, port=free_port(), workers=0)
    server = subprocess.Popen([sys.executable, "-m", "skills", "serve"], cwd=ROOT, env=environment(settings))
    try:
        wait_until_it_answers(settings.port, server)
        command = [sys.executable, "-m", "tests.bench.session", str(settings.port), str(clients), str(seconds)]
        crowd = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert crowd.stdout is not None
        admitted, again_s = json.loads(crowd.stdout.readline())
        table.add_row("  admitted", f"{admitted} of {clients}", f"the others may come again in {again_s}")
        before_s = processor_s(server.pid)
        measured = json.loads(crowd.stdout.readline())
        work = (processor_s(server.pid) - before_s) / len(measured["took"])
        name = f"  {admitted} clients at {RATE_HZ:g} Hz, {len(measured['took'])} answers"
        table.add_row(name, *percentiles(measured["took"]))
        table.add_row(
            "    server", f"{1e6 * work:.0f} us", f"of the processor a message, load {os.getloadavg()[0]:.1f}"
        )
        sleep(0.5)
        with database.writing() as opened:
            policy = served_release(opened, **KESTREL).policy
            releases.withdraw(opened, policy.surgeon, policy.suture, "bench")
        withdrawn = monotonic()
        ends = json.loads(crowd.stdout.readline())
        late = [at - withdrawn for at, _ in ends]
        assert {code for _, code in ends} == {4404} and len(ends) == admitted, ends
        table.add_row("    closed after a withdrawal", f"{max(late):.2f} s", f"the last; the first {min(late):.2f} s")
        crowd.wait()
        with database.writing() as opened:
            releases.release(opened, find_version(opened, **KESTREL, version=policy.version), "bench")
        flooded(table, settings.port)
    finally:
        server.terminate()
        server.wait()


def flooded(table: Table, port: int) -> None:
    """Measure another client's answers beside a flood of pings, and beside the same bytes over HTTP."""
    alone = beside(port, lambda over: over.wait(FLOOD_S))
    pings = beside(port, partial(flood, port, ping=True))
    bodies = beside(port, partial(flood, port, ping=False))
    for name, took in (("alone", alone), ("beside pings", pings), ("beside the same bytes over HTTP", bodies)):
        table.add_row(f"  another client {name}, {len(took)} answers", *percentiles(took))


def beside(port: int, do: Callable[[Event], object]) -> list[float]:
    """Return the seconds that the answers to another client took during `FLOOD_S` of something."""
    over, took = Event(), list[float]()
    thread = Thread(target=do, args=(over,))
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=FLOOD_S) as http:
        thread.start()
        until_s = monotonic() + FLOOD_S
        while (began_s := monotonic()) < until_s:
            http.get(POLICY).raise_for_status()
            took.append(monotonic() - began_s)
            sleep(0.01)
    over.set()
    thread.join()
    return took


def flood(port: int, over: Event, *, ping: bool) -> None:
    """Send pieces of pings, or of the body of an upload, as fast as they are taken; connect again when it is closed."""
    pings = bytes([PING, MASKED, 0, 0, 0, 0]) * (PIECE // 6)
    head = b"\r\n".join(upgrade(f"127.0.0.1:{port}")) if ping else UPLOAD
    while not over.is_set():
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0) as connection:
            connection.sendall(head)
            if ping:
                connection.recv(PIECE)
            while not over.is_set():
                connection.sendall(pings)


def percentiles(took: list[float]) -> tuple[str, str]:
    middle, p99, most = (1000 * float(np.quantile(took, part)) for part in (0.5, 0.99, 1.0))
    return f"p99 {p99:.2f} ms", f"median {middle:.3f} ms, at most {most:.1f} ms"


def upgrade(host: str) -> list[bytes]:
    """Return the lines of the request for a session."""
    key = b64encode(os.urandom(16))
    head = [f"GET {POLICY}/session HTTP/1.1".encode(), b"Host: " + host.encode(), b"Upgrade: websocket"]
    return [*head, b"Connection: Upgrade", b"Sec-WebSocket-Key: " + key, b"Sec-WebSocket-Version: 13", b"", b""]


# ---- the clients ---------------------------------------------------------------------------------------------------


class Hand(asyncio.Protocol):
    """One client: it sends the pose that it was told to go to, each time when it is due."""

    def __init__(self, host: str, first_s: float, took: list[float]) -> None:
        self.host, self.due, self.took = host, first_s, took
        self.loop = asyncio.get_running_loop()
        self.opened: asyncio.Future[str | None] = self.loop.create_future()
        self.ended: asyncio.Future[tuple[float, int]] = self.loop.create_future()
        self.buffer, self.pose, self.until = b"", b"", 0.0

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        transport.write(b"\r\n".join(upgrade(self.host)))

    def data_received(self, data: bytes) -> None:
        self.buffer += data
        if not self.opened.done():
            head, end, rest = self.buffer.partition(b"\r\n\r\n")
            if not end:
                return
            status, *headers = head.decode().lower().split("\r\n")
            self.buffer = rest
            if " 101 " not in status:
                assert " 429 " in status, head
                self.opened.set_result(next(one for one in headers if one.startswith("retry-after:")))
                self.transport.close()
                return
            self.opened.set_result(None)
        while (frame := self.frame()) is not None:
            kind, payload = frame
            if kind == TEXT:
                self.told(json.loads(payload))
            elif kind == CLOSE:
                self.ended.set_result((monotonic(), int.from_bytes(payload[:2], "big")))

    def frame(self) -> tuple[int, bytes] | None:
        """Take one frame of the server, which has no mask, out of the buffer."""
        if len(self.buffer) < 4:
            return None
        start, size = 2, self.buffer[1]
        if size == 126:
            start, size = 4, int.from_bytes(self.buffer[2:4], "big")
        if len(self.buffer) < start + size:
            return None
        kind, payload = self.buffer[0], self.buffer[start : start + size]
        self.buffer = self.buffer[start + size :]
        return kind, payload

    def told(self, said: dict[str, Any]) -> None:
        if "version" in said:  # the opening message
            return
        assert said.get("inside"), said
        self.took.append(monotonic() - self.due)
        hand = {name: said[name] for name in ("position_mm", "rotation_xyzw", "phase")}
        self.pose = json.dumps(START if said["finished"] else hand).encode()
        self.due += 1 / RATE_HZ
        if self.due < self.until:
            self.loop.call_at(self.due, self.send)

    def send(self) -> None:
        size = len(self.pose)
        head = bytes([TEXT, MASKED | size]) if size < 126 else bytes([TEXT, MASKED | 126]) + size.to_bytes(2, "big")
        self.transport.write(head + bytes(4) + self.pose)  # a mask of zeros leaves the payload as it is


async def crowd(port: int, clients: int, seconds: float) -> None:
    """Open sessions, follow the poses for some time, then wait until all are closed."""
    loop, took = asyncio.get_running_loop(), list[float]()
    hands, refused = [], []
    for _ in range(clients):
        _, hand = await loop.create_connection(lambda: Hand(f"127.0.0.1:{port}", 0.0, took), "127.0.0.1", port)
        if (again := await hand.opened) is None:
            hands.append(hand)
        else:
            refused.append(again)
    print(json.dumps([len(hands), sorted({*refused})]), flush=True)
    begin = loop.time() + 0.1
    for number, hand in enumerate(hands):
        hand.pose, hand.due = json.dumps(START).encode(), begin + number / len(hands) / RATE_HZ
        hand.until = begin + seconds
        loop.call_at(hand.due, hand.send)
    await asyncio.sleep(seconds + 1.0)
    print(json.dumps({"took": took}), flush=True)
    print(json.dumps(await asyncio.gather(*(hand.ended for hand in hands))), flush=True)


if __name__ == "__main__":
    asyncio.run(crowd(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
