"""The filter of system calls, run by a second interpreter for every number, against rules written by hand."""

import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import BadSettings
from skills.sandbox.system_calls import ALLOW, KILL, MACHINES, REFUSE, UNKNOWN, filter_of

PID = 4711
WORDS = st.integers(0, 2**64 - 1) | st.sampled_from([0, 1, 3, 8, 15, PID, 0x10000, 0x5401, 2**32, 2**32 + PID])


def outcome(steps: bytes, audit: int, number: int, arguments: tuple[int, ...] = (0,) * 6) -> int:
    """Run a filter on the data of one call, by the meaning of BPF's instructions."""
    data, at, held = struct.pack("=iIQ6Q", number, audit, 0, *arguments), 0, 0
    program = list(struct.iter_unpack("=HBBI", steps))
    while True:
        code, if_true, if_false, operand = program[at]
        at += 1
        if code == 0x20:
            held = struct.unpack_from("=I", data, operand)[0]
        elif code == 0x06:
            return operand
        else:
            holds = {0x15: held == operand, 0x25: held > operand, 0x45: bool(held & operand)}[code]
            at += if_true if holds else if_false


def of(machine: str, number: int, *arguments: int, threads: bool = False, programs: bool = False) -> int:
    steps = filter_of(threads=threads, programs=programs, pid=PID, machine=machine)
    return outcome(steps, MACHINES[machine].audit, number, (*arguments, *(0,) * 6)[:6])


# From the tables of Linux: read, openat, exit_group; socket, connect, execve, memfd_create; ptrace, mount, unshare.
BY_HAND = {
    "x86_64": ((0, 257, 231), (41, 42, 59, 319, 57, 58), (101, 165, 272), (435, 437, 451, 9999)),
    "aarch64": ((63, 56, 94), (198, 203, 221, 279), (117, 40, 97), (435, 437, 451, 9999)),
}


@pytest.mark.parametrize("machine", MACHINES)
def test_calls_are_allowed_refused_fatal_or_unknown(machine):
    for numbers, expected in zip(BY_HAND[machine], (ALLOW, REFUSE, KILL, UNKNOWN), strict=True):
        assert {of(machine, number) for number in numbers} == {expected}


@pytest.mark.parametrize("machine", MACHINES)
def test_the_calls_of_another_processor_are_fatal(machine):
    steps = filter_of(threads=True, programs=True, pid=PID, machine=machine)
    assert {outcome(steps, audit, 0) for audit in (0x40000003, 0xC0000028, 0)} == {KILL}
    assert outcome(steps, MACHINES["x86_64"].audit, 0x40000000) in (KILL, UNKNOWN)
    assert of("x86_64", 0x40000000) == KILL  # x32: read


@pytest.mark.parametrize(("machine", "kill", "tgkill"), [("x86_64", 62, 234), ("aarch64", 129, 131)])
def test_a_signal_goes_to_itself_only(machine, kill, tgkill):
    for number in (kill, tgkill):
        assert [of(machine, number, pid) for pid in (PID, PID + 1, 1, 0, 2**32 - 1)] == [ALLOW, *[REFUSE] * 4]


CLONE = {"x86_64": 56, "aarch64": 220}


@pytest.mark.parametrize("machine", MACHINES)
def test_threads_and_programs_are_allowed_apart(machine):
    thread, process, space = 0x3D0F00, 0x1200011, 0x10000011
    for threads in (False, True):
        for programs in (False, True):
            allowed = {"threads": threads, "programs": programs}
            assert of(machine, CLONE[machine], thread, **allowed) == (ALLOW if threads else REFUSE)
            assert of(machine, CLONE[machine], process, **allowed) == (ALLOW if programs else REFUSE)
            assert of(machine, CLONE[machine], space, **allowed) == (KILL if threads or programs else REFUSE)


@given(WORDS, WORDS, WORDS)
def test_only_its_own_limits_are_read_and_none_is_set(pid, which, new):
    assert of("x86_64", 302, pid, which, new) == (ALLOW if pid % 2**32 == 0 and new == 0 else REFUSE)


@given(WORDS)
def test_of_fcntl_all_but_what_sends_signals_is_allowed(command):
    expected = REFUSE if command % 2**32 in (8, 10, 15, 1024, 1026) else ALLOW
    assert of("x86_64", 72, 0, command) == of("aarch64", 25, 0, command) == expected


def test_every_number_has_an_answer_and_few_are_allowed():
    for machine in MACHINES:
        answers = [of(machine, number) for number in range(520)]
        assert set(answers) == {ALLOW, REFUSE, KILL, UNKNOWN}
        assert 60 < answers.count(ALLOW) < 140
        assert set(answers[451:]) == {UNKNOWN}


def test_a_processor_without_a_table_is_refused(monkeypatch):
    with pytest.raises(BadSettings, match="riscv64"):
        filter_of(threads=False, programs=False, pid=1, machine="riscv64")
    assert os.uname().machine in MACHINES
