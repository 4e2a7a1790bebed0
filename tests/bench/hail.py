"""A load generator in a separate process: one request repeated on connections that stay open.

It reads orders as lines of JSON and answers each with a line: requests per second, the median and the 99th percentile
of their times in ms, and the statuses.
"""

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Hail:
    """The result of one order."""

    rate: float
    seconds: float
    median_ms: float
    p99_ms: float
    statuses: list[int]


class Connection(asyncio.Protocol):
    """One client: it repeats the request after each response, or after a pause, until the end time."""

    def __init__(self, request: bytes, pause_s: float, end: float, took: list[float]) -> None:
        self.request, self.pause_s, self.end, self.took = request, pause_s, end, took
        self.loop = asyncio.get_running_loop()
        self.ended: asyncio.Future[int] = self.loop.create_future()
        self.head, self.size, self.had, self.status = b"", 0, 0, 0

    def connection_made(self, transport: Any) -> None:
        self.transport = transport
        self.send()

    def send(self) -> None:
        self.began = perf_counter()
        self.transport.write(self.request)

    def data_received(self, data: bytes) -> None:
        self.had += len(data)
        if not self.size:  # of the first response; all following ones have the same length
            self.head += data
            head, end, _ = self.head.partition(b"\r\n\r\n")
            if not end:
                return
            lines = head.lower().split(b"\r\n")
            self.status = int(lines[0].split()[1])
            body = next((int(line.split(b":")[1]) for line in lines if line.startswith(b"content-length:")), 0)
            self.size = len(head) + len(end) + body
        assert self.had <= self.size, "an answer of another length"
        if self.had == self.size:
            self.had = 0
            self.answered()

    def answered(self) -> None:
        at = perf_counter()
        self.took.append(at - self.began)
        if at >= self.end:
            self.transport.close()
        elif self.pause_s:
            self.loop.call_later(self.pause_s, self.send)
        else:
            self.send()

    def connection_lost(self, _error: Exception | None) -> None:
        self.ended.set_result(self.status)


async def hail(
    port: int, path: str, headers: dict[str, str], clients: int, seconds: float, pause_s: float
) -> dict[str, Any]:
    """Send the ordered requests, and measure."""
    lines = [
        f"GET {path} HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        *(f"{name}: {value}" for name, value in headers.items()),
    ]
    request = "\r\n".join([*lines, "", ""]).encode()
    took: list[float] = []
    loop = asyncio.get_running_loop()
    began = perf_counter()
    made = [
        await loop.create_connection(lambda: Connection(request, pause_s, began + seconds, took), "127.0.0.1", port)
        for _ in range(clients)
    ]
    statuses = {await connection.ended for _, connection in made}
    seconds = perf_counter() - began
    took.sort()
    return {
        "rate": len(took) / seconds,
        "seconds": seconds,
        "median_ms": took[len(took) // 2] * 1e3,
        "p99_ms": took[len(took) * 99 // 100] * 1e3,
        "statuses": sorted(statuses),
    }


class Hailing:
    """The process that sends the requests."""

    def __init__(self, process: subprocess.Popen[str], port: int) -> None:
        self.process, self.port = process, port

    def __call__(
        self,
        path: str,
        headers: dict[str, str] | None = None,
        clients: int = 16,
        seconds: float = 0.4,
        pause_s: float = 0.0,
    ) -> Hail:
        order = {"port": self.port, "path": path, "headers": headers or {}, "clients": clients}
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(order | {"seconds": seconds, "pause_s": pause_s}) + "\n")
        self.process.stdin.flush()
        return Hail(**json.loads(self.process.stdout.readline()))


@contextmanager
def hailing(port: int) -> Iterator[Hailing]:
    """Start the sending process."""
    command = [sys.executable, "-m", "tests.bench.hail"]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield Hailing(process, port)
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


if __name__ == "__main__":
    import uvloop

    for line in sys.stdin:
        print(json.dumps(uvloop.run(hail(**json.loads(line)))), flush=True)
