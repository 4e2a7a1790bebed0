"""The fork server itself: one small process without threads, which imports its modules once and then only forks.

It gets its requests on standard input, a socket that keeps messages apart: JSON, and four open files with it.

    given     read-only, what the function is to read
    answer    what the function writes
    said      what is printed, by it or by C libraries
    line      the asker's own line: it hears "begun" and then the exit code, and hanging up ends the process

A fork's temporary files are in a folder of its own, which the server removes however the fork ended. The server ends
when its last asker is gone, and whatever it forked ends with it.
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
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from skills.confined.limits import Limits, confine, perform

MAX_REQUEST_BYTES = 16384
BEGUN, NO_FORK = b"begun", b"no fork"


@dataclass(frozen=True)
class _Child:
    pid: int
    ended: int  # readable when it has
    line: socket.socket

    @property
    def folder(self) -> Path:
        """Where its temporary files are."""
        return Path(tempfile.gettempdir(), str(self.pid))


def main(folder: str, *modules: str) -> None:
    """Be the fork server, until nobody is left to ask; its forks' temporary files go into the folder.

    A module may be given as `module:function`: the function is called once, and readies what every fork is to find.
    """
    tempfile.tempdir = folder
    for given in modules:
        module, _, function = given.partition(":")
        imported = importlib.import_module(module)
        if function:
            getattr(imported, function)()
    gc.freeze()  # what is shared with every fork stays shared
    children: dict[int, _Child] = {}
    try:
        with socket.socket(fileno=0) as control, selectors.DefaultSelector() as events:
            _serve(control, events, children)
    finally:
        for child in children.values():
            _kill(child)
        shutil.rmtree(folder, ignore_errors=True)


def _serve(control: socket.socket, events: selectors.BaseSelector, children: dict[int, _Child]) -> None:
    """Fork, kill and report, one event at a time: what is done for one may make the next one void."""
    events.register(control, selectors.EVENT_READ)
    while True:
        key, _ = events.select()[0]
        if key.fileobj is not control:
            act: Callable[[], None] = key.data
            act()
            continue
        request, files, _, _ = socket.recv_fds(control, MAX_REQUEST_BYTES, 4)
        if not request:
            return
        child = _fork(json.loads(request), *files)
        if child is None:
            continue
        children[child.pid] = child
        events.register(child.line, selectors.EVENT_READ, partial(_hung_up, child, events))
        events.register(child.ended, selectors.EVENT_READ, partial(_ended, child, events, children))


def _fork(request: dict[str, Any], given: int, answer: int, said: int, asker: int) -> _Child | None:
    """Fork a process for a request; None where the system has none to give."""
    server, line = os.getpid(), socket.socket(fileno=asker)
    try:
        pid = os.fork()
    except OSError:
        pid = -1
    if pid == 0:
        _be_child(request, given, answer, said, server)
    for file in (given, answer, said):
        os.close(file)
    _tell(line, BEGUN if pid > 0 else NO_FORK)
    if pid < 0:
        line.close()
        return None
    with suppress(OSError):  # it does so itself, and may be gone already
        os.setpgid(pid, pid)
    return _Child(pid, os.pidfd_open(pid), line)


def _hung_up(child: _Child, events: selectors.BaseSelector) -> None:
    """End a process for which nobody waits any longer; its end is seen to as any other."""
    events.unregister(child.line)
    _kill(child)


def _ended(child: _Child, events: selectors.BaseSelector, children: dict[int, _Child]) -> None:
    """Report how a process ended, and see that nothing is left of it."""
    _kill(child)  # what it started, while its id is still its own
    code = os.waitstatus_to_exitcode(os.waitpid(child.pid, 0)[1])
    shutil.rmtree(child.folder, ignore_errors=True)
    _tell(child.line, str(code).encode())
    events.unregister(child.ended)
    if child.line in events.get_map():
        events.unregister(child.line)
    os.close(child.ended)
    child.line.close()
    del children[child.pid]


def _kill(child: _Child) -> None:
    """End a process and all that it started."""
    for kill in (os.kill, os.killpg):
        with suppress(ProcessLookupError):
            kill(child.pid, signal.SIGKILL)


def _tell(line: socket.socket, message: bytes) -> None:
    with suppress(OSError):  # whoever asked may be gone
        line.send(message)


def _be_child(request: dict[str, Any], given: int, answer: int, said: int, server: int) -> NoReturn:
    """Drop everything but the files of this request, confine yourself, call the function, leave."""

    def work() -> None:
        os.setpgid(0, 0)
        os.dup2(given, 0)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.closerange(3, answer)
        os.closerange(answer + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        tempfile.tempdir = f"{tempfile.gettempdir()}/{os.getpid()}"
        os.mkdir(tempfile.tempdir)
        limits = Limits(**request["limits"])
        confine(Limits(**request["limits"] | {"memory_bytes": _held_bytes() + limits.memory_bytes}), server)
        module, _, name = request["target"].partition(":")
        function = getattr(importlib.import_module(module), name)
        with os.fdopen(0, "rb", closefd=False) as file, os.fdopen(answer, "wb") as out:
            function(file, out, **request["arguments"])

    perform(work)


def _held_bytes() -> int:
    """Say how much address space this process has: what the server imported, which every fork is given."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
