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


def test_every_command_of_the_readme_exists() -> None:
    from typer.testing import CliRunner

    from skills.cli import app

    commands = {tuple(m.split()) for m in re.findall(r"^skills ((?:demo |policy )?[a-z]+)", README, re.MULTILINE)}
    assert ("train",) in commands
    for command in commands:
        assert CliRunner().invoke(app, [*command, "--help"]).exit_code == 0, command


def test_every_page_that_the_readme_links_to_is_there() -> None:
    for page in re.findall(r"\]\(([^)#]+)\)", README):
        assert (Path(__file__).parent.parent / page).exists(), page
