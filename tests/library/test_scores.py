"""Scores on a real database: the reference, the percentiles, the history, and only surgeons with consent."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from skills.db.models import Demonstration, MeasuredShape, StoredCalibration, StoredRecording
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound
from skills.formats.parsed import parse_recording
from skills.library.comparison.calibrations import VERSION, digest_of, put_calibration
from skills.library.comparison.scores import LEAST_DEMOS, progress, score
from skills.library.people.surgeons import put_surgeon
from skills.library.recordings.demos import mark_demo, upload_demo, withdraw_demo
from skills.library.recordings.recordings import store_recording
from skills.schemas.calibrations import Calibration
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.scores import Score, ScoreIn
from skills.scoring.calibration import SkillModel, as_numbers
from tests.library import cases, rated
from tests.scoring.test_rating import JUDGED as RATED
from tests.scoring.test_rating import model

JUDGED = asdict(RATED)
NO_ATLAS = {"uses": ["training", "export"]}
READ = parse_recording


def put(database: Database, slug: str, **about: object) -> None:
    with database.writing() as session:
        put_surgeon(session, slug, SurgeonIn.model_validate({"skill_level": None, "consent": None} | about), "test")


def bent(way_mm: float, surgeon: str, database: Database, samples: int = 20) -> Demonstration:
    """Store the hand-off with a swerve, so that each one differs; more samples take more time."""
    tip = cases.points_mm(samples=samples)
    tip = tip + way_mm * np.sin(np.linspace(0, np.pi, len(tip)))[:, None] * np.array([0.0, 1.0, 0.3])
    return cases.add_demo(database, cases.table(tip), surgeon)


def scored(database: Database, demo: Demonstration | None = None, **asked: object) -> Score:
    about = {"demo": demo.sha256} if demo is not None else {}
    return score(database, ScoreIn(surgeon="kestrel", suture=cases.SUTURE, **about, **asked), READ)


def test_a_demo_is_scored_against_the_released_demo_or_else_the_newest(
    database: Database,
) -> None:
    first = bent(0.0, "kestrel", database)
    version = cases.train(database, release=False)
    newest = bent(1.0, "kestrel", database)
    put(database, "plover")
    mine = bent(6.0, "plover", database)
    told = scored(database, mine)
    assert told.reference.demo == newest.sha256 and "newest" in told.reference.because
    cases.train(database, demos=[first.sha256], release=True)
    told = scored(database, mine)
    assert told.reference.demo == first.sha256
    assert f"version {version.version}" in told.reference.because
    assert scored(database, mine, reference=newest.sha256).reference.because == "it was requested"


def test_figures_and_deviation_are_those_of_the_two_motions(database: Database) -> None:
    reference = bent(0.0, "kestrel", database)
    put(database, "plover")
    told = scored(database, bent(6.0, "plover", database, samples=40))
    figures = {one.name: one for one in told.figures}
    assert figures["duration_s"].ratio == pytest.approx(119 / 59, rel=0.01)
    assert figures["path_length_mm"].reference == pytest.approx(reference.report.path_length_mm)
    assert told.deviation.total_mm > 100 and len(told.deviation.path_mm) == 100
    assert np.sum(told.deviation.shares) == pytest.approx(1.0)
    assert told.as_recorded.total_mm > 100
    assert "middle third" in " ".join(told.as_recorded.words)
    assert told.skill.calibrated is False and "calibrate it on rated trials" in told.skill.words[0]
    assert "not a credential" in told.use


def test_a_demonstration_lies_nowhere_from_itself(database: Database) -> None:
    told = scored(database, bent(0.0, "kestrel", database))
    assert told.reference.is_itself
    assert told.deviation.total_mm == 0.0
    assert {one.ratio for one in told.figures} <= {None, 1.0}


def test_a_part_of_a_recording_is_scored_and_nothing_is_stored(database: Database) -> None:
    demo = bent(0.0, "kestrel", database)
    before = count(database)
    told = scored(database, recording=demo.recording.sha256, start_s=0.2, end_s=1.0)
    assert (told.demo, told.surgeon, told.curve) == (None, None, [])
    assert (told.start_s, told.end_s) == (0.2, 1.0)
    assert count(database) == before


def count(database: Database) -> list[int]:
    with database.reading() as session:
        return [session.query(kind).count() for kind in (Demonstration, StoredRecording, MeasuredShape)]


def test_percentiles_count_demonstrations_by_level_and_need_enough_of_them(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "plover", skill_level="novice")
    put(database, "wren", skill_level="novice")
    for number in range(LEAST_DEMOS - 1):
        bent(4.0 + number, "plover", database)
    mine = bent(2.5, "plover", database)
    novice = next(one for one in scored(database, mine).percentiles if one.level == "novice")
    assert (novice.demos, novice.surgeons, novice.below) == (LEAST_DEMOS - 1, 1, None)  # without itself
    assert "at least 5 demonstrations of 2 surgeons" in novice.reason
    bent(9.0, "wren", database)
    bent(1.0, "wren", database)
    novice = next(one for one in scored(database, mine).percentiles if one.level == "novice")
    assert (novice.demos, novice.surgeons, novice.reason) == (LEAST_DEMOS + 1, 2, None)
    assert novice.below["distance_mm"] == pytest.approx(1 / 6)  # one of six is nearer to the reference
    assert novice.below["duration_s"] == pytest.approx(0.5)  # all are equal
    assert novice.below["clutch_presses"] == pytest.approx(0.5)
    assert novice.below["spectral_arc_length"] is not None
    assert novice.below["orientation_change_rad"] is None  # a table has no orientation


def test_the_curve_has_the_surgeons_demonstrations_up_to_this_one(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "plover")
    made = [bent(way, "plover", database) for way in (9.0, 6.0, 3.0, 2.0)]
    told = scored(database, made[2])
    assert [one.demo for one in told.curve] == [one.sha256 for one in made[:3]]
    distances = [one.distance_mm for one in told.curve]
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] == pytest.approx(told.deviation.distance_mm)


def test_overlapping_cuts_of_one_motion_count_once(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "plover", skill_level="novice")
    put(database, "wren", skill_level="novice")
    for number in range(LEAST_DEMOS):
        bent(4.0 + number, "wren", database)
    tip_mm = cases.points_mm(samples=40)
    mine = cases.add_demo(database, cases.table(tip_mm), "plover")
    cases.add_demo(database, cases.table(tip_mm), "plover", start_s=0.1)
    another = cases.add_demo(database, cases.table(tip_mm), "wren", start_s=0.2)
    told = scored(database, mine)
    novice = next(one for one in told.percentiles if one.level == "novice")
    assert (novice.demos, novice.surgeons) == (LEAST_DEMOS, 1)  # none of the motion's own cuts
    assert [one.demo for one in told.curve] == [mine.sha256]
    cases.committed(database, withdraw_demo, mine.sha256, "test")
    novice = next(one for one in scored(database, another).percentiles if one.level == "novice")
    assert novice.demos == LEAST_DEMOS


def test_a_newer_cut_that_failed_does_not_hide_one_that_did_not(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "wren", skill_level="novice")
    for number in range(LEAST_DEMOS - 1):
        bent(4.0 + number, "wren", database)
    tip_mm = cases.points_mm(samples=40)
    cases.add_demo(database, cases.table(tip_mm), "wren")
    failed = cases.add_demo(database, cases.table(tip_mm), "wren", start_s=0.1)
    cases.committed(database, mark_demo, failed.sha256, "failure", "The needle fell.", "test")
    put(database, "plover")
    told = scored(database, bent(20.0, "plover", database))
    (novice,) = (one for one in told.percentiles if one.level == "novice")
    assert novice.demos == LEAST_DEMOS


def test_the_largest_differences_are_from_the_experts_other_motions(database: Database) -> None:
    for number in range(4):
        reference = bent(0.1 * number, "kestrel", database)
    put(database, "plover")
    told = scored(database, bent(20.0, "plover", database))
    assert told.differences.expert_demos == 4
    assert {"to the side"} <= {one.kind for one in told.differences.named}
    told = scored(database, reference)
    assert told.differences.expert_demos == 3 and told.reference.is_itself
    assert told.differences.words == ("There is no difference beyond the expert's own spread, in 3 demonstrations.",)


def test_the_only_motion_of_an_expert_is_not_compared_with_itself(database: Database) -> None:
    assert scored(database, bent(0.0, "kestrel", database)).differences is None


def test_progress_is_by_session_in_order_of_recording(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "plover")
    for way_mm, day in ((9.0, "monday"), (7.0, "monday"), (4.0, "tuesday"), (2.0, None)):
        tip_mm = cases.points_mm() + way_mm * np.sin(np.linspace(0, np.pi, 60))[:, None] * np.array([0.0, 1.0, 0.3])
        cases.add_demo(database, cases.table(tip_mm), "plover", session=day)
    found = progress(database, "plover", cases.SUTURE, "kestrel")
    assert [(one.session, one.demos) for one in found.sessions] == [("monday", 2), ("tuesday", 1), (None, 1)]
    apart = [one.distance_mm for one in found.demos]
    assert found.sessions[0].distance_mm == pytest.approx(np.mean(apart[:2])) and apart == sorted(apart, reverse=True)
    assert not found.reference.is_itself and "not a credential" in found.use
    with pytest.raises(NotFound, match="no surgeon 'plover2'"):
        progress(database, "kestrel", cases.SUTURE, "plover2")
    put(database, "plover", consent=NO_ATLAS)
    with pytest.raises(Conflict):
        progress(database, "plover", cases.SUTURE, "kestrel")


def test_surgeons_without_consent_are_not_scored_compared_or_counted(database: Database) -> None:
    bent(0.0, "kestrel", database)
    put(database, "plover", skill_level="novice")
    mine = bent(3.0, "plover", database)
    put(database, "wren", skill_level="novice")
    others = [bent(4.0 + number, "wren", database) for number in range(LEAST_DEMOS)]
    counted = next(one for one in scored(database, mine).percentiles if one.level == "novice")
    assert counted.demos == LEAST_DEMOS
    put(database, "wren", skill_level="novice", consent=NO_ATLAS)
    left = next(one for one in scored(database, mine).percentiles if one.level == "novice")
    assert left.demos == 0
    with pytest.raises(Conflict, match="'wren' does not cover atlas"):
        scored(database, others[0])
    with pytest.raises(Conflict, match="does not cover comparisons") as refused:
        scored(database, recording=others[0].recording.sha256)
    assert "wren" not in str(refused.value)
    put(database, "kestrel", consent=NO_ATLAS)
    with pytest.raises(Conflict, match="'kestrel'"):
        scored(database, mine)


def test_what_cannot_be_scored_is_refused(database: Database) -> None:
    with pytest.raises(NotFound, match="no demonstration of 'kestrel'"):
        scored(database, demo=None, recording="0" * 64)
    reference = bent(0.0, "kestrel", database)
    put(database, "plover")
    mine = bent(3.0, "plover", database)
    other = cases.upload(cases.hand_off((0.0, 0.0, 2.5)))
    interrupted = upload_demo(
        database, other, DemoIn(surgeon="plover", suture="simple-interrupted", segment="whole"), "test"
    ).row
    with pytest.raises(BadInput, match="another suture type"):
        scored(database, interrupted)
    with pytest.raises(BadInput, match="of another style"):
        scored(database, mine, reference=mine.sha256)
    cases.committed(database, withdraw_demo, reference.sha256, "test")
    with pytest.raises(Conflict, match="reference was withdrawn"):
        scored(database, mine, reference=reference.sha256)
    with pytest.raises(Conflict, match="demonstration was withdrawn"):
        scored(database, reference, reference=bent(2.0, "kestrel", database).sha256)


def calibration(*tasks: str, **judged: Any) -> Calibration:
    """Return a calibration of tasks, each with the same figures and the same model."""
    one = model(highest=[[1e9] * 17], lowest=[[-1e9] * 17])
    arrays = {
        name: np.repeat(value, len(tasks), axis=0) for name, value in vars(one).items() if isinstance(value, np.ndarray)
    }
    whole = JUDGED | {
        "repetition_out": JUDGED["model"],
        "rivals": {name: {"rho_interval": [0.0, 1.0], **rival} for name, rival in JUDGED["rivals"].items()},
        "chance": {"permutations": 39, **JUDGED["chance"]},
    }
    return Calibration.model_validate(
        {
            "version": VERSION,
            "model": as_numbers(SkillModel(**vars(one) | arrays | {"tasks": tasks})),
            "data": {"tasks": {}, "left_out": 0, "surgeons": 8, "trials": 40, "files": []},
            "validated": {"tasks": dict.fromkeys(tasks, whole | judged), "mean": whole, "chosen": {}},
            "settings": {"strengths": [], "seed": 0, "permutations": 39, "bootstraps": 0},
            "versions": {},
        }
    )


@pytest.fixture
def trial(database: Database) -> dict[str, Any]:
    """Store a trial of two instruments and a reference to compare with; return the part of it to score."""
    bent(0.0, "kestrel", database)
    data = rated.text(rated.trial(0.5, np.random.default_rng(0))[0])
    sha256 = store_recording(database, cases.upload(data, "text/plain"), "test")[0].sha256
    return {"recording": sha256, "arm": "PSM_right", "start_s": 1.0, "end_s": 4.0}


def stored(database: Database, about: Calibration) -> str:
    with database.writing() as session:
        return put_calibration(session, about, "test")[0].sha256


def test_the_whole_recording_is_rated_and_not_the_motion(database: Database, trial: dict[str, Any]) -> None:
    digest = stored(database, calibration("Knot_Tying"))
    skill = scored(database, **trial).skill
    assert skill.calibrated and (skill.calibration, skill.task) == (digest, "Knot_Tying")
    assert skill.rating == pytest.approx(18.0 + sum(term.points for term in skill.terms))
    assert scored(database, **trial | {"end_s": 3.0}).skill == skill
    assert "rate the whole recording" in skill.words[1] and len(skill.terms) == 17


def test_of_several_tasks_one_is_named(database: Database, trial: dict[str, Any]) -> None:
    stored(database, calibration("Knot_Tying", "Needle_Passing"))
    said = "Not rated: {}. Name the recording's task; it has Knot_Tying, Needle_Passing."
    assert scored(database, **trial).skill.words == (said.format("the calibration has several tasks"),)
    assert scored(database, **trial, task="Sewing").skill.words == (said.format("the calibration has no task Sewing"),)
    assert scored(database, **trial, task="Needle_Passing").skill.task == "Needle_Passing"


def test_a_task_without_evidence_is_not_rated(database: Database, trial: dict[str, Any]) -> None:
    about = calibration("Knot_Tying", "Needle_Passing")
    tasks = about.validated.tasks
    tasks["Needle_Passing"] = replace(tasks["Needle_Passing"], over_duration=(-0.1, 0.4))
    stored(database, about)
    skill = scored(database, **trial, task="Needle_Passing").skill
    assert (skill.calibrated, skill.rating, skill.levels, skill.terms) == (False, None, None, ())
    assert "not accepted for Needle_Passing" in skill.words[0] and "no better than the duration alone" in skill.words[0]
    assert scored(database, **trial, task="Knot_Tying").skill.calibrated


def test_a_recording_of_one_arm_is_not_rated_in_words(database: Database) -> None:
    stored(database, calibration("Knot_Tying"))
    skill = scored(database, bent(0.0, "kestrel", database)).skill
    assert skill.words[0].startswith("Not rated: A trial has two instruments")


def test_a_calibration_of_another_version_is_not_used(database: Database, trial: dict[str, Any]) -> None:
    with database.writing() as session:
        other = calibration("Knot_Tying").model_copy(update={"version": VERSION - 1})
        session.add(StoredCalibration(sha256=digest_of(other), about=other))
    (said,) = scored(database, **trial).skill.words
    assert "another version" in said and "calibrate it again" in said


def test_without_the_consent_of_all_in_a_recording_it_is_not_rated(database: Database) -> None:
    """A demonstration whose surgeon agreed, in a recording with one of a surgeon who did not."""
    bent(0.0, "kestrel", database)
    data = rated.text(rated.trial(0.5, np.random.default_rng(0))[0])
    put(database, "plover")
    put(database, "wren")
    cut = {"surgeon": "plover", "suture": cases.SUTURE, "arm": "PSM_right"}
    agreed = upload_demo(database, cases.upload(data, "text/plain"), DemoIn(**cut, start_s=1.0, end_s=4.0), "test").row
    other = cut | {"surgeon": "wren", "start_s": 4.0, "end_s": 6.0}
    upload_demo(database, cases.upload(data, "text/plain"), DemoIn(**other), "test")
    stored(database, calibration("Knot_Tying"))
    assert scored(database, agreed).skill.calibrated
    put(database, "wren", consent=NO_ATLAS)
    found = scored(database, agreed)
    assert found.deviation.total_mm > 0
    assert found.skill.words == ("Not rated: the consent of a surgeon in this recording does not cover comparisons.",)
