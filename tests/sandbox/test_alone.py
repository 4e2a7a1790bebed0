"""A function in a new interpreter: its faults are named, and it never outlives its time limit or its parent."""

import os
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skills.errors import BadInput, Unanswered
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import call_alone
from tests.by_day import some
from tests.waiting import alive, crowded, leaders, until

GIB = 1 << 30


def call(fault: str, wall_s: float = 20.0, memory_bytes: int = GIB, **request: Any) -> dict[str, Any]:
    limits = ProcessLimits(memory_bytes, wall_s)
    return call_alone(f"tests.sandbox.faults:{fault}", request, returns=(dict,), classes={}, limits=limits)


def test_values_go_in_and_values_come_out_whatever_libraries_print():
    array = np.array([1.5, -0.0, np.nan])
    back = call("echo_a_value", array=array, text="abc", number=2.5, bytes=b"\x00\xff")
    assert back.pop("array").tobytes() == array.tobytes()
    assert back == {"text": "abc", "number": 2.5, "bytes": b"\x00\xff"}


def test_it_sees_none_of_our_settings(monkeypatch):
    monkeypatch.setenv("SKILLS_SECRET", "hush")
    assert "SKILLS_SECRET" not in call("environment")["names"]


@pytest.mark.parametrize(
    ("fault", "cause", "word"),
    some([
        ("crash", "crashed", "SIGSEGV"),
        ("leave", "failed", "code 3"),
        ("fail", "failed", "code 1"),
        ("eat_memory", "out of memory", "1024 MiB"),
        ("open_without_end", "failed", "code 1"),
        ("no_such_function", "failed", "code 1"),
        ("garbage", "nonsense", "unreadable data"),
        ("nothing", "nonsense", "unreadable data"),
        ("with_pickles", "nonsense", "unreadable data"),
        ("a_number", "nonsense", "unreadable data"),
        ("a_class_that_is_not_named", "nonsense", "unreadable data"),
    ], 4),  # each is a new interpreter; test_forked has all by day
)  # fmt: skip
def test_what_went_wrong_is_named(fault, cause, word):
    with pytest.raises(Unanswered, match=word) as caught:
        call(fault)
    assert caught.value.cause == cause


def test_an_answer_that_is_too_large_is_not_read():
    limits = ProcessLimits(GIB, 20.0, answer_bytes=1 << 20)
    for fault, cause in (("unfolding", "nonsense"), ("two_megabytes", "too much")):
        with pytest.raises(Unanswered) as caught:
            call_alone(f"tests.sandbox.faults:{fault}", {}, returns=(dict,), classes={}, limits=limits)
        assert caught.value.cause == cause


def forks_of(pid: int) -> list[int]:
    """Return the process ids of the forks of every server of a process."""
    return [fork for server in leaders(pid) for fork in leaders(server)]


def test_one_that_hangs_is_killed_when_its_time_is_over():
    with ThreadPoolExecutor(1) as thread:
        hanging = thread.submit(call, "hang", wall_s=3.0 * crowded())
        until(lambda: forks_of(os.getpid()))
        (pid,) = forks_of(os.getpid())
        with pytest.raises(Unanswered, match="did not finish") as caught:
            hanging.result()
    assert caught.value.cause == "hung"
    assert not alive(pid)


def test_its_output_is_watched_and_whoever_raises_there_ends_it():
    pids, seen = [], []

    def watch(said: bytes) -> None:
        seen.append(said)
        pids.extend(forks_of(os.getpid()))
        if b"half" in said:
            raise OSError("enough")

    with pytest.raises(OSError, match="enough"):
        call_alone(
            "tests.sandbox.faults:report_and_hang",
            {},
            returns=(dict,),
            classes={},
            limits=ProcessLimits(GIB, 60.0),
            watch=watch,
        )
    assert seen[-1].endswith(b"half\n") and len(seen[-1]) <= 1000
    assert pids and not any(map(alive, pids))


def test_it_leaves_no_temporary_files_and_no_server(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    call("echo_a_value")
    with pytest.raises(Unanswered):
        call("crash")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process that its parent died")
def test_it_dies_with_its_parent():
    code = "from tests.sandbox.test_alone import call; call('hang')"
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    until(lambda: forks_of(parent.pid), by=[parent])
    (pid,) = forks_of(parent.pid)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not alive(pid))


@pytest.mark.parametrize("wrong", [{"wall_s": 0.0}, {"wall_s": float("nan")}, {"memory_bytes": 0}])
def test_no_time_and_no_memory_are_refused(wrong):
    with pytest.raises(BadInput):
        call("echo_a_value", **wrong)
