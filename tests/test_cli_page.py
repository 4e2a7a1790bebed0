"""What docs/cli.md shows really runs, and prints what the page says.

Digests, ids, secrets and moments differ from one run to the next: the page's stand for those of this run in the order
in which they are printed, and a command on the page that names one is given this run's. `...` is anything.
"""

import doctest
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from skills.cli import app
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from tests.e2e.conftest import running
from tests.library import rated
from tests.recordings import trials

PAGE = (Path(__file__).parent.parent / "docs" / "cli.md").read_text()
BLOCKS = re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
NAME = re.compile(r"skills_[\w-]+|\b[0-9a-f]{8,64}\b")
MOMENT = re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.]+(?:Z|\+00:00)")
AS_SHOWN, HOW = doctest.OutputChecker(), doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NOT_RUN = {"serve", "worker", "report"}  # they do not end, or are another page's


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The real service, and a folder with what the page sends."""
    pytest.importorskip("pybullet", reason="PyBullet has no wheel here: the page's playback cannot run")
    sample = next(sample for sample in sample_recordings() if sample.surgeon == "wren")
    (tmp_path / "hand-off.mcap").write_bytes(sample.data)
    trials.folder(tmp_path / "jigsaws")
    rated.folder(tmp_path / "rated")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "UTC")
    with running(tmp_path) as service:
        monkeypatch.setenv("SKILLS_SERVER", service.url)
        monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{service.database}")
        monkeypatch.delenv("SKILLS_API_KEY", raising=False)
        settings.cache_clear()
        yield
    settings.cache_clear()


def steps() -> Iterator[tuple[str, bool, str]]:
    """Give each command of the page, whether it fails, and what it prints."""
    for block in BLOCKS:
        for step in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, _, printed = step.partition("\n")
            command, _, comment = line.partition("  # ")
            yield command, comment == "exits with 1", printed


def lasting(printed: str) -> str:
    """Leave out what is of the moment."""
    return MOMENT.sub("MOMENT", NAME.sub("NAME", printed)).strip() + "\n"


def test_every_command_of_the_page_runs_and_prints_what_the_page_says(installation: None) -> None:
    now: dict[str, str] = {}
    for command, fails, printed in steps():
        ours = NAME.sub(lambda found, now=now: now.get(found[0], found[0]), command)
        result = CliRunner().invoke(app, shlex.split(ours)[1:], env={"COLUMNS": "160"})
        said = result.stdout + result.stderr
        assert (result.exit_code, result.exception) == (1, result.exception) if fails else (0, None), (command, said)
        assert AS_SHOWN.check_output(lasting(printed), lasting(said), HOW), f"{command}\n{said}"
        now |= zip(NAME.findall(printed), NAME.findall(said), strict=False)


def commands() -> Iterator[tuple[str, ...]]:
    """Name every command there is."""

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
        assert f"`skills {path}`" in PAGE
