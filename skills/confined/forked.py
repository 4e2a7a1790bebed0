"""Run functions in forks of a server that has imported them already.

The server is a process of its own, started anew (so it has no threads, none of our memory and next to none of our
environment) and started again when it dies. Any number of threads may ask at once. Linux only.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from threading import Lock
from typing import IO, Any, BinaryIO

from skills.confined.fork_server import BEGUN
from skills.confined.limits import Limits, check_end, environment, overdue
from skills.errors import Busy

START_S = 15.0  # to import the modules on a busy machine; forking takes a millisecond
_NO_PROCESS = "This machine has no process to spare; try again in a moment."
_ENTRY = "import sys; from skills.confined.fork_server import main; main(*sys.argv[1:])"


class _Dead(Exception):
    """The server is gone, or does not answer."""


@dataclass(frozen=True)
class _Server:
    process: subprocess.Popen[bytes]
    control: socket.socket
    folder: str  # for the temporary files of its forks

    def end(self) -> None:
        """End it: with nobody left to ask it leaves, and takes along what it forked."""
        self.control.close()
        try:
            self.process.wait(1.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)  # it does so itself, if it can


class ForkServer:
    """Runs functions in forks of a process that has imported some modules, or called some `module:function` once."""

    def __init__(self, *modules: str) -> None:
        self._modules = modules
        self._server: _Server | None = None
        self._open = True
        self._lock = Lock()

    @property
    def pid(self) -> int | None:
        """The server's process, None while there is none."""
        return None if self._server is None else self._server.process.pid

    def start(self) -> None:
        """Start the server, and do not wait until it has imported everything."""
        self._running()

    def close(self) -> None:
        """End the server and all that it forked; nothing can be run any longer."""
        with self._lock:
            self._open = False
            if self._server is not None:
                self._server.end()
                self._server = None

    @contextmanager
    def run(self, target: str, given: BinaryIO, arguments: Mapping[str, Any], limits: Limits) -> Iterator[IO[bytes]]:
        """Call a function in a fork, for as long as the block with its answer, a file at its beginning.

        Args:
            target: The function, as `module:function`; it is called with a file to read, one to write, and arguments.
            given: A real file, or one that turns into one; the function sees it read-only, from its beginning.
            arguments: Keywords, plain JSON.
            limits: What the fork may use; its memory comes on top of what the server has.

        Raises:
            Unanswered: It hung, crashed, ran out of memory, wrote too much, or failed; the end of what it printed is a
                note of the error.
            Busy: The server died twice, or the system has no process to give.
        """
        request = json.dumps({"target": target, "arguments": arguments, "limits": asdict(limits)}).encode()
        given_fd = _opened_again(given)
        try:
            for _ in range(2):
                with tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as said:
                    server = self._running()
                    try:
                        code = _ask(server, request, (given_fd, answer.fileno(), said.fileno()), limits)
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
        raise Busy("The process that reads for this service keeps ending; try again in a moment.")

    def _running(self) -> _Server:
        with self._lock:
            if not self._open:
                raise Busy("The service is stopping; try again when it is back.")
            if self._server is None:
                try:
                    self._server = _start(self._modules)
                except OSError as error:
                    raise Busy(_NO_PROCESS) from error
            return self._server

    def _replace(self, dead: _Server) -> None:
        with self._lock:
            if self._server is dead:  # else another thread was first
                self._server = None
                dead.process.kill()
                dead.end()


def _start(modules: tuple[str, ...]) -> _Server:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(START_S)
    folder = tempfile.mkdtemp(prefix="suture-skills-")
    with theirs:
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-P", "-c", _ENTRY, folder, *modules],
            stdin=theirs.fileno(),
            stdout=subprocess.DEVNULL,
            env=environment(),
            start_new_session=True,  # Ctrl-C is for us; it ends when we do
        )
    return _Server(process, ours, folder)


def _opened_again(file: BinaryIO) -> int:
    """Open a file once more: read-only, and with a position of its own."""
    descriptor = file.fileno()  # here a spooled file is written out
    file.flush()
    return os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY)


def _ask(server: _Server, request: bytes, files: tuple[int, int, int], limits: Limits) -> int | None:
    """Have the server fork, and wait for the fork's exit code; None: it was not done in time, and is killed.

    Raises:
        _Dead: There is no server any longer.
        Busy: It could not fork.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        try:
            with theirs:
                socket.send_fds(server.control, [request], [*files, theirs.fileno()])
            ours.settimeout(START_S)
            begun = ours.recv(16)
        except OSError as error:
            raise _Dead from error
        if begun and begun != BEGUN:
            raise Busy(_NO_PROCESS)
        ours.settimeout(limits.wall_s)
        try:
            ended = begun and ours.recv(16)
        except TimeoutError:
            return None
        except OSError as error:
            raise _Dead from error
        if not ended:
            raise _Dead
        return int(ended)
