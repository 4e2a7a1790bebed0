"""The fork server: a small single-threaded process that imports its modules once and then only forks.

Requests arrive on standard input, a SOCK_SEQPACKET socket, which preserves message boundaries. Each request is JSON
with four open files attached:

    given     read-only, the input of the function
    answer    the function writes its result here
    said      stdout and stderr of the fork, including output of C libraries
    line      the caller's socket: it receives "begun" and then the exit code; closing it ends the fork

Before the first request it enters the layers of `skills.sandbox.containment` that a server enters, and tells its
caller which layers its forks will have; each fork enters the others before it calls the function.

Each fork has its own folder for temporary files, which the server removes however the fork ended. The server exits
when its last caller has disconnected, and kills all its forks then. It imports little itself, because a call in a new
interpreter starts one, too.
"""

import gc
import importlib
import json
import os
import resource
import selectors
import shutil
import signal
import socket
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from skills.sandbox import ProcessLimits, confine, perform
from skills.sandbox.containment import Allowance, enter, offered, prepare

MAX_REQUEST_BYTES = 16384
BEGUN, NO_FORK = b"begun", b"no fork"


@dataclass(frozen=True)
class _Child:
    """A fork that was begun: its process, and its caller's socket."""

    pid: int
    ended: int  # a pidfd: readable once the process has ended
    line: socket.socket

    @property
    def folder(self) -> Path:
        """The folder of its temporary files."""
        return Path(tempfile.gettempdir(), str(self.pid))


@dataclass(frozen=True)
class _Inherited:
    """What every fork has of the server: its containment, and the address space of the server's imports in bytes."""

    place: Allowance
    layers: tuple[str, ...]
    held_bytes: int


def main(folder: str, code: str, layers: str, *modules: str) -> NoReturn:
    """Run as the fork server until the last caller disconnects.

    Args:
        folder: For the temporary files of the forks; removed at the end.
        code: The folders of code that forks may read, as JSON.
        layers: The layers of containment to enter, as JSON; null: those that the system offers.
        modules: Imported before the first fork. One may be given as `module:function`: the function is called once,
            to prepare state that every fork inherits.
    """
    tempfile.tempdir = folder
    in_use, remover = _removed_afterwards(folder)
    place, wanted = Allowance(folder, tuple(json.loads(code))), json.loads(layers)
    held = tuple(offered(place) if wanted is None else wanted)
    prepare(held)
    gc.disable()  # imports create no garbage, and looking for it takes a fifth of the start
    for given in modules:
        module, _, function = given.partition(":")
        imported = importlib.import_module(module)
        if function:
            getattr(imported, function)()
    gc.freeze()  # the collector would write to pages shared with the forks, and so copy them
    gc.enable()
    inherited = _Inherited(place, held, _held_bytes())
    enter(place, held, of_server=True)
    children: dict[int, _Child] = {}
    try:
        with socket.socket(fileno=0) as control, selectors.DefaultSelector() as events:
            with suppress(BrokenPipeError):  # the caller has ended by now
                control.send(json.dumps(inherited.layers).encode())
            _serve(control, events, children, inherited)
    finally:
        for child in children.values():
            _kill(child)
            os.waitpid(child.pid, 0)  # when the server has ended, none of its forks runs any more
        os.close(in_use)
        os.waitpid(remover, 0)
    os._exit(0)  # without the interpreter's shutdown, for which a caller in `call_alone` would wait


def _removed_afterwards(folder: str) -> tuple[int, int]:
    """Fork a process that removes a folder when this one ends in any way; once contained, this one cannot.

    Returns:
        The file to close, and the process that then removes the folder and ends.
    """
    ended, in_use = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(in_use)
        os.close(0)  # the caller learns from it that the server has ended
        os.read(ended, 1)
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)
    os.close(ended)
    return in_use, pid


def _serve(
    control: socket.socket, events: selectors.BaseSelector, children: dict[int, _Child], inherited: _Inherited
) -> None:
    """Fork, kill and report, one event at a time.

    Only the first pending event is handled before selecting again, because handling it may invalidate the others.
    """
    events.register(control, selectors.EVENT_READ)
    while True:
        key, _ = events.select()[0]
        if key.fileobj is not control:
            act: Callable[[], None] = key.data
            act()
            continue
        try:
            request, files, _, _ = socket.recv_fds(control, MAX_REQUEST_BYTES, 4)
        except ConnectionResetError:  # the caller ended before it read what it was told
            return
        if not request:
            return
        child = _fork(json.loads(request), inherited, *files)
        if child is None:
            continue
        children[child.pid] = child
        events.register(child.line, selectors.EVENT_READ, partial(_hung_up, child, events))
        events.register(child.ended, selectors.EVENT_READ, partial(_ended, child, events, children))


def _fork(
    request: dict[str, Any], inherited: _Inherited, given: int, answer: int, said: int, caller: int
) -> _Child | None:
    """Fork a process for a request; return None where the system refuses another process."""
    server, line = os.getpid(), socket.socket(fileno=caller)
    try:
        pid = os.fork()
    except OSError:
        pid = -1
    if pid == 0:
        _run_child(request, given, answer, said, server, inherited)
    for file in (given, answer, said):
        os.close(file)
    _send(line, BEGUN if pid > 0 else NO_FORK)
    if pid < 0:
        line.close()
        return None
    with suppress(OSError):  # the fork does so too, and may have ended already
        os.setpgid(pid, pid)
    return _Child(pid, os.pidfd_open(pid), line)


def _hung_up(child: _Child, events: selectors.BaseSelector) -> None:
    """Kill a fork whose caller has disconnected; `_ended` cleans up after it as after any other."""
    events.unregister(child.line)
    _kill(child)


def _ended(child: _Child, events: selectors.BaseSelector, children: dict[int, _Child]) -> None:
    """Report the exit code of a fork, and remove its processes, files and sockets."""
    _kill(child)  # its descendants, before waitpid lets the system reuse its process id
    code = os.waitstatus_to_exitcode(os.waitpid(child.pid, 0)[1])
    shutil.rmtree(child.folder, ignore_errors=True)
    _send(child.line, str(code).encode())
    events.unregister(child.ended)
    if child.line in events.get_map():
        events.unregister(child.line)
    os.close(child.ended)
    child.line.close()
    del children[child.pid]


def _kill(child: _Child) -> None:
    """Kill a process and its process group."""
    for kill in (os.kill, os.killpg):
        with suppress(ProcessLookupError):
            kill(child.pid, signal.SIGKILL)


def _send(line: socket.socket, message: bytes) -> None:
    with suppress(OSError):  # the caller may have disconnected
        line.send(message)


def _run_child(
    request: dict[str, Any], given: int, answer: int, said: int, server: int, inherited: _Inherited
) -> NoReturn:
    """Close all files but those of this request, apply the limits and the containment, call the function, exit."""

    def work() -> None:
        """Enter the limits and the layers, and call the function."""
        os.setpgid(0, 0)
        os.dup2(given, 0)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.closerange(3, answer)
        os.closerange(answer + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        tempfile.tempdir = f"{tempfile.gettempdir()}/{os.getpid()}"
        os.mkdir(tempfile.tempdir)
        os.environ["TMPDIR"] = os.environ["HOME"] = tempfile.tempdir  # for libraries that write to either
        limits = ProcessLimits(**request["limits"])
        # Memory on top of the inherited address space, so that the limit does not depend on the server's imports.
        confine(replace(limits, memory_bytes=inherited.held_bytes + limits.memory_bytes), server)
        module, _, name = request["target"].partition(":")
        # The outermost package before, because the folder that contains it can no longer be listed then.
        importlib.import_module(module.partition(".")[0])
        place = Allowance(tempfile.tempdir, inherited.place.code, threads=limits.threads, program=limits.program)
        enter(place, inherited.layers, of_server=False)
        function = getattr(importlib.import_module(module), name)
        with os.fdopen(0, "rb", closefd=False) as file, os.fdopen(answer, "wb") as out:
            function(file, out, **request["arguments"])

    perform(work)


def _held_bytes() -> int:
    """Return the address space of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
