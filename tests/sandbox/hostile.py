"""Attempts of an attacker whose code runs in place of a reader, and a process that makes them all.

An attempt raises unless it succeeds. `python -m tests.sandbox.hostile` prepares what there is to attack, as the user
that runs it, makes every attempt as a function of a fork server, and again without containment, to show that it would
succeed, and prints what came of each as JSON.
"""

import ctypes
import fcntl
import json
import os
import resource
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from skills import packing
from skills.errors import Unanswered
from skills.sandbox import ProcessLimits, forked

ATTEMPT = "tests.sandbox.hostile:attempt"
LIMITS = ProcessLimits(memory_bytes=256 << 20, wall_s=60.0, threads=False)
_libc = ctypes.CDLL(None, use_errno=True)
BPF, CLONE = (321, 56) if os.uname().machine == "x86_64" else (280, 220)
IO_URING_SETUP = 425
PTRACE_ATTACH, PTRACE_DETACH = 16, 17
PR_SET_PDEATHSIG, PR_SET_DUMPABLE, NEW_USER = 1, 4, 0x10000000


@dataclass(frozen=True)
class Prey:
    """What the test has prepared: a database, files that it owns, a process of the same user, and sockets."""

    database: str
    secret: str  # a file as `~/.ssh/id_ed25519`, 0600
    writable: str  # a folder
    pid: int  # of a process with a secret in its environment
    address: int  # of eight bytes in its memory
    port: int
    unix: str
    abstract: str


def _of_c(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _connected(family: int, address: object) -> None:
    with socket.socket(family) as one:
        one.settimeout(2.0)
        one.connect(address)


def _listen(family: int, address: object) -> None:
    with socket.socket(family) as one:
        one.bind(address)
        one.listen()


def _datagram(prey: Prey) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"all of it", ("127.0.0.1", prey.port))


def _change_database(prey: Prey) -> None:
    with sqlite3.connect(prey.database) as database:
        database.execute("DELETE FROM releases")


def _write(path: str) -> None:
    with open(path, "xb") as file:
        file.write(b"x")
    os.unlink(path)


def _process_ends(pid: int) -> None:
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def _fork() -> None:
    if (pid := os.fork()) == 0:
        os._exit(0)
    _process_ends(pid)


def _thread() -> None:
    one = threading.Thread(target=int)
    one.start()
    one.join()


def _read_memory(prey: Prey) -> None:
    here = ctypes.create_string_buffer(8)
    pieces = ((ctypes.c_size_t * 2)(at, 8) for at in (ctypes.addressof(here), prey.address))
    _of_c(_libc.process_vm_readv(prey.pid, next(pieces), ctypes.c_ulong(1), next(pieces), ctypes.c_ulong(1), 0))


def _trace(prey: Prey) -> None:
    _of_c(_libc.ptrace(PTRACE_ATTACH, prey.pid, None, None))
    os.waitpid(prey.pid, 0)
    _libc.ptrace(PTRACE_DETACH, prey.pid, None, None)


def _mount(prey: Prey) -> None:
    _of_c(_libc.mount(b"tmpfs", prey.writable.encode(), b"tmpfs", 0, None))
    _libc.umount2(prey.writable.encode(), 2)


def _fork_into_namespaces() -> None:
    if (pid := _of_c(_libc.syscall(CLONE, NEW_USER | 17, 0, 0, 0, 0))) == 0:
        os._exit(0)
    _process_ends(pid)


def _link(prey: Prey) -> None:
    path = f"{prey.writable}/link"
    os.link(prey.secret, path)
    os.unlink(path)


def _io_uring(prey: Prey) -> None:
    os.close(_of_c(_libc.syscall(IO_URING_SETUP, 1, ctypes.create_string_buffer(120))))


def _device() -> None:
    path = f"{os.environ['TMPDIR']}/device"
    os.mknod(path, 0o020600, os.makedev(1, 1))
    os.unlink(path)


def _shared(get: str, remove: str) -> None:
    given = (4096, 0o1600) if get == "shmget" else (0o1600,)
    one = _of_c(getattr(_libc, get)(0, *given))
    getattr(_libc, remove)(one, 0, None)


def _names_of_processes(prey: Prey) -> None:
    if not any(name.isdecimal() for name in os.listdir("/proc")):
        raise FileNotFoundError


def _own_signals(prey: Prey) -> None:
    """Have the kernel send a signal to another process, as the owner of a pipe."""
    receive, _ = os.pipe()
    fcntl.fcntl(receive, fcntl.F_SETOWN, prey.pid)


NETWORK, FILES, CAPABILITIES, RIGHTS, SIGNALS, CALLS = (
    *("own network", "own files", "no capabilities", "file rights", "signals", "system calls"),
)


@dataclass(frozen=True)
class Attempt:
    """One line of what an attacker tries.

    Attributes:
        act: The attempt; it raises unless it succeeds.
        closed_by: The layers of which each alone refuses it, to any user; empty: it is refused without them.
        ordinary: Whether an ordinary user could do it without containment, as root can.
        everywhere: Whether it succeeds without containment on every system; some, as containers, refuse it themselves.
    """

    act: Callable[[Prey], object]
    closed_by: frozenset[str]
    ordinary: bool
    everywhere: bool


def _by(act: Callable[[Prey], object], *layers: str, ordinary: bool = True, everywhere: bool = True) -> Attempt:
    return Attempt(act, frozenset(layers), ordinary, everywhere)


# Refused with an error, so that one process can attempt all of them.
REFUSED: dict[str, Attempt] = {
    "read the database": _by(lambda prey: Path(prey.database).read_bytes(), FILES, RIGHTS),
    "change the database": _by(_change_database, FILES, RIGHTS),
    "read a private key": _by(lambda prey: Path(prey.secret).read_bytes(), FILES, RIGHTS),
    "read /etc/passwd": _by(lambda prey: Path("/etc/passwd").read_bytes(), FILES, RIGHTS),
    "list the root": _by(lambda prey: os.listdir("/"), RIGHTS),
    "list a folder of another": _by(lambda prey: os.listdir(prey.writable), FILES, RIGHTS),
    "see that a file exists": _by(lambda prey: os.stat(prey.secret), FILES),
    "write to /tmp": _by(lambda prey: _write(os.path.join(os.sep, "tmp", "hostile")), FILES, RIGHTS),
    "write to /dev/shm": _by(lambda prey: _write("/dev/shm/hostile"), FILES, RIGHTS, everywhere=False),
    "write to a folder of its user": _by(lambda prey: _write(f"{prey.writable}/hostile"), FILES, RIGHTS),
    "write to the working folder": _by(lambda prey: _write("hostile"), FILES, RIGHTS),
    "write beside the code": _by(
        lambda prey: _write(f"{Path(packing.__file__).parent}/hostile"), FILES, RIGHTS, ordinary=False, everywhere=False
    ),
    "link to a private key": _by(_link, FILES, RIGHTS, CALLS),
    "make a device": _by(lambda prey: _device(), CAPABILITIES, RIGHTS, CALLS, ordinary=False, everywhere=False),
    "read the environment of a process": _by(
        lambda prey: Path(f"/proc/{prey.pid}/environ").read_bytes(), FILES, RIGHTS
    ),
    "read the environment of its parent": _by(
        lambda prey: Path(f"/proc/{os.getppid()}/environ").read_bytes(), FILES, RIGHTS, ordinary=False, everywhere=False
    ),
    "list the processes": _by(_names_of_processes, FILES, RIGHTS),
    "see that a process exists": _by(lambda prey: os.stat(f"/proc/{prey.pid}"), FILES),
    "ask for a process's group": _by(lambda prey: os.getpgid(prey.pid), CALLS),
    "read the limits of a process": _by(lambda prey: resource.prlimit(prey.pid, resource.RLIMIT_NOFILE), CALLS),
    "ask for a process's priority": _by(lambda prey: os.getpriority(os.PRIO_PROCESS, prey.pid), CALLS),
    "signal a process": _by(lambda prey: os.kill(prey.pid, 0), SIGNALS, CALLS),
    "signal its parent": _by(lambda prey: os.kill(os.getppid(), 0), SIGNALS, CALLS, ordinary=False, everywhere=False),
    "signal every process": _by(lambda prey: os.kill(-1, 0), CALLS),
    "signal its group": _by(lambda prey: os.killpg(0, 0), CALLS),
    "signal through a pipe": _by(_own_signals, CALLS),
    "open a process": _by(lambda prey: os.pidfd_open(prey.pid), CALLS),
    "connect to loopback": _by(
        lambda prey: _connected(socket.AF_INET, ("127.0.0.1", prey.port)), NETWORK, SIGNALS, CALLS
    ),
    "connect to loopback, IPv6": _by(
        lambda prey: _connected(socket.AF_INET6, ("::1", prey.port)), NETWORK, SIGNALS, CALLS, everywhere=False
    ),
    "send a datagram": _by(_datagram, NETWORK, CALLS),
    "connect to a socket with a path": _by(lambda prey: _connected(socket.AF_UNIX, prey.unix), FILES, CALLS),
    "connect to an abstract socket": _by(
        lambda prey: _connected(socket.AF_UNIX, "\0" + prey.abstract), NETWORK, SIGNALS, CALLS
    ),
    "listen on a port": _by(lambda prey: _listen(socket.AF_INET, ("127.0.0.1", 0)), SIGNALS, CALLS),
    "listen on an abstract socket": _by(lambda prey: _listen(socket.AF_UNIX, "\0hostile"), CALLS),
    "talk to the kernel": _by(
        lambda prey: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW).close(), CALLS, everywhere=False
    ),
    "make a pair of sockets": _by(lambda prey: [one.close() for one in socket.socketpair()], CALLS),
    "fork": _by(lambda prey: _fork(), CALLS),
    "fork into namespaces": _by(lambda prey: _fork_into_namespaces(), CALLS, everywhere=False),
    "start a thread": _by(lambda prey: _thread(), CALLS),
    "start a program": _by(lambda prey: subprocess.run([sys.executable, "-c", ""], check=True), FILES, RIGHTS, CALLS),
    "become root": _by(lambda prey: os.setresuid(0, 0, 0), CALLS, ordinary=False),
    "join groups": _by(lambda prey: os.setgroups([0, 1]), CAPABILITIES, CALLS, ordinary=False, everywhere=False),
    "be dumpable again": _by(lambda prey: _of_c(_libc.prctl(PR_SET_DUMPABLE, 1, 0, 0, 0)), CALLS),
    "hide from its parent's death": _by(lambda prey: _of_c(_libc.prctl(PR_SET_PDEATHSIG, 0, 0, 0, 0)), CALLS),
    "change a limit": _by(lambda prey: resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64)), CALLS),
    "keep files in memory": _by(lambda prey: os.close(os.memfd_create("hostile")), CALLS),
    "have the kernel work aside": _by(_io_uring, CALLS, everywhere=False),
    "share memory": _by(lambda prey: _shared("shmget", "shmctl"), CALLS, everywhere=False),
    "queue messages": _by(lambda prey: _shared("msgget", "msgctl"), CALLS, everywhere=False),
    "write to what it was given": _by(lambda prey: os.write(0, b"x"), everywhere=False),
}
# End the process: nothing but an attack calls them.
ENDED: dict[str, Attempt] = {
    "attach to a process": _by(_trace, RIGHTS, SIGNALS, CALLS, everywhere=False),
    "read a process's memory": _by(_read_memory, RIGHTS, SIGNALS, CALLS, everywhere=False),
    "load a program into the kernel": _by(lambda prey: _of_c(_libc.syscall(BPF, 0, None, 0)), CALLS, everywhere=False),
    "mount": _by(_mount, CAPABILITIES, RIGHTS, CALLS, ordinary=False, everywhere=False),
    "make namespaces": _by(lambda prey: _of_c(_libc.unshare(NEW_USER)), CALLS, everywhere=False),
    "change its root": _by(lambda prey: os.chroot("/"), CAPABILITIES, CALLS, ordinary=False, everywhere=False),
}


def start_a_thread() -> None:
    """Leave a thread in the server, as Arrow's allocator does."""
    threading.Thread(target=threading.Event().wait, daemon=True).start()


def attempt(given: BinaryIO, answer: BinaryIO, *, names: list[str], prey: dict[str, Any]) -> None:
    """Write what came of each attempt: an empty text if it succeeded, else its error."""
    answer.write(json.dumps(attempted(names, Prey(**prey))).encode())


def attempted(names: Iterable[str], prey: Prey) -> dict[str, str]:
    """Return what came of each attempt: an empty text if it succeeded, else its error."""
    came = {}
    for name in names:
        try:
            (REFUSED | ENDED)[name].act(prey)
        except (OSError, sqlite3.Error, RuntimeError, ValueError) as error:
            came[name] = f"{type(error).__name__}: {error}"
        else:
            came[name] = ""
    return came


_VICTIM = """
import ctypes, sys
secret = ctypes.create_string_buffer(b"a secret")
ctypes.CDLL(None).prctl(0x59616d61, ctypes.c_ulong(-1), 0, 0, 0)  # where Yama would forbid what it tests
print(ctypes.addressof(secret), flush=True)
sys.stdin.read()
"""


@contextmanager
def prepared(folder: Path) -> Iterator[Prey]:
    """Prepare what there is to attack: all of the same user, as the service and its files are."""
    database, secret, unix, writable = folder / "skills.sqlite", folder / "key", folder / "unix", folder / "writable"
    with closing(sqlite3.connect(database)) as made:
        made.executescript("CREATE TABLE releases (policy TEXT); INSERT INTO releases VALUES ('a')")
    secret.write_text("a secret")
    secret.chmod(0o600)
    writable.mkdir()
    abstract = f"suture-skills-{os.getpid()}"
    with ExitStack() as ended:
        servers = []
        for family, address in (
            (socket.AF_INET, ("127.0.0.1", 0)),
            (socket.AF_UNIX, str(unix)),
            (socket.AF_UNIX, "\0" + abstract),
        ):
            server = ended.enter_context(socket.socket(family))
            server.bind(address)
            server.listen(16)
            servers.append(server)
        port = servers[0].getsockname()[1]
        with suppress(OSError):  # a machine without IPv6
            sixth = ended.enter_context(socket.socket(socket.AF_INET6))
            sixth.bind(("::1", port))
            sixth.listen(16)
        command = [sys.executable, "-c", _VICTIM]
        victim = ended.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={"SKILLS_SECRET": "hush"})
        )
        yield Prey(
            str(database),
            str(secret),
            str(writable),
            victim.pid,
            int(victim.stdout.readline()),
            port,
            str(unix),
            abstract,
        )


def main() -> None:
    """Make every attempt with and without containment, and print what came of them, and the layers, as JSON.

    The layers to enter may be named as arguments; by default they are those that the system offers.
    """
    forked._layers = tuple(sys.argv[1:]) or None
    with tempfile.TemporaryDirectory() as folder, prepared(Path(folder)) as prey:
        os.chdir(folder)
        came = {"uid": os.geteuid(), "contained": contained(prey), "layers": forked.layers_held()}
        print(json.dumps(came | {"free": attempted([*REFUSED, *ENDED], prey)}))


def contained(prey: Prey) -> dict[str, str]:
    """Return what came of each attempt in a fork; the cause of its end, where it ended the fork."""
    came: dict[str, str] = {}
    with (
        closing(forked.ForkServer("tests.sandbox.hostile:start_a_thread")) as server,
        tempfile.TemporaryFile() as given,
    ):
        for names in (list(REFUSED), *([name] for name in ENDED)):
            try:
                with server.run(ATTEMPT, given, {"names": names, "prey": vars(prey)}, LIMITS) as answer:
                    came |= json.load(answer)
            except Unanswered as error:
                came |= dict.fromkeys(names, f"{error.cause}: {getattr(error, '__notes__', [])}")
    return came


if __name__ == "__main__":
    main()
