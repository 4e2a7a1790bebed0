"""The generated files of the client are those that `python -m tests.generated` writes."""

from pathlib import Path

import pytest

from tests.generated import files


@pytest.mark.parametrize(("path", "text"), files().items(), ids=lambda one: one.stem if isinstance(one, Path) else "")
def test_a_generated_file_is_up_to_date(path: Path, text: str):
    assert path.read_text() == text
