"""Batches: each style is trained independently and once, and released only on request and if not worse."""

import math
from dataclasses import replace

import pytest
from sqlalchemy import func, select

from skills.db.models import PolicyVersion, Release
from skills.db.service_tables import Event, Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Conflict, NotFound
from skills.learning.dynamic_programming import ValueIteration
from skills.learning.q_learning import CellQLearning
from skills.library.operation import jobs
from skills.library.operation.jobs import BATCH
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.policies import batches, requests, retraining
from skills.library.policies.batches import compare
from skills.library.policies.learning import learn_style
from skills.library.recordings.demos import withdraw_demo
from skills.schemas.people import SurgeonIn
from skills.schemas.training import FitOnTheSame, PolicyFigures, TrainingIn
from tests.library import cases
from tests.library.styles import (
    NO_CONSENT,
    add_styles,
    ask_retraining,
    count_versions,
    counted,
    finish,
    look,
    parts_of,
    retrain,
    states_of,
    styles_of,
)

# ---- the selection of styles


def test_all_styles_of_a_surgeon_or_of_a_suture_type_are_trained_once_each(database: Database):
    styles = add_styles(database, 13)  # eleven of one surgeon, two of the next
    first, second = styles[0][0], styles[-1][0]
    batch = retrain(database, surgeon=second)
    assert (batch.state, batch.progress, batch.result["done"], batch.error) == ("succeeded", 1.0, 2, None)
    assert batch.started_at <= batch.ended_at
    retrain(database, suture=styles[0][1])  # one style of each surgeon, of which one is trained by now
    assert count_versions(database) == 3
    whole = retrain(database)
    assert states_of(database, whole) == ["done"] * 13
    assert count_versions(database) == 13
    with database.reading() as session:
        trained = session.execute(select(Event.object_id).where(Event.action == "train")).all()
        assert len(trained) == len(set(trained)) == 13
        ended = select(func.count()).where(Event.action == "finish", Event.object_kind == f"job-{BATCH}")
        assert session.scalar(ended) == 3
    assert counted(database, Release) == 0
    with pytest.raises(NotFound, match="no surgeon 'nobody'"):
        ask_retraining(database, surgeon="nobody")
    with pytest.raises(Conflict, match="no active demonstration"):
        ask_retraining(database, surgeon="kestrel")
    assert first != second


def test_a_style_in_a_batch_is_trained_as_by_a_training_of_its_own(database: Database):
    alone = cases.trained(database)
    (style,) = styles_of(database, retrain(database))
    assert (style.policy_row, count_versions(database)) == (alone.row, 1)
    other = ValueIteration()
    (style,) = styles_of(database, retrain(database, learner=other))
    assert style.policy.version == 2
    assert cases.train(database, learner=other).row == style.policy_row


def test_equal_requests_for_the_same_styles_are_one_job_until_one_fails(database: Database):
    add_styles(database, 3)
    job = ask_retraining(database)
    assert ask_retraining(database).row == job.row
    assert ask_retraining(database, release=True).row != job.row
    assert ask_retraining(database, learner=CellQLearning()).row != job.row
    finish(database, job)
    assert ask_retraining(database).row == job.row
    cases.add_demo(database)
    more = ask_retraining(database)
    assert (more.row != job.row, more.request["styles"]) == (True, 4)
    cases.committed(database, put_surgeon, "kestrel", SurgeonIn.model_validate(NO_CONSENT), "test")
    finish(database, more)
    assert look(database, more).state == "failed"
    again = ask_retraining(database)
    assert (again.row != more.row, again.state) == (True, "queued")


def test_only_stale_styles_are_trained_and_each_says_why(database: Database, monkeypatch: pytest.MonkeyPatch):
    def reasons(**asked: object) -> list[list[str]]:
        return [style.stale for style in styles_of(database, retrain(database, only_stale=True, **asked))]

    add_styles(database, 2)
    assert reasons() == [["never trained"]] * 2
    nothing = ask_retraining(database, only_stale=True)
    assert (nothing.state, nothing.progress, nothing.request["styles"]) == ("succeeded", 1.0, 0)
    assert ask_retraining(database, only_stale=True).row == nothing.row
    older = cases.trained(database)
    cases.add_demo(database, cases.hand_off((5.0, 0.0, 0.0)))
    assert reasons() == [["a newer demonstration"]]
    assert reasons(learner=ValueIteration(), surgeon="kestrel") == [["other settings"]]
    monkeypatch.setattr(requests, "GATE_VERSION", requests.GATE_VERSION + 1)
    assert reasons(surgeon="surgeon-0") == []  # an accepted version stays; for the rest see test_release_gate
    monkeypatch.setattr(requests, "LEARNER_VERSION", requests.LEARNER_VERSION + 1)
    assert sorted(reasons()) == [["a newer learner"]] * 2 + [["other settings", "a newer learner"]]
    with database.writing() as session:  # the newest version's demonstration is gone: the one before counts again
        newest = session.scalars(select(PolicyVersion).order_by(PolicyVersion.row.desc())).first()
        withdraw_demo(session, newest.demonstration.sha256, "test")
    (style,) = styles_of(database, ask_retraining(database, only_stale=True, surgeon="kestrel"))
    assert (style.stale, style.demonstration_row) == (["a newer demonstration"], older.demonstration_row)


@pytest.mark.parametrize("release", [False, True])
def test_stale_styles_are_settled_by_a_batch_that_makes_an_older_version(database: Database, release: bool):
    def stale(**asked: object) -> list[list[str]]:
        return [
            style.stale for style in styles_of(database, retrain(database, only_stale=True, release=release, **asked))
        ]

    add_styles(database, 3)
    stale()
    retrain(database, learner=ValueIteration(), release=release)
    assert stale(surgeon="surgeon-0") == [["other settings"]] * 3
    assert stale() == []
    assert count_versions(database) == 6
    again = ask_retraining(database, only_stale=True, release=release)
    assert (again.state, again.request["styles"]) == ("succeeded", 0)
    if release:  # somebody releases the other version of one of them: what the batch made is not served any more
        with database.reading() as session:
            other = session.scalars(select(PolicyVersion).where(PolicyVersion.version == 2)).first()
        cases.release(database, other)
        assert stale() == [["other settings"]]
        assert stale() == []


def test_no_demonstration_is_not_the_newest_one():
    with pytest.raises(ValueError, match="demos"):
        TrainingIn(surgeon="kestrel", suture=cases.SUTURE, demos=[])


# ---- cancelling and erasing


@pytest.mark.parametrize(
    ("together", "begun", "kept"), [pytest.param(1, 3, 2, marks=pytest.mark.nightly), (2, 4, 2), (5, 4, 0)]
)
def test_a_cancelled_batch_stops_at_its_next_commit_and_drops_late_results(
    database: Database, monkeypatch: pytest.MonkeyPatch, together: int, begun: int, kept: int
):
    monkeypatch.setattr(retraining, "FEWEST_PARTS", 2)
    monkeypatch.setattr(batches, "TOGETHER", together)
    monkeypatch.setattr(batches, "TOGETHER_S", 60.0)
    add_styles(database, 8)
    job = ask_retraining(database)
    learnt = []

    def learn(lesson, request, settings):
        learnt.append(lesson.row)
        if len(learnt) == 3:
            cases.committed(database, jobs.cancel, job.id, "test")
        return learn_style(lesson, request, settings)

    monkeypatch.setattr(batches, "learn_style", learn)
    finish(database, job)
    assert (len(learnt), count_versions(database)) == (begun, kept)
    assert states_of(database, job) == ["done"] * kept + ["cancelled"] * (8 - kept)
    batch = look(database, job)
    assert (batch.state, batch.result) == ("cancelled", None)
    assert {part.state for part in parts_of(database, job)} == {"cancelled"}
    assert ask_retraining(database).row != job.row
    done = retrain(database, only_stale=True)
    with database.writing() as session, pytest.raises(Conflict, match="ended already"):
        jobs.cancel(session, done.id, "test")


def test_an_erased_surgeon_leaves_batches_and_the_others_go_on(database: Database):
    styles = add_styles(database, 13)
    whole, own = ask_retraining(database), ask_retraining(database, surgeon=styles[-1][0])
    unfinished = {(job.row, job.attempt) for job in (own, *parts_of(database, own))}
    first, *rest = parts_of(database, whole)
    cases.work(database, first)
    with database.writing() as session:
        erased = erase_surgeon(session, styles[-1][0], "test")
        demo = styles_of(database, whole)[5].demonstration
        erase_demo(session, demo.sha256, "test")
    assert set(erased) == unfinished
    for part in rest:
        cases.work(database, part)
    batch = look(database, whole)
    assert (batch.state, batch.result["done"]) == ("succeeded", 10)
    assert len(states_of(database, whole)) == 10
    with database.reading() as session:
        assert session.get(Job, own.row) is None
    with database.writing() as session:  # trained in a batch, and still erased
        erase_surgeon(session, styles[0][0], "test")
    assert counted(database, StyleToRetrain) == 0
    assert count_versions(database) == 0


def test_a_batch_all_of_whose_styles_were_erased_ends(database: Database):
    cases.add_demo(database)
    job = ask_retraining(database)
    (part,) = parts_of(database, job)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    cases.work(database, part)
    assert (look(database, job).state, look(database, job).result["done"]) == ("succeeded", 0)


# ---- its parts


def test_parts_are_shared_out_and_nobody_sees_them(database: Database):
    add_styles(database, 40)
    job = ask_retraining(database)
    assert len(parts_of(database, job)) == 4  # of ten styles: enough for some workers
    with database.reading() as session:
        assert [one.id for one in jobs.list_jobs(session, 50, None, None)] == [job.id]
        assert len(jobs.attempts_to_submit(session, job)) == 4
        with pytest.raises(NotFound):
            jobs.find_job(session, parts_of(database, job)[0].id)


# ---- releasing


def test_retraining_releases_only_on_request_and_stores_the_comparison(database: Database):
    cases.add_demo(database)
    (style,) = styles_of(database, retrain(database))
    assert style.comparison.released is None
    assert (style.comparison.now_released, counted(database, Release)) == (False, 0)
    (style,) = styles_of(database, retrain(database, release=True))
    assert (style.comparison.now_released, counted(database, Release)) == (True, 1)
    (style,) = styles_of(database, retrain(database, release=True, learner=ValueIteration()))
    compared = style.comparison
    assert (compared.released.version, compared.trained.version) == (1, 2)
    assert (compared.same_demonstration, list(compared.worse_because)) == (True, [])
    assert (compared.now_released, counted(database, Release)) == (True, 2)
    cases.add_demo(database, cases.hand_off((5.0, 0.0, 0.0)))
    (style,) = styles_of(database, retrain(database, release=True))
    assert (style.comparison.same_demonstration, style.comparison.now_released) == (False, True)


def test_a_worse_version_is_kept_and_not_released(database: Database):
    cases.trained(database, release=True)
    job = retrain(database, release=True, learner=CellQLearning(episodes=3))
    (style,) = styles_of(database, job)
    assert (job.state, style.state, style.policy.version) == ("succeeded", "done", 2)
    assert style.comparison.worse_because
    assert style.comparison.not_released_because.startswith("It is worse than the released version: ")
    assert counted(database, Release) == 1


FIGURES = PolicyFigures(
    version=1,
    sha256="a",
    demos=("a", "b"),
    rests_on=2,
    dtw_total_mm=0.0,
    exact_share=0.9,
    reaching_share=0.95,
    mean_share=0.8,
)
SAME = FitOnTheSame(("a",), 10.0, 10.0)


@pytest.mark.parametrize(
    ("name", "equal", "better", "worse"),
    [
        ("rests_on", 2, 3, 1),
        ("exact_share", 0.9, 1.0, 0.8),
        ("reaching_share", 0.95, 1.0, 0.9),
        ("mean_share", 0.8, 0.9, 0.7),
    ],
)
def test_worse_is_what_is_worse_in_one_figure_or_no_number(name: str, equal: float, better: float, worse: float):
    for value, reasons in ((equal, 0), (better, 0), (worse, 1), (math.nan, 1)):
        assert len(compare(FIGURES, replace(FIGURES, **{name: value}), SAME).worse_because) == reasons
    assert len(compare(replace(FIGURES, **{name: math.nan}), FIGURES, SAME).worse_because) == 1
    assert compare(None, replace(FIGURES, **{name: worse}), None).worse_because == ()


def test_worse_is_what_is_further_from_the_same_demonstrations():
    for trained_mm, reasons in ((10.0, 0), (9.0, 0), (10.1, 1), (math.nan, 1)):
        assert len(compare(FIGURES, FIGURES, FitOnTheSame(("a",), 10.0, trained_mm)).worse_because) == reasons
    assert len(compare(FIGURES, FIGURES, FitOnTheSame(("a",), math.nan, 10.0)).worse_because) == 1
