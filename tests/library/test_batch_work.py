"""Parts of batches: each style is trained independently and once, even if several workers work on it."""

import time
from collections.abc import Callable
from threading import Thread

import pytest
from sqlalchemy import func, select

from skills.db.service_tables import Event, Job
from skills.db.session import Database
from skills.jobs.attempts import Work, fail, start
from skills.library.people.surgeons import put_surgeon
from skills.library.perform import perform_job
from skills.library.policies import batches, retraining
from skills.library.policies.learning import Learnt, Lesson, learn_style
from skills.library.policies.requests import TrainingRequest
from skills.library.recordings.demos import withdraw_demo
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from tests.library import cases, styles
from tests.library.styles import (
    add_styles,
    ask_retraining,
    finish,
    look,
    parts_of,
    states_of,
    styles_of,
)

Before = Callable[[Callable[[Lesson], object]], None]


@pytest.fixture
def in_one_part(database: Database, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], tuple[Job, Job]]:
    """Return a function that adds styles and requests a batch of a single part; it returns the batch and the part."""
    monkeypatch.setattr(retraining, "FEWEST_PARTS", 1)

    def request(number: int) -> tuple[Job, Job]:
        add_styles(database, number)
        job = ask_retraining(database)
        (part,) = parts_of(database, job)
        return job, part

    return request


@pytest.fixture
def before_learning(monkeypatch: pytest.MonkeyPatch) -> Before:
    """Return a function that sets what is done before a style is learnt."""

    def before(step: Callable[[Lesson], object]) -> None:
        def learn(lesson: Lesson, request: TrainingRequest, settings: Settings) -> Learnt:
            step(lesson)
            return learn_style(lesson, request, settings)

        monkeypatch.setattr(batches, "learn_style", learn)

    return before


# ---- one bad style


def test_one_bad_style_of_eight_fails_with_its_reason_and_seven_are_done(database: Database):
    styles.add_styles(database, 8)
    job = styles.ask_retraining(database)
    styles.damage(database, styles.styles_of(database, job)[3].demonstration_row)
    for part in styles.parts_of(database, job):
        assert cases.work(database, part).state == "succeeded"
    assert styles.states_of(database, job) == ["done"] * 3 + ["failed"] + ["done"] * 4
    bad = styles.styles_of(database, job)[3]
    assert "does not match its checksum" in bad.reason
    assert (bad.policy_row, bad.comparison, bad.ended_at is None) == (None, None, False)
    batch = styles.look(database, job)
    assert (batch.state, batch.progress) == ("failed", 1.0)
    assert batch.error.startswith("1 of 8 styles failed")
    assert batch.result == {"queued": 0, "done": 7, "failed": 1, "cancelled": 0}
    assert styles.count_versions(database) == 7


def test_styles_without_consent_or_valid_demo_fail_and_the_others_continue(database: Database):
    styles.add_styles(database, 2)
    demo = cases.add_demo(database)
    cases.add_surgeon(database, "heron")
    cases.add_demo(database, surgeon="heron")
    job = styles.ask_retraining(database)
    with database.writing() as session:
        put_surgeon(session, "kestrel", SurgeonIn.model_validate(styles.NO_CONSENT), "test")
        heron = cases.Demonstration.surgeon.has(slug="heron")
        withdraw_demo(session, session.scalars(select(cases.Demonstration).where(heron)).one().sha256, "test")
    finish(database, job)
    reasons = {style.demonstration.surgeon.slug: style.reason for style in styles_of(database, job)}
    assert reasons["surgeon-0"] is None
    assert "does not cover training" in reasons["kestrel"]
    assert "was withdrawn" in reasons["heron"]
    assert (styles.look(database, job).result["done"], styles.look(database, job).result["failed"]) == (2, 2)
    assert demo.sha256 not in str(reasons)


def test_an_internal_failure_is_retried_and_then_only_its_style_gives_up(
    database: Database, in_one_part, before_learning
):
    job, part = in_one_part(5)
    bad = styles_of(database, job)[1].demonstration_row
    learnt = []

    def step(lesson: Lesson) -> None:
        learnt.append(lesson.row)
        if lesson.row == bad:
            raise RuntimeError("/srv/secret")

    before_learning(step)
    work = Work(database, Settings(database_url=database.url), perform_job)
    assert not work.try_once(part.row, 1, 0)
    assert styles.states_of(database, job) == ["done", "queued", "done", "done", "done"]
    assert styles.look(database, job).state == "running"
    assert 0.79 < styles.look(database, job).progress < 0.81
    assert not work.try_once(part.row, 1, 1)
    assert learnt.count(bad) == 3  # once among the others, and then alone
    work.give_up(part.row, 1)
    style = styles.styles_of(database, job)[1]
    assert style.state == "failed"
    assert "failed inside the service" in style.reason and "secret" not in style.reason
    batch = styles.look(database, job)
    assert (batch.state, batch.result["done"], batch.result["failed"]) == ("failed", 4, 1)


def test_a_style_at_which_its_worker_died_comes_last_the_next_time(database, in_one_part, before_learning, monkeypatch):
    job, part = in_one_part(4)
    deadly = styles_of(database, job)[1].demonstration_row

    class Death(BaseException):
        """An error that kills the worker."""

    def step(lesson: Lesson) -> None:
        if lesson.row == deadly:
            raise Death

    before_learning(step)
    monkeypatch.setattr(batches, "TOGETHER_S", 60.0)  # on a slow machine too
    for done in (0, 1, 3):  # at first it rolled back the others in its transaction
        assert start(database, part.row, 1)
        with pytest.raises(Death):
            perform_job(database, part.row, 1, Settings(database_url=database.url))
        assert styles.states_of(database, job).count("done") == done
    assert [style.tries for style in styles.styles_of(database, job)] == [2, 3, 2, 2]
    assert fail(database, part.row, 1, "The worker died at each attempt at this job.")
    assert styles.states_of(database, job) == ["done", "failed", "done", "done"]
    assert styles.look(database, job).state == "failed"


def test_a_style_refused_at_commit_does_not_roll_back_the_others(database: Database, in_one_part, before_learning):
    job, part = in_one_part(3)
    withdrawn = styles_of(database, job)[1].demonstration.sha256

    def step(lesson: Lesson) -> None:
        if lesson.sha256 == withdrawn:
            cases.committed(database, withdraw_demo, withdrawn, "test")

    before_learning(step)
    cases.work(database, part)
    assert styles.states_of(database, job) == ["done", "failed", "done"]
    assert "withdrawn while the training used it" in styles.styles_of(database, job)[1].reason
    assert styles.count_versions(database) == 2


def test_what_takes_long_is_committed_alone(database, in_one_part, before_learning, monkeypatch):
    monkeypatch.setattr(batches, "TOGETHER_S", 0.0)
    job, part = in_one_part(3)
    seen = []

    def step(lesson: Lesson) -> None:
        seen.append((states_of(database, job).count("done"), look(database, job).progress))

    before_learning(step)
    cases.work(database, part)
    assert [done for done, _ in seen] == [0, 1, 2]
    assert [round(progress, 6) for _, progress in seen] == [0.0, round(1 / 3, 6), round(2 / 3, 6)]


def test_a_worker_that_was_handed_two_parts_learns_one_after_the_other(
    database: Database, before_learning, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(retraining, "FEWEST_PARTS", 2)
    styles.add_styles(database, 6)
    job = styles.ask_retraining(database)
    parts = {style.demonstration_row: style.part_row for style in styles.styles_of(database, job)}
    learnt = []

    def step(lesson: Lesson) -> None:
        learnt.append(parts[lesson.row])
        time.sleep(0.02)  # long enough for the other thread to intervene

    before_learning(step)
    both = [Thread(target=cases.work, args=(database, part)) for part in parts_of(database, job)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert styles.states_of(database, job) == ["done"] * 6
    assert learnt in (sorted(learnt), sorted(learnt, reverse=True))


# ---- two workers on the same part


def test_a_late_result_changes_nothing_and_its_worker_does_what_is_left(
    database, in_one_part, before_learning, monkeypatch
):
    job, part = in_one_part(3)
    others, ended = [], []

    def step(lesson: Lesson) -> None:
        if not others:  # meanwhile another worker takes the part over, and finishes it
            others.append(lesson.row)
            with monkeypatch.context() as meanwhile:
                meanwhile.setattr(batches, "learn_style", learn_style)
                perform_job(database, part.row, 1, Settings(database_url=database.url))
            ended.append(look(database, job).ended_at)

    before_learning(step)
    cases.work(database, part)
    assert styles.states_of(database, job) == ["done"] * 3
    assert (styles.count_versions(database), styles.look(database, job).state) == (3, "succeeded")
    assert [styles.look(database, job).ended_at] == ended
    with database.reading() as session:
        finished = select(func.count()).where(Event.action == "finish", Event.object_id == job.id)
        assert session.scalar(finished) == 1
