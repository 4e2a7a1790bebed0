"""The faults, each against the real service over loopback with all clients at work, and what an audit finds after it.

Every fault is a function of a running `Site`; it is over when the function returns.
"""

import errno
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

import httpx2 as httpx
from sqlalchemy import func, select

from skills.db.service_tables import Job
from skills.db.session import Database
from tests.backends import new_server, start
from tests.e2e.conftest import WORKER
from tests.faults.audit import Verdict, audit, stored
from tests.faults.crew import STYLES, UPLOADER, Crew
from tests.faults.installation import Installation
from tests.faults.ledger import Ledger
from tests.faults.shim import Shim, compiler
from tests.library import cases
from tests.needs import NEEDS
from tests.waiting import END_S, alive, children, until

HOUR_NS = 3600 * 10**9
AHEAD_NS = 400 * 24 * HOUR_NS  # longer than every retention
SMALL_BYTES = 448 << 20  # of the file system that fills up
HOLD_S = 6.0  # how long a fault lasts, unless it is an instant
SLOW_US = 300_000  # of each sync on a slow disk, and a hundredth of it of each write


@dataclass
class Site:
    """An installation with its clients' records, as a fault sees it."""

    folder: Path
    shim: Shim | None
    services: list[Installation]
    rng: random.Random
    server: "Postgres | None" = None
    ledger: Ledger = field(default_factory=Ledger)

    @property
    def service(self) -> Installation:
        """The first of its services."""
        return self.services[0]


@dataclass(frozen=True)
class Fault:
    """A row of the table.

    Attributes:
        name: Its name on the command line.
        words: Its description.
        inflict: The function.
        shimmed: Whether it needs the preloaded library.
        mounted: Whether the database is on a file system of its own, which needs root.
        postgresql: Whether it is a fault of PostgreSQL, with a server of its own.
        services: How many services share the database.
        workers: Workers of each.
    """

    name: str
    words: str
    inflict: Callable[[Site], None]
    shimmed: bool = False
    mounted: bool = False
    postgresql: bool = False
    services: int = 1
    workers: int = 1

    @property
    def lacks(self) -> str | None:
        """What this machine lacks for it; None if nothing."""
        if self.shimmed and compiler() is None:
            return "no C compiler"
        if self.mounted and not can_mount():
            return "no right to mount a file system"
        if self.postgresql and not NEEDS["postgresql"].here():
            return str(NEEDS["postgresql"])
        return None


@dataclass
class Row:
    """The result of a fault."""

    fault: Fault
    verdict: Verdict
    held_s: float
    recovered_s: dict[str, float]
    answered: Counter[str]
    logged: Counter[str]
    exits: list[int]
    bugs: list[str]


# ---- the disk ----------------------------------------------------------------------------------------------------


def can_mount() -> bool:
    """Return whether this user may mount a file system."""
    return os.geteuid() == 0 and shutil.which("mount") is not None and _mounts()


def _mounts() -> bool:
    with TemporaryDirectory() as folder:
        command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder]
        if subprocess.run(command, capture_output=True).returncode != 0:
            return False
        subprocess.run(["umount", folder], check=True)
        return True


def full_disk(site: Site) -> None:
    """Fill the file system to its last byte, and again whenever something was freed."""
    deadline = time.monotonic() + HOLD_S
    with _full(site.folder) as file:
        while time.monotonic() < deadline:
            _fill(file)
            time.sleep(0.05)


def ending_on(*, database: bool) -> Callable[[Site], None]:
    """Return the fault of a full disk on which a service of its own withdraws, revokes and erases.

    Args:
        database: Whether its database is on the disk; otherwise only its temporary files are.
    """

    def inflict(site: Site) -> None:
        with ExitStack() as stack:
            folder = Path(tempfile.mkdtemp(dir=site.folder if database else site.folder.parent))
            service = Installation(folder)
            service.environment["TMPDIR"] = str(site.folder)
            stack.callback(_stop, service)
            service.start()
            http = stack.enter_context(httpx.Client(base_url=service.url, timeout=END_S))
            for name, shift_mm in (("wren", 0.1), ("heron", 0.2), ("osprey", 0.3)):
                http.put(f"/surgeons/{name}", json={}).raise_for_status()
                how = {"content": cases.hand_off((shift_mm, 0.0, 0.0)), "headers": {"Content-Type": "text/csv"}}
                asked = {"surgeon": name, "suture": cases.SUTURE}
                http.post("/demos", params=asked, **how).raise_for_status()
                http.post("/trainings", json=asked | {"release": True}).raise_for_status()
                until(lambda at=f"/policies/{name}/{cases.SUTURE}": http.get(at).is_success)
            http.headers["X-API-Key"] = http.post("/keys", json={"owner": "a", "role": "admin"}).json()["secret"]
            lost = http.post("/keys", json={"owner": "b", "role": "admin"}).json()
            stack.enter_context(_full(site.folder))
            demo = {"content": cases.hand_off((0.4, 0.0, 0.0)), "headers": {"Content-Type": "text/csv"}}
            if database:
                full = http.post("/demos", params={"surgeon": "wren", "suture": cases.SUTURE}, **demo)
                assert full.status_code == 507, full.text
            for method, path, body, at in (
                ("DELETE", f"/policies/wren/{cases.SUTURE}/release", None, f"/policies/wren/{cases.SUTURE}"),
                ("PUT", "/surgeons/heron", {"consent": {"uses": ["atlas"]}}, f"/policies/heron/{cases.SUTURE}"),
                ("DELETE", f"/keys/{lost['key']}", None, None),
                ("DELETE", "/surgeons/osprey", None, "/surgeons/osprey"),
            ):
                answer = http.request(method, path, json=body)
                assert answer.is_success, (method, path, answer.text)
                assert at is None or http.get(at).status_code in (404, 410), at
            assert http.get("/surgeons", headers={"X-API-Key": lost["secret"]}).status_code == 401
            verified = subprocess.run(
                [sys.executable, "-m", "skills", "verify"], env=service.environment, capture_output=True, text=True
            )
            assert verified.returncode == 0, verified.stderr

    return inflict


@contextmanager
def _full(folder: Path) -> Iterator[BinaryIO]:
    """Fill a file system to its last byte for the duration of the block; yield the file that fills it."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as file:
        _fill(file)
        yield file
    filler.unlink()


def _fill(file: BinaryIO) -> None:
    with suppress(OSError):
        while True:
            file.write(bytes(4096))


def failing(**numbers: int) -> Callable[[Site], None]:
    """Return the fault of a disk or a clock that the preloaded library makes."""

    def inflict(site: Site) -> None:
        assert site.shim is not None
        with site.shim.during(**numbers):
            time.sleep(HOLD_S)

    return inflict


def clock_ahead(site: Site) -> None:
    """Set the clock ahead of every retention, and let a worker start there: it sweeps in its first round."""
    assert site.shim is not None
    with site.shim.during(clock_ns=AHEAD_NS):
        began_s = time.monotonic()
        os.kill(site.service.child(WORKER), signal.SIGKILL)
        until(lambda: site.ledger.first_after("training", began_s) and site.ledger.first_after("release", began_s))
        time.sleep(HOLD_S)


def no_descriptors(site: Site) -> None:
    """Leave the service and its workers no further descriptor."""
    assert site.service.process is not None
    pids = [site.service.process.pid, *site.service.children(WORKER)]
    before = {pid: resource.prlimit(pid, resource.RLIMIT_NOFILE) for pid in pids}
    try:
        deadline = time.monotonic() + HOLD_S
        while time.monotonic() < deadline:
            for pid in pids:
                with suppress(ProcessLookupError, FileNotFoundError):
                    opened = len(os.listdir(f"/proc/{pid}/fd"))
                    # from no free one to a few: requests fail at different places
                    resource.prlimit(pid, resource.RLIMIT_NOFILE, (opened + site.rng.randrange(4), before[pid][1]))
            time.sleep(0.2)
    finally:
        for pid, limits in before.items():
            with suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)


# ---- processes ---------------------------------------------------------------------------------------------------


def killed(*words: str, times: int = 3) -> Callable[[Site], None]:
    """Return the fault of some killed processes: "worker", "API" or both."""

    def inflict(site: Site) -> None:
        for turn in range(times):
            if turn:
                time.sleep(site.rng.uniform(4.0, 8.0))
            service = site.service
            assert service.process is not None
            with suppress(OSError):
                victims = service.children(WORKER) if "worker" in words else []
                for pid in [*victims, *([service.process.pid] if "API" in words else [])]:
                    os.kill(pid, signal.SIGKILL)

    return inflict


class Postgres:
    """A PostgreSQL server of its own, which is killed and started again."""

    def __init__(self) -> None:
        self._server = new_server()

    @property
    def url(self) -> str:
        return str(self._server.get_uri(database="postgres", driver="psycopg"))

    def kill(self) -> None:
        """Kill the server and all its processes with SIGKILL."""
        file = self._server.pgdata / "postmaster.pid"
        pid = int(file.read_text().split()[0])
        pids = [pid, *children(pid)]
        for one in pids:
            with suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
        until(lambda: not any(map(alive, pids)))
        file.unlink()  # nobody may have waited for the process, and then its id is still taken

    def start(self) -> None:
        """Start it; it recovers from its write-ahead log."""
        until(lambda: start(self._server.ensure_postgres_running))

    def close(self) -> None:
        """Stop it, and remove its files."""
        self._server.cleanup()


def postgresql_killed(site: Site) -> None:
    """Kill the server twice, and start it again after a moment."""
    assert site.server is not None
    for turn in range(2):
        if turn:
            time.sleep(site.rng.uniform(4.0, 8.0))
        site.server.kill()
        time.sleep(site.rng.uniform(0.5, 4.0))
        site.server.start()


def two_servers(site: Site) -> None:
    """Let both work for a while, then kill one of them with its worker."""
    time.sleep(HOLD_S)
    killed("worker", "API", times=1)(site)


FAULTS = (
    Fault("full-disk", "full disk (a tmpfs that is filled)", full_disk, mounted=True),
    Fault("full-disk-ending", "full disk, on which others withdraw, revoke and erase", ending_on(database=True),
          mounted=True),
    Fault("full-temporary-ending", "full disk of temporary files, while others withdraw, revoke and erase",
          ending_on(database=False), mounted=True),
    Fault("no-space", "writes fail: no space (ENOSPC)", failing(write_error=errno.ENOSPC), shimmed=True),
    Fault("write-fails", "writes fail (EIO)", failing(write_error=errno.EIO), shimmed=True),
    Fault("sync-fails", "fsync fails (EIO)", failing(sync_error=errno.EIO), shimmed=True),
    Fault("slow-disk", f"fsync takes {SLOW_US // 1000} ms more, each write {SLOW_US // 100_000} ms",
          failing(sync_us=SLOW_US, write_us=SLOW_US // 100), shimmed=True),
    Fault("read-only", "read-only file system (EROFS)",
          failing(write_error=errno.EROFS, open_error=errno.EROFS, sync_error=errno.EROFS), shimmed=True),
    Fault("descriptors", "no descriptor left (RLIMIT_NOFILE)", no_descriptors),
    Fault("clock-forward", "clock 400 days ahead, a worker killed (-9) then, and right again", clock_ahead,
          shimmed=True),
    Fault("clock-back", "clock an hour back, and right again", failing(clock_ns=-HOUR_NS), shimmed=True),
    Fault("two-servers", "two services on one SQLite file, one killed (-9)", two_servers, services=2),
    Fault("worker-killed", "worker killed (-9), three times", killed("worker")),
    Fault("api-killed", "API killed (-9), three times", killed("API")),
    Fault("postgresql-killed", "PostgreSQL killed (-9), twice", postgresql_killed, postgresql=True),
    Fault("postgresql-api-killed", "API and worker killed (-9), three times, on PostgreSQL",
          killed("worker", "API"), postgresql=True),
)  # fmt: skip


# ---- a row -------------------------------------------------------------------------------------------------------


def run(fault: Fault, folder: Path, seed: int) -> Row:
    """Start the installation and its clients, inflict the fault, wait for the recovery, and audit.

    Args:
        fault: The fault.
        folder: An empty folder.
        seed: Seed of the instants.
    """
    with ExitStack() as stack:
        site = stack.enter_context(_site(fault, folder, seed))
        urls = [service.url for service in site.services]
        database = stack.enter_context(closing(Database(site.service.environment["SKILLS_DATABASE_URL"])))
        http = stack.enter_context(httpx.Client(base_url=urls[-1], timeout=END_S))
        for name in (*STYLES, UPLOADER):
            http.put(f"/surgeons/{name}", json={}).raise_for_status()
        before = stored(database)
        (backups := site.folder / "backups").mkdir()
        crew = Crew(urls, backups, site.service.environment, seed)
        with crew.at_work():
            ledger = site.ledger = crew.ledger
            crew.wait(lambda: all(ledger.first_after(kind, 0.0) for kind in KINDS))
            places = [service.log.stat().st_size for service in site.services]
            began_s = time.monotonic()
            fault.inflict(site)
            over_s = time.monotonic()
            crew.wait(lambda: all(ledger.first_after(kind, over_s) for kind in KINDS))
            recovered_s = {kind: (ledger.first_after(kind, over_s) or over_s) - over_s for kind in KINDS}
        for url in urls:
            with httpx.Client(base_url=url, timeout=END_S) as one:
                until(lambda one=one: one.get("/readyz").status_code == 200)
        until(lambda: _unfinished(database) == 0)
        verdict = audit(ledger, http, database, backups, before)
        logged: Counter[str] = Counter()
        for service, place in zip(site.services, places, strict=True):
            logged += service.said(place)
        answered = Counter(said for moment_s, said in ledger.refused if moment_s >= began_s)
        exits = [code for service in site.services for code in service.exits]
        bugs = [bug for service, place in zip(site.services, places, strict=True) for bug in service.bugs(place)]
        return Row(fault, verdict, over_s - began_s, recovered_s, answered, logged, exits, bugs)


KINDS = ("upload", "recording", "training", "release", "backup")


def _unfinished(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(Job).where(Job.ended_at.is_(None))) or 0


@contextmanager
def _site(fault: Fault, folder: Path, seed: int) -> Iterator[Site]:
    inside = folder / "installation"
    inside.mkdir()
    with ExitStack() as stack:
        if fault.mounted:
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SMALL_BYTES},mode=700", "tmpfs", inside], check=True)
            stack.callback(subprocess.run, ["umount", "--lazy", inside], check=True)
        shim = Shim(inside, folder / "control") if fault.shimmed else None
        settings: dict[str, object] = {"workers": fault.workers}
        server = None
        if fault.postgresql:
            server = Postgres()
            stack.callback(server.close)
            settings["database_url"] = server.url
        site = Site(inside, shim, [], random.Random(seed), server)
        for _ in range(fault.services):
            service = Installation(inside, shim, **settings)
            site.services.append(service)
            stack.callback(_stop, service)
            service.start()
        try:
            yield site
        except AssertionError as error:
            for service in site.services:
                error.add_note("\n".join(json.dumps(one) for one in service.lines() if one["level"] != "info"))
            raise


def _stop(service: Installation) -> None:
    if service.process is not None:
        service.stop()


def named(names: Sequence[str]) -> list[Fault]:
    """Return faults by their names, all of them for none.

    Raises:
        SystemExit: A name is not one of a fault.
    """
    known = {fault.name: fault for fault in FAULTS}
    if unknown := set(names) - known.keys():
        raise SystemExit(f"There is no fault {', '.join(sorted(unknown))}; there are {', '.join(known)}.")
    return [known[name] for name in names or known]
