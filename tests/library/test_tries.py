"""Tries: each step on a synthetic bag, every question with its answers, every refusal with its remedy."""

from collections.abc import Callable
from copy import copy
from io import BytesIO
from itertools import count
from typing import Any

import numpy as np
import pytest
from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, ParsedRecording, Plan, PolicyVersion, Release, StoredPlayback, Surgeon
from skills.db.service_tables import Event, Job
from skills.db.session import Database
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Motion, Recording
from skills.errors import BadSettings, Conflict, NotFound
from skills.formats import read_recording, write_mcap
from skills.gridworld.grid import GridWorld, choose_grid
from skills.jobs.workflows import Work
from skills.library.operation import jobs
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.perform import perform_job
from skills.library.plans.tries import CELLS_MM, choose_cells, request_try
from skills.library.recordings.demos import add_demo
from skills.library.recordings.recordings import store_recording
from skills.schemas.demos import DemoIn
from skills.schemas.people import SurgeonIn
from skills.schemas.tries import LOSS_MM, TryIn
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings
from tests.by_day import some
from tests.library import cases
from tests.library.styles import counted
from tests.model.replaced import Interruptible

MCAP = "application/vnd.mcap"
ANSWERS: dict[str, Any] = {"tissue_mm": -170.0, "errors": "calibrated", "release": True}


def stored(database: Database, data: bytes | None = None) -> str:
    return store_recording(database, cases.upload(data or cases.bag(), MCAP), "test", surgeon="kestrel")[0].sha256


def tried(database: Database, recording: str, **asked: Any) -> Job:
    with database.writing() as session:
        said = TryIn(recording=recording, surgeon="kestrel", suture=cases.SUTURE, **asked)
        job = request_try(session, said, "test").job
    return cases.work(database, job)


def steps(job: Job) -> list[dict[str, Any]]:
    assert job.result is not None
    found: list[dict[str, Any]] = job.result["steps"]
    return found


def named(job: Job, state: str) -> list[str]:
    return [one["name"] for one in steps(job) if one["state"] == state]


def in_frame(frame: str) -> bytes:
    """Return the hand-off as a bag whose poses are in a frame that is no arm's base."""
    tip = cases.points_mm()
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    down = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (len(tip), 1))
    motion = Motion("PSM2", "/PSM2/measured_cp", frame, stamps_ns, tip, down)
    return write_mcap(Recording(format="mcap", integrity="full", motions=(motion,)))


@pytest.mark.needs("simulator")
def test_a_bag_comes_to_a_verdict_with_every_question_answered(database: Database) -> None:
    job = tried(database, stored(database), **ANSWERS)
    assert job.state == "succeeded", job.error
    done = ["read", "propose", "cut", "report", "train", "certify", "plan", "play", "verdict", "release"]
    assert named(job, "done") == done and len(steps(job)) == len(done)
    with database.reading() as session:
        (demo,), (version,) = session.scalars(select(Demonstration)).all(), session.scalars(select(PolicyVersion)).all()
        (plan,), (playback,) = session.scalars(select(Plan)).all(), session.scalars(select(StoredPlayback)).all()
        (release,) = session.scalars(select(Release)).all()
        ids = {one["name"]: one["id"] for one in steps(job) if one["id"]}
        assert ids == {
            **{"cut": demo.sha256, "train": version.sha256, "certify": version.sha256, "release": version.sha256},
            **{"plan": plan.sha256, "play": playback.sha256, "verdict": playback.sha256},
        }
        assert release.policy_row == version.row
        assert plan.about.passes[0].position_mm == version.manifest.goal_mm
        assert playback.feasible and playback.report.estimate.under[0].errors.name == "calibrated"
    assert "feasible in an exact simulation" in steps(job)[-2]["text"]


def test_open_questions_end_a_try_and_nothing_is_released(database: Database) -> None:
    recording = stored(database)
    job = tried(database, recording)
    assert (job.state, named(job, "asks")) == ("succeeded", ["tissue", "errors", "release"])
    for name in ("tissue", "errors", "release"):
        (step,) = [one for one in steps(job) if one["name"] == name]
        for choice in step["choices"]:
            TryIn(recording=recording, surgeon="kestrel", suture=cases.SUTURE, **choice["change"])
    half = tried(database, recording, tissue_mm="none", errors="calibrated")
    assert named(half, "asks") == ["release"]
    assert counted(database, Release) == counted(database, Plan) == 0
    assert counted(database, PolicyVersion) == 1  # found again, not learnt as another version


def test_of_several_hand_offs_one_is_asked_for(database: Database) -> None:
    sample = sample_recordings()[4]
    recording = stored(database, sample.data)
    asked = steps(tried(database, recording))[-1]
    assert (asked["name"], asked["state"]) == ("propose", "asks")
    parts = [choice["change"]["segment"] for choice in asked["choices"]]
    assert parts == [*range(1, len(sample.segments) + 1), "whole"]
    taken = tried(database, recording, **asked["choices"][1]["change"])
    assert "Taken: proposal 2" in steps(taken)[1]["text"]
    with database.reading() as session:
        (demo,) = session.scalars(select(Demonstration)).all()
        assert demo.start_s == pytest.approx(sample.segments[1][0], abs=0.6)


@pytest.mark.parametrize("number", [0, 3])
@pytest.mark.parametrize("loss_mm", [LOSS_MM, 1.4])
def test_the_coarsest_cells_that_lose_little_are_chosen(number: int, loss_mm: float) -> None:
    sample = sample_recordings()[number]
    demo = cut_demo(read_recording(BytesIO(sample.data)), start_s=sample.segments[0][0], end_s=sample.segments[0][1])
    asked = TryIn(recording="0" * 64, surgeon="kestrel", suture=cases.SUTURE, loss_mm=loss_mm)
    chosen, measured = choose_cells(demo, asked)

    def lost_mm(grid: GridWorld, hysteresis: float) -> float:
        """Walk through the samples one by one, as the rule of hysteresis is written."""
        at, squares = grid.cells_at(demo.tip_mm[0]), []
        for tip in demo.tip_mm:
            if (np.abs(tip - grid.origin_mm - grid.cell_mm * at) > (0.5 + hysteresis) * grid.cell_mm).any():
                at = grid.cells_at(tip)
            squares.append(((tip - grid.origin_mm - grid.cell_mm * at) ** 2).sum())
        return float(np.sqrt(np.mean(squares)))

    losses = {one.cell_mm: lost_mm(choose_grid(demo.tip_mm, "auto", one.cell_mm), one.hysteresis) for one in measured}
    assert [*losses] == [*CELLS_MM]
    assert {one.cell_mm: one.loss_mm for one in measured} == pytest.approx(losses)
    assert chosen.cell_mm == max(cell_mm for cell_mm, lost in losses.items() if lost <= loss_mm)
    assert f"{losses[chosen.cell_mm]:.2f} mm" in chosen.because and f"at most {loss_mm:g} mm" in chosen.because


def test_a_loss_that_no_cells_reach_is_refused_with_the_least(database: Database) -> None:
    job = tried(database, stored(database), loss_mm=0.01)
    assert job.state == "failed" and "the finest lose" in (job.error or "")
    refused = steps(job)[-1]
    assert (refused["name"], refused["state"]) == ("cut", "refused")
    assert refused["text"] == job.error
    accepted, *_, whole = (choice["change"] for choice in refused["choices"])
    assert whole == {"segment": "whole"}
    assert "1 mm cells" in steps(tried(database, stored(database), **accepted))[2]["text"]


def test_stated_cells_are_taken_without_a_choice(database: Database) -> None:
    job = tried(database, stored(database), cell_mm=3.0, hysteresis=0.1)
    assert "3 mm cells with hysteresis 0.1, as stated" in steps(job)[2]["text"]
    with database.reading() as session:
        (demo,) = session.scalars(select(Demonstration)).all()
        assert (demo.path.grid.cell_mm, demo.path.hysteresis) == (3.0, 0.1)


def test_a_policy_that_may_not_be_released_says_so_and_is_not(database: Database) -> None:
    job = tried(database, stored(database, in_frame("ECM")), **ANSWERS)
    assert job.state == "failed"
    assert named(job, "refused") == ["certify", "play"]
    certify, play = (one for one in steps(job) if one["state"] == "refused")
    assert "not the arm's base" in certify["text"] and "local/measured_cp" in certify["remedies"][0]
    assert {"cell_mm": 4.0, "hysteresis": 0.0} in [choice["change"] for choice in certify["choices"]]
    assert play["text"].startswith((job.error or "")[:40])
    assert counted(database, Release) == 0


@pytest.mark.needs("simulator")
def test_a_try_that_releases_nothing_says_which_version_is_served(database: Database) -> None:
    recording = stored(database)
    assert steps(tried(database, recording, **ANSWERS))[-1]["text"] == "Version 1 is served now."
    again = steps(tried(database, recording, **ANSWERS | {"release": False}))[-1]["text"]
    assert again == "Version 1 is not released by this: that was not requested. Version 1 is served."
    other = steps(tried(database, recording, **ANSWERS | {"release": False, "cell_mm": 4.0}))[-1]["text"]
    assert other == "Version 2 is not released by this: that was not requested. Version 1 is served."


def test_a_try_is_repeated_after_it_ended_and_not_before(database: Database) -> None:
    recording = stored(database)
    asked = TryIn(recording=recording[:12], surgeon="kestrel", suture=cases.SUTURE)
    with database.writing() as session:
        first = request_try(session, asked, "test")
        second = request_try(session, asked, "test")
        assert (first.new, second.new, first.job.id) == (True, False, second.job.id)
        assert first.job.request["recording"] == recording
    assert cases.work(database, first.job).state == "succeeded"
    with database.writing() as session:
        assert request_try(session, asked, "test").new


def test_a_cancelled_try_stops_at_its_next_step(database: Database) -> None:
    recording = stored(database)
    with database.writing() as session:
        job = request_try(session, TryIn(recording=recording, surgeon="kestrel", suture=cases.SUTURE), "test").job
        session.execute(update(Job).where(Job.row == job.row).values(state="cancelled"))
    assert cases.work(database, job).state == "cancelled"
    assert counted(database, Demonstration) == 0


def test_what_is_not_there_or_not_consented_is_refused_at_once(database: Database) -> None:
    recording = stored(database)
    cases.committed(database, cases.agree, {"uses": ["export"]}, "heron")
    for surgeon, known, error in (
        ("nobody", recording, NotFound),
        ("kestrel", "0" * 64, NotFound),
        ("heron", recording, Conflict),
    ):
        with pytest.raises(error), database.writing() as session:
            request_try(session, TryIn(recording=known, surgeon=surgeon, suture=cases.SUTURE), "test")


def test_an_erased_demonstration_takes_its_tries_along(database: Database) -> None:
    recording = stored(database)
    job = tried(database, recording)
    (digest,) = {one["id"] for one in steps(job) if one["name"] == "cut"}
    cases.committed(database, erase_demo, digest, "test")
    assert counted(database, Job) == 0


def erase_its_demo(session: Session, job: Job) -> None:
    mine = select(Demonstration.sha256).where(Demonstration.surgeon_row == job.surgeon_row)
    for digest in session.scalars(mine).all():
        erase_demo(session, digest, "test")


def erase_its_surgeon(session: Session, job: Job) -> None:
    erase_surgeon(session, session.get_one(Surgeon, job.surgeon_row).slug, "test")


def cancel_it(session: Session, job: Job) -> None:
    jobs.cancel(session, job.id, "test")


def start_it_over(session: Session, job: Job) -> None:
    session.execute(update(Job).where(Job.row == job.row).values(attempt=job.attempt + 1))


def allow_nothing(session: Session, job: Job) -> None:
    put_surgeon(
        session,
        session.get_one(Surgeon, job.surgeon_row).slug,
        SurgeonIn.model_validate({"consent": {"uses": []}}),
        "test",
    )


STORED = (Demonstration, ParsedRecording, PolicyVersion, Release, Plan, StoredPlayback, Event)
ENDINGS = (erase_its_demo, erase_its_surgeon, cancel_it, start_it_over, allow_nothing)


def ended_before(last: int, database: Database, job: Job, ending: Callable[[Session, Job], None]) -> bool:
    """Perform a try that ends before a transaction of it; return whether it had so many."""
    worker, at = copy(database), 0
    worker.__class__ = Interruptible
    there: list[int] = []

    def pause() -> None:
        nonlocal at
        at += 1
        if at == last:
            with database.writing() as session:
                ending(session, session.get_one(Job, job.row))
            there[:] = [counted(database, one) for one in STORED]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Interruptible, "pause", staticmethod(pause))
        Work(worker, Settings(database_url=database.url), perform_job).try_once(job.row, job.attempt, 0)
    if there:
        assert [counted(database, one) for one in STORED] == there, f"stored after its end before transaction {last}"
    return bool(there)


def end_before_each_transaction(database: Database, ending: Callable[[Session, Job], None], **asked: Any) -> int:
    """End a try, each time of another surgeon, before each of its transactions; return the number of those."""
    recording = cases.store(database, cases.upload(cases.bag(), MCAP)).recording.sha256  # kestrel's, so that it stays
    for last in count(1):
        cases.add_surgeon(database, surgeon := f"heron-{last}")
        said = TryIn(recording=recording, surgeon=surgeon, suture=cases.SUTURE, **asked)
        add_demo(database, recording, DemoIn(surgeon=surgeon, suture=cases.SUTURE, cell_mm=asked["cell_mm"]), "test")
        with database.writing() as session:
            job = request_try(session, said, "test").job
            session.execute(delete(ParsedRecording))
        if not ended_before(last, database, job, ending):
            return last - 1
    raise AssertionError("it never ends")


@pytest.mark.parametrize("ending", some(ENDINGS, of=len(ENDINGS)))
def test_a_try_that_was_ended_stores_nothing_more(database: Database, ending: Callable[[Session, Job], None]) -> None:
    assert end_before_each_transaction(database, ending, cell_mm=5.0) > 10


@pytest.mark.nightly  # each of some thirty tries is played; by day a try ends with its questions
@pytest.mark.needs("simulator")
def test_nor_does_one_that_is_played(database: Database) -> None:
    assert end_before_each_transaction(database, erase_its_demo, cell_mm=5.0, **ANSWERS) > 20


def test_cells_without_a_path_are_passed_over() -> None:
    sample = sample_recordings()[0]
    whole = read_recording(BytesIO(sample.data))
    still = cut_demo(whole, start_s=sample.segments[0][0], end_s=sample.segments[0][0] + 0.6)
    asked = TryIn(recording="0" * 64, surgeon="kestrel", suture=cases.SUTURE, loss_mm=50)
    _, measured = choose_cells(still, asked)
    assert 0 < len(measured) <= len(CELLS_MM)
    with pytest.raises(BadSettings, match="No cells"):
        choose_cells(still, asked.model_copy(update={"loss_mm": 1e-6}))
