"""The cost of containment: starting a process, calls in forks, reading and playing, with and without it.

The times are of the processor, of all processes that take part; on a busy machine others would say little.
"""

import json
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import IO

from rich.table import Table

from skills.formats.reader_process import ConfinedReader
from skills.sandbox import ProcessLimits, forked
from skills.sandbox.containment import Allowance, code_folders, enter, offered
from skills.sandbox.forked import ForkServer, call_alone, layers_held
from skills.simulation.player import play
from tests.bench.timing import in_turn
from tests.formats import large
from tests.simulation.test_player import TRAJECTORY
from tests.waiting import leaders

LIMITS = ProcessLimits(memory_bytes=1 << 30, wall_s=60.0, threads=False)
ROUNDS, FORKS = 7, 50


def containing(table: Table) -> None:
    """Measure each with the layers that hold here, and with none."""
    table.add_row("containment: layers that hold here", f"{len(layers_held())}", ", ".join(layers_held()))
    with tempfile.TemporaryDirectory() as folder:
        place = Allowance(folder, tuple(code_folders()))
        (found_s,) = in_turn(partial(offered, place), rounds=ROUNDS, clock=_processor_s)
        entered_s, shut_s = map(min, zip(*(_entering_s(place) for _ in range(ROUNDS)), strict=True))
    table.add_row("  finding out which hold, once for each service", f"{found_s * 1e3:.1f} ms", "")
    table.add_row("  entering those of a server", f"{entered_s * 1e3:.1f} ms", "")
    table.add_row("  entering those of a fork", f"{shut_s * 1e3:.1f} ms", "")
    _row(table, "a new interpreter that returns a number", _alone, _alone, ROUNDS)
    with _server(True) as contained, _server(False) as free, tempfile.TemporaryFile() as given:
        calls = (partial(_calls, server, given) for server in (contained, free))
        _row(table, f"a call in a fork, of {FORKS}", *calls, rounds=ROUNDS, each=FORKS)
    with _server(True, READY) as contained, _server(False, READY) as free, tempfile.TemporaryFile() as given:
        given.write(large.four_arms())
        readers = (partial(_reader(server), given) for server in (contained, free))
        _row(table, "reading four arms, 60 s at 200 Hz, in a fork", *readers, rounds=ROUNDS)
    _row(table, "playing a short plan", partial(play, TRAJECTORY), partial(play, TRAJECTORY), 3)


READY = "skills.formats.reader_process:get_ready"


def _entering_s(place: Allowance) -> tuple[float, float]:
    """Return the processor time that a fork needs to enter the layers of a server, and those of a fork."""
    held = layers_held()
    receive, send = os.pipe()
    if (pid := os.fork()) == 0:
        try:
            began = time.thread_time()
            enter(place, held, of_server=True)
            entered = time.thread_time()
            enter(place, held, of_server=False)
            os.write(send, json.dumps((entered - began, time.thread_time() - entered)).encode())
        finally:
            os._exit(0)
    os.close(send)
    with open(receive, "rb") as told:
        entered_s, shut_s = json.load(told)
    os.waitpid(pid, 0)
    return entered_s, shut_s


@contextmanager
def _layers(contained: bool) -> Iterator[None]:
    """Let every server that starts in the block enter the layers that hold here, or none."""
    held = forked._layers
    try:
        forked._layers = held if contained else ()
        yield
    finally:
        forked._layers = held


@contextmanager
def _server(contained: bool, *modules: str) -> Iterator[ForkServer]:
    with closing(ForkServer(*(modules or ("tests.sandbox.faults",)))) as server:
        with _layers(contained):
            server.wait()
        yield server


def _row(
    table: Table, what: str, contained: Callable[[], object], free: Callable[[], object], rounds: int, each: int = 1
) -> None:
    def within(layers: bool, work: Callable[[], object]) -> None:
        with _layers(layers):
            work()

    with_s, without_s = in_turn(
        partial(within, True, contained), partial(within, False, free), rounds=rounds, clock=_processor_s
    )
    cost = f"{with_s / without_s:.2f} x without, {(with_s - without_s) / each * 1e3:+.1f} ms"
    table.add_row(f"  {what}", f"{with_s / each * 1e3:.1f} ms", cost)


def _processor_s() -> float:
    """Return the processor time of the processes that this one has started, and of those that they have started."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    ticks = 0
    for pid in leaders(os.getpid()):
        ticks += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]))
    return used.ru_utime + used.ru_stime + ticks / os.sysconf("SC_CLK_TCK")


def _alone() -> None:
    call_alone("tests.sandbox.faults:a_number", {}, returns=(int,), classes={}, limits=LIMITS)


def _calls(server: ForkServer, given: IO[bytes]) -> None:
    for _ in range(FORKS):
        with server.run("tests.sandbox.faults:echo", given, {}, LIMITS):
            pass


def _reader(server: ForkServer) -> ConfinedReader:
    reader = ConfinedReader(LIMITS, at_once=1)
    reader.server = server
    return reader
