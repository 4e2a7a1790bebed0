"""Tries: each step on a synthetic bag, every question with its answers, every refusal with its remedy."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select, update

from skills.db.models import Demonstration, Plan, PolicyVersion, Release, StoredPlayback
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.demonstration.demonstration import cut_demo
from skills.demonstration.recording import Motion, Recording
from skills.errors import BadSettings, Conflict, NotFound
from skills.formats import read_recording, write_mcap
from skills.gridworld.grid import GridWorld, choose_grid
from skills.library.catalogue import put_surgeon
from skills.library.erasure import erase_demo
from skills.library.recordings import store_recording
from skills.library.tries import CELLS_MM, choose_cells, request_try
from skills.schemas.tries import LOSS_MM, TryIn
from skills.seeds.recordings import sample_recordings
from tests.library import cases

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


def count(database: Database, table: Any) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


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
    done = ["read", "propose", "cut", "report", "train", "certify", "release", "plan", "play", "verdict"]
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
        assert plan.about["passes"][0]["position_mm"] == version.manifest["goal_mm"]
        assert playback.feasible and playback.report["doubt"]["under"][0]["errors"]["name"] == "calibrated"
    assert "feasible in an exact simulation" in steps(job)[-1]["text"]


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
    assert count(database, Release) == count(database, Plan) == 0
    assert count(database, PolicyVersion) == 1  # found again, not learnt as another version


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
    assert count(database, Release) == 0


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
    assert count(database, Demonstration) == 0


def test_what_is_not_there_or_not_consented_is_refused_at_once(database: Database) -> None:
    recording = stored(database)
    with database.writing() as session:
        put_surgeon(session, "heron", {"consent": {"uses": ["export"]}}, "test")
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
    with database.writing() as session:
        erase_demo(session, digest, "test")
    assert count(database, Job) == 0


def test_cells_without_a_path_are_passed_over() -> None:
    sample = sample_recordings()[0]
    whole = read_recording(BytesIO(sample.data))
    still = cut_demo(whole, start_s=sample.segments[0][0], end_s=sample.segments[0][0] + 0.6)
    asked = TryIn(recording="0" * 64, surgeon="kestrel", suture=cases.SUTURE, loss_mm=50)
    _, measured = choose_cells(still, asked)
    assert 0 < len(measured) <= len(CELLS_MM)
    with pytest.raises(BadSettings, match="No cells"):
        choose_cells(still, asked.model_copy(update={"loss_mm": 1e-6}))
