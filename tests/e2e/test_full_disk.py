"""The real service on a small separate file system that fills up, and on a disk whose writes or syncs fail."""

import os
import resource
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx2 as httpx
import pytest

from skills.db.disk import EXIT_CODE
from skills.serving import environment
from tests.api.service import CSV, KESTREL, assert_problem
from tests.e2e.conftest import WORKER, Service, running
from tests.jobs.house import House
from tests.library import cases
from tests.waiting import END_S, until

pytestmark = pytest.mark.nightly

MOUNTED = "mount -t tmpfs -o size=24m,mode=700 tmpfs {0} && exec {1} -m skills serve"


def unshare(*command: str) -> list[str]:
    """Return a command that runs in separate mounts, which needs only the right to create user namespaces."""
    return ["unshare", "--map-root-user", "--mount", "sh", "-c", *command]


class Small(Service):
    """A service whose database and temporary files are on a file system of 24 MiB that only it sees."""

    def launch(self) -> None:
        folder = str(self.database.parent)
        environment = self.environment | {"TMPDIR": folder}
        command = unshare(MOUNTED.format(folder, sys.executable))
        with self.printed.open("wb") as printed:
            self.process = subprocess.Popen(command, env=environment, stderr=printed)

    @property
    def printed(self) -> Path:
        """The path of its log, next to the small file system."""
        return self.database.parent.with_name("log")

    @property
    def seen(self) -> Path:
        """The folder as the service sees it."""
        assert self.process is not None
        return Path(f"/proc/{self.process.pid}/root{self.database.parent}")


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Small]:
    folder = tmp_path / "small"
    folder.mkdir()
    command = unshare(f"mount -t tmpfs -o size=1m tmpfs {folder}")
    if shutil.which("unshare") is None or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("a file system for a test is not here: allow user namespaces, or run as root")
    service = Small(folder)
    service.environment["SKILLS_LOG_FORMAT"] = "text"
    try:
        service.start()
        yield service
    finally:
        if service.process is not None and service.process.poll() is None:
            service.stop()


def upload(url: str, shift_mm: float) -> httpx.Response:
    content = cases.hand_off((shift_mm, 0.0, 0.0))
    return httpx.post(f"{url}/demos", params=KESTREL, content=content, headers={"Content-Type": CSV}, timeout=60.0)


def test_a_disk_fills_up_and_gets_space_again(small: Small):
    assert httpx.put(f"{small.url}/surgeons/kestrel", json={}, timeout=END_S).status_code in (200, 201)
    assert upload(small.url, 0.1).status_code == 201
    assert {oct(path.stat().st_mode & 0o777) for path in small.seen.glob("skills.*")} == {"0o600"}
    filler = small.seen / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
    answers = [upload(small.url, 0.2 + 0.1 * k) for k in range(3)]
    for answer in answers:
        assert_problem(answer, 507, "storage-full")
    assert httpx.get(f"{small.url}/surgeons", timeout=END_S).status_code == 200
    filler.unlink()
    assert upload(small.url, 0.2).status_code == 201
    assert small.process is not None and small.process.poll() is None
    assert "disk is full" in small.printed.read_text()


def test_a_write_that_fails_ends_the_service_and_its_workers(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    with running(tmp_path) as service:
        assert service.process is not None
        worker = service.child("skills.jobs.worker")
        assert httpx.put(f"{service.url}/surgeons/kestrel", json={}, timeout=END_S).status_code in (200, 201)
        size = Path(f"{service.database}-wal").stat().st_size
        resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (size // 2, size // 2))
        with pytest.raises(httpx.HTTPError):  # noqa: PT012
            for k in range(200):
                httpx.put(f"{service.url}/surgeons/heron-{k}", json={"protocol": "." * 200}, timeout=END_S)
        assert service.process.wait(30) == EXIT_CODE
        assert "The database's disk failed" in capfd.readouterr().err
        until_gone(worker)


def fragile(*words: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    """Start a command whose syncs fail from SIGUSR2 on; those of its children do not."""
    return subprocess.Popen([sys.executable, "-m", "tests.failing_disk", "-m", "skills", *words], env=environment)


class Fragile(Service):
    """A service whose disk can be told to fail."""

    def launch(self) -> None:
        self.process = fragile("serve", environment=self.environment)


def test_a_sync_that_fails_ends_the_service_and_its_workers(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    service = Fragile(tmp_path)
    try:
        service.start()
        assert service.process is not None
        worker = service.child(WORKER)
        assert httpx.put(f"{service.url}/surgeons/wren", json={}, timeout=END_S).status_code == 201
        fail(service.process.pid)
        assert httpx.get(f"{service.url}/surgeons/wren", timeout=END_S).status_code == 200  # reading syncs nothing
        with pytest.raises(httpx.HTTPError):
            httpx.put(f"{service.url}/surgeons/heron", json={}, timeout=END_S)
        assert service.process.wait(END_S) == EXIT_CODE
        printed = capfd.readouterr().err
        assert "The database's disk failed (SQLITE_IOERR_FSYNC" in printed and "skills verify" in printed
        until_gone(worker)
        service.start()
        assert httpx.get(f"{service.url}/surgeons/wren", timeout=END_S).status_code == 200
        assert httpx.put(f"{service.url}/surgeons/plover", json={}, timeout=END_S).status_code == 201
    finally:
        if service.process is not None and service.process.poll() is None:
            service.stop()


def test_a_sync_that_fails_ends_a_worker(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    with closing(House(f"sqlite:///{tmp_path / 'skills.sqlite'}", tmp_path)) as house:
        worker = fragile("worker", environment=environment(house.settings))
        try:
            until(house.executors, by=[worker])
            fail(worker.pid)
            assert worker.wait(END_S) == EXIT_CODE  # its next heartbeat is not stored
        finally:
            worker.kill()
            worker.wait()
        assert "The database's disk failed (SQLITE_IOERR_FSYNC" in capfd.readouterr().err


def fail(pid: int) -> None:
    """Let the syncs of a `fragile` process fail, and wait until they do."""
    os.kill(pid, signal.SIGUSR2)
    until(lambda: "Seccomp_filters:\t0" not in Path(f"/proc/{pid}/status").read_text())


def until_gone(pid: int) -> None:
    """Wait for a process that is not our child: a worker exits when its parent is gone."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    assert select.select([handle], [], [], 30)[0]
    os.close(handle)
