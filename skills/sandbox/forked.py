"""Function calls in forks of a server process.

`ForkServer` calls functions in forks of a server process that has imported their modules already. The server is started
as a new interpreter (so it has no threads, none of our memory and a minimal environment) and is started again when it
dies. It is thread-safe. Linux only.

`call_alone` calls one function in a server of its own without imports, which ends with the call: a new interpreter,
which shares no state with this process or other calls, but takes a while to import what the function needs.

Every fork is contained (`skills.sandbox.containment`). The first server of this process finds out which layers the
system offers; later ones must take the same, or end. `layers_held` returns them.

    def function(given: BinaryIO, answer: BinaryIO, **arguments) -> None

A function reads its input from a file, which is a stranger's or a value written by `skills.packing`, and writes its
result to another with `packing.write`. That is read as untrusted: only the classes that the caller names are built, and
their constructors check every number.
"""

import ctypes
import errno
import json
import logging
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from select import select
from subprocess import TimeoutExpired
from threading import Lock
from typing import IO, Any, BinaryIO, TypeVar

from skills import packing
from skills.errors import BadSettings, Busy, Unanswered
from skills.packing import Known
from skills.sandbox import ProcessLimits, check_end, environment, overdue
from skills.sandbox.containment import LAYERS, code_folders
from skills.sandbox.fork_server import BEGUN, main

log = logging.getLogger(__name__)

OF_THE_SYSTEM = {errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ESTALE, errno.EMFILE, errno.ENFILE}  # whatever was read

Watch = Callable[[bytes], None]
Answer = TypeVar("Answer")


START_S = 60.0  # timeout of the imports on a busy machine; usually they take 1 s, and forking a millisecond
MAX_GREETING_BYTES = 4096
WATCHED_S = 1.0  # between two calls of a `Watch`
WATCHED_BYTES = 1000  # of the end of the output
_NO_PROCESS = "The machine cannot start another process now; try again in a moment."
_ENDS = "The fork server of this service ends repeatedly; try again in a moment."
_PR_SET_NAME = 15  # linux/prctl.h
_ENTRY = "import sys; from skills.sandbox.fork_server import main; main(*sys.argv[1:])"


class _Dead(Exception):
    """The server has ended, or does not respond."""


@dataclass
class Fork:
    """A fork of this process, in place of a `Popen`."""

    pid: int

    def kill(self) -> None:
        """End it at once."""
        os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, and return its exit code; raises `TimeoutExpired`. Call it once."""
        ended = os.pidfd_open(self.pid)
        try:
            if not select([ended], [], [], timeout)[0]:
                raise TimeoutExpired("a fork", timeout or 0.0)
            return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        finally:
            os.close(ended)


@dataclass
class _Server:
    """A fork server: its process, and our end of its control socket."""

    process: subprocess.Popen[bytes] | Fork
    control: socket.socket
    folder: str  # for the temporary files of its forks
    ready: bool = False  # it has imported its modules and is contained
    greeting: Lock = field(default_factory=Lock)

    def end(self) -> None:
        """Stop the server: it exits when its control socket closes, and kills its forks."""
        self.control.close()
        try:
            self.process.wait(1.0)
        except TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)  # the server does so too, unless it was killed


_ahead: dict[tuple[str, ...], _Server] = {}  # forked before they were needed, by their modules
_layers: tuple[str, ...] | None = None  # those that the first server of this process held


def layers_held() -> tuple[str, ...]:
    """Return those of `containment.LAYERS` that hold in every process of the sandbox, as attempted by one of them.

    Raises:
        Busy: No process can be started.
    """
    if _layers is None:
        with closing(ForkServer()) as server:
            server.wait()
    assert _layers is not None
    return _layers


def layers_missing() -> list[str]:
    """Return those of `containment.LAYERS` that this system does not offer."""
    return [name for name in LAYERS if name not in layers_held()]


def refuse_uncontained() -> None:
    """Refuse a system that does not offer every layer of containment.

    Raises:
        BadSettings: A layer does not hold; the message names it.
    """
    if missing := layers_missing():
        raise BadSettings(
            "SKILLS_CONTAINMENT=required, and this system does not offer all layers of containment: "
            + "; ".join(f"{name} (needs {LAYERS[name]})" for name in missing)
            + ".",
            "Provide them, or set SKILLS_CONTAINMENT=available to run without them.",
        )


class ForkServer:
    """A client of a fork server: runs functions in forks of a process that has imported some modules.

    A module may be given as `module:function`; the function is called once before the first fork.
    """

    def __init__(self, *modules: str) -> None:
        self._modules = modules
        self._server: _Server | None = None
        self._open = True
        self._lock = Lock()

    @property
    def pid(self) -> int | None:
        """The process id of the server, None while it is not running."""
        return None if self._server is None else self._server.process.pid

    def start(self) -> None:
        """Start the server without waiting for its imports."""
        self._running()

    def wait(self) -> None:
        """Start the server, and wait until it is ready.

        Raises:
            Busy: It cannot be started.
        """
        try:
            _greet(self._running())
        except _Dead as error:
            raise Busy(_ENDS) from error

    def close(self) -> None:
        """Stop the server and all its forks; later calls of `run` raise `Busy`."""
        with self._lock:
            self._open = False
            if self._server is not None:
                self._server.end()
                self._server = None

    def call(
        self,
        target: str,
        given: BinaryIO,
        *,
        returns: tuple[type[Answer], ...],
        classes: Known,
        limits: ProcessLimits,
        arguments: Mapping[str, Any] | None = None,
        watch: Watch | None = None,
    ) -> Answer:
        """Call a function in a fork, and return its result.

        Args:
            target: The function, as `module:function`; it is called with a file to read, a file to write, and
                `arguments`.
            given: Input: a real file, or a spooled one, which is written to disk first; the function gets its own
                read-only file object, at the beginning.
            returns: The classes of which the result may be.
            classes: The classes that may occur in it, by name.
            limits: Limits of the fork; its memory is added to the address space of the server.
            arguments: Keyword arguments, plain JSON.
            watch: Callback, called about every second with the end of the fork's output on stdout and stderr; an
                exception that it raises ends the fork.

        Raises:
            Unanswered: The fork hung, crashed, ran out of memory, wrote too much, failed, or returned anything else;
                the end of its output is added as a note of the error.
            StorageFull: The disk had no space for its files.
            Busy: The server died twice, is closed, or the system refuses another process.
        """
        with self.run(target, given, arguments or {}, limits, watch) as answer:
            return _value(answer, returns, classes, limits.answer_bytes)

    @contextmanager
    def run(
        self,
        target: str,
        given: BinaryIO,
        arguments: Mapping[str, Any],
        limits: ProcessLimits,
        watch: Watch | None = None,
    ) -> Iterator[IO[bytes]]:
        """Call a function in a fork, and yield what it has written, a file at its beginning; as for `call`."""
        request = json.dumps({"target": target, "arguments": arguments, "limits": asdict(limits)}).encode()
        given_fd = _opened_again(given)
        try:
            for _ in range(2):  # a dead server is replaced once; a request that kills it twice is refused
                with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as said:
                    server = self._running()
                    try:
                        _greet(server)
                        code = _ask(server, request, (given_fd, answer.fileno(), said.fileno()), limits.wall_s, watch)
                    except _Dead:
                        self._replace(server)
                        continue
                    if code is None:
                        raise overdue(said, limits)
                    check_end(code, said, limits)
                    answer.seek(0)
                    yield answer
                    return
        finally:
            os.close(given_fd)
        raise Busy(_ENDS)

    def _running(self) -> _Server:
        """Return the server, after starting it if there is none; raises `Busy` if that is not possible."""
        with self._lock:
            if not self._open:
                raise Busy("The service is stopping; try again when it runs again.")
            if self._server is None:
                try:
                    self._server = _ahead.pop(self._modules, None) or _start(self._modules)
                except OSError as error:
                    raise Busy(_NO_PROCESS) from error
            return self._server

    def _replace(self, dead: _Server) -> None:
        """End a server that does not respond, so that the next call starts another."""
        with self._lock:
            if self._server is dead:  # otherwise another thread has replaced it already
                self._server = None
                dead.process.kill()
                dead.end()


def call_alone(
    target: str,
    request: object,
    *,
    returns: tuple[type[Answer], ...],
    classes: Known,
    limits: ProcessLimits,
    ready: Sequence[str] = (),
    watch: Watch | None = None,
) -> Answer:
    """Call a function in a new interpreter, and return its result.

    Args:
        target: As for `ForkServer.call`.
        request: A value, which the function reads from its file.
        returns: The classes of which the result may be.
        classes: The classes that may occur in the request and in the result, by name.
        limits: Limits of the process.
        ready: Modules of its own, as for `ForkServer`: a contained process loads no machine code.
        watch: As for `ForkServer.call`.

    Raises:
        Unanswered, StorageFull, Busy: As for `ForkServer.call`.
    """
    with tempfile.TemporaryFile() as given, closing(ForkServer(*ready)) as server:
        packing.write(given, request, classes)
        return server.call(target, given, returns=returns, classes=classes, limits=limits, watch=watch)


def _value(answer: IO[bytes], returns: tuple[type[Answer], ...], classes: Known, most_bytes: int) -> Answer:
    """Return the value that a fork has written; it is untrusted.

    Raises:
        Unanswered: It is too large, or none of the classes.
        OSError: It cannot be read, such as where the disk fails: that says nothing about the fork.
    """
    if (size := answer.seek(0, os.SEEK_END)) > most_bytes:
        raise Unanswered("too much", f"returned {size >> 20} MiB, more than the limit of {most_bytes >> 20} MiB")
    answer.seek(0)
    try:
        if packing.unfolded_bytes(answer) > most_bytes:  # a compressed archive may unpack to much more
            raise ValueError(f"more than {most_bytes} bytes")
        value = packing.read(answer, classes)
        if not isinstance(value, returns):
            raise TypeError(type(value).__name__)
    except Exception as error:  # `read` raises exceptions of any class
        if (failed := _failed_reading(error)) is not None:
            raise failed from None
        raise Unanswered("nonsense", "returned unreadable data") from error
    return value


def _failed_reading(error: BaseException | None) -> OSError | None:
    """Return the error of the disk or of the system's limits behind an error, if any; zip readers hide it."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in OF_THE_SYSTEM:
            return error
        error = error.__cause__ or error.__context__
    return None


def fork_ahead(*modules: str) -> None:
    """Fork the server of some modules from this process; the first `ForkServer` of these modules takes it.

    Like a server in a new interpreter, this process must have no thread, no secret, and a minimal environment.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    folder = tempfile.mkdtemp(prefix="suture-skills-")
    if (pid := os.fork()) == 0:
        os.setsid()
        ctypes.CDLL(None).prctl(_PR_SET_NAME, b"fork_server")
        os.dup2(theirs.fileno(), 0)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.closerange(3, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        main(folder, json.dumps(code_folders()), json.dumps(None), *modules)
    theirs.close()
    _ahead[modules] = _Server(Fork(pid), ours, folder)


def _start(modules: tuple[str, ...]) -> _Server:
    """Start a fork server without waiting for its imports."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(START_S)
    folder = tempfile.mkdtemp(prefix="suture-skills-")
    with theirs:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-P", "-c", _ENTRY, folder, json.dumps(code_folders()), json.dumps(_layers), *modules],
            stdin=theirs.fileno(),
            stdout=subprocess.DEVNULL,
            env=environment(),
            start_new_session=True,  # Ctrl-C must not reach it; it exits when our socket closes
        )
    return _Server(process, ours, folder)


def _greet(server: _Server) -> None:
    """Wait until a server is ready, and note which layers its forks have.

    Raises:
        _Dead: It has ended, for example because it could not enter a layer, or does not respond.
    """
    global _layers
    with server.greeting:
        if server.ready:
            return
        server.control.settimeout(START_S)
        try:
            message = server.control.recv(MAX_GREETING_BYTES)
        except OSError as error:
            raise _Dead from error
        if not message:
            raise _Dead
        first, _layers, server.ready = _layers is None, tuple(json.loads(message)), True
    if first and (missing := layers_missing()):
        log.warning("Readers, simulators and learners run without: %s (`skills doctor`).", ", ".join(missing))


def _opened_again(file: BinaryIO) -> int:
    """Return a new file descriptor for the same file: read-only, with its own position."""
    descriptor = file.fileno()  # `fileno` makes a spooled file write itself to disk
    file.flush()
    return os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY)


def _ask(
    server: _Server, request: bytes, files: tuple[int, int, int], wall_s: float, watch: Watch | None
) -> int | None:
    """Send a request to the server and return the fork's exit code; None at the timeout, and the fork is killed.

    Raises:
        _Dead: The server has ended.
        Busy: It could not fork.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:  # when this end closes, at the timeout or because `watch` raises, the server kills the fork
        try:
            with theirs:
                socket.send_fds(server.control, [request], [*files, theirs.fileno()])
        except OSError as error:
            raise _Dead from error
        if (begun := _receive(ours, START_S)) != BEGUN:
            raise _Dead if begun is None else Busy(_NO_PROCESS)
        until = time.monotonic() + wall_s
        while (left_s := until - time.monotonic()) > 0:
            if (ended := _receive(ours, left_s if watch is None else min(left_s, WATCHED_S))) is not None:
                return int(ended)
            if watch is not None:
                watch(_lately(files[2]))
    return None


def _receive(line: socket.socket, within_s: float) -> bytes | None:
    """Return the next message of the server; None if none comes in time.

    Raises:
        _Dead: It has ended.
    """
    line.settimeout(within_s)
    try:
        message = line.recv(16)
    except TimeoutError:
        return None
    except OSError as error:
        raise _Dead from error
    if not message:
        raise _Dead
    return message


def _lately(said: int) -> bytes:
    """Return the end of a fork's output so far."""
    # pread, because the fork shares this file's position: seeking would change where it writes next.
    return os.pread(said, WATCHED_BYTES, max(0, os.fstat(said).st_size - WATCHED_BYTES))
