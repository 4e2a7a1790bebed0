"""The examples of docs/tables.md and docs/lerobot.md run, and print the output on the pages."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.formats.lerobot.writer import AboutDataset, ExportedEpisode, dataset_files
from skills.settings import settings
from tests.formats import written
from tests.library import cases
from tests.test_cli_page import AS_SHOWN, HOW, NAME, lasting, steps

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "tables.md").read_text()


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make an empty installation, and a folder with the files that the page reads."""
    (tmp_path / "hand-off.csv").write_text(written.positions())
    (tmp_path / "ee_csv.csv").write_text(written.ee_csv())
    (tmp_path / "joints.csv").write_text(written.joints())
    task = "simple running suture"
    episodes = [ExportedEpisode(written.sample(one), task=task, split="train") for one in ("kestrel", "wren")]
    about = AboutDataset("Sutures", arms=("PSM2",), fps=30, licence="CC-BY-4.0", consent="Export, until 2030.")
    for name, file in dataset_files(episodes, about, "v3.0"):
        (tmp_path / "sutures" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sutures" / name).write_bytes(file.read())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{tmp_path}/skills.sqlite")
    monkeypatch.setattr("skills.serving.working", cases.working)
    settings.cache_clear()
    yield
    settings.cache_clear()


@pytest.mark.parametrize(("name", "least"), [("tables", 10), pytest.param("lerobot", 5, marks=pytest.mark.nightly)])
def test_every_command_of_the_page_runs_and_prints_what_it_says(installation: None, name: str, least: int) -> None:
    now: dict[str, str] = {}
    page = (DOCS / f"{name}.md").read_text()
    for command, fails, printed in steps(page):
        ours = NAME.sub(lambda found, now=now: now.get(found[0], found[0]), command)
        result = CliRunner().invoke(app, shlex.split(ours)[1:], env={"COLUMNS": "160"})
        said = result.stdout + result.stderr
        assert (result.exit_code, result.exception) == (1, result.exception) if fails else (0, None), (command, said)
        assert AS_SHOWN.check_output(lasting(printed), lasting(said), HOW), f"{command}\n{said}"
        now |= zip(NAME.findall(printed), NAME.findall(said), strict=False)
    assert len(list(steps(page))) > least


def test_the_page_names_every_quantity_unit_and_limit() -> None:
    from skills.formats.cells import COLUMNS, LINE_CHARACTERS, NS_PER, ROWS
    from skills.formats.tables import ANGLES, QUANTITIES

    for quantity, units in QUANTITIES.items():
        assert any(f"`{quantity}{'_' if unit else ''}{unit}`" in PAGE for unit in units), quantity
    for unit in (*NS_PER, *ANGLES):
        assert f"_{unit}`" in PAGE, unit
    assert f"{COLUMNS} columns, {LINE_CHARACTERS:,} characters a line and {ROWS:,} rows" in PAGE
