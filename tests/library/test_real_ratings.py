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
from skills.library.calibrations import Of, calibrate_on, read_cohort
from skills.scoring.calibration import refusals
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


@pytest.mark.nightly  # 8 s; by day `test_calibrations` refuses a synthetic cohort
@pytest.mark.parametrize(
    ("task", "left_out"),
    [
        ("Knot_Tying", "without a kinematics file: Knot_Tying_G004."),
        ("Needle_Passing", "unrated: Needle_Passing_B005, Needle_Passing_F002"),
    ],
)
def test_a_user_is_refused_with_the_figures_and_nothing_is_stored(
    jigsaws: Path, task: str, left_out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"sqlite:///{tmp_path / 'skills.sqlite'}"
    monkeypatch.setenv("SKILLS_DATABASE_URL", url)
    settings.cache_clear()
    result = CliRunner().invoke(
        app,
        ["calibrate", str(jigsaws), "--task", task, "--of", "trial", "--permutations", "20"],
        env={"COLUMNS": "120"},
    )
    settings.cache_clear()
    said = result.stdout + result.stderr
    assert result.exit_code == 1, said
    assert left_out in said
    assert "shorter trials first" in said and "number of gestures" in said
    assert "The model is not accepted, and nothing was stored." in said
    assert "no better than the duration alone" in said and "try --of trial" not in said
    database = Database(url)
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(StoredCalibration)) == 0
    database.close()


@pytest.mark.nightly  # 12 calibrations
@pytest.mark.parametrize("arm", [None, "PSM_left", "PSM_right"])
@pytest.mark.parametrize("of", ["trial", "hand-off"])
@pytest.mark.parametrize("task", TASKS)
def test_each_segmentation_is_refused_with_the_figures_of_the_page(
    jigsaws: Path, task: str, of: Of, arm: str | None
) -> None:
    judged = calibrate_on(read_cohort(jigsaws, task=task, of=of, arm=arm), permutations=20)["validated"]
    assert refusals(judged)
    ours, rivals = judged["all_figures"], judged["rivals"]
    row = f"| {task}, each {of}, {'both arms' if arm is None else arm} | {ours['rho']:.2f} |"
    assert row in PAGE
    if of == "trial" and arm is None:
        for name in ("trial_duration", "shorter_first", "path_length", "gestures", "mean"):
            assert f"{rivals[name]['rho']:.2f}" in PAGE.split(f"| {task}: ")[1].split("\n")[0], name
