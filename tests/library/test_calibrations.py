"""Calibration on a folder in the layout of JIGSAWS: a cohort of known truth, and invalid folders."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from sqlalchemy.exc import DatabaseError

from skills.db.models import StoredCalibration
from skills.db.session import Database
from skills.errors import BadInput, Corrupt, NotAQuaternion, NotFinite, UnreadableRecording
from skills.library.comparison import calibrations
from skills.schemas.calibrations import Calibration
from skills.scoring.calibration import as_numbers, held_out, rank_correlations
from skills.scoring.validation import refusals, shuffled
from tests.formats.trials import kinematics
from tests.formats.trials import text as as_text
from tests.library import cases, rated
from tests.library.cases import fetch, wrong

META = "meta_file_Suturing.txt"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return eight surgeons with five trials each."""
    return rated.folder(tmp_path_factory.mktemp("rated"))


@pytest.fixture(scope="module")
def read(folder: Path) -> calibrations.Rated:
    return calibrations.read_cohort(folder)


@pytest.fixture(scope="module")
def about(read: calibrations.Rated) -> Calibration:
    return calibrations.calibrate_on(read, permutations=39)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return five surgeons with two trials each."""
    return rated.folder(tmp_path_factory.mktemp("small"), count=5, trials=2)


@pytest.fixture
def copied(small: Path, tmp_path: Path) -> Path:
    """Return a copy of the small folder, to be damaged."""
    return Path(shutil.copytree(small, tmp_path / "copied"))


@pytest.mark.nightly  # by day tests/scoring/test_validation.py
def test_eight_surgeons_are_rated_well_by_a_model_that_has_not_seen_them(
    read: calibrations.Rated, about: Calibration
) -> None:
    judged = asdict(about.validated.tasks["Suturing"])
    print(judged)
    assert read.data.surgeons == 8 and read.data.trials == judged["trials"] == 40
    assert read.data.tasks["Suturing"].levels == {"novice": 15, "intermediate": 10, "expert": 15}
    assert judged["model"]["rho"] > 0.9 and judged["model"]["rho_interval"][0] > 0.6
    assert judged["model"]["accuracy"] > judged["chance"]["commonest"]
    assert judged["over_duration"][0] > 0.1
    assert judged["chance"]["rho"] < 0.2 and judged["chance"]["rho_p"] < 0.1
    assert calibrations.accepted(about) == ["Suturing"]


@pytest.mark.nightly
def test_other_cohorts_are_rated_as_well(tmp_path: Path) -> None:
    """The same surgeons in nine other cohorts are rated equally well, so the result does not depend on one draw."""
    rhos = []
    for seed in range(1, 10):
        drawn = calibrations.read_cohort(rated.folder(tmp_path / str(seed), seed)).cohort
        rhos.append(float(rank_correlations(held_out(drawn).scores[:, 0].T, drawn.ratings[:, 0])[0]))
    print(rhos)
    assert min(rhos) > 0.85


def test_what_is_kept_is_plain_and_names_nobody(read: calibrations.Rated, about: Calibration) -> None:
    written = about.model_dump_json()
    assert "Suturing_" not in written and ".txt" not in written
    assert len(about.data.files) == 41 and all(len(digest) == 64 for digest in about.data.files)
    assert set(about.versions) == {"suture-skills", "scipy", "numpy"}
    assert calibrations.calibrate_on(read, permutations=39) == about  # identical to the last bit


def test_the_newest_is_used_and_an_equal_one_is_not_kept_again(database: Database, about: Calibration) -> None:
    with database.writing() as session:
        assert calibrations.newest(session) is None
        first, new = calibrations.put_calibration(session, about, "test")
        assert new
        assert calibrations.put_calibration(session, about, "test") == (first, False)
        other, new = calibrations.put_calibration(session, about.model_copy(update={"versions": {}}), "test")
        assert new
    with database.writing() as session:
        assert calibrations.newest(session).sha256 == other.sha256
        again, new = calibrations.put_calibration(session, about, "test")  # of older numbers, and in use again
        assert new
        assert calibrations.newest(session).row == again.row
        assert as_numbers(calibrations.read_calibration(again)) == as_numbers(calibrations.read_calibration(first))


def test_a_calibration_cannot_be_changed_and_damage_is_found(database: Database, about: Calibration) -> None:
    cases.committed(database, calibrations.put_calibration, about, "test")
    assert not wrong(database)
    with pytest.raises(DatabaseError, match="append-only"), database.writing() as session:
        session.execute(text("UPDATE calibrations SET sha256 = '0'"))
    with database.writing() as session:
        session.add(StoredCalibration(sha256="0" * 64, about=about))
    with database.reading() as session, pytest.raises(Corrupt, match="calibrate it on rated trials"):
        calibrations.read_calibration(calibrations.newest(session))
    assert wrong(database)


# ---- invalid folders ---------------------------------------------------------------------------------------------


def test_an_empty_folder_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="kinematics/AllGestures"):
        calibrations.read_cohort(tmp_path)


def test_all_tasks_are_read_or_those_that_are_named(copied: Path) -> None:
    rated.folder(copied, task="Knot_Tying", count=5, trials=1)
    both = calibrations.read_cohort(copied)
    assert both.cohort.names == ("Knot_Tying", "Suturing") and both.data.trials == 15
    assert both.data.surgeons == 5  # a letter is one surgeon in both
    assert calibrations.read_cohort(copied, tasks=["Suturing"]).data.trials == 10
    with pytest.raises(BadInput, match="has trials of Knot_Tying, Suturing, not of Sewing"):
        calibrations.read_cohort(copied, tasks=["Suturing", "Sewing"])


def test_two_copies_of_a_trial_are_not_two_trials(small: Path, copied: Path) -> None:
    shutil.copytree(small, copied / "again")
    with pytest.raises(BadInput, match="10 trials more than once, such as Suturing_B001"):
        calibrations.read_cohort(copied)


def test_a_missing_meta_file_is_named(copied: Path) -> None:
    (copied / "Suturing" / META).unlink()
    with pytest.raises(BadInput, match=META):
        calibrations.read_cohort(copied)


def test_names_that_do_not_match_are_named(copied: Path) -> None:
    meta = copied / "Suturing" / META
    meta.write_text(meta.read_text().replace("Suturing_B001", "Suturing_B901"))
    found = calibrations.read_cohort(copied)
    assert found.left_out == {
        "rated, but without a kinematics file": ["Suturing_B901"],
        "unrated": ["Suturing_B001"],
    }
    assert (found.data.trials, found.data.left_out) == (9, 1)
    meta.write_text("")
    with pytest.raises(BadInput, match="10 of 10 trials: Suturing_B001"):
        calibrations.read_cohort(copied)


@pytest.mark.parametrize("score", ["nan", "13.5", "-3", "x"])
def test_a_rating_that_is_no_number_is_refused(copied: Path, score: str) -> None:
    meta = copied / "Suturing" / META
    first, *rest = meta.read_text().splitlines(keepends=True)
    cells = first.split("\t")
    meta.write_text("".join(["\t".join([*cells[:3], score, *cells[4:]]), *rest]))
    with pytest.raises(BadInput, match="whole numbers"):
        calibrations.read_cohort(copied)


def test_a_rating_beyond_thirty_is_refused(copied: Path) -> None:
    meta = copied / "Suturing" / META
    first, *rest = meta.read_text().splitlines(keepends=True)
    cells = first.split("\t")
    meta.write_text("".join(["\t".join([*cells[:3], "310", *cells[4:]]), *rest]))
    with pytest.raises(BadInput, match="rates Suturing_B001 with 310"):
        calibrations.read_cohort(copied)


def test_one_surgeon_is_not_enough(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="Suturing has rated trials of 1 surgeon; at least 4"):
        calibrations.read_cohort(rated.folder(tmp_path / "one", count=1))


@pytest.mark.parametrize(
    ("spoil", "refusal"),
    [
        (lambda table: table.__setitem__((5, 60), np.nan), NotFinite),
        (lambda table: table.__setitem__((slice(None), slice(60, 69)), 2.0), NotAQuaternion),
    ],
)
def test_a_trial_that_is_wrong_is_named(copied: Path, spoil: Any, refusal: type[Exception]) -> None:
    table = kinematics(90)
    spoil(table)
    (copied / "Suturing/kinematics/AllGestures/Suturing_C002.txt").write_bytes(as_text(table))
    with pytest.raises(refusal, match=r"Suturing_C002\.txt"):
        calibrations.read_cohort(copied)


def test_a_trial_that_is_cut_off_is_named(copied: Path) -> None:
    path = copied / "Suturing/kinematics/AllGestures/Suturing_C002.txt"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UnreadableRecording, match=r"Suturing_C002\.txt"):
        calibrations.read_cohort(copied)


def test_an_empty_trial_is_left_out_and_named(copied: Path) -> None:
    (copied / "Suturing/kinematics/AllGestures/Suturing_C002.txt").write_bytes(b"")
    found = calibrations.read_cohort(copied)
    assert found.left_out == {"empty": ["Suturing_C002"]}
    assert (found.data.trials, found.data.left_out) == (9, 1)


# ---- accepted models ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unknowable(read: calibrations.Rated) -> Calibration:
    """Return a model of ratings that were shuffled among the surgeons."""
    order = shuffled(read.cohort, np.random.default_rng(1))
    dealt = replace(read.cohort, ratings=read.cohort.ratings[order], levels=read.cohort.levels[order])
    return calibrations.calibrate_on(calibrations.Rated(dealt, read.data, {}), permutations=39)


def test_a_model_of_what_cannot_be_known_is_refused_and_nothing_is_stored(
    database: Database, unknowable: Calibration
) -> None:
    assert unknowable.validated.mean.model.rho < 0.5
    said = r"not accepted, and nothing was stored\. Suturing: .*p = .*There are 8 surgeons.*about 40 with 5 trials"
    with pytest.raises(BadInput, match=said), database.writing() as session:
        calibrations.put_calibration(session, unknowable, "test")
    assert fetch(database, calibrations.newest) is None


def test_one_rated_task_of_two_is_enough_to_be_kept(
    database: Database, about: Calibration, unknowable: Calibration
) -> None:
    tasks = {"Knot_Tying": unknowable.validated.tasks["Suturing"], **about.validated.tasks}
    both = about.model_copy(update={"validated": replace(about.validated, tasks=tasks)})
    assert refusals(tasks["Knot_Tying"]) and calibrations.accepted(both) == ["Suturing"]
    with database.writing() as session:
        assert calibrations.put_calibration(session, both, "test")[1]


def test_a_calibration_of_another_version_is_whole_and_not_used(database: Database, about: Calibration) -> None:
    other = about.model_copy(update={"version": calibrations.VERSION - 1})
    with database.writing() as session:
        session.add(StoredCalibration(sha256=calibrations.digest_of(other), about=other))
    with database.reading() as session:
        assert calibrations.read_calibration(calibrations.newest(session)) is None
    assert not wrong(database)


def test_a_calibration_of_other_figures_is_not_used(database: Database, about: Calibration) -> None:
    """The figures are told apart by their order, so a model of others would rate anything."""
    other = about.model_copy(update={"model": about.model | {"figures": about.model["figures"][::-1]}})
    with database.writing() as session:
        assert calibrations.read_calibration(calibrations.put_calibration(session, about, "test")[0]) is not None
        assert calibrations.read_calibration(calibrations.put_calibration(session, other, "test")[0]) is None


def test_numbers_that_are_no_model_are_damage(database: Database, about: Calibration) -> None:
    spoilt = about.model_copy(update={"model": about.model | {"margins": []}})
    with database.writing() as session:
        session.add(StoredCalibration(sha256=calibrations.digest_of(spoilt), about=spoilt))
    with database.reading() as session, pytest.raises(Corrupt, match="are no model"):
        calibrations.read_calibration(calibrations.newest(session))
    assert wrong(database)


def test_trials_that_are_too_short_are_left_out_and_named(copied: Path) -> None:
    names = sorted((copied / "Suturing/kinematics/AllGestures").iterdir())
    names[0].write_bytes(as_text(kinematics(60)))
    found = calibrations.read_cohort(copied)
    assert found.left_out == {"too short to be measured": ["Suturing_B001"]}
    assert (found.data.trials, found.data.left_out) == (9, 1)
    for name in names:
        name.write_bytes(as_text(kinematics(60)))
    with pytest.raises(BadInput, match="None of 10 trials can be measured"):
        calibrations.read_cohort(copied)
