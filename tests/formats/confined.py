"""Readers in forks of the tests' fork server, and what they cost."""

import os
import tempfile
from pathlib import Path
from typing import Any

from skills.demonstration.recording import Recording
from skills.formats.reader_process import ConfinedReader
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import ForkServer

LIMITS = ProcessLimits(
    memory_bytes=1 << 30, wall_s=60.0, cpu_s=30, file_bytes=1 << 30, answer_bytes=256 << 20, threads=False
)


def on(server: ForkServer, limits: ProcessLimits = LIMITS, **how: Any) -> ConfinedReader:
    """Return a reader on a fork server that runs already."""
    made = ConfinedReader(limits, **{"at_once": 1, **how})
    made.server = server
    return made


def read(reader: ConfinedReader, data: bytes, **options: Any) -> Recording:
    """Read a file in a fork."""
    with tempfile.TemporaryFile() as file:
        file.write(data)
        return reader(file, **options)


def cpu_s(reader: ConfinedReader) -> float:
    """Return the processor time of all forks so far."""
    if not reader.server.pid:
        return 0.0
    fields = Path(f"/proc/{reader.server.pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[13:15])) / os.sysconf("SC_CLK_TCK")  # cutime and cstime of proc(5)
