"""The commands of docs/tutorial.md run, and print the transcript on the page; the questions are asked at a terminal.

`python -m tests.test_tutorial` writes the transcript into the page again.
"""

import doctest
import re
import shlex
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from typer.testing import CliRunner, Result

from skills.cli import app
from skills.cli.output import out
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from tests.formats import bags
from tests.library import cases
from tests.needs import need

WIDTH = 110  # of the page
PAGE = Path(__file__).parent.parent / "docs" / "tutorial.md"
MADE = re.compile(r"/\S*skills-try-\w+")
AS_SHOWN, HOW = doctest.OutputChecker(), doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
COMMAND = re.compile(r"^\$ (.*?)(?:  # exits with (\d))?\n((?:(?!\$ |```).*\n)*)", re.MULTILINE)


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Stand in a folder with two bags and nothing else, on an installation that names no database."""
    need("simulator")
    for name in ("SKILLS_SERVER", "SKILLS_DATABASE_URL", "SKILLS_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("skills.serving.working", cases.working)
    monkeypatch.setattr("skills.library.plans.playbacks.request_pictures", lambda *_: None)  # nobody looks at the film
    monkeypatch.setattr(out, "width", WIDTH)
    place(tmp_path)
    monkeypatch.chdir(tmp_path)
    settings.cache_clear()
    yield
    settings.cache_clear()
    assert not (tmp_path / "data").exists()


def place(folder: Path) -> None:
    samples = sample_recordings()
    (folder / "hand-off.mcap").write_bytes(next(one for one in samples if one.surgeon == "wren").data)
    (folder / "five-hand-offs.mcap").write_bytes(next(one for one in samples if len(one.segments) > 1).data)


def run(command: str, typed: str | None = None) -> Result:
    return CliRunner().invoke(app, shlex.split(command)[1:], input=typed)


def lasting(printed: str) -> str:
    return MADE.sub("<temporary folder>", printed)


def test_every_command_of_the_tutorial_prints_its_transcript(bare: None) -> None:
    shown = COMMAND.findall(PAGE.read_text())
    assert len(shown) == 6
    for command, code, printed in shown:
        result = run(command)
        assert result.exit_code == int(code or 0), result.output
        assert AS_SHOWN.check_output(lasting(printed), lasting(result.stdout), HOW), f"{command}\n{result.stdout}"
        for made in MADE.findall(result.stdout):
            assert not Path(made.rstrip(",")).exists()


@pytest.mark.nightly  # 3 s of processor time
def test_a_user_at_a_terminal_is_asked_what_is_open(bare: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skills.cli.tries.on_terminal", lambda: True)
    result = run("skills try five-hand-offs.mcap --folder kept --suture simple-interrupted", "2\n-165\n1\ny\n")
    assert result.exit_code == 0, result.output
    assert "Taken: proposal 2 of 5" in result.stdout and "Version 1 is served now." in result.stdout
    assert result.stdout.count("A recording of") == 1  # a step is printed once, though the request is sent three times
    assert "--errors" not in result.stdout  # choices are numbers there, not commands
    assert Path("kept/skills.sqlite").is_file()
    assert run("skills try five-hand-offs.mcap --folder kept --segment 9").exit_code == 1
    refused = run("skills try five-hand-offs.mcap --folder kept --tissue-mm high")
    assert (refused.exit_code, "neither a height in mm nor none" in refused.output) == (1, True)


def test_the_samples_are_the_bags_of_the_page(bare: None) -> None:
    assert run("skills seed --files samples").exit_code == 0
    for name, sample in (("hand-off", "wren-simple-running"), ("five-hand-offs", "kestrel-five-hand-offs")):
        assert f"`{name}.mcap` is `samples/{sample}.mcap`" in PAGE.read_text()
        assert Path(f"samples/{sample}.mcap").read_bytes() == Path(f"{name}.mcap").read_bytes()
    refused = run("skills seed --files hand-off.mcap")
    assert refused.exit_code != 0 and "is a file" in refused.output


def test_the_command_of_a_choice_keeps_what_was_typed(bare: None) -> None:
    given = "--surgeon lark --folder 'my folder' --cell-mm 4 --column x=a --column y=b"
    result = run(f"skills try five-hand-offs.mcap {given} --json")
    assert result.exit_code == 1 and "column" in result.output  # an MCAP file takes no columns
    precise = "--cell-mm 4 --loss-mm 2.1234567"
    result = run(f"skills try five-hand-offs.mcap --surgeon lark --folder 'my folder' {precise} --no-release")
    assert result.exit_code == 3
    said = "skills try five-hand-offs.mcap --loss-mm=2.1234567 --cell-mm=4 --no-release "
    assert f"{said}--surgeon=lark '--folder=my folder' --segment=2\n" in result.stdout, result.stdout


def test_a_try_that_ends_without_a_refused_step_says_why(bare: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr("skills.library.plans.tries._learn", broken)
    result = run("skills try hand-off.mcap")
    assert result.exit_code == 1 and "A recording of" in result.stdout
    assert "The try failed: " in result.stderr, result.output


@pytest.mark.nightly
def test_the_real_sample_bag_comes_to_a_verdict(bare: None) -> None:
    bag = bags.sample_folder() / "rosbag2"
    result = run(f"skills try {shlex.quote(str(bag))} --tissue-mm=-190 --errors calibrated --release")
    assert result.exit_code == 0, result.output
    assert "4 mm cells with hysteresis 0.25" in result.stdout and "feasible in an exact simulation" in result.stdout


def write_transcript() -> None:
    """Write what the commands print now into the page."""
    out.width = WIDTH
    with TemporaryDirectory() as made, chdir(made):
        place(Path(made))

        def again(found: re.Match[str]) -> str:
            first = found[0].partition("\n")[0]
            lines = lasting(run(found[1]).stdout).splitlines()
            return "\n".join([first, *(line.rstrip() for line in lines), ""])

        page = COMMAND.sub(again, PAGE.read_text())
    PAGE.write_text(page)


if __name__ == "__main__":
    write_transcript()
