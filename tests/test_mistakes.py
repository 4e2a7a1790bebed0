"""Mistakes of a new user: each is reported in the words of the command line, as docs/mistakes.md shows."""

import subprocess
import sys
from pathlib import Path

import pytest

from skills.remedies import Door
from tests.mistakes import MISTAKES, PAGE, Mistake, Said, fill, lasting, make, surroundings, words_of
from tests.test_messages import foreign

PLAYED = "a playback without PyBullet"  # with a worker: 3 s of processor time
QUICK = [mistake for number, mistake in enumerate(MISTAKES) if number % 3 == 0 and mistake.what != PLAYED]
OF_SETTINGS = [mistake for mistake in MISTAKES if mistake.env]
SLOW = [mistake for mistake in MISTAKES if mistake not in QUICK]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("mistakes")
    fill(place)
    return place


def told(mistake: Mistake, folder: Path) -> None:
    said = make(mistake, folder)
    assert said.crashed is None, said
    assert said.code == mistake.code, said
    assert len(said.lines) >= 2, "what is wrong, and below it what to do"
    text = "\n".join(said.lines)
    assert "Traceback" not in text and "Error:" not in text
    assert foreign(Door.COMMAND, text) == []
    assert "secret" not in text
    assert said.row(mistake) in PAGE.read_text().splitlines()


def test_there_are_at_least_50_mistakes_and_the_page_has_no_others():
    assert len(MISTAKES) >= 50
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ") and "`" in line]
    assert len(rows) == len(MISTAKES)


def named(mistake: Mistake) -> str:
    return mistake.what.replace(" ", "-")


@pytest.mark.parametrize("mistake", QUICK, ids=named)
def test_a_mistake_is_told_as_the_page_says(mistake: Mistake, folder: Path):
    told(mistake, folder)


@pytest.mark.nightly
@pytest.mark.parametrize("mistake", SLOW, ids=named)
def test_every_other_mistake_is_told_as_the_page_says(mistake: Mistake, folder: Path):
    told(mistake, folder)


@pytest.mark.parametrize(
    "mistake",
    [pytest.param(one, marks=[pytest.mark.nightly] if number else []) for number, one in enumerate(OF_SETTINGS)],
    ids=named,
)
def test_a_mistake_in_the_settings_is_told_by_a_process_of_its_own(mistake: Mistake, folder: Path):
    with surroundings(mistake, folder):
        ended = subprocess.run(
            [sys.executable, "-m", "skills", *words_of(mistake, folder)],
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=120,
            check=False,
        )
    said = Said(lasting(ended.stderr or ended.stdout, folder), ended.returncode, None)
    assert said.row(mistake) in PAGE.read_text().splitlines(), said
