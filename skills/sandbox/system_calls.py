"""The system calls that a contained process may use, as a filter that the kernel applies (seccomp).

The filter is a list of allowed calls; of some only with certain arguments. A call that is not in it fails with EPERM,
and one that only an attack needs ends the process with SIGSYS. What is newer than these tables fails with ENOSYS, so
that the C library uses the older call instead. Numbers are those of Linux's tables for x86_64 and aarch64 (`-`: none).

A filter is a program of classic BPF over the number of the call and its arguments. It is the same for every call of a
process and can neither be changed nor removed, also not in a program that the process starts.
"""

import errno
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from skills.errors import BadSettings

# ---- tables: name, number on x86_64, number on aarch64 -----------------------------------------------------------

_ALLOWED = """
    read 0 63, write 1 64, pread64 17 67, pwrite64 18 68, readv 19 65, writev 20 66, preadv 295 69, pwritev 296 70,
    lseek 8 62, close 3 57, close_range 436 436, fstat 5 80, newfstatat 262 79, stat 4 -, lstat 6 -, statx 332 291,
    access 21 -, faccessat 269 48, faccessat2 439 439, readlink 89 -, readlinkat 267 78, open 2 -, openat 257 56,
    getdents64 217 61, getcwd 79 17, dup 32 23, dup2 33 -, dup3 292 24, pipe 22 -, pipe2 293 59, ftruncate 77 46,
    truncate 76 45, fsync 74 82, fdatasync 75 83, fallocate 285 47, fadvise64 221 223, sendfile 40 71,
    copy_file_range 326 285, mkdir 83 -, mkdirat 258 34, rmdir 84 -, unlink 87 -, unlinkat 263 35, rename 82 -,
    renameat 264 38, renameat2 316 276, chmod 90 -, fchmod 91 52, fchmodat 268 53, umask 95 166, utimensat 280 88,
    flock 73 32, statfs 137 43, fstatfs 138 44, select 23 -, pselect6 270 72, poll 7 -, ppoll 271 73,
    epoll_create1 291 20, epoll_ctl 233 21, epoll_wait 232 -, epoll_pwait 281 22, eventfd2 290 19,
    mmap 9 222, munmap 11 215, mprotect 10 226, mremap 25 216, madvise 28 233, brk 12 214, membarrier 324 283,
    futex 202 98, set_robust_list 273 99, rseq 334 293, set_tid_address 218 96, sched_yield 24 124,
    clock_gettime 228 113, clock_getres 229 114, clock_nanosleep 230 115, nanosleep 35 101, gettimeofday 96 169,
    time 201 -, times 100 153, setitimer 38 103, alarm 37 -, rt_sigaction 13 134, rt_sigprocmask 14 135,
    rt_sigreturn 15 139, rt_sigpending 127 136, rt_sigtimedwait 128 137, rt_sigsuspend 130 133, sigaltstack 131 132,
    restart_syscall 219 128, pause 34 -, gettid 186 178, getpid 39 172, getppid 110 173, getuid 102 174,
    geteuid 107 175, getgid 104 176, getegid 108 177, getgroups 115 158, getresuid 118 148, getresgid 120 150,
    getpgrp 111 -, getrandom 318 278, uname 63 160, sysinfo 99 179, getrusage 98 165, getrlimit 97 163,
    getcpu 309 168, arch_prctl 158 -, exit 60 93, exit_group 231 94
"""
_TO_START_A_PROGRAM = "fork 57 -, vfork 58 -, execve 59 221, wait4 61 260, waitid 247 95"
_CHECKED = """
    fcntl 72 25, ioctl 16 29, prctl 157 167, prlimit64 302 261, getpriority 140 141, setpriority 141 140,
    sched_getaffinity 204 123, kill 62 129, tgkill 234 131, clone 56 220
"""
_FATAL = """
    ptrace 101 117, process_vm_readv 310 270, process_vm_writev 311 271, process_madvise 440 440, kcmp 312 272,
    pidfd_getfd 438 438, mount 165 40, umount2 166 39, pivot_root 155 41, chroot 161 51, fsopen 430 430,
    fsmount 432 432, fsconfig 431 431, fspick 433 433, open_tree 428 428, move_mount 429 429, mount_setattr 442 442,
    unshare 272 97, setns 308 268, init_module 175 105, finit_module 313 273, delete_module 176 106,
    kexec_load 246 104, kexec_file_load 320 294, bpf 321 280, perf_event_open 298 241, userfaultfd 323 282,
    add_key 248 217, request_key 249 218, keyctl 250 219, open_by_handle_at 304 265, swapon 167 224, swapoff 168 225,
    reboot 169 142, iopl 172 -, ioperm 173 -, acct 163 89, settimeofday 164 170, clock_settime 227 112,
    clock_adjtime 305 266, adjtimex 159 171
"""
_FOR_NEWER_LIBRARIES = "clone3 435 435, openat2 437 437"  # their arguments are in memory, where no filter sees them
_NEWEST = 450


@dataclass(frozen=True)
class Machine:
    """A kind of processor: its own number, the column of its calls' numbers, and a bit that none of these has."""

    audit: int
    column: int
    foreign: int


MACHINES = {"x86_64": Machine(0xC000003E, 1, 0x40000000), "aarch64": Machine(0xC00000B7, 2, 0x80000000)}

# ---- arguments ---------------------------------------------------------------------------------------------------

_TO_ANOTHER = (8, 10, 15, 1024, 1026)  # F_SETOWN, F_SETSIG, F_SETOWN_EX, F_SETLEASE, F_NOTIFY: they end in signals
_ABOUT_A_FILE = (0x5401, 0x5413, 0x541B, 0x5450, 0x5451)  # TCGETS, TIOCGWINSZ, FIONREAD, FIONCLEX, FIOCLEX
# PR_GET_DUMPABLE, PR_SET_NAME, PR_GET_NAME, PR_GET_SECCOMP, PR_GET_NO_NEW_PRIVS, PR_SET_VMA (names of its memory)
_NAMES_AND_STATE = (3, 15, 16, 21, 39, 0x53564D41)
_THREAD, _NAMESPACES = 0x00010000, 0x7E020080  # CLONE_THREAD; every CLONE_NEW*

# ---- classic BPF -------------------------------------------------------------------------------------------------

_LOAD, _EQUAL, _GREATER, _ANY_BIT, _RETURN = 0x20, 0x15, 0x25, 0x45, 0x06
_NUMBER, _AUDIT = 0, 4  # offsets in struct seccomp_data; the arguments follow from 16 on, 8 bytes each
ALLOW, KILL = 0x7FFF0000, 0x80000000
REFUSE, UNKNOWN = 0x00050000 | errno.EPERM, 0x00050000 | errno.ENOSYS
Step = tuple[int, int, int, int]  # code, steps to skip if true, if false, operand


def filter_of(*, threads: bool, programs: bool, pid: int, machine: str | None = None) -> bytes:
    """Return the filter of a process as an array of `struct sock_filter`.

    Args:
        threads: Whether it may start threads.
        programs: Whether it may start processes; which program they may run is for the file system to decide.
        pid: Its process id: signals may go to itself only.
        machine: The processor, by its key in `MACHINES`; by default this one.

    Raises:
        BadSettings: There is no table for this processor.
    """
    kind = MACHINES.get(machine or os.uname().machine)
    if kind is None:
        raise BadSettings(f"No system calls are listed for the processor {machine or os.uname().machine}.")
    steps: list[Step] = [(_LOAD, 0, 0, _AUDIT), (_EQUAL, 1, 0, kind.audit), (_RETURN, 0, 0, KILL)]
    # One kernel understands the calls of two processors; the other one's numbers would mean other calls here.
    steps += [(_LOAD, 0, 0, _NUMBER), (_ANY_BIT, 0, 1, kind.foreign), (_RETURN, 0, 0, KILL)]
    for table, answer in ((_ALLOWED, ALLOW), (_FATAL, KILL), (_FOR_NEWER_LIBRARIES, UNKNOWN)):
        for _, number in _numbers(table, kind):
            steps += _case(number, [(_RETURN, 0, 0, answer)])
    if programs:
        for _, number in _numbers(_TO_START_A_PROGRAM, kind):
            steps += _case(number, [(_RETURN, 0, 0, ALLOW)])
    rules = _rules(threads, programs, pid)
    for name, number in _numbers(_CHECKED, kind):
        steps += _case(number, rules[name])
    steps += [(_GREATER, 0, 1, _NEWEST), (_RETURN, 0, 0, UNKNOWN), (_RETURN, 0, 0, REFUSE)]
    return b"".join(struct.pack("=HBBI", *step) for step in steps)


def _numbers(table: str, machine: Machine) -> Iterator[tuple[str, int]]:
    """Yield the names and numbers of a table's calls on a processor."""
    for entry in table.split(","):
        fields = entry.split()
        if fields[machine.column] != "-":
            yield fields[0], int(fields[machine.column])


def _case(number: int, then: list[Step]) -> list[Step]:
    """Return the steps that are taken for one call only."""
    return [(_EQUAL, 0, len(then), number), *then]


def _rules(threads: bool, programs: bool, pid: int) -> dict[str, list[Step]]:
    """Return the steps for each call whose arguments matter; each ends with an answer."""
    nothing: list[Step] = [(_RETURN, 0, 0, REFUSE)]
    return {
        "fcntl": _unless(_one_of(1, _TO_ANOTHER)),
        "ioctl": _if(_one_of(1, _ABOUT_A_FILE)),
        "prctl": _if(_one_of(0, _NAMES_AND_STATE)),
        "prlimit64": _if(_is(0, 0), _is(2, 0), _is(2, 0, high=True)),  # its own, to read
        "getpriority": _if(_is(0, 0), _is(1, 0)),
        "setpriority": _if(_is(0, 0), _is(1, 0)),
        "sched_getaffinity": _if(_one_of(0, (0, pid))),
        "kill": _if(_is(0, pid)),
        "tgkill": _if(_is(0, pid)),
        "clone": _clone(threads, programs) if threads or programs else nothing,
    }


def _argument(place: int, *, high: bool = False) -> Step:
    return (_LOAD, 0, 0, 16 + 8 * place + 4 * high)  # the low half comes first on both processors


def _is(place: int, value: int, *, high: bool = False) -> list[Step]:
    return _one_of(place, (value,), high=high)


def _one_of(place: int, values: tuple[int, ...], *, high: bool = False) -> list[Step]:
    """Return steps that go on behind the next one if an argument has one of the values, and with it otherwise."""
    return [_argument(place, high=high), *((_EQUAL, len(values) - k, 0, one) for k, one in enumerate(values))]


def _if(*conditions: list[Step]) -> list[Step]:
    """Return steps that allow a call if all conditions hold, and refuse it otherwise."""
    return [step for one in conditions for step in (*one, (_RETURN, 0, 0, REFUSE))] + [(_RETURN, 0, 0, ALLOW)]


def _unless(condition: list[Step]) -> list[Step]:
    """Return steps that refuse a call if a condition holds, and allow it otherwise."""
    return [*condition, (_RETURN, 0, 0, ALLOW), (_RETURN, 0, 0, REFUSE)]


def _clone(threads: bool, programs: bool) -> list[Step]:
    """Return the steps for `clone`: never into another namespace; a thread, a process, or either."""
    steps: list[Step] = [_argument(0), (_ANY_BIT, 0, 1, _NAMESPACES), (_RETURN, 0, 0, KILL)]
    of_thread, of_process = (ALLOW if allowed else REFUSE for allowed in (threads, programs))
    return [*steps, (_ANY_BIT, 0, 1, _THREAD), (_RETURN, 0, 0, of_thread), (_RETURN, 0, 0, of_process)]
