"""Outcomes of demonstrations: who may learn from a failure, and what a mark ends."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from sqlalchemy import event, select
from sqlalchemy.exc import IntegrityError

from skills.db.models import Demonstration, DemonstrationOutcome, PolicyVersion, Release
from skills.db.row_visibility import Only
from skills.db.service_tables import Event
from skills.db.session import Database
from skills.errors import Conflict
from skills.formats.parsed import parse_recording
from skills.library import perform as library
from skills.library.comparison.scores import LEAST_DEMOS, score
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import keep_erasures, read_erasures
from skills.library.operation.styles import matrix
from skills.library.people.erasure import erase_demo
from skills.library.policies.cards import card_of
from skills.library.policies.gate import remedy
from skills.library.policies.requests import TrainingRequest
from skills.library.policies.versions import find_by_digest
from skills.library.recordings.demos import list_demos, mark_demo, newest_demo
from skills.packing import canonical, sha256
from skills.remedies import Action, Remedy
from skills.schemas.demos import OutcomeIn
from skills.schemas.policies import GateRefusal
from skills.schemas.scores import ScoreIn
from tests import backends
from tests.library import cases
from tests.library.cases import fetch, wrong
from tests.library.styles import ask_retraining, counted, finish, look, retrain, served, styles_of

WHY = "The needle fell."
FAILED = pytest.mark.parametrize("outcome", ["recovery", "failure"])


def add(database: Database, shift_mm: float = 0.0, **cut: object) -> Demonstration:
    return cases.add_demo(database, cases.hand_off((shift_mm, 0.0, 0.0)), **cut)


def mark(database: Database, demo: Demonstration, outcome: str, reason: str | None = WHY) -> Demonstration:
    with database.writing() as session:
        return mark_demo(session, demo.sha256, outcome, reason, "test")


def actions(database: Database) -> Sequence[tuple[str, str]]:
    with database.reading() as session:
        marks = select(Event.action, Event.actor).where(Event.action.startswith("mark-"))
        return [tuple(row) for row in session.execute(marks.order_by(Event.row))]


# ---- marks


def test_the_newest_mark_counts_and_every_mark_says_who_and_why(database: Database):
    demo = add(database)
    assert (demo.outcome, demo.outcome_reason) == (None, None)
    for outcome, reason in (("failure", WHY), ("failure", WHY), ("recovery", "Caught again."), ("success", None)):
        marked = mark(database, demo, outcome, reason)
        assert (marked.outcome, marked.outcome_reason) == (outcome, reason)
    assert counted(database, DemonstrationOutcome) == 3  # an equal mark is not stored twice
    assert actions(database) == [(f"mark-{what}", "test") for what in ("failure", "recovery", "success")]
    with database.reading() as session:
        kept = session.scalars(select(DemonstrationOutcome).order_by(DemonstrationOutcome.row)).all()
    assert [(one.outcome, one.reason, one.actor) for one in kept][:2] == [
        ("failure", WHY, "test"),
        ("recovery", "Caught again.", "test"),
    ]
    with pytest.raises(IntegrityError), database.writing() as session:
        session.add(DemonstrationOutcome(demonstration_row=demo.row, outcome="unheard", actor="test"))


@FAILED
def test_a_recovery_or_a_failure_needs_a_reason(outcome: str):
    with pytest.raises(ValueError, match=f"a {outcome} needs a reason"):
        OutcomeIn(outcome=outcome)
    assert OutcomeIn(outcome="success").reason is None


def test_an_outcome_is_stored_and_a_repetition_does_not_change_it(database: Database):
    demo = add(database, outcome="failure", outcome_reason=WHY)
    assert (demo.outcome, demo.outcome_reason) == ("failure", WHY)
    assert add(database, outcome="failure", outcome_reason=WHY).row == add(database).row == demo.row
    for other in ({"outcome": "success"}, {"outcome": "failure", "outcome_reason": "It slipped."}):
        with pytest.raises(Conflict, match=r"is stored as a failure \(The needle fell") as refused:
            add(database, **other)
        assert refused.value.remedies == (Remedy(Action.MARK_DEMO, demo=demo.sha256, outcome=other["outcome"]),)
    unmarked = add(database, 1.0)
    with pytest.raises(Conflict, match="stored without an outcome"):
        add(database, 1.0, outcome="success")
    with database.reading() as session:
        assert session.get_one(Demonstration, unmarked.row).outcome is None
    assert actions(database) == [("mark-failure", "test")]
    with pytest.raises(ValueError, match="a reason needs an outcome"):
        add(database, outcome_reason=WHY)


def test_demonstrations_are_listed_by_outcome_with_one_statement(database: Database):
    rows = {what: add(database, shift).row for shift, what in ((0.0, "unknown"), (1.0, "success"), (5.0, "failure"))}
    for what, row in rows.items():
        if what != "unknown":
            with database.reading() as session:
                demo = session.get_one(Demonstration, row)
            mark(database, demo, what)
    asked: list[str] = []
    event.listen(database.engine, "before_cursor_execute", lambda _c, _k, statement, *_: asked.append(statement))
    with database.reading() as session:
        found = list_demos(session, 10, None, None, None)
        assert [one.outcome for one in found] == ["failure", "success", None]
        assert [one.outcome_reason for one in found] == [WHY, WHY, None]
        assert len([one for one in asked if one.startswith("SELECT")]) == 1
        for what, row in rows.items():
            assert [one.row for one in list_demos(session, 10, None, None, None, outcome=what)] == [row]
        assert list_demos(session, 10, None, None, None, outcome="recovery") == []


def test_a_mark_is_seen_with_its_surgeon_and_goes_with_its_demonstration(database: Database):
    cases.add_surgeon(database, "heron")
    mine, theirs = add(database), cases.add_demo(database, surgeon="heron")
    for one in (mine, theirs):
        mark(database, one, "failure")
    with database.seen_by(Only("somebody", frozenset({mine.surgeon_row}))).reading() as session:
        assert session.scalars(select(DemonstrationOutcome.demonstration_row)).all() == [mine.row]
        assert [one.outcome for one in list_demos(session, 10, None, None, None)] == ["failure"]
    cases.committed(database, erase_demo, mine.sha256, "test")
    assert counted(database, DemonstrationOutcome) == 1
    assert wrong(database) == []


# ---- learning


@FAILED
def test_what_failed_is_learnt_from_only_if_told(database: Database, outcome: str):
    good, bad = add(database), add(database, 1.0)
    mark(database, bad, outcome)
    assert cases.ask_training(database).request["demos"] == [good.sha256]
    with pytest.raises(Conflict, match=f"is marked {outcome}: The needle fell.") as refused:
        cases.ask_training(database, demos=[good.sha256, bad.sha256])
    assert refused.value.remedies == (Remedy(Action.TRAIN_ANY),)
    told = cases.ask_training(database, outcomes="any")
    assert (told.request["demos"], told.request["outcomes"]) == ([bad.sha256], "any")
    mark(database, good, "failure")
    with pytest.raises(Conflict, match=r"Every active demonstration .* is marked recovery or failure"):
        cases.ask_training(database)
    assert fetch(database, newest_demo, good.surgeon_row, cases.SUTURE) is None


def test_a_training_of_successes_keeps_identity_and_manifest(database: Database):
    demo = add(database)
    unmarked = cases.train(database)
    mark(database, demo, "success", None)
    job = cases.ask_training(database)
    assert "outcomes" not in job.request and "outcomes" not in unmarked.manifest
    assert job.result["sha256"] == unmarked.sha256  # the same job
    assert job.identity == sha256(canonical(["training", job.request]))


def test_a_policy_of_any_outcome_names_the_outcomes(database: Database):
    good, bad, unknown = add(database), add(database, 1.0), add(database, 5.0)
    mark(database, good, "success", None)
    mark(database, bad, "failure")
    demos = [one.sha256 for one in (bad, unknown, good)]
    version = cases.train(database, demos=demos, outcomes="any", release=True)
    assert version.manifest.outcomes == ["success", "failure", None]
    alone = cases.train(database, outcomes="any", demos=[unknown.sha256])
    assert alone.manifest.outcomes == [None]
    with database.reading() as session:
        card = card_of(session, find_by_digest(session, version.sha256)).facts.model_dump()
    assert "that of its demonstrations was: success, failure, not known." in card["learner"]["in_words"]
    assert [one["outcome"] for one in card["demonstrations"]] == ["success", "failure", None]
    assert card["demonstrations"][1]["state_in_words"] == f"Active. Marked failure: {WHY}"
    assert wrong(database) == []


def test_a_card_states_outcomes_and_of_an_unmarked_demonstration_none(database: Database):
    def learner() -> str:
        with database.reading() as session:
            return str(
                card_of(session, find_by_digest(session, version.sha256)).facts.model_dump()["learner"]["in_words"]
            )

    demo = add(database)
    version = cases.train(database)
    before = learner()
    assert before.endswith("the same numbers.")
    mark(database, demo, "success", None)
    assert learner() == f"{before} When it was learnt, no demonstration of it was marked recovery or failure."


def test_a_card_states_the_samples_that_were_dropped(database: Database):
    rows = [f"{k * 0.01:.2f},{min(k, 150) * 0.2:.2f},50,-120" for k in range(200)]
    rows[50] = rows[50].replace("0.50,", "0.48,")
    demo = cases.add_demo(database, "\n".join(["t_s,x_mm,y_mm,z_mm", *rows, rows[-1]]).encode(), segment="whole")
    sound = add(database, 1.0)
    version = cases.train(database, demos=[demo.sha256, sound.sha256], combine="medoid")
    with database.reading() as session:
        card = card_of(session, find_by_digest(session, version.sha256)).facts.model_dump()
    said, none = (one["quality_in_words"] for one in card["demonstrations"])
    assert said[1] == (
        "Samples dropped from the whole recording: 1 for repeating a stamp, 1 for a stamp that went back."
    )
    assert not any("ropped" in one for one in none)


# ---- what a mark ends


@FAILED
def test_a_mark_withdraws_the_releases_that_rest_on_it(database: Database, outcome):
    first, demo = add(database), add(database, 1.0)
    cases.train(database, demos=[first.sha256], release=True)
    version = cases.train(database, release=True)
    assert served(database) == [2, 1]
    mark(database, demo, "success", None)
    assert served(database) == [2, 1]
    mark(database, demo, outcome)
    assert served(database) == []  # the one before does not come back by itself
    with pytest.raises(Conflict, match=f"its demonstration was marked {outcome}") as refused:
        cases.release(database, version)
    assert "was marked" in refused.value.message
    assert remedy([GateRefusal("marked", "")]).startswith("Train from another demonstration, or with outcomes 'any'")
    assert wrong(database) == []
    mark(database, demo, "success", None)
    assert served(database) == []
    cases.release(database, version)
    assert served(database) == [2]


def test_a_mark_of_one_of_several_demonstrations_withdraws_the_release(database: Database):
    first, second, third = add(database), add(database, 1.0), add(database, 5.0)
    cases.train(database, demos=[first.sha256, second.sha256], combine="medoid", release=True)
    cases.train(database, demos=[third.sha256], release=True)
    mark(database, first, "failure")
    assert served(database) == [2]
    mark(database, third, "failure")
    assert served(database) == []


def test_a_policy_trained_from_any_outcome_stays_released(database: Database):
    demo = add(database)
    version = cases.train(database, outcomes="any", release=True)
    mark(database, demo, "failure")
    assert served(database) == [1]
    with database.writing() as session:
        for one in session.scalars(select(Release)):
            one.withdrawn_at = one.released_at
    cases.release(database, version)
    assert served(database) == [1]
    assert wrong(database) == []


def test_a_release_that_stands_on_a_failure_is_found(database: Database):
    demo = add(database)
    cases.train(database, release=True)
    with database.writing() as session:
        session.add(DemonstrationOutcome(demonstration_row=demo.row, outcome="failure", actor="test"))
    assert wrong(database) == [("releases 1", "it is not withdrawn, but its demonstration was marked failure")]


@pytest.mark.parametrize(("outcomes", "made"), [("success", 0), ("any", 1)])
def test_a_mark_made_while_a_style_is_learnt(
    database: Database, monkeypatch: pytest.MonkeyPatch, outcomes: str, made: int
):
    demo = add(database)
    train = library.PERFORMERS[TrainingRequest]

    def make(*asked: object) -> object:
        store = train(*asked)
        mark(database, demo, "failure")
        return store

    monkeypatch.setitem(library.PERFORMERS, TrainingRequest, make)
    job = cases.work(database, cases.ask_training(database, release=True, outcomes=outcomes))
    assert job.state == ("succeeded" if made else "failed")
    if not made:
        assert job.error.startswith("A demonstration was marked failure while the training used it.")
    assert counted(database, PolicyVersion) == counted(database, Release) == made


# ---- batches


def test_a_batch_learns_from_the_newest_that_did_not_fail(database: Database):
    good, bad = add(database), add(database, 1.0)
    mark(database, bad, "failure")
    (style,) = styles_of(database, retrain(database))
    assert (style.demonstration_row, style.state) == (good.row, "done")
    mark(database, good, "failure")
    with pytest.raises(Conflict, match="one marked recovery or failure does not count"):
        ask_retraining(database)


def test_a_mark_made_before_a_batch_learns_fails_its_style(database: Database):
    demo = add(database)
    job = ask_retraining(database, release=True)
    mark(database, demo, "failure")
    finish(database, job)
    (style,) = styles_of(database, job)
    assert (style.state, style.reason.split(" while ")[0]) == ("failed", "A demonstration was marked failure")
    assert (look(database, job).state, counted(database, PolicyVersion)) == ("failed", 0)


def test_a_batch_whose_demonstrations_have_all_been_marked_says_so(database: Database):
    demos = [add(database), add(database, 1.0)]
    cases.train(database, demos=[one.sha256 for one in demos], outcomes="any", release=True)
    job = ask_retraining(database)
    for demo in demos:
        mark(database, demo, "failure")
    assert served(database) == [1]
    finish(database, job)
    (style,) = styles_of(database, job)
    assert style.state == "failed" and "withdrawn or marked since" in style.reason


# ---- what else takes the newest


def test_a_newer_failure_is_not_waited_for(database: Database):
    add(database)
    cases.train(database)
    bad = add(database, 1.0)
    for waits in (True, False):
        with database.reading() as session:
            (row,) = [styles for surgeon, styles in matrix(session).rows if surgeon.slug == "kestrel"]
            assert [(style.waiting, style.demos) for style in row if style.suture == cases.SUTURE] == [(waits, 2)]
        mark(database, bad, "failure")


def test_a_failure_is_compared_only_if_named_and_in_no_percentile(database: Database):
    good, bad = add(database), add(database, 1.0)
    mark(database, bad, "failure")
    asked = {"surgeon": "kestrel", "suture": cases.SUTURE, "demo": bad.sha256}
    found = score(database, ScoreIn(**asked), parse_recording)
    assert found.reference.demo == good.sha256
    assert [one.demo for one in found.curve] == [good.sha256, bad.sha256]
    named = score(database, ScoreIn(**asked, reference=bad.sha256), parse_recording)
    assert named.reference.because == "it was requested, and is marked failure"
    cases.add_surgeon(database, "plover", skill_level="novice")
    cases.add_surgeon(database, "wren", skill_level="novice")
    for number in range(LEAST_DEMOS):
        cases.add_demo(database, cases.hand_off((0.0, 0.5 * (number + 1), 0.0)), ("plover", "wren")[number % 2])
    fell = cases.add_demo(database, cases.hand_off((0.0, 4.0, 0.0)), "wren")
    for demos in (LEAST_DEMOS + 1, LEAST_DEMOS):
        levels = score(database, ScoreIn(**asked), parse_recording).percentiles
        assert [one.demos for one in levels if one.level == "novice"] == [demos]
        mark(database, fell, "failure")


# ---- backups


def test_a_mark_made_after_the_backup_is_made_again(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    demo, other = add(database), add(database, 1.0)
    mark(database, other, "recovery", "Dr Doe slipped.")
    version = cases.train(database, demos=[demo.sha256], release=True)
    back_up(database, tmp_path / "b.zip")
    mark(database, demo, "failure", "Dr Doe slipped again.")
    keep_erasures(database, tmp_path / "list.json")
    after = empty(backends.OTHER[database.engine.dialect.name])
    assert restore(after, tmp_path / "b.zip", read_erasures(str(tmp_path / "list.json"))).demos_marked == 1
    assert served(after) == []
    with after.reading() as session:
        outcomes = {one.sha256: one.outcome for one in session.scalars(select(Demonstration))}
    assert outcomes == {demo.sha256: "failure", other.sha256: "recovery"}
    with pytest.raises(Conflict, match="was marked failure"):
        cases.release(after, version)
    assert wrong(after) == []
    assert "Doe" not in (tmp_path / "list.json").read_text()


def test_a_mark_taken_back_before_the_list_is_not_made_again(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    demo = add(database)
    cases.train(database, release=True)
    back_up(database, tmp_path / "b.zip")
    mark(database, demo, "failure")
    keep_erasures(database, tmp_path / "list.json")
    mark(database, demo, "success", None)
    keep_erasures(database, tmp_path / "list.json")
    listed = read_erasures(str(tmp_path / "list.json"))
    assert [outcome for _, outcome in listed.outcomes.values()] == ["success"]
    after = empty("sqlite")
    assert restore(after, tmp_path / "b.zip", listed).demos_marked == 0
    with after.reading() as session:
        assert session.scalars(select(Demonstration)).one().outcome is None
    assert served(after) == []  # the mark withdrew it, and the list never releases
