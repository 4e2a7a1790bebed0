"""The examples of README.md run."""

import re
from pathlib import Path

import pytest

from skills.settings import PREFIX, Settings

README = (Path(__file__).parent.parent / "README.md").read_text()


@pytest.mark.needs("simulator")
def test_the_python_of_the_readme_runs_and_ends_with_a_feasible_playback(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert "suboptimal=0" in printed[0]
    assert "starts_reaching=1331" in printed[0]
    assert printed[-1] == "True"


def test_every_setting_is_in_the_readme_or_in_a_page_that_it_links_to() -> None:
    pages = [page.read_text() for page in (Path(__file__).parent.parent / "docs").glob("*.md")]
    named = set(re.findall(rf"\b{PREFIX}([A-Z_]+)\b", "\n".join([README, *pages])))
    assert {name.upper() for name in Settings.model_fields} - named == set()
