"""The table of docs/recordings.md is the one that the command prints."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.client import NotReached
from skills.settings import settings
from tests.formats.gathered import gather_others, gather_samples

DOCS = Path(__file__).parent.parent / "docs"
SHOWN = [line for line in (DOCS / "recordings.md").read_text().splitlines() if line.count(" | ") == 6]


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("SKILLS_SERVER", raising=False)
    monkeypatch.setenv("SKILLS_DATABASE_URL", f"sqlite:///{tmp_path}/skills.sqlite")
    settings.cache_clear()
    yield
    settings.cache_clear()


def table(folder: Path, *options: str) -> list[str]:
    """Return the lines that the command prints."""
    result = CliRunner().invoke(app, ["recording", "table", str(folder), *options])
    assert result.exception is None, result.output
    return result.stdout.splitlines()


def test_the_samples_are_understood_as_the_page_shows(installation: None, tmp_path: Path) -> None:
    gather_samples(tmp_path / "all")
    shown = [line for line in SHOWN if not line.startswith(("| jigsaws/", "| paper/", "| recordings/"))]
    assert table(tmp_path / "all", "--stated", str(DOCS / "recordings.toml")) == shown
    assert len(shown) > 10


@pytest.mark.nightly  # 10 s; by day the samples
@pytest.mark.needs("recordings")
@pytest.mark.needs("paper")
@pytest.mark.needs("jigsaws")
def test_the_real_recordings_are_understood_as_the_page_shows(installation: None, tmp_path: Path) -> None:
    gather_others(tmp_path / "all")
    shown = [line for line in SHOWN if not line.startswith("| samples/")]
    assert table(tmp_path / "all", "--stated", str(DOCS / "recordings.toml")) == shown
    assert len(shown) > 10


def test_damaged_recordings_are_rows_and_stop_no_other(installation: None, tmp_path: Path) -> None:
    folder = tmp_path / "all"
    (folder / "deep").mkdir(parents=True)
    (folder / "a.csv").write_text("t_s,x_mm,y_mm,z_mm|\n")
    (folder / "deep" / "b.csv").write_text("t_s,x_mm,y_mm,z_mm\n0,0,50,-120\n0.1,1,50,-120")
    (folder / "c.zip").write_bytes(b"PK\x03\x04" + bytes(50))
    (folder / "notes.md").write_text("no recording")
    a, c, b = table(folder)[2:]
    assert a == "| a.csv |  |  | csv |  |  | The table has the unknown column 'z_mm\\|'. |"
    assert c.startswith("| c.zip |  |  | zip |  |  | ")
    assert "PSM in PSM_base at 10.0 Hz; last row: It has no line end" in b


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("[[", "is not TOML"),
        ('["*"]\nhz = 3', "can be stated"),
        ('["*"]\nrate_hz = -1', "greater than 0"),
        ("a = 3", "valid dictionary"),
    ],
)
def test_statements_that_cannot_be_used_are_refused(installation: None, tmp_path: Path, said: str, why: str) -> None:
    stated = tmp_path / "stated.toml"
    stated.write_text(said)
    result = CliRunner().invoke(app, ["recording", "table", str(tmp_path), "--stated", str(stated)])
    assert result.exit_code == 1
    assert why in result.stderr


def test_an_outage_is_no_refusal_of_a_recording(installation: None, tmp_path: Path, monkeypatch) -> None:
    gather_samples(tmp_path / "all")

    def away(*_: object, **__: object) -> None:
        raise NotReached("The service sent no response.")

    monkeypatch.setattr("skills.cli.recordings._preview", away)
    result = CliRunner().invoke(app, ["recording", "table", str(tmp_path / "all")])
    assert (result.exit_code, result.stdout) == (1, "")
    assert "The service sent no response." in result.stderr
