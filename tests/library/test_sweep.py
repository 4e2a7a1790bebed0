"""Uploads in pieces, erasures in steps, retentions, and batches whose styles are added in steps."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import func, select, text, update
from sqlalchemy.orm import Session

from skills.db import models, now
from skills.db.service_tables import ErasedSurgeon, Event, Job, StyleToRetrain
from skills.db.session import Database
from skills.errors import Busy, NotFound
from skills.formats.parsed import parse_recording
from skills.library.operation import sweep
from skills.library.operation.jobs import cancel, find_job, identity_of, list_jobs
from skills.library.operation.sweep import STEADY_S, SteadyClock, drop_contents, sweep_erased
from skills.library.people.erasure import delete_recording, erase_surgeon
from skills.library.plans.plans import planned, trajectory_of
from skills.library.policies import retraining
from skills.library.policies.retraining import request_retraining
from skills.library.recordings import content_cache, recordings
from skills.library.recordings.recordings import find_recording, recording_bytes, store_recording, stored_recording
from skills.schemas.training import RetrainingIn
from skills.settings import Settings
from skills.verification.playback import Pictures
from tests.db.test_query_plans import noted
from tests.library import cases
from tests.library.styles import add_styles, ask_retraining, counted, finish, look, parts_of, styles_of
from tests.library.test_pictures import store_playback
from tests.planning.motions import ideal_playback

KIB = 1 << 10


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of 1 KiB, so that a recording of 3 kB has several, and three jobs in a step."""
    for room in (recordings, content_cache, sweep):
        monkeypatch.setattr(room, "CHUNK_BYTES", KIB)
        monkeypatch.setattr(room, "AT_ONCE_BYTES", KIB)
    monkeypatch.setattr("skills.library.people.erasure.AT_ONCE_BYTES", KIB)
    monkeypatch.setattr(sweep, "JOBS_AT_ONCE", 3)


def settings_of(database: Database, **days: float) -> Settings:
    return Settings(database_url=database.url, **days)


@contextmanager
def failing_at(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[list[int]]:
    """Let the writing transaction of this number, from 1, fail at its beginning, as if the process were killed."""
    begun: list[int] = []
    writing = Database.writing

    @contextmanager
    def counted(self: Database, names: Any = None) -> Iterator[Session]:
        begun.append(1)
        if len(begun) == number:
            raise KeyboardInterrupt
        with writing(self, names) as session:
            yield session

    with monkeypatch.context() as patched:
        patched.setattr(Database, "writing", counted)
        yield begun


def test_a_large_recording_is_stored_in_pieces_and_read_whole(database: Database, small: None):
    data = cases.hand_off()
    stored, new = store_recording(database, cases.upload(data), "test")
    assert new
    with database.reading() as session:
        chunks = session.scalar(select(func.count()).where(models.RecordingChunk.recording == stored.row))
        assert chunks == -(-len(data) // KIB) > 2
        assert b"".join(recording_bytes(session, find_recording(session, stored.sha256))) == data
    assert counted(database, models.LooseChunks) == 0
    assert counted(database, models.ParsedChunk) > 1
    again, new = store_recording(database, cases.upload(data), "test")
    assert (again.row, new) == (stored.row, False)


def test_an_upload_that_dies_anywhere_leaves_nothing_to_see_and_is_swept(
    database: Database, small: None, monkeypatch: pytest.MonkeyPatch
):
    data = cases.hand_off()
    before_row = -(-len(data) // KIB) + 2  # the reservation, the pieces, and the transaction that makes it visible
    for number in range(1, before_row + 1):
        with failing_at(monkeypatch, number), pytest.raises(KeyboardInterrupt):
            store_recording(database, cases.upload(data), "test")
        assert counted(database, models.StoredRecording) == 0
    left = counted(database, models.RecordingChunk)
    sweep_erased(database)
    assert counted(database, models.RecordingChunk) == left > 0, "an upload under way is left alone"
    assert not cases.wrong(database)
    with database.writing() as session:
        session.execute(update(models.LooseChunks).values(due_at=now()))
    sweep_erased(database)
    assert (counted(database, models.RecordingChunk), counted(database, models.LooseChunks)) == (0, 0)
    store_recording(database, cases.upload(data), "test")
    assert counted(database, models.StoredRecording) == 1


def test_pieces_that_were_swept_are_not_continued(database: Database, small: None, monkeypatch: pytest.MonkeyPatch):
    data = cases.hand_off()
    upload = cases.upload(data)
    add, swept = recordings._add_chunks, []

    def late(session: Session, row: int, number: int, piece: bytes) -> int:
        if not swept:
            swept.append(1)
            session.execute(update(models.LooseChunks).values(due_at=now() - timedelta(seconds=1)))
        return add(session, row, number, piece)

    monkeypatch.setattr(recordings, "_add_chunks", late)
    with pytest.raises(Busy, match="send it again"):
        store_recording(database, upload, "test")
    assert counted(database, models.StoredRecording) == 0


def test_a_content_half_cached_is_not_used_and_is_completed(
    database: Database, small: None, monkeypatch: pytest.MonkeyPatch
):
    stored, _ = store_recording(database, cases.upload(cases.hand_off()), "test")
    told = stored_recording(database, stored.sha256)
    with database.writing() as session:
        session.execute(update(models.ParsedRecording).values(version=content_cache.UNFINISHED))
        session.execute(text("DELETE FROM parsed_chunks WHERE number = 1"))
    chunks = counted(database, models.ParsedChunk)
    assert content_cache.alike(stored_recording(database, stored.sha256), told)
    assert counted(database, models.ParsedChunk) == chunks + 1
    with database.reading() as session:
        assert content_cache.cached_content(session, find_recording(session, stored.sha256)) is not None


def test_a_deleted_recording_is_gone_at_once_and_swept_later(database: Database, small: None):
    stored, _ = store_recording(database, cases.upload(cases.hand_off()), "test")
    cases.committed(database, delete_recording, stored.sha256, "test", as_admin=True)
    with database.reading() as session, pytest.raises(NotFound):
        find_recording(session, stored.sha256)
    assert counted(database, models.RecordingChunk) > 0
    again, _ = store_recording(database, cases.upload(cases.hand_off()), "test")  # with chunks of its own
    sweep_erased(database)
    with database.reading() as session:
        assert b"".join(recording_bytes(session, again)) == cases.hand_off()
        assert session.scalars(select(models.RecordingChunk.recording).distinct()).all() == [again.row]


def test_cached_content_is_dropped_in_steps_and_unused_from_the_first_on(
    database: Database, small: None, monkeypatch: pytest.MonkeyPatch
):
    data = cases.hand_off()
    stored, _ = store_recording(database, cases.upload(data), "test")
    chunks = counted(database, models.ParsedChunk)
    assert chunks > 2
    with failing_at(monkeypatch, 2), pytest.raises(KeyboardInterrupt):  # killed after the first step
        drop_contents(database, [stored.row])
    assert counted(database, models.ParsedChunk) == chunks - 1
    assert stored_recording(database, stored.sha256).recording.duration_s > 0, "decoded, and cached again"
    assert counted(database, models.ParsedChunk) == chunks
    with failing_at(monkeypatch, 0) as begun:
        drop_contents(database, [stored.row, stored.row + 1])  # the second one is gone
    assert (counted(database, models.ParsedChunk), len(begun)) == (0, chunks + 1)
    assert not cases.wrong(database)


def add_jobs(database: Database, number: int, **about: Any) -> None:
    with database.reading() as session:
        first = session.scalars(select(Job)).first()
    with database.writing() as session:
        session.add_all(
            Job(
                **{"id": f"{n:016x}", "kind": "training", "state": "succeeded", "ended_at": now()}
                | {"request": request, "identity": identity_of("training", request), "surgeon_row": first.surgeon_row}
                | about
            )
            for n in range(number)
            for request in [first.request | {"seed": 100 + n}]
        )


def test_an_erased_surgeons_jobs_are_gone_at_once_and_swept_later(
    database: Database, small: None, monkeypatch: pytest.MonkeyPatch
):
    cases.add_demo(database)
    cases.train(database, release=True)
    add_jobs(database, 10)
    cases.committed(database, erase_surgeon, "kestrel", "test")
    assert (counted(database, Job), counted(database, ErasedSurgeon)) == (11, 1)
    with database.reading() as session:
        assert list(list_jobs(session, 50, None, None)) == []
        with pytest.raises(NotFound):
            find_job(session, f"{9:016x}")
    assert not cases.wrong(database)
    with failing_at(monkeypatch, 3), pytest.raises(KeyboardInterrupt):  # killed in the middle
        sweep_erased(database)
    assert counted(database, Job) == 7, "one in the first step, three in the second"
    with noted(database) as asked:
        sweep_erased(database)
    assert (counted(database, Job), counted(database, ErasedSurgeon)) == (0, 0)
    assert sum("FROM jobs" in statement for statement, _ in asked) == 1, "for all its steps together"


def test_ended_jobs_are_deleted_after_their_retention_with_their_batch(database: Database, small: None):
    cases.add_demo(database)
    job = ask_retraining(database)
    finish(database, job)
    young = cases.train(database, seed=9)
    add_jobs(database, 7, ended_at=now() - timedelta(days=30))
    days = settings_of(database, keep_jobs_days=20)
    assert sweep.sweep(database, days)
    assert counted(database, StyleToRetrain) == 1, "the batch is young"
    events = counted(database, Event)
    with database.writing() as session:
        session.execute(text("UPDATE jobs SET ended_at = created_at"))
        old = now() - timedelta(days=30)
        session.execute(update(Job).where(Job.kind != "training").values(ended_at=old))
    assert sweep.sweep(database, days)
    with database.reading() as session:
        (left,) = session.scalars(select(Job)).all()
    assert left.result["sha256"] == young.sha256
    assert (counted(database, StyleToRetrain), counted(database, Event)) == (0, events)


def test_a_sweep_ends_in_time_and_says_that_something_is_left(database: Database, small: None):
    cases.add_demo(database)
    cases.train(database)
    add_jobs(database, 7, ended_at=now() - timedelta(days=30))
    days = settings_of(database, keep_jobs_days=20)
    assert not sweep.sweep(database, days, at_most_s=0.0)
    assert counted(database, Job) == 5
    assert sweep.sweep(database, days)
    assert counted(database, Job) == 1


def test_old_pictures_are_deleted_with_the_jobs_that_drew_them(database: Database, monkeypatch):
    monkeypatch.setattr(sweep, "PICTURES_AT_ONCE", 2)
    cases.add_demo(database)
    cases.train(database, release=True)
    plan = cases.add_plan(database)
    names = [f"{number:064x}" for number in range(5)]
    with database.writing() as session:
        measured = ideal_playback(trajectory_of(planned(session.get_one(models.Plan, plan.row))))
        playbacks = [store_playback(session, plan, name, measured) for name in names]
        session.execute(update(Job).where(Job.kind == "pictures").values(state="succeeded", ended_at=now()))
        for number, playback in enumerate(playbacks):
            drawn = models.StoredPictures(playback_row=playback.row, drawn=Pictures(b"mp4", b"gif", b"png", b"png"))
            drawn.created_at = now() - timedelta(days=(30, 10, 30, 30, 21)[number])
            session.add(drawn)
        last = identity_of("pictures", {"plan": plan.sha256, "playback": names[4]})
        session.execute(update(Job).where(Job.identity == last).values(state="running", ended_at=None))
    assert sweep.sweep(database, settings_of(database))
    assert counted(database, models.StoredPictures) == 5, "the default is a year"
    assert sweep.sweep(database, settings_of(database, keep_pictures_days=20))
    with database.reading() as session:
        assert session.scalars(select(models.StoredPictures.playback_row)).all() == [playbacks[1].row]
        asked = session.scalars(select(Job.request).where(Job.kind == "pictures").order_by(Job.row)).all()
        assert [one["playback"] for one in asked] == [names[1], names[4]]
        assert session.scalar(select(func.count()).where(Job.kind == "training")) == 1
    assert counted(database, models.StoredPlayback) == 5


def batch_of_two(database: Database, monkeypatch: pytest.MonkeyPatch, then: Callable[[Session, Job], None]) -> Job:
    """Ask for a batch of two styles, which are added one by one; a callback runs after each."""
    monkeypatch.setattr(retraining, "STYLES_AT_ONCE", 1)
    cases.add_surgeon(database, "osprey")
    for slug in ("kestrel", "osprey"):
        cases.add_demo(database, surgeon=slug)
    divide = retraining._divide

    def and_then(session: Session, job: Job, *styles: Any) -> None:
        divide(session, job, *styles)
        then(session, job)

    monkeypatch.setattr(retraining, "_divide", and_then)
    return ask_retraining(database)


def test_a_batch_does_not_end_before_all_its_styles_are_added(database: Database, monkeypatch: pytest.MonkeyPatch):
    def work(session: Session, job: Job) -> None:
        session.commit()
        for part in parts_of(database, job):
            if part.state == "queued":
                cases.work(database, part)
        assert look(database, job).state == "running"

    assert batch_of_two(database, monkeypatch, work).state == "succeeded"


def test_a_batch_whose_request_was_interrupted_fails_and_can_be_repeated(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    cases.add_demo(database)
    with failing_at(monkeypatch, 3), pytest.raises(KeyboardInterrupt):  # the one that completes it
        ask_retraining(database)
    sweep.sweep(database, settings_of(database))
    with database.reading() as session:
        (job,) = session.scalars(select(Job).where(Job.kind == "retraining")).all()
    assert job.state == "queued", "its request may still be at work"
    with database.writing() as session:
        session.execute(update(Job).values(created_at=now() - timedelta(hours=1)))
    sweep.sweep(database, settings_of(database))
    failed = look(database, job)
    assert (failed.state, failed.error) == ("failed", sweep.INTERRUPTED)
    assert [part.state for part in parts_of(database, job)] == ["cancelled"]
    again = ask_retraining(database)
    assert again.row != job.row


@pytest.mark.parametrize("killed", [2, 3, 4])  # before each of two styles, and before it is complete
def test_an_equal_request_goes_on_with_a_batch_that_was_interrupted(
    database: Database, monkeypatch: pytest.MonkeyPatch, killed: int
):
    monkeypatch.setattr(retraining, "STYLES_AT_ONCE", 1)
    add_styles(database, 2)
    with monkeypatch.context() as patched, failing_at(patched, killed), pytest.raises(KeyboardInterrupt):
        ask_retraining(database)
    again = request_retraining(database, RetrainingIn(), "test")
    assert len({one.demonstration_row for one in styles_of(database, again.job)}) == 2
    assert counted(database, StyleToRetrain) == 2 and again.new and finish(database, again.job).state == "succeeded"
    with database.reading() as session:
        assert session.scalar(select(func.count()).where(Job.kind == "retraining")) == 1
    assert not request_retraining(database, RetrainingIn(), "test").new


def test_two_equal_requests_that_add_styles_at_once_add_each_once(database: Database, monkeypatch: pytest.MonkeyPatch):
    others: list[bool] = []

    def ask_too(session: Session, job: Job) -> None:
        session.commit()
        if not others:
            others.append(True)
            assert request_retraining(database, RetrainingIn(), "test").job.row == job.row

    job = batch_of_two(database, monkeypatch, ask_too)
    assert counted(database, StyleToRetrain) == 2
    assert finish(database, job).state == "succeeded"


def test_a_batch_cancelled_while_styles_are_added_gets_no_more(database: Database, monkeypatch: pytest.MonkeyPatch):
    job = batch_of_two(database, monkeypatch, lambda session, job: cancel(session, job.id, "test"))
    assert (job.state, counted(database, StyleToRetrain)) == ("cancelled", 1)


def test_a_small_upload_needs_one_transaction(database: Database, monkeypatch: pytest.MonkeyPatch):
    with failing_at(monkeypatch, 99) as begun:
        store_recording(database, cases.upload(cases.hand_off()), "test")
    assert len(begun) == 1


def test_bytes_sent_twice_at_once_are_kept_once(database: Database, small: None):
    data = cases.hand_off()
    first, second = cases.upload(data), cases.upload(data)
    told = recordings.read_upload(first, parse_recording)
    ahead = [recordings.send_ahead(database, one) for one in (first, second)]
    assert None not in ahead and len(set(ahead)) == 2
    kept = []
    for upload, row in zip((first, second), ahead, strict=True):
        with database.writing() as session:
            kept.append(recordings.put_recording(session, upload, told, None, "test", row)[0].row)
    assert kept == [ahead[0], ahead[0]]
    sweep_erased(database)
    with database.reading() as session:
        assert session.scalars(select(models.RecordingChunk.recording).distinct()).all() == [ahead[0]]
        assert b"".join(recording_bytes(session, find_recording(session, first.sha256))) == data


def test_a_clock_that_is_set_ahead_deletes_nothing_by_its_age():
    """A worker deletes by age once the clock has run like the monotonic one for an hour."""
    wall_s, passed_s = 1000.0, 0.0
    clock = SteadyClock(lambda: wall_s, lambda: passed_s)

    def after(seconds: float, jump_s: float = 0.0) -> bool:
        nonlocal wall_s, passed_s
        wall_s, passed_s = wall_s + seconds + jump_s, passed_s + seconds
        return clock.is_steady()

    assert not after(0.0)
    assert not after(STEADY_S - 1.0)
    assert after(1.0)
    assert after(60.0, jump_s=5.0)  # as a clock that is corrected gently
    assert not after(60.0, jump_s=400 * 86_400.0)
    assert not after(60.0, jump_s=-400 * 86_400.0)
    assert not after(STEADY_S - 1.0)
    assert after(1.0)


def test_without_a_steady_clock_only_erasures_are_swept(database: Database):
    cases.add_surgeon(database)
    cases.add_demo(database)
    ended = cases.work(database, cases.ask_training(database))
    with database.writing() as session:
        session.execute(update(Job).values(ended_at=now() - timedelta(days=400)))
        session.add(ErasedSurgeon(surgeon_row=99))
    assert sweep.sweep(database, settings_of(database), by_age=False)
    assert (counted(database, Job), counted(database, ErasedSurgeon)) == (1, 0)
    assert sweep.sweep(database, settings_of(database))
    assert counted(database, Job) == 0, ended.id
