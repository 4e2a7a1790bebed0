"""A fork server: a fork's fault is named, everything of it is removed, and the next fork is unaffected."""

import errno
import io
import json
import os
import resource
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import pytest

from skills.errors import Busy, Unanswered
from skills.sandbox import ProcessLimits, fork_server, forked
from skills.sandbox.containment import Allowance
from skills.sandbox.forked import ForkServer, layers_held
from tests.measured import peak_mib
from tests.waiting import alive, crowded, leaders, until

LIMITS = ProcessLimits(memory_bytes=256 << 20, wall_s=20.0, cpu_s=20, file_bytes=16 << 20, threads=False)


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    server = ForkServer("tests.sandbox.faults")
    yield server
    server.close()


@pytest.fixture
def given() -> Iterator[IO[bytes]]:
    with tempfile.TemporaryFile() as file:
        file.write(b"abc")
        yield file


def run(server: ForkServer, fault: str, given: IO[bytes], limits: ProcessLimits = LIMITS, **said: Any) -> bytes:
    with server.run(f"tests.sandbox.faults:{fault}", given, said, limits) as answer:
        return answer.read()


def test_a_file_and_arguments_go_in_and_a_file_comes_out(server, given):
    assert run(server, "echo", given, wide=1.5, frame=None) == b'cba{"wide": 1.5, "frame": null}'
    assert run(server, "echo", given) == b"cba{}"  # the file is read from its beginning again
    assert given.tell() == 3


def test_a_file_still_in_memory_is_written_out_first(server):
    with tempfile.SpooledTemporaryFile(max_size=1 << 20) as spooled:
        spooled.write(b"xyz")
        assert run(server, "echo", spooled) == b"zyx{}"


def test_what_is_printed_is_not_in_the_answer(server, given):
    assert run(server, "chatter", given) == b"quiet"


def test_a_fork_has_nothing_of_ours(server, given, monkeypatch):
    monkeypatch.setenv("SKILLS_SECRET", "hush")
    with tempfile.TemporaryFile() as other:
        seen = json.loads(run(server, "surroundings", given))
        assert "SKILLS_SECRET" not in seen["environment"]
        assert len(seen["files"]) == 4, other.fileno()
    assert seen["files"][:3] == [0, 1, 2]
    assert (seen["threads"], seen["own group"]) == (1, True)


def test_get_ready_runs_once_in_the_server_and_every_fork_inherits_it(given):
    server = ForkServer("tests.sandbox.faults:get_ready")
    try:
        assert [json.loads(run(server, "who_got_ready", given)) for _ in range(3)] == 3 * [[server.pid]]
    finally:
        server.close()


def test_a_fork_uses_freed_memory_again(server, given):
    asked_for_each = 10 * 4 * 400_000 * 8 // resource.getpagesize()
    assert json.loads(run(server, "freed_and_used_again", given)) < asked_for_each / 10


def test_a_fork_is_told_where_compiled_loops_are_kept(given, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    server = ForkServer("tests.sandbox.faults")
    try:
        assert "NUMBA_CACHE_DIR" in json.loads(run(server, "surroundings", given))["environment"]
    finally:
        server.close()


def test_it_cannot_change_what_it_is_given(server, given):
    with pytest.raises(Unanswered, match="code 1"):
        run(server, "write_to_what_is_given", given)
    given.seek(0)
    assert given.read() == b"abc"


def ended(pid: int) -> bool:
    return not alive(pid)


def test_its_temporary_files_go_with_it_and_the_folder_with_the_server(given):
    server = ForkServer("tests.sandbox.faults")
    left = Path(run(server, "scatter", given, stay=False).decode())
    assert left.is_absolute()
    with pytest.raises(Unanswered):
        run(server, "scatter", given, stay=True)
    assert list(left.parents[1].iterdir()) == []
    server.close()
    assert not left.parents[1].exists()


FAULTS = [
    ("crash", "crashed", "SIGSEGV"),
    ("leave", "failed", "code 3"),
    ("fail", "failed", "code 1"),
    ("open_without_end", "failed", "code 1"),
    ("no_such_function", "failed", "code 1"),
    ("abort", "out of memory", "256 MiB"),
    ("eat_memory", "out of memory", "256 MiB"),
    ("eat_memory_bit_by_bit", "out of memory", "256 MiB"),
    ("answer_without_end", "too much", "16 MiB"),
    ("talk_without_end", "too much", "16 MiB"),
]


@pytest.mark.parametrize(("fault", "cause", "word"), FAULTS)
def test_what_went_wrong_is_named_and_the_next_one_works(server, given, fault, cause, word):
    with pytest.raises(Unanswered, match=word) as caught:
        run(server, fault, given)
    assert caught.value.cause == cause
    assert run(server, "echo", given) == b"cba{}"


def test_its_last_words_are_a_note(server, given):
    with pytest.raises(Unanswered) as caught:
        run(server, "fail", given)
    assert "nobody knows" in caught.value.__notes__[0]


def test_one_that_hangs_is_killed_when_its_time_is_over(server, given):
    with ThreadPoolExecutor(1) as thread:
        hanging = thread.submit(run, server, "hang", given, replace(LIMITS, wall_s=2.0))
        pid = only_fork(server)
        with pytest.raises(Unanswered, match=r"did not finish within 2 s") as caught:
            hanging.result()
    assert caught.value.cause == "hung"
    until(lambda: not alive(pid))


def only_fork(server: ForkServer) -> int:
    """Wait for a fork and return its process id."""
    found: list[int] = []
    until(lambda: server.pid and (found.extend(leaders(server.pid)) or found))
    return found[0]


def test_one_that_spins_is_ended_by_its_processor_time(server, given):
    with pytest.raises(Unanswered, match="1 s of processor time"):
        run(server, "spin", given, replace(LIMITS, cpu_s=1))


@pytest.mark.parametrize("fault", ["multiply", "start_a_program", "call_what_only_an_attack_needs"])
def test_what_containment_refuses_is_told_as_such(server, given, fault):
    if "system calls" not in layers_held():
        pytest.skip("NOT TRIED: this system offers no filter of system calls.")
    with pytest.raises(Unanswered, match="was stopped by its containment") as caught:
        run(server, fault, given)
    assert caught.value.cause == "contained"
    assert run(server, "echo", given) == b"cba{}"


def test_the_server_has_one_thread_and_does_not_grow(server, given):
    run(server, "echo", given)
    before = peak_mib(server.pid)
    for fault in ("eat_memory", "eat_memory_bit_by_bit", "answer_without_end", "talk_without_end"):
        with pytest.raises(Unanswered):
            run(server, fault, given)
    assert peak_mib(server.pid) < before + 8
    assert len(os.listdir(f"/proc/{server.pid}/task")) == 1
    until(lambda: len(os.listdir(f"/proc/{server.pid}/fd")) <= 6)


def test_16_at_once_get_their_own_answers(server):
    def one(k: int) -> bytes:
        with tempfile.TemporaryFile() as file:
            file.write(b"%02d" % k)
            return run(server, "echo", file, k=k)

    with ThreadPoolExecutor(16) as threads:
        answers = list(threads.map(one, range(64)))
    assert answers == [(b"%02d" % k)[::-1] + b'{"k": %d}' % k for k in range(64)]


def test_one_that_hangs_does_not_hold_up_another(server, given):
    with ThreadPoolExecutor(1) as thread:
        hanging = thread.submit(run, server, "hang", given, replace(LIMITS, wall_s=3.0 * crowded()))
        only_fork(server)
        began = time.monotonic()
        with tempfile.TemporaryFile() as file:
            assert run(server, "echo", file) == b"{}"
        assert time.monotonic() - began < 1.0 * crowded()
        assert not hanging.done()
        with pytest.raises(Unanswered):
            hanging.result()


def test_a_server_that_is_killed_is_replaced(given):
    server = ForkServer("tests.sandbox.faults")
    try:
        run(server, "echo", given)
        killed = server.pid
        os.kill(killed, signal.SIGKILL)
        assert run(server, "echo", given) == b"cba{}"
        assert server.pid != killed
        assert not alive(killed)
    finally:
        server.close()


def test_a_fork_dies_with_its_server_and_is_tried_once_more(given):
    server = ForkServer("tests.sandbox.faults")
    server.wait()
    with ThreadPoolExecutor(1) as thread:
        hanging = thread.submit(run, server, "hang", given)
        for _ in range(2):
            forked = only_fork(server)
            os.kill(server.pid, signal.SIGKILL)
            until(partial(ended, forked))
        with pytest.raises(Busy, match="ends repeatedly"):
            hanging.result()
    server.close()


def test_a_server_that_cannot_start_makes_one_busy(given, capfd):
    server = ForkServer("tests.sandbox.there_is_no_such_module")
    with pytest.raises(Busy):
        run(server, "echo", given)
    server.close()
    assert "there_is_no_such_module" in capfd.readouterr().err


def test_closing_it_ends_what_it_forked_and_the_askers_are_told(given):
    server = ForkServer("tests.sandbox.faults")
    server.wait()
    with ThreadPoolExecutor(1) as thread:
        hanging = thread.submit(run, server, "hang", given)
        own, forked = server.pid, only_fork(server)
        server.close()
        with pytest.raises(Busy, match="stopping"):
            hanging.result()
    assert not alive(own)
    until(lambda: not alive(forked))


def test_it_ends_with_its_asker(tmp_path):
    told = tmp_path / "told"
    code = (
        "import sys, tempfile, tests.sandbox.test_forked as t\n"
        "server = t.ForkServer('tests.sandbox.faults')\n"
        "with tempfile.TemporaryFile() as file: t.run(server, 'echo', file)\n"
        f"open({str(told)!r}, 'w').write(str(server.pid))\n"
        "with tempfile.TemporaryFile() as file: t.run(server, 'hang', file)\n"
    )
    asker = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], env=os.environ | {"TMPDIR": str(tmp_path)}
    )
    until(lambda: told.exists() and told.read_text() and leaders(int(told.read_text())), by=[asker])
    (forked,) = leaders(int(told.read_text()))
    asker.send_signal(signal.SIGKILL)
    asker.wait()
    until(lambda: not alive(int(told.read_text())))
    until(lambda: not alive(forked))
    until(lambda: not list(tmp_path.glob("suture-skills-*")))


def test_an_asker_that_leaves_without_reading_ends_the_server_silently():
    asker, control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with control, selectors.DefaultSelector() as events:
        control.send(b"ready")
        asker.close()  # the kernel tells the other side of it as a reset connection
        fork_server._serve(control, events, {}, fork_server._Inherited(Allowance("", ()), (), 0))


def test_an_asker_gone_before_the_server_is_ready_ends_it_silently(tmp_path: Path):
    asker, control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    asker.close()
    folder = tempfile.mkdtemp(dir=tmp_path)
    with control:
        ended = subprocess.run(
            [sys.executable, "-P", "-c", forked._ENTRY, folder, json.dumps(forked.code_folders()), "null"],
            stdin=control.fileno(),
            stderr=subprocess.PIPE,
            env=forked.environment(),
            timeout=60 * crowded(),
            check=False,
        )
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_a_disk_that_fails_is_not_said_to_be_an_unreadable_answer():
    class Failing(io.BytesIO):
        def read(self, *_: Any) -> bytes:
            raise OSError(errno.EIO, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        forked._value(Failing(b"x" * 100), (int,), {}, 1000)
    with pytest.raises(Unanswered, match="unreadable data"):
        forked._value(io.BytesIO(b"x" * 100), (int,), {}, 1000)
