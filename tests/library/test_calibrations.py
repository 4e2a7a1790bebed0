"""Calibration on a folder in the layout of JIGSAWS: a cohort of known truth, and invalid folders."""

import copy
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from sqlalchemy.exc import DatabaseError

from skills.db.models import StoredCalibration
from skills.db.session import Database
from skills.errors import BadInput, Corrupt, NotAQuaternion, NotFinite, UnreadableRecording
from skills.library.calibrations import Rated, calibrate_on, keep, newest, read_calibration, read_cohort
from skills.library.inspection import inspect_installation
from skills.scoring.calibration import as_numbers, held_out, level_refusals, refusals, shuffled, spearman
from tests.formats.trials import kinematics
from tests.formats.trials import text as as_text
from tests.library import rated

META = "meta_file_Suturing.txt"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return eight surgeons with five trials each."""
    return rated.folder(tmp_path_factory.mktemp("rated"))


@pytest.fixture(scope="module")
def read(folder: Path) -> Rated:
    return read_cohort(folder)


@pytest.fixture(scope="module")
def about(read: Rated) -> dict[str, Any]:
    return calibrate_on(read, permutations=20)


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    """Return a copy of the folder, to be damaged."""
    return Path(shutil.copytree(folder, tmp_path / "copied"))


def test_eight_surgeons_are_rated_well_by_a_model_that_has_not_seen_them(read: Rated, about: dict[str, Any]) -> None:
    best, duration, chance = (about["validated"][name] for name in ("all_figures", "duration_only", "chance"))
    print(best, duration, chance, sep="\n")
    assert read.data["surgeons"] == 8 and read.data["trials"] == read.data["motions"] == 40
    assert read.data["levels"] == {"novice": 15, "intermediate": 10, "expert": 15}
    assert best["rho"] > 0.9 and best["rho_interval"][0] > 0.6
    assert best["accuracy_interval"][0] > chance["commonest"]
    assert best["rho"] > duration["rho"] + 0.1
    assert chance["rho"] < 0.2 and chance["rho_p"] < 0.1


def fallen(read: Rated, seeds: range) -> None:
    rhos, rights = [], []
    for seed in seeds:
        dealt = shuffled(read.cohort, np.random.default_rng(seed))
        found = held_out(dealt)
        rhos.append(spearman(found.ratings, dealt.ratings))
        rights.append(float((found.levels == dealt.levels).mean()))
    print(f"{len(seeds)} shuffles: rho {np.mean(rhos):.2f}, right {np.mean(rights):.2f}")
    assert np.mean(rhos) < 0.1
    assert np.mean(rights) < 0.45


def test_with_labels_shuffled_it_falls_to_chance(read: Rated) -> None:
    fallen(read, range(10))


@pytest.mark.nightly
def test_with_labels_shuffled_many_times(read: Rated) -> None:
    fallen(read, range(300))


@pytest.mark.nightly
def test_other_cohorts_are_rated_as_well(tmp_path: Path) -> None:
    """The same surgeons in nine other cohorts are rated equally well, so the result does not depend on one draw."""
    rhos = []
    for seed in range(1, 10):
        drawn = read_cohort(rated.folder(tmp_path / str(seed), seed)).cohort
        rhos.append(spearman(held_out(drawn).ratings, drawn.ratings))
    print(rhos)
    assert min(rhos) > 0.85


def test_whole_trials_can_be_rated_instead(folder: Path) -> None:
    whole = read_cohort(folder, of="trial", arm="PSM_right")
    assert whole.data["of"] == "trial" and whole.data["motions"] == 40
    hand_off = read_cohort(folder, arm="PSM_right")
    assert (whole.cohort.values[:, 0] > hand_off.cohort.values[:, 0] + 1.0).all()  # with its rests


def test_what_is_kept_is_plain_and_names_nobody(read: Rated, about: dict[str, Any]) -> None:
    written = json.dumps(about)
    assert "Suturing_" not in written and ".txt" not in written
    assert len(about["data"]["files"]) == 81 and all(len(digest) == 64 for digest in about["data"]["files"])
    assert set(about["versions"]) == {"suture-skills", "scikit-learn", "scipy", "numpy"}
    assert calibrate_on(read, permutations=20) == about  # identical to the last bit


def test_the_newest_is_used_and_an_equal_one_is_not_kept_again(database: Database, about: dict[str, Any]) -> None:
    with database.writing() as session:
        assert newest(session) is None
        first, new = keep(session, about, "test")
        assert new
        assert keep(session, about, "test") == (first, False)
        other, new = keep(session, about | {"settings": {}}, "test")
        assert new
    with database.writing() as session:
        assert newest(session).sha256 == other.sha256
        again, new = keep(session, about, "test")  # of older numbers, and in use again
        assert new
        assert newest(session).row == again.row
        assert as_numbers(read_calibration(again)) == as_numbers(read_calibration(first))


def test_a_calibration_cannot_be_changed_and_damage_is_found(database: Database, about: dict[str, Any]) -> None:
    with database.writing() as session:
        keep(session, about, "test")
    assert not wrong(database)
    with pytest.raises(DatabaseError, match="append-only"), database.writing() as session:
        session.execute(text("UPDATE calibrations SET sha256 = '0'"))
    with database.writing() as session:
        session.add(StoredCalibration(sha256="0" * 64, about=about))
    with database.reading() as session, pytest.raises(Corrupt, match="calibrate it on rated trials"):
        read_calibration(newest(session))
    assert wrong(database)


def wrong(database: Database) -> list[tuple[str, str]]:
    parts = {part.what: part for part in inspect_installation(database)}
    return [one for part in parts.values() for one in part.wrong]


# ---- invalid folders ---------------------------------------------------------------------------------------------


def test_an_empty_folder_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="kinematics/AllGestures"):
        read_cohort(tmp_path)


def test_of_several_tasks_one_is_named(copied: Path) -> None:
    rated.folder(copied, task="Knot_Tying", trials=1)
    with pytest.raises(BadInput, match="Knot_Tying, Suturing; name one of them with --task"):
        read_cohort(copied)
    assert read_cohort(copied, task="Suturing").data["trials"] == 40
    with pytest.raises(BadInput, match="has trials of Knot_Tying, Suturing, not of Sewing"):
        read_cohort(copied, task="Sewing")


def test_two_copies_of_a_trial_are_not_two_trials(folder: Path, copied: Path) -> None:
    shutil.copytree(folder, copied / "again")
    with pytest.raises(BadInput, match="40 trials more than once, such as Suturing_B001"):
        read_cohort(copied)


def test_a_missing_meta_file_is_named(copied: Path) -> None:
    (copied / "Suturing" / META).unlink()
    with pytest.raises(BadInput, match=META):
        read_cohort(copied)


def test_names_that_do_not_match_are_named(copied: Path) -> None:
    meta = copied / "Suturing" / META
    meta.write_text(meta.read_text().replace("Suturing_B001", "Suturing_B901"))
    found = read_cohort(copied)
    assert found.left_out == {
        "rated, but without a kinematics file": ["Suturing_B901"],
        "unrated": ["Suturing_B001"],
    }
    assert (found.data["trials"], found.data["left_out"]) == (39, 1)
    meta.write_text("")
    with pytest.raises(BadInput, match="40 of 40 trials: Suturing_B001"):
        read_cohort(copied)


@pytest.mark.parametrize("score", ["nan", "13.5", "-3", "x"])
def test_a_rating_that_is_no_number_is_refused(copied: Path, score: str) -> None:
    meta = copied / "Suturing" / META
    first, *rest = meta.read_text().splitlines(keepends=True)
    cells = first.split("\t")
    meta.write_text("".join(["\t".join([*cells[:3], score, *cells[4:]]), *rest]))
    with pytest.raises(BadInput, match="whole numbers"):
        read_cohort(copied)


def test_a_rating_beyond_thirty_is_refused(copied: Path) -> None:
    meta = copied / "Suturing" / META
    first, *rest = meta.read_text().splitlines(keepends=True)
    cells = first.split("\t")
    meta.write_text("".join(["\t".join([*cells[:3], "310", *cells[4:]]), *rest]))
    with pytest.raises(BadInput, match="rates Suturing_B001 with 310"):
        read_cohort(copied)


def test_one_surgeon_is_not_enough(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="There is 1 surgeon; at least 3"):
        read_cohort(rated.folder(tmp_path / "one", count=1))


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
        read_cohort(copied)


def test_a_trial_that_is_cut_off_is_named(copied: Path) -> None:
    path = copied / "Suturing/kinematics/AllGestures/Suturing_C002.txt"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UnreadableRecording, match=r"Suturing_C002\.txt"):
        read_cohort(copied)


def test_an_empty_trial_is_left_out_and_named(copied: Path) -> None:
    (copied / "Suturing/kinematics/AllGestures/Suturing_C002.txt").write_bytes(b"")
    found = read_cohort(copied)
    assert found.left_out == {"empty": ["Suturing_C002"]}
    assert (found.data["trials"], found.data["left_out"]) == (39, 1)


# ---- accepted models ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unknowable(read: Rated) -> dict[str, Any]:
    """Return a model of ratings that were shuffled among the surgeons."""
    return calibrate_on(Rated(shuffled(read.cohort, np.random.default_rng(1)), read.data, {}), permutations=20)


def test_a_model_of_what_cannot_be_known_is_refused_and_nothing_is_stored(
    database: Database, unknowable: dict[str, Any]
) -> None:
    assert unknowable["validated"]["all_figures"]["rho"] < 0.5
    refused = pytest.raises(BadInput, match=r"not accepted, and nothing was stored\. .*p = .*--of trial")
    with refused, database.writing() as session:
        keep(session, unknowable, "test")
    with database.reading() as session:
        assert newest(session) is None


@pytest.mark.parametrize(
    ("part", "field", "wrong", "said"),
    [
        ("all_figures", "rho_interval", [-0.1, 0.9], "may be 0 or less"),
        ("all_figures", "rho_interval", [math.nan, math.nan], "may be 0 or less"),
        ("chance", "rho_p", 0.051, "A random order does as well"),
        ("chance", "rho_p", math.nan, "A random order does as well"),
        ("chance", "accuracy_p", 0.2, "right as often"),
        ("chance", "accuracy_p", math.nan, "right as often"),
        ("all_figures", "accuracy", 0.0, "in 0 % of the trials"),
        ("all_figures", "accuracy", math.nan, "in nan % of the trials"),
        ("duration_only", "accuracy", 0.99, "the duration alone in 99 %"),
        (None, "over_duration", [0.0, 0.4], "no better than the duration alone"),
        (None, "over_duration", [math.nan, 0.4], "no better than the duration alone"),
        (None, "over_duration", None, "no better than the duration alone"),
    ],
)
def test_each_comparison_can_refuse_and_nan_does(
    part: str | None, field: str, wrong: Any, said: str, about: dict[str, Any]
) -> None:
    judged = copy.deepcopy(about["validated"])
    assert refusals(judged) == []
    of = judged if part is None else judged[part]
    assert level_refusals(judged) == []
    if wrong is None:  # as an older version stored it
        del of[field]
    else:
        of[field] = wrong
    of_levels = "accuracy" in field
    assert (refusals(judged) == []) == of_levels
    why = level_refusals(judged) if of_levels else refusals(judged)
    assert len(why) == 1 and said in why[0]


def test_a_model_without_any_figure_is_refused_in_words() -> None:
    nothing: dict[str, Any] = {"all_figures": {}, "duration_only": {}, "chance": {}}
    assert (len(refusals(nothing)), len(level_refusals(nothing))) == (3, 2)


def test_trials_without_a_hand_off_are_left_out_and_counted(copied: Path) -> None:
    """An arm stands still, in one trial and then in all of them."""
    names = sorted((copied / "Suturing/kinematics/AllGestures").iterdir())
    still = as_text(np.tile(kinematics(90)[0], (90, 1)))
    names[0].write_bytes(still)
    (copied / "Suturing/transcriptions" / names[0].name).unlink()
    found = read_cohort(copied)
    assert (found.data["trials"], found.data["left_out"]) == (39, 1)
    for name in names:
        name.write_bytes(still)
        (copied / "Suturing/transcriptions" / name.name).unlink(missing_ok=True)
    with pytest.raises(BadInput, match="None of 40 trials"):
        read_cohort(copied)
