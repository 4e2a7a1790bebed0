"""The preloaded library of `shim.c`, and the numbers that control it.

A lower layer than the interpreter, so SQLite, Python and every child process see the same disk and the same clock. It
needs a compiler; neither root nor a file system of its own.
"""

import mmap
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from tests.leftovers import shared

NUMBERS = ("write_error", "sync_error", "open_error", "write_us", "sync_us", "clock_ns")
SOURCE = Path(__file__).with_name("shim.c")


def compiler() -> str | None:
    """Return the C compiler, None if there is none."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


@cache
def library() -> Path:
    """Return the compiled library; it is compiled once in a run."""

    def make(folder: Path) -> None:
        command = [str(compiler()), "-shared", "-fPIC", "-O2", "-o", str(folder / "shim.so"), str(SOURCE), "-ldl"]
        subprocess.run(command, check=True)

    return shared("faults", make) / "shim.so"


class Shim:
    """Control of the disk and the clock of every process that was started with `environment`."""

    def __init__(self, folder: Path, control: Path) -> None:
        """Create the control file.

        Args:
            folder: The files that are affected are in it.
            control: A new file outside of that folder.
        """
        control.write_bytes(bytes(64))
        with control.open("r+b") as file:
            self._numbers = mmap.mmap(file.fileno(), 64)
        self.environment = {
            "LD_PRELOAD": str(library()),
            "FAULTS_FOLDER": f"{folder}{os.sep}",
            "FAULTS_CONTROL": str(control),
        }

    def set(self, **numbers: int) -> None:
        """Set some numbers: an error number, a delay in microseconds, or the shift of the clock in nanoseconds."""
        for name, number in numbers.items():
            struct.pack_into("q", self._numbers, 8 * NUMBERS.index(name), number)

    @contextmanager
    def during(self, **numbers: int) -> Iterator[None]:
        """Set some numbers for the duration of the block; they are 0 after it."""
        self.set(**numbers)
        try:
            yield
        finally:
            self.set(**dict.fromkeys(numbers, 0))
