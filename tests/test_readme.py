"""The examples of README.md run."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()


@pytest.mark.needs("simulator")
def test_the_python_of_the_readme_runs_and_ends_with_a_feasible_playback(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert "suboptimal=0" in printed[0]
    assert "starts_reaching=1331" in printed[0]
    assert printed[-1] == "True"
