"""Clients that upload, train, release, withdraw, read and back up without a pause, and record all of it."""

import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import httpx2 as httpx

from skills.packing import sha256
from tests.faults.ledger import Ledger, Read
from tests.library import cases
from tests.waiting import END_S, until

AGAIN_S = 0.15  # between two attempts of a client that was not answered with success
ANSWER_S = 60.0  # timeout of an answer
STYLES = ("kestrel", "wren")  # each has one writer, so the order of its releases is known
UPLOADER = "heron"
LARGE_ROWS = 60_000  # over 4 MiB: it is stored in several transactions
DIGITS = 24
POLICY = "/policies/{surgeon}/{suture}"  # as a route
SUCCESS = (200, 201, 202, 204, 304)


def large(number: int) -> bytes:
    """Return a table of over 4 MiB; another number gives other bytes."""
    tail = "0" * DIGITS
    rows = "\n".join(f"{k / 50},-10.{tail},55.{tail},-120.{tail}" for k in range(1, LARGE_ROWS))
    return f"t_s,x_mm,y_mm,z_mm\n0.0,-10.0,55.0,-120.{number:06d}\n{rows}\n".encode()


class Crew:
    """All clients of a run; what they ask and are told is in `ledger`."""

    def __init__(self, urls: Sequence[str], backups: Path, environment: Mapping[str, str], seed: int) -> None:
        """Create the clients.

        Args:
            urls: The addresses of the services on one database; the clients are divided among them.
            backups: The folder for backups.
            environment: The environment of `skills backup`.
            seed: Seed of the choices.
        """
        self.ledger = Ledger()
        self.broken: list[Exception] = []
        self._urls, self._backups, self._environment = urls, backups, dict(environment)
        self._over, self._serial, self._lock, self._seed = Event(), 0, Lock(), seed
        doing: list[Callable[[httpx.Client], None]] = [self._upload, self._upload]
        doing += [self._learner(style, random.Random(f"{seed} {style}")) for style in STYLES]
        doing += [partial(self._look, style=style) for style in STYLES]
        doing += [self._upload_large, self._back_up, self._ask_ready]
        self._threads = [Thread(target=self._live, args=(do, place)) for place, do in enumerate(doing)]

    @contextmanager
    def at_work(self) -> Iterator["Crew"]:
        """Run all clients for the duration of the block."""
        for thread in self._threads:
            thread.start()
        try:
            yield self
        finally:
            self._over.set()
            for thread in self._threads:
                thread.join()

    def _live(self, do: Callable[[httpx.Client], None], place: int) -> None:
        # one connection for each request: one that was kept open would survive what refuses new ones
        limits = httpx.Limits(max_keepalive_connections=0)
        try:
            with httpx.Client(base_url=self._urls[place % len(self._urls)], timeout=ANSWER_S, limits=limits) as http:
                while not self._over.is_set():
                    do(http)
        except Exception as error:
            self.broken.append(error)

    # ---- requests ------------------------------------------------------------------------------------------------

    def _send(self, http: httpx.Client, method: str, path: str, route: str, **what: Any) -> httpx.Response | None:
        """Send once; return the answer, None if there was none. What is no success is noted."""
        try:
            answer = http.request(method, path, **what)
        except httpx.TransportError as error:
            kind = "connection refused" if isinstance(error, httpx.ConnectError) else type(error).__name__
            self.ledger.refuse(f"no answer ({kind})")
            return None
        if answer.status_code not in SUCCESS:
            told = answer.json() if answer.headers.get("content-type") == "application/problem+json" else {}
            kind = told.get("type", "no problem document").removeprefix("urn:suture-skills:")
            self.ledger.refuse(f"{method} {route} {answer.status_code} {kind}")
        return answer

    def _until_done(
        self, http: httpx.Client, method: str, path: str, route: str, also: tuple[int, ...] = (), **what: Any
    ) -> httpx.Response | None:
        """Send the same request again until it succeeds; None if the run is over before."""
        while True:
            answer = self._send(http, method, path, route, **what)
            if answer is not None and answer.status_code in SUCCESS + also:
                return answer
            if answer is not None and answer.status_code < 500:
                raise AssertionError(f"{method} {path}: {answer.status_code} {answer.text[:500]}")
            if self._over.wait(AGAIN_S):
                return None

    def wait(self, done: Callable[[], object], within_s: float = END_S) -> None:
        """Wait for what the clients do; fail if one of them has failed."""

        def reached() -> bool:
            if self.broken:
                raise self.broken[0]
            return bool(done())

        until(reached, within_s)

    def _new(self) -> int:
        with self._lock:
            self._serial += 1
            return self._serial

    # ---- what clients do -----------------------------------------------------------------------------------------

    def _demo(self, http: httpx.Client, surgeon: str) -> str | None:
        """Upload a new hand-off until it is acknowledged; return its id. One in four is sent once more."""
        number = self._new()
        data = cases.hand_off((number / 1e4, self._seed % 1000 / 1e6, 0.0))  # so near that the gate passes every one
        asked = self.ledger.ask("upload", sha256(data), surgeon=surgeon, data=data)
        query = {"surgeon": surgeon, "suture": cases.SUTURE}
        how: dict[str, Any] = {"params": query, "content": data, "headers": {"Content-Type": "text/csv"}}
        for _ in range(2 if number % 4 == 0 else 1):
            answer = self._until_done(http, "POST", "/demos", "/demos", **how)
            if answer is None:
                return None
            self.ledger.acknowledge(asked, answer.json()["id"])
        return str(next(iter(asked.ids)))

    def _upload(self, http: httpx.Client) -> None:
        self._demo(http, UPLOADER)
        self._over.wait(0.5)

    def _upload_large(self, http: httpx.Client) -> None:
        data = large(self._new())
        asked = self.ledger.ask("recording", sha256(data), data=data)
        how: dict[str, Any] = {"content": data, "headers": {"Content-Type": "text/csv"}}
        answer = self._until_done(http, "POST", f"/recordings?surgeon={UPLOADER}", "/recordings", **how)
        if answer is not None:
            self.ledger.acknowledge(asked, answer.json()["id"])
        self._over.wait(4.0)

    def _learner(self, style: str, rng: random.Random) -> Callable[[httpx.Client], None]:
        return lambda http: self._learn(http, style, rng)

    def _learn(self, http: httpx.Client, style: str, rng: random.Random) -> None:
        """Upload a hand-off, train from it, and release the version, in one request or in two; withdraw some."""
        demo = self._demo(http, style)
        if demo is None:
            return
        at_once = rng.random() < 0.5
        body = {"surgeon": style, "suture": cases.SUTURE, "demos": [demo], "release": at_once}
        asked, sent_s = self.ledger.ask("training", demo), time.monotonic()
        answer = self._until_done(http, "POST", "/trainings", "/trainings", json=body)
        if answer is None:
            if at_once:
                self._unknown(style, demo, sent_s)
            return
        job = answer.json()["id"]
        self.ledger.acknowledge(asked, job)
        ended = self._ended(http, job)
        if ended is None or ended["state"] != "succeeded":
            if at_once:
                self._unknown(style, demo, sent_s)
            return
        version, policy = ended["result"]["policy_version"], ended["result"]["sha256"]
        if at_once:
            released = self.ledger.ask("release", policy, style=style)
            released.sent_s = sent_s
            with self.ledger.writing(style, policy, sent_s) as happened:
                happened.append(bool(ended["result"]["was_released"]))
            if any(happened):
                self.ledger.acknowledge(released, policy)
        else:
            self._release(http, style, version, policy)
        if rng.random() < 0.3:
            self._withdraw(http, style)
        self._over.wait(0.1)

    def _unknown(self, style: str, demo: str, sent_s: float) -> None:
        """Note a release whose version the client never learnt: any version of this demonstration."""
        with self.ledger.writing(style, f"of {demo}", sent_s):
            pass

    def _ended(self, http: httpx.Client, job: str) -> dict[str, Any] | None:
        """Wait for a job's end; return it, None if the run is over before."""
        while True:
            answer = self._until_done(http, "GET", f"/jobs/{job}", "/jobs/{job}")
            if answer is None:
                return None
            if (found := answer.json())["state"] not in ("queued", "running"):
                return dict(found)
            if self._over.wait(0.05):
                return None

    def _release(self, http: httpx.Client, style: str, version: int, policy: str) -> None:
        asked = self.ledger.ask("release", policy, style=style)
        path = f"/policies/{style}/{cases.SUTURE}/versions/{version}/release"
        with self.ledger.writing(style, policy) as happened:
            answer = self._until_done(http, "POST", path, f"{POLICY}/versions/{{version}}/release")
            happened.append(answer is not None)
        if answer is not None:
            self.ledger.acknowledge(asked, answer.json()["sha256"])

    def _withdraw(self, http: httpx.Client, style: str) -> None:
        asked = self.ledger.ask("withdrawal", style)
        path = f"/policies/{style}/{cases.SUTURE}/release"
        with self.ledger.writing(style, None) as happened:
            # 404: an attempt that was not answered has done it
            answer = self._until_done(http, "DELETE", path, f"{POLICY}/release", also=(404,))
            happened.append(answer is not None)
        if answer is not None:
            self.ledger.acknowledge(asked, style)

    def _look(self, http: httpx.Client, style: str) -> None:
        """Read what a style serves."""
        began_s = time.monotonic()
        try:
            answer = http.get(f"/policies/{style}/{cases.SUTURE}")
        except httpx.TransportError as error:
            kind = "connection refused" if isinstance(error, httpx.ConnectError) else type(error).__name__
            self.ledger.refuse(f"no answer ({kind})")
            self._over.wait(AGAIN_S)
            return
        ended_s = time.monotonic()
        if answer.status_code == 200:
            body, etag = sha256(answer.content), answer.headers["etag"].strip('"')
            self.ledger.read(Read(style, began_s, ended_s, body, etag), answer.content)
        elif answer.status_code == 404 and json.loads(answer.content)["type"].endswith("not-found"):
            self.ledger.read(Read(style, began_s, ended_s, None, None), None)
        else:
            kind = answer.json()["type"].removeprefix("urn:suture-skills:")
            self.ledger.refuse(f"GET {POLICY} {answer.status_code} {kind}")
        self._over.wait(0.04)

    def _ask_ready(self, http: httpx.Client) -> None:
        """Ask whether the service is ready, as a monitor does."""
        self._send(http, "GET", "/readyz", "/readyz")
        self._over.wait(1.0)

    def _back_up(self, _http: httpx.Client) -> None:
        """Write a backup with the command, and keep the newest three."""
        file = self._backups / f"{self._new()}.zip"
        asked = self.ledger.ask("backup", file.name)
        said = self._command(file)
        if said is None:
            self.ledger.acknowledge(asked, file.name)
            for old in sorted(self._backups.glob("*.zip"), key=lambda one: one.stat().st_mtime)[:-3]:
                old.unlink()
        else:
            self.ledger.refuse(f"skills backup: {said}")
        self._over.wait(2.5)

    def _command(self, file: Path) -> str | None:
        """Write a backup with the command; return the reason why not, None if it was written."""
        command = [sys.executable, "-m", "skills", "backup", str(file)]
        done = subprocess.run(command, env=self._environment | {"PYTHONPATH": os.getcwd()}, capture_output=True)
        words = " ".join(done.stderr.decode(errors="replace").split())
        return f"exit {done.returncode}, {words[-110:]}" if done.returncode else None
