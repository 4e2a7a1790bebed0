"""Small hostile files cost little, in every format: a reader refuses them with a message or is soon stopped."""

import io
import tempfile
from collections.abc import Callable

import pytest

from skills.errors import SkillsError, UnreadableRecording
from skills.formats import read_recording
from skills.formats.reader_process import ConfinedReader
from tests.formats import costly
from tests.formats.confined import cpu_s, read

MOST_CPU_S = 5.0  # for a file below 1 MB


def cost_s(reader: ConfinedReader, data: bytes) -> tuple[float, str]:
    """Read a file; return the processor time in seconds, and the message of its refusal."""
    assert len(data) < 1_000_000
    began = cpu_s(reader)
    try:
        read(reader, data)
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
