"""Faults of a fork, one per function, to be named to a fork server: from a file to a file, with keywords."""

import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from skills import packing

_ready: list[int] = []


def get_ready() -> None:
    """Record the process in which this was called."""
    _ready.append(os.getpid())


def who_got_ready(given: BinaryIO, answer: BinaryIO) -> None:
    answer.write(json.dumps(_ready).encode())


def echo(given: BinaryIO, answer: BinaryIO, **said: Any) -> None:
    answer.write(given.read()[::-1] + json.dumps(said).encode())


def chatter(given: BinaryIO, answer: BinaryIO) -> None:
    print("of Python", flush=True)
    os.write(1, b"of a C library\n")
    answer.write(b"quiet")


def freed_and_used_again(given: BinaryIO, answer: BinaryIO) -> None:
    """Write how many pages were mapped for arrays of megabytes that others of their size have just left."""
    pages = []
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(10):
            _several = [np.ones(400_000) for _ in range(4)]
        pages.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    answer.write(json.dumps(pages[1]).encode())


def surroundings(given: BinaryIO, answer: BinaryIO) -> None:
    """Write what the fork inherited: the environment, the open files, the threads, the process group."""
    answer.write(
        json.dumps(
            {
                "environment": sorted(os.environ),
                "files": [file for file in range(1000) if _is_open(file)],
                "threads": threading.active_count(),
                "own group": os.getpgrp() == os.getpid(),
            }
        ).encode()
    )


def _is_open(file: int) -> bool:
    try:
        os.fstat(file)
    except OSError:
        return False
    return True


def write_to_what_is_given(given: BinaryIO, answer: BinaryIO) -> None:
    os.write(given.fileno(), b"other bytes")


def hang(given: BinaryIO, answer: BinaryIO) -> None:
    time.sleep(120)


def scatter(given: BinaryIO, answer: BinaryIO, *, stay: bool) -> None:
    """Make temporary files, write their names, and be killed among them or exit."""
    folder = Path(tempfile.mkdtemp())
    (folder / "bag").write_bytes(bytes(1000))
    answer.write(str(folder).encode())
    answer.flush()
    if stay:
        os.kill(os.getpid(), signal.SIGKILL)


def spin(given: BinaryIO, answer: BinaryIO) -> None:
    while True:
        pass


def crash(given: BinaryIO, answer: BinaryIO) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def abort(given: BinaryIO, answer: BinaryIO) -> None:
    os.write(2, b"terminate called after throwing an instance of 'std::bad_alloc'\n")
    os.abort()


def leave(given: BinaryIO, answer: BinaryIO) -> None:
    os._exit(3)


def fail(given: BinaryIO, answer: BinaryIO) -> None:
    raise RuntimeError("the joint that nobody knows")


def eat_memory(given: BinaryIO, answer: BinaryIO) -> None:
    answer.write(bytes(len(np.ones(1 << 30))))


def eat_memory_bit_by_bit(given: BinaryIO, answer: BinaryIO) -> None:
    eaten: list[bytes] = []
    while True:
        eaten.append(b"0" * (1 << 20))


def answer_without_end(given: BinaryIO, answer: BinaryIO) -> None:
    while True:
        answer.write(bytes(1 << 20))


def talk_without_end(given: BinaryIO, answer: BinaryIO) -> None:
    while True:
        os.write(1, bytes(1 << 20))


def open_without_end(given: BinaryIO, answer: BinaryIO) -> None:
    opened = [os.open("/dev/null", os.O_RDONLY) for _ in range(10_000)]
    answer.write(str(len(opened)).encode())


def multiply(given: BinaryIO, answer: BinaryIO) -> None:
    """Fork a child that stays."""
    if os.fork() == 0:
        time.sleep(120)
        os._exit(0)


def call_what_only_an_attack_needs(given: BinaryIO, answer: BinaryIO) -> None:
    ctypes.CDLL(None).ptrace(16, os.getppid(), 0, 0)  # PTRACE_ATTACH


def start_a_program(given: BinaryIO, answer: BinaryIO) -> None:
    answer.write(subprocess.run([sys.executable, "-c", "print('here')"], capture_output=True, check=True).stdout)


# ---- values


def echo_a_value(given: BinaryIO, answer: BinaryIO) -> None:
    print("of Python", flush=True)
    os.write(1, b"of a C library\n")
    packing.write(answer, packing.read(given, {}), {})


def environment(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, {"names": tuple(os.environ)}, {})


def report_and_hang(given: BinaryIO, answer: BinaryIO) -> None:
    print("." * 2000, "half", sep="\n", file=sys.stderr, flush=True)
    hang(given, answer)


# ---- invalid answers


def a_number(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, 3, {})


def two_megabytes(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, {"zeros": bytes(2 << 20)}, {})


def garbage(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    answer.write(b"PK\x03\x04 this is no archive")


def nothing(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    pass


def with_pickles(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    np.savez(answer, tree=np.array([{"a": 1}], dtype=object))


def unfolding(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    np.savez_compressed(answer, tree=np.zeros(1 << 27, np.uint8))  # type: ignore[arg-type]


def _tree(answer: BinaryIO, tree: Any) -> None:
    np.savez(answer, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8))


def another_value(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    label = {"name": "a", "kind": "stage", "start_ns": 0, "end_ns": 1}
    _tree(answer, {"value": "Label", "of": label})


def a_class_that_is_not_named(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    _tree(answer, {"value": "Popen", "of": {"args": "true"}})


def an_empty_recording(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    _tree(answer, {"value": "Recording", "of": {"format": "csv", "integrity": "none", "motions": {"tuple": []}}})


def _refusal(answer: BinaryIO, error: str) -> None:
    _tree(answer, {"value": "Refusal", "of": {"error": error, "message": "Mend it.", "numbers": "{}"}})


def our_mistake(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    _refusal(answer, "Corrupt")


def no_error_at_all(given: BinaryIO, answer: BinaryIO, **how: Any) -> None:
    _refusal(answer, "__loader__")
