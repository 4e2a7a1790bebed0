"""The examples of docs/cli.md run, and print the output on the page.

Digests, ids, secrets and times differ from one run to the next: the page's stand for those of this run in the order
in which they are printed, and a command that names one is given this run's. `...` matches anything.
"""

import doctest
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from skills.cli import app
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from tests.arms import ARMS
from tests.e2e.conftest import running
from tests.formats import trials
from tests.library import cases, rated
from tests.library.test_arm_errors import bag as calibration_bag
from tests.needs import need

PAGE = (Path(__file__).parent.parent / "docs" / "cli.md").read_text()
NAME = re.compile(r"skills_[\w-]+|\b[0-9a-f]{8,64}\b")
MOMENT = re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.]+(?:Z|\+00:00)")
AS_SHOWN, HOW = doctest.OutputChecker(), doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NOT_RUN = {"serve", "worker", "report", "try", "recognise", "arm"}  # without an end, on another page, or of many trials


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Start the real service, and make a folder with the files that the page uploads."""
    need("simulator")
    sample = next(sample for sample in sample_recordings() if sample.surgeon == "wren")
    (tmp_path / "hand-off.mcap").write_bytes(sample.data)
    (tmp_path / "both-arms.mcap").write_bytes(cases.bag("PSM1", "PSM2"))
    trials.folder(tmp_path / "jigsaws")
    rated.folder(tmp_path / "rated")
    (tmp_path / "arms.json").write_text(json.dumps(asdict(ARMS)))
    calibration_bag(tmp_path / "arm.mcap")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "UTC")
    with running(tmp_path) as service:
        monkeypatch.setenv("SKILLS_SERVER", service.url)
        monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{service.database}")
        monkeypatch.delenv("SKILLS_API_KEY", raising=False)
        settings.cache_clear()
        yield
    settings.cache_clear()


def steps(page: str = PAGE) -> Iterator[tuple[str, bool, str]]:
    """Yield each command of a page, whether it fails, and its output."""
    for block in re.findall(r"```console\n(.*?)```", page, re.DOTALL):
        for step in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, _, printed = step.partition("\n")
            command, _, comment = line.partition("  # ")
            yield command, comment == "exits with 1", printed


def lasting(printed: str) -> str:
    """Remove the parts that depend on the time."""
    return MOMENT.sub("MOMENT", NAME.sub("NAME", printed)).strip() + "\n"


@pytest.mark.nightly  # 36 s of processor time; by day tests/test_cli.py runs commands
def test_every_command_of_the_page_runs_and_prints_what_the_page_says(installation: None) -> None:
    now: dict[str, str] = {}
    for command, fails, printed in steps():
        ours = NAME.sub(lambda found, now=now: now.get(found[0], found[0]), command)
        with pytest.MonkeyPatch.context() as here:
            if ours == "skills doctor":  # it checks the machine of the service, not a service elsewhere
                here.delenv("SKILLS_SERVER")
                settings.cache_clear()
            result = CliRunner().invoke(app, shlex.split(ours)[1:], env={"COLUMNS": "160"})
        settings.cache_clear()
        said = result.stdout + result.stderr
        assert (result.exit_code, result.exception) == (1, result.exception) if fails else (0, None), (command, said)
        assert AS_SHOWN.check_output(lasting(printed), lasting(said), HOW), f"{command}\n{said}"
        now |= zip(NAME.findall(printed), NAME.findall(said), strict=False)


def commands() -> Iterator[tuple[str, ...]]:
    """Name every command of the command line."""

    def below(group: object, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        for name, command in getattr(group, "commands", {}).items():
            yield from below(command, (*path, name))
        if not hasattr(group, "commands"):
            yield path

    return below(get_command(app), ())


def test_the_page_has_every_command() -> None:
    shown = [command.split()[1:] for command, _, _ in steps()]
    missing = [path for path in commands() if not any(words[: len(path)] == list(path) for words in shown)]
    assert {path[0] for path in missing} <= NOT_RUN | {"keys"}, missing
    for path in NOT_RUN:
        assert f"`skills {path}" in PAGE
