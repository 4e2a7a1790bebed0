"""Small hostile files cost little, in every format: a reader refuses them with a message or is soon stopped."""

import io
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from skills.errors import SkillsError, UnreadableRecording
from skills.formats import read_recording
from skills.formats.reader_process import ConfinedReader
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import ForkServer
from tests.formats import costly

MOST_CPU_S = 5.0  # for a file below 1 MB
LIMITS = ProcessLimits(
    memory_bytes=1 << 30, wall_s=60.0, cpu_s=30, file_bytes=1 << 30, answer_bytes=256 << 20, threads=False
)


@pytest.fixture(scope="module")
def reader(reading_server: ForkServer) -> ConfinedReader:
    reader = ConfinedReader(LIMITS, at_once=1)
    reader.server = reading_server
    reader.server.start()
    return reader


def cpu_s(reader: ConfinedReader) -> float:
    """Return the processor time of all forks so far."""
    fields = Path(f"/proc/{reader.server.pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[13:15])) / os.sysconf("SC_CLK_TCK")  # cutime and cstime of proc(5)


def cost_s(reader: ConfinedReader, data: bytes) -> tuple[float, str]:
    """Read a file; return the processor time in seconds, and the message of its refusal."""
    assert len(data) < 1_000_000
    began = cpu_s(reader) if reader.server.pid else 0.0
    with tempfile.TemporaryFile() as file:
        file.write(data)
        try:
            reader(file)
            said = ""
        except SkillsError as refused:
            said = str(refused)
    return cpu_s(reader) - began, said


FOREIGN = costly.foreign_databases()


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_database_with_anything_that_rosbag2_does_not_write_is_refused(kind):
    with pytest.raises(UnreadableRecording, match=f"has a {kind}.*rosbag2 does not write") as caught:
        read_recording(io.BytesIO(FOREIGN[kind]))
    assert str(caught.value.numbers["kind"]).startswith(kind)


@pytest.mark.parametrize(
    "files", [costly.costly_databases, costly.costly_tables, costly.costly_recordings], ids=lambda f: f.__name__
)
def test_a_small_file_that_is_laborious_to_read_is_refused_at_once(
    reader: ConfinedReader, files: Callable[[], dict[str, bytes]]
):
    for name, data in files().items():
        took, said = cost_s(reader, data)
        assert took < 2.0, name
        assert said, name
        assert "processor time" not in said, name  # it was analysed, and not stopped


def test_what_is_told_of_a_small_file_is_found_out_soon_or_not_at_all(reader: ConfinedReader):
    for name, data in costly.costly_to_tell().items():
        with tempfile.TemporaryFile() as file:
            assert len(data) < 1_000_000, name
            file.write(data)
            began = cpu_s(reader)
            try:
                said = reader.parse(file).about_json
            except UnreadableRecording as cut:  # on a busy machine
                said = str(cut)
        assert '"counts": {"segments": ' in said or "used up its 4 s of processor time" in said, name
        assert cpu_s(reader) - began < MOST_CPU_S, name


@pytest.mark.nightly
@pytest.mark.parametrize("files", [costly.costly_definitions, costly.costly_archives], ids=lambda f: f.__name__)
def test_whatever_else_is_laborious_is_cut_soon(reader: ConfinedReader, files: Callable[[], dict[str, bytes]]):
    for name, data in files().items():
        assert cost_s(reader, data)[0] < MOST_CPU_S, name
