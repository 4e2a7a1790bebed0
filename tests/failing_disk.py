"""A disk whose syncs fail: the kernel answers `fsync` and `fdatasync` of a process with EIO, by a seccomp filter.

    python -m tests.failing_disk -m skills serve    the program whose syncs fail from SIGUSR2 on

A filter needs neither root nor a compiler. A process cannot remove it, and its children inherit it. Kernels other than
Linux on x86-64 number their calls differently.
"""

import ctypes
import errno
import os
import platform
import runpy
import signal
import struct
import sys

FSYNC, FDATASYNC, SECCOMP = 74, 75, 317  # system calls of Linux on x86-64
NO_NEW_PRIVILEGES, FILTER, ALL_THREADS = 38, 1, 1
LOAD, IF_EQUAL, RETURN = 0x20, 0x15, 0x06  # instructions of the packet filter: code, jump if true, if false, constant
FAIL, ALLOW = 0x00050000, 0x7FFF0000
PROGRAM = ((LOAD, 0, 0, 0), (IF_EQUAL, 1, 0, FSYNC), (IF_EQUAL, 0, 1, FDATASYNC), (RETURN, 0, 0, FAIL | errno.EIO),
           (RETURN, 0, 0, ALLOW))  # fmt: skip


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def fail_syncs() -> None:
    """Let every sync of this process fail from now on, in all its threads.

    Raises:
        OSError: The kernel refuses the filter.
    """
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        raise OSError(errno.ENOSYS, "the filter is for Linux on x86-64")
    code = b"".join(struct.pack("HBBI", *instruction) for instruction in PROGRAM)
    program = _Program(len(PROGRAM), code)
    libc = ctypes.CDLL(None, use_errno=True)
    if (
        libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0
        or libc.syscall(SECCOMP, FILTER, ALL_THREADS, ctypes.byref(program)) != 0
    ):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def main() -> None:
    """Run a module like `python -m`; its syncs fail from SIGUSR2 on."""
    signal.signal(signal.SIGUSR2, lambda _signal, _frame: fail_syncs())
    _, _, module, *words = sys.argv
    sys.argv = [module, *words]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
