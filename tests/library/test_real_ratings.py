"""Calibration on rated trials of JIGSAWS, two of its tasks, as its users would do it.

The data set is for research and no part of this project: `SKILLS_TEST_JIGSAWS` names the folder of an archive, which is
unpacked into the run's temporary folder. The trials have no transcriptions. docs/scoring.md has the figures.
"""

import os
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import func, select
from typer.testing import CliRunner

from skills.cli import app
from skills.db.models import StoredCalibration
from skills.db.session import Database
from skills.library.comparison.calibrations import calibrate_on, read_cohort
from skills.scoring.validation import DURATIONS, RIVALS, refusals
from skills.settings import settings
from tests.needs import need

TASKS = ("Knot_Tying", "Needle_Passing")
PAGE = (Path(__file__).parents[2] / "docs" / "scoring.md").read_text()


@pytest.fixture(scope="module")
def jigsaws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the trials in the layout of the data set."""
    need("jigsaws")
    folder = tmp_path_factory.mktemp("jigsaws")
    tasks = {task.lower(): task for task in TASKS}
    with tarfile.open(Path(os.environ["SKILLS_TEST_JIGSAWS"], "knot_tying_needle_passing.tar.xz")) as archive:
        for member in archive:
            name, home = Path(member.name).name, tasks.get(Path(member.name).parent.name)
            if home is not None:
                to = folder / home / "kinematics" / "AllGestures" / name
            elif name in {f"meta_file_{task}.txt" for task in TASKS}:
                to = folder / name.removeprefix("meta_file_").removesuffix(".txt") / name
            else:
                continue
            to.parent.mkdir(parents=True, exist_ok=True)
            content = archive.extractfile(member)
            assert content is not None
            with to.open("wb") as file:
                shutil.copyfileobj(content, file)
    yield folder
    shutil.rmtree(folder)


ROWS = {"the model": "model", **{label: name for name, label in RIVALS.items()}}


@pytest.mark.nightly  # 8 s; by day `test_calibrations` refuses a synthetic cohort
def test_a_user_is_refused_with_the_figures_and_nothing_is_stored(
    jigsaws: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command that a laboratory runs, on both tasks; so few surgeons cannot show more than the duration does."""
    url = f"sqlite:///{tmp_path / 'skills.sqlite'}"
    monkeypatch.setenv("SKILLS_DATABASE_URL", url)
    settings.cache_clear()
    result = CliRunner().invoke(app, ["calibrate", str(jigsaws), "--permutations", "39"], env={"COLUMNS": "120"})
    settings.cache_clear()
    said = result.stdout + result.stderr
    assert result.exit_code == 1, said
    assert "without a kinematics file" not in said
    assert "Knot_Tying: 36 trials" in said and "Needle_Passing: 28 trials" in said
    assert "Needle_Passing_B005, Needle_Passing_E002" in said
    for part in (
        "shorter trials first",
        "mean of the surgeon's other trials",
        "a repetition left out",
        "The mean of the",
    ):
        assert part in said
    assert "The model is not accepted, and nothing was stored." in said
    assert said.count("no better than the duration alone") == 2 and "There are 8 surgeons" in said
    database = Database(url)
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(StoredCalibration)) == 0
    database.close()


@pytest.mark.nightly
def test_the_figures_of_the_page_are_those_of_the_real_trials(jigsaws: Path) -> None:
    found = calibrate_on(read_cohort(jigsaws))
    judged = found.model_dump()["validated"]
    knots, needles = (judged["tasks"][task] for task in TASKS)
    assert knots["model"]["rho"] >= 0.65  # the goal, stated before; that of the needles was 0.45, and is missed
    assert knots["model"]["rho"] > max(knots["rivals"][name]["rho"] for name in DURATIONS)
    for task, is_by_chance in zip(TASKS, (False, True), strict=True):
        reasons = " ".join(refusals(found.validated.tasks[task]))
        assert "no better than the duration alone" in reasons
        assert ("no better than by chance" in reasons) == is_by_chance
    for label, name in ROWS.items():
        cells = []
        for task in (knots, needles):
            row = task["model"] if name == "model" else task["rivals"][name]
            low, high = row["rho_interval"]
            level = "" if row["accuracy"] is None else f", {100 * row['accuracy']:.0f} %"
            cells.append(f"{row['rho']:.2f} ({low:.2f} to {high:.2f}){level}")
        assert f"| {label} | {cells[0]} | {cells[1]} |" in PAGE, f"| {label} | {cells[0]} | {cells[1]} |"
    for name in ("rho", "rho_p", "accuracy_p"):
        assert f"{knots['chance'][name]:.3f}" in PAGE and f"{needles['chance'][name]:.3f}" in PAGE, name
