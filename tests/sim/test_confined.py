"""A process of its own: what it does wrong is named, and it never outlives its time or its parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from skills.errors import BadInput, SimulationFailed
from skills.sim import confined

GIB = 1 << 30


def run(fault: str, request: bytes = b"abc", timeout_s: float = 20.0, memory_bytes: int = GIB) -> bytes:
    return confined.run(f"tests.sim.faults:{fault}", request, timeout_s=timeout_s, memory_bytes=memory_bytes)


def test_bytes_go_in_and_bytes_come_out():
    assert run("echo") == b"cba"


def test_what_libraries_print_is_not_in_the_answer():
    assert run("echo_and_chatter", b"\x00\xff") == b"\x00\xff"


def test_it_sees_none_of_our_settings(monkeypatch):
    monkeypatch.setenv("SKILLS_SECRET", "hush")
    assert b"SKILLS_SECRET" not in run("surroundings")


@pytest.mark.parametrize(
    ("fault", "cause", "word"),
    [
        ("crash", "crashed", "SIGSEGV"),
        ("leave", "failed", "code 3"),
        ("fail", "failed", "code 1"),
        ("eat_memory", "out of memory", "1024 MiB"),
        ("open_too_many_files", "failed", "code 1"),
        ("no_such_function", "failed", "code 1"),
    ],
)
def test_what_went_wrong_is_named(fault, cause, word):
    with pytest.raises(SimulationFailed, match=word) as caught:
        run(fault)
    assert caught.value.numbers["cause"] == cause


def test_its_last_words_are_a_note_and_not_in_the_message():
    with pytest.raises(SimulationFailed) as caught:
        run("fail")
    assert "nobody knows" in caught.value.__notes__[0]
    assert "nobody knows" not in str(caught.value)


def test_one_that_hangs_is_killed_when_its_time_is_over(tmp_path):
    pid = tmp_path / "pid"
    with pytest.raises(SimulationFailed, match="did not finish") as caught:
        run("hang", str(pid).encode(), timeout_s=3.0)
    assert caught.value.numbers["cause"] == "hung"
    assert not alive(int(pid.read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process that its parent died")
def test_it_dies_with_its_parent(tmp_path):
    pid = tmp_path / "pid"
    code = f"from tests.sim.test_confined import run; run('hang', {str(pid).encode()!r})"
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    waited(pid.exists)
    waited(pid.read_text)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    waited(lambda: not alive(int(pid.read_text())))


@pytest.mark.parametrize("wrong", [{"timeout_s": 0.0}, {"timeout_s": float("nan")}, {"memory_bytes": 0}])
def test_no_time_and_no_memory_are_refused(wrong):
    with pytest.raises(BadInput):
        run("echo", **wrong)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A killed child whose new parent has not yet reaped it is dead, too.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def waited(condition) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)
