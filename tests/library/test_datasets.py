"""Exports of datasets: the same numbers again, only what was consented to, gone with what they contain."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from sqlalchemy import delete, select, text

from skills.db.models import Demonstration, ParsedRecording, StoredRecording
from skills.db.row_visibility import Only
from skills.db.service_tables import DatasetDemonstration, Event, Job
from skills.db.session import Database
from skills.errors import BadInput, Conflict, NotFound, TooLarge
from skills.formats.parsed import ParsedContent
from skills.formats.reader_process import ConfinedReader
from skills.library.operation.jobs import cancel, find_job, list_jobs
from skills.library.people import consent
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.perform import perform_job
from skills.library.recordings.datasets import DatasetRequest, delete_dataset, export_dataset, find_dataset
from skills.library.recordings.demos import mark_demo, withdraw_demo
from skills.library.recordings.recordings import store_recording
from skills.remedies import Door
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from tests.library import cases, exports
from tests.library.cases import wrong
from tests.library.exports import PASS_S, add, ask, export, kept, members, read_episode, session_of, zip_of
from tests.library.test_consent import ALL, agree

NO_EXPORT = {"uses": ["training"], "until": None}
NONE_LEFT = (0, 0, 0)
SHIFT = (2.5, 0.0, 0.0)


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "confined" not in request.node.name:
        exports.in_this_process(monkeypatch)


def two_surgeons(database: Database, *, apart: bool = True) -> tuple[str, str]:
    """Store one recording with a hand-off of kestrel and one of wren, one after another or at the same time."""
    cases.add_surgeon(database, "wren")
    both = session_of((0.0, 0.0, 0.0), SHIFT)
    first = add(database, both, start_s=0.0, end_s=PASS_S - 0.02)
    second = (PASS_S, 2 * PASS_S) if apart else (PASS_S / 2, 2 * PASS_S)
    return first, add(database, both, "wren", start_s=second[0], end_s=second[1] - 0.02)


def state(found: Any) -> np.ndarray:
    """Return what a dataset has of a recording: positions in m, rotations, jaws, in single precision."""
    parts = [[one.tip_mm / 1000.0, one.rotation_xyzw, found.jaw_of(one.arm).values[:, None]] for one in found.motions]
    return np.concatenate([part for parts_of in parts for part in parts_of], axis=1).astype(np.float32)


# ---- contents ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_export_read_again_has_the_same_bits(database: Database, tmp_path: Path, version: str):
    given = session_of((0.0, 0.0, 0.0), SHIFT)
    add(database, given, start_s=0.0, end_s=PASS_S - 0.02)
    add(database, given, start_s=PASS_S, end_s=2 * PASS_S - 0.02)
    data = zip_of(database, export(database, version=version))
    for number in range(2):
        again = read_episode(data, tmp_path, number)
        assert [(one.arm, one.frame) for one in again.motions] == [("PSM1", "PSM1_base"), ("PSM2", "PSM2_base")]
        np.testing.assert_array_equal(state(again), state(given)[60 * number : 60 * number + 60])


def test_a_whole_recording_is_one_episode_of_all_its_hand_offs(database: Database, tmp_path: Path):
    two_surgeons(database)
    data = zip_of(database, export(database, whole=True))
    info = json.loads(members(data)["meta/info.json"])
    assert (info["total_episodes"], info["total_frames"]) == (1, 120)
    np.testing.assert_array_equal(state(read_episode(data, tmp_path, 0)), state(session_of((0.0, 0.0, 0.0), SHIFT)))


def test_an_interval_contains_nothing_from_outside(database: Database):
    """The jaw numbers the samples, and of kestrel are those below 60."""
    two_surgeons(database)
    for fps in (7, 33, 50):
        data = members(zip_of(database, export(database, surgeons=["wren"], fps=fps)))
        stats = json.loads(data["meta/episodes_stats.jsonl"])["stats"]["observation.state"]
        assert stats["min"][7] >= 60 / 1024
        assert stats["max"][7] <= 119 / 1024


def test_a_dataset_has_no_pseudonym_and_states_its_terms(database: Database):
    cases.add_surgeon(database, "wren", consent={"uses": ["export"], "until": "2099-05-31"})
    demos = add(database, session_of()), add(database, session_of(SHIFT), "wren")
    asked = {"name": "Running sutures", "licence": "CC-BY-4.0", "description": "Two.", "procedure": "On a bench."}
    data = zip_of(database, export(database, **asked))
    files = members(data)
    for name in ("kestrel", "wren", "test", *demos):
        assert not any(name.encode() in content for content in (*files.values(), *(one.encode() for one in files)))
    readme = files["meta/README.md"].decode()
    for said in (
        *asked.values(),
        "Surgeons recorded: 2.",
        "Agreed to an export: 1; the first of these consents ends on 2099-05-31.",
        "Without a recorded consent, so that the protocol of the study decides: 1.",
        "Each episode is one needle hand-off",
        "Splits, by surgeon",
    ):
        assert said in readme
    lines = dict(reversed(line.split("  ")) for line in files["SHA256SUMS"].decode().splitlines())
    assert lines == {n: hashlib.sha256(one).hexdigest() for n, one in files.items() if n != "SHA256SUMS"}


def splits_of(database: Database) -> list[str]:
    with database.reading() as session:
        return sorted(session.scalars(select(DatasetDemonstration.split)))


def test_outcomes_are_splits_and_left_out_unless_requested(database: Database):
    demos = [add(database, session_of((0.5 * k, 0.0, 0.0))) for k in range(4)]
    with database.writing() as session:
        mark_demo(session, demos[0], "failure", "it fell", "test")
        mark_demo(session, demos[1], "recovery", "regrasped", "test")
        mark_demo(session, demos[2], "success", None, "test")
    info = json.loads(members(zip_of(database, export(database)))["meta/info.json"])
    assert info["splits"] == {"train": "0:2"}
    with pytest.raises(Conflict, match="is marked failure; leave it out"):
        ask(database, demos=demos)
    info = json.loads(members(zip_of(database, export(database, demos=demos, outcomes="any")))["meta/info.json"])
    assert info["splits"] == {"train": "0:2", "recovery": "2:3", "failure": "3:4"}


def test_a_surgeon_or_a_session_is_in_one_split(database: Database):
    for k in range(10):
        both = session_of((0.3 * k, 0.0, 0.0), (0.3 * k, 0.0, 0.1))
        add(database, both, start_s=0.0, end_s=PASS_S - 0.02)
        add(database, both, start_s=PASS_S, end_s=2 * PASS_S - 0.02)
    ask(database)
    assert splits_of(database) == ["train"] * 20
    job = ask(database, split="session")
    with database.reading() as session:
        rows = select(DatasetDemonstration).where(DatasetDemonstration.job_row == job.row)
        splits = [one.split for one in session.scalars(rows.order_by(DatasetDemonstration.demonstration_row))]
    assert splits[::2] == splits[1::2]
    assert {name: splits.count(name) for name in splits} == {"train": 16, "val": 2, "test": 2}


def test_surgeons_in_one_whole_recording_share_a_split(database: Database):
    two_surgeons(database)
    add(database, session_of((1.0, 0.0, 0.0)), "wren")
    add(database, session_of((1.5, 0.0, 0.0)))
    ask(database, whole=True)
    assert splits_of(database) == ["train"] * 4


def test_arms_are_those_of_all_recordings(database: Database):
    add(database, session_of())
    add(database, session_of(SHIFT, arms=("PSM1", "PSM3")))
    assert ask(database).request["arms"] == ["PSM1"]
    with pytest.raises(BadInput, match="has no pose of PSM2"):
        ask(database, arms=["PSM1", "PSM2"])
    add(database, session_of((3.0, 0.0, 0.0), arms=("PSM2",)), arm="PSM2")
    with pytest.raises(BadInput, match="no arm in common"):
        ask(database)


def test_a_recording_without_a_jaw_fails_the_job_by_name(database: Database):
    demo = add(database, replace(session_of(), jaws=()))
    job = cases.work(database, ask(database))
    assert job.state == "failed"
    assert f"Episode 0 (demonstration {demo[:12]}) has no jaw of PSM1" in job.error


@pytest.mark.parametrize(
    ("asked", "error", "words"),
    [
        ({"surgeons": ["nobody"]}, NotFound, "no surgeon"),
        ({"sutures": ["nowhere"]}, NotFound, "no suture type"),
        ({"demos": ["0" * 64]}, NotFound, "no demonstration"),
        ({"sutures": ["simple-interrupted"]}, Conflict, "no demonstration to export"),
    ],
    ids=["surgeon", "suture", "demo", "nothing"],
)
def test_what_is_not_there_is_refused(database: Database, asked: dict[str, Any], error: type, words: str):
    add(database, session_of())
    with pytest.raises(error, match=words):
        ask(database, **asked)
    assert kept(database) == NONE_LEFT


def test_a_demonstration_named_twice_is_refused(database: Database):
    demo = add(database, session_of())
    with pytest.raises(BadInput, match="named twice"):
        ask(database, demos=[demo, demo[:12]])


def test_a_dataset_over_the_limit_is_not_stored(database: Database):
    add(database, session_of())
    with pytest.raises(TooLarge, match="larger than 1000 bytes; export fewer"):
        perform(database, ask(database), max_dataset_bytes=1000)
    assert kept(database) == (0, 0, 1)


def test_a_confined_reader_reads_what_is_not_cached(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, session_of())
    tell, told = ConfinedReader.parse, []

    def counted(reader: ConfinedReader, *given: Any, **how: Any) -> ParsedContent:
        told.append(reader)
        return tell(reader, *given, **how)

    monkeypatch.setattr(ConfinedReader, "parse", counted)
    assert zip_of(database, export(database))
    assert told == []
    with database.writing() as session:
        session.execute(delete(ParsedRecording))
    assert zip_of(database, export(database, fps=25))
    assert len(told) == 1  # and cached then


# ---- the job -------------------------------------------------------------------------------------------------------


def perform(database: Database, job: Job, **settings: Any) -> None:
    """Run a job without a worker around it."""
    running(database, job)
    perform_job(database, job.row, job.attempt, Settings(database_url=database.url, **settings))


def running(database: Database, job: Job) -> None:
    with database.writing() as session:
        session.get_one(Job, job.row).state = "running"


def test_an_equal_request_is_the_same_job_and_another_is_another(database: Database):
    demo = add(database, session_of())
    job = ask(database)
    assert ask(database).row == job.row == ask(database, demos=[demo[:16]]).row
    assert ask(database, fps=25).row != job.row
    cases.committed(database, mark_demo, demo, "failure", "it fell", "test")
    assert ask(database, outcomes="any").row != job.row  # its split is another one


def test_two_workers_and_a_second_attempt_store_one_dataset(database: Database):
    add(database, session_of())
    job = ask(database)
    both = [Thread(target=cases.work, args=(database, job)) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert kept(database) == (1, 1, 1)


def test_a_second_attempt_writes_the_same_bytes(database: Database):
    """A worker that crashes before it stores has changed nothing; the next one writes the same."""
    add(database, session_of())
    job = ask(database)
    running(database, job)
    cut_short = export_dataset(database, DatasetRequest.model_validate(job.request), Settings())
    assert kept(database) == (0, 0, 1)
    with database.writing() as session:
        digest = cut_short(session, "test").dataset
        session.rollback()
    assert kept(database) == (0, 0, 1)
    assert cases.work(database, job).result["dataset"] == digest


def test_a_cancelled_export_stores_nothing(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, session_of())
    job = ask(database)
    midway(monkeypatch, lambda: cancelled(database, job))
    with pytest.raises(Conflict, match="cancelled while it ran"):
        perform(database, job)
    assert kept(database) == (0, 0, 1)


def cancelled(database: Database, job: Job) -> None:
    cases.committed(database, cancel, job.id, "test")


def midway(monkeypatch: pytest.MonkeyPatch, happens: Callable[[], None]) -> None:
    """Run a callback after the export has begun, before it reads the first recording."""
    episodes = exports_module()._episodes

    def then(session: Any, job_row: int) -> Any:
        found = episodes(session, job_row)
        session.close()
        happens()
        return found

    monkeypatch.setattr("skills.library.recordings.datasets._episodes", then)


def exports_module() -> Any:
    from skills.library.recordings import datasets

    return datasets


def test_the_events_name_everybody_whose_data_is_exported(database: Database):
    two_surgeons(database)
    dataset = export(database, whole=True)
    with database.reading() as session:
        exported = select(Event.subject).where(Event.action == "export", Event.object_id == dataset)
        subjects = {find_surgeon(session, name).subject for name in ("kestrel", "wren")}
        assert {*session.scalars(exported)} == subjects


def test_a_deleted_dataset_can_be_requested_again(database: Database):
    add(database, session_of())
    dataset = export(database)
    cases.committed(database, delete_dataset, dataset, "test")
    assert kept(database) == NONE_LEFT
    export(database)


def test_damage_of_a_dataset_is_found(database: Database):
    add(database, session_of())
    export(database)
    assert not wrong(database)
    with database.writing() as session:
        session.execute(text("DELETE FROM dataset_chunks"))
    assert [why for _, why in wrong(database)] == [
        "it does not match its digest",
        f"it has 0 bytes, its row has {size_of(database)}",
    ]


def size_of(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(text("SELECT size_bytes FROM datasets")) or 0


# ---- consent -------------------------------------------------------------------------------------------------------


def test_consent_is_required_for_a_request(database: Database):
    add(database, session_of())
    agree(database, NO_EXPORT)
    with pytest.raises(Conflict, match="consent of 'kestrel' does not cover export"):
        ask(database)
    assert kept(database) == NONE_LEFT


def test_a_surgeon_without_consent_can_be_left_out_by_name(database: Database):
    kept_one, _ = two_surgeons(database)
    agree(database, NO_EXPORT, "wren")
    with pytest.raises(Conflict) as refused:
        ask(database)
    assert "without_surgeons" in refused.value.words(Door.HTTP)
    job = ask(database, without_surgeons=["wren"])
    assert (job.request["episodes"], counted_demos(database, job)) == (1, [kept_one])
    with pytest.raises(Conflict, match="another surgeon"):
        ask(database, without_surgeons=["wren"], whole=True)
    with pytest.raises(ValueError, match="but not both"):
        ask(database, without_surgeons=["wren"], demos=[kept_one])


def counted_demos(database: Database, job: Job) -> list[str]:
    """Return the demonstrations of an export."""
    of = DatasetDemonstration
    query = (
        select(Demonstration.sha256).join(of, of.demonstration_row == Demonstration.row).where(of.job_row == job.row)
    )
    with database.reading() as session:
        return [*session.scalars(query)]


def test_consent_withdrawn_during_the_job_stores_nothing(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, session_of())
    job = ask(database)
    midway(monkeypatch, lambda: agree(database, NO_EXPORT))
    assert cases.work(database, job).state == "failed"
    assert kept(database) == (0, 0, 1)


def test_consent_withdrawn_or_expired_refuses_a_download(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, session_of())
    dataset = export(database)
    agree(database, NO_EXPORT)
    with pytest.raises(Conflict, match="consent of 'kestrel' does not cover export"):
        zip_of(database, dataset)
    with pytest.raises(Conflict):
        ask(database)  # nor does an equal request lead to it
    agree(database, ALL | {"until": str(consent.today())})
    assert zip_of(database, dataset)
    tomorrow = consent.today() + timedelta(days=1)
    monkeypatch.setattr(consent, "today", lambda: tomorrow)
    with pytest.raises(Conflict, match="expired on"):
        zip_of(database, dataset)


def test_a_withdrawn_demonstration_refuses_a_download(database: Database):
    demo = add(database, session_of())
    dataset = export(database)
    cases.committed(database, withdraw_demo, demo, "test")
    with pytest.raises(Conflict, match="was withdrawn; export the others again"):
        zip_of(database, dataset)
    with pytest.raises(Conflict, match=f"demonstration {demo[:12]} was withdrawn"):
        ask(database, demos=[demo])


@pytest.mark.parametrize(
    ("apart", "whole", "refused"), [(True, False, False), (False, False, True), (True, True, True)],
    ids=["one after another", "at the same time", "the whole recording"],
)  # fmt: skip
def test_everybody_who_can_be_seen_consents(database: Database, apart: bool, whole: bool, refused: bool):
    two_surgeons(database, apart=apart)
    asked = {"surgeons": ["kestrel"], "whole": whole}
    dataset = export(database, **asked)
    agree(database, NO_EXPORT, "wren")
    if refused:
        with pytest.raises(Conflict, match="another surgeon whose consent does not cover export") as error:
            ask(database, **asked)
        assert "wren" not in str(error.value)
        with pytest.raises(Conflict, match="another surgeon"):
            zip_of(database, dataset)
    else:
        assert ask(database, **asked).state == "succeeded"
        assert zip_of(database, dataset)


def test_a_hand_off_added_later_needs_consent_too(database: Database):
    both = session_of((0.0, 0.0, 0.0), SHIFT)
    add(database, both, start_s=0.0, end_s=PASS_S - 0.02)
    dataset = export(database, whole=True)
    cases.add_surgeon(database, "wren", consent=NO_EXPORT)
    assert zip_of(database, dataset)
    add(database, both, "wren", start_s=PASS_S, end_s=2 * PASS_S - 0.02)
    with pytest.raises(Conflict, match="another surgeon"):
        zip_of(database, dataset)


@pytest.mark.parametrize("whole", [False, True])
def test_a_recording_needs_the_surgeon_it_was_uploaded_for(database: Database, whole: bool):
    from skills.formats import write_mcap

    cases.add_surgeon(database, "wren", consent=NO_EXPORT)
    add(database, session_of())
    sent = cases.upload(write_mcap(session_of()), "application/vnd.mcap")
    store_recording(database, sent, "test", surgeon="wren")
    with pytest.raises(Conflict, match="another surgeon"):
        ask(database, whole=whole)


# ---- erasure and visibility ----------------------------------------------------------------------------------------


def test_erasing_a_demonstration_deletes_the_datasets_with_it(database: Database):
    first, _ = add(database, session_of()), add(database, session_of(SHIFT))
    export(database)
    export(database, demos=[first])
    cases.committed(database, erase_demo, first, "test")
    assert kept(database) == NONE_LEFT
    export(database)


@pytest.mark.parametrize(
    ("apart", "whole", "gone"), [(True, False, False), (False, False, True), (True, True, True)],
    ids=["one after another", "at the same time", "the whole recording"],
)  # fmt: skip
def test_erasing_a_surgeon_deletes_the_datasets_with_them(database: Database, apart: bool, whole: bool, gone: bool):
    two_surgeons(database, apart=apart)
    export(database, surgeons=["kestrel"], whole=whole)
    cases.committed(database, erase_surgeon, "wren", "test")
    assert kept(database) == (NONE_LEFT if gone else (1, 1, 1))
    assert not wrong(database)


@pytest.mark.parametrize("whole", [False, True])
def test_erasing_a_surgeon_whom_an_upload_named_deletes_it(database: Database, whole: bool):
    from skills.formats import write_mcap

    cases.add_surgeon(database, "wren")
    add(database, session_of())
    sent = cases.upload(write_mcap(session_of()), "application/vnd.mcap")
    store_recording(database, sent, "test", surgeon="wren")
    export(database, whole=whole)
    with database.writing() as session:
        erase_surgeon(session, "wren", "test")
        assert session.query(StoredRecording).count() == 1  # kestrel's demonstration is of it
    assert kept(database) == NONE_LEFT


def test_erasing_drops_an_export_that_is_queued_or_runs(database: Database):
    demo = add(database, session_of())
    job = ask(database)
    assert cases.committed(database, erase_demo, demo, "test") == [(job.row, job.attempt)]
    assert kept(database) == NONE_LEFT


def test_erasing_during_the_job_stores_nothing(database: Database, monkeypatch: pytest.MonkeyPatch):
    add(database, session_of())
    job = ask(database)

    def erased() -> None:
        cases.committed(database, erase_surgeon, "kestrel", "test")

    midway(monkeypatch, erased)
    with pytest.raises(Conflict, match="cancelled while it ran"):
        perform(database, job)
    assert kept(database) == NONE_LEFT


def test_a_dataset_is_hidden_with_any_of_its_surgeons(database: Database):
    two_surgeons(database)
    of_both, of_kestrel = export(database), export(database, surgeons=["kestrel"])
    with database.reading() as session:
        rows = {name: find_surgeon(session, name).row for name in ("kestrel", "wren")}
        [one] = [job.id for job in list_jobs(session, 10, None, None) if job.result["dataset"] == of_both]
    seeing = {name: database.seen_by(Only("ada", frozenset({row}))) for name, row in rows.items()}
    assert zip_of(seeing["kestrel"], of_kestrel)
    for name, dataset in (("kestrel", of_both), ("wren", of_both), ("wren", of_kestrel)):
        with pytest.raises(NotFound), seeing[name].reading() as session:
            find_dataset(session, dataset)
        with pytest.raises(NotFound), seeing[name].reading() as session:
            find_job(session, one)
    everybody = database.seen_by(Only("ada", frozenset(rows.values())))
    assert zip_of(everybody, of_both)
    ask(seeing["wren"])  # all that wren may see
    cases.committed(database, put_surgeon, "kestrel", SurgeonIn.model_validate({"consent": NO_EXPORT}), "anna")
    assert ask(seeing["wren"]).request["episodes"] == 1
