"""The pictures of a playback: requested with the verdict, drawn after it, erased with the playback."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.models import Plan, StoredPictures, StoredPlayback
from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import NotDrawnYet, NotInstalled, SimulationFailed
from skills.library.operation.integrity import planned
from skills.library.operation.jobs import cancel
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.plans import playback_pictures, playbacks
from skills.library.plans.plans import trajectory_of
from skills.library.plans.playback_pictures import PicturesRequest, draw_pictures, find_pictures
from skills.planning.trajectory import time_parametrise
from skills.settings import Settings
from skills.simulation import film, pictures
from skills.verification.bodies import bodies_clearance, distances_at, names_of
from skills.verification.playback import Pictures, Playback
from tests.library import cases
from tests.library.cases import fetch
from tests.library.verdicts import verdict_on
from tests.planning.motions import hand_off, ideal_playback
from tests.planning.test_trajectory import BESIDE

REPORT = {
    "failure": None,
    "failure_sentence": None,
    "settings": {"clearance_pad_mm": 1.0, "clearance_psm_m_mm": 0.5},
}


def store_playback(session: Session, plan: Plan, sha256: str, measured: Playback) -> StoredPlayback:
    """Store a playback and request its pictures, as a worker does with the verdict."""
    report = verdict_on(plan.sha256, measured.trajectory, measured)
    row = StoredPlayback(
        sha256=sha256, plan=session.get_one(Plan, plan.row), feasible=True, report=report, measured=measured
    )
    session.add(row)
    session.flush()
    playbacks.request_pictures(session, row, "test")
    return row


@pytest.fixture
def playback(database: Database) -> StoredPlayback:
    """Return a playback whose pictures are still to be drawn."""
    cases.trained(database, release=True)
    plan = cases.add_plan(database)
    with database.writing() as session:
        measured = ideal_playback(trajectory_of(planned(session.get_one(Plan, plan.row))))
        return store_playback(session, plan, "a" * 64, measured)


def asked(database: Database) -> list[Job]:
    with database.reading() as session:
        return list(session.scalars(select(Job).where(Job.kind == "pictures").order_by(Job.row)))


def drawn(database: Database) -> list[StoredPictures]:
    with database.reading() as session:
        return list(session.scalars(select(StoredPictures)))


def refusal(database: Database, playback: StoredPlayback) -> str:
    with database.reading() as session, pytest.raises(NotDrawnYet) as caught:
        find_pictures(session, playback)
    return str(caught.value)


@pytest.mark.nightly  # by day tests/api draws them
@pytest.mark.needs("simulator")
def test_pictures_are_drawn_and_stored_once_however_often_that_is_tried(
    database: Database, playback: StoredPlayback, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(film, "FRAMES", 2)
    monkeypatch.setattr(film, "FRAMES_PER_PASS", 2)
    [job] = asked(database)
    assert job.id in refusal(database, playback)
    store = draw_pictures(database, PicturesRequest.model_validate(job.request), Settings(database_url=database.url))
    for _ in range(2):  # the second time by a worker that does not know of the first
        assert cases.committed(database, store, "test") == {"playback": playback.sha256}
    assert len(drawn(database)) == 1
    found = fetch(database, find_pictures, playback)
    assert found.animation_mp4[4:8] == b"ftyp"
    assert found.animation_gif.startswith(b"GIF89a")
    assert all(png.startswith(b"\x89PNG") for png in (found.joints_png, found.clearance_png))


def test_asking_again_gives_the_same_job_until_it_has_failed(database: Database, playback: StoredPlayback):
    [job] = asked(database)
    with database.writing() as session:
        assert playbacks.request_pictures(session, playback, "test")[0].row == job.row
        cancel(session, job.id, "test")
    assert f"client.draw('{playback.sha256}')" in refusal(database, playback)
    with database.writing() as session:
        again, new, _ = playbacks.request_pictures(session, playback, "test")
    assert new and again.row != job.row
    assert again.id in refusal(database, playback)


def test_without_the_extra_a_request_says_what_to_install(database: Database, playback, monkeypatch):
    monkeypatch.setattr(playback_pictures, "find_spec", lambda name: None if name == "matplotlib" else True)
    with database.writing() as session, pytest.raises(NotInstalled, match=r"suture-skills\[pictures\]"):
        playbacks.request_pictures(session, playback, "test")


def test_nobody_asked_for_pictures_of_older_playbacks(database: Database, playback: StoredPlayback):
    with database.writing() as session:
        session.delete(session.get_one(Job, asked(database)[0].row))
    assert "No pictures of this playback were requested" in refusal(database, playback)


def test_a_film_that_fails_fails_the_job_and_nothing_is_stored(
    database: Database, playback: StoredPlayback, monkeypatch: pytest.MonkeyPatch
):
    def make_film(*_: Any, **__: Any) -> None:
        raise SimulationFailed("The simulator hung; play fewer passes.", cause="hung")

    monkeypatch.setattr(film, "make_film", make_film)
    [job] = asked(database)
    ended = cases.work(database, job)
    assert (ended.state, ended.error) == ("failed", "The simulator hung; play fewer passes.")
    assert drawn(database) == []
    assert job.id in refusal(database, playback)


@pytest.mark.parametrize("what", ["surgeon", "demonstration"])
def test_they_are_erased_with_what_they_show(database: Database, playback: StoredPlayback, what: str):
    with database.writing() as session:
        session.add(StoredPictures(playback_row=playback.row, drawn=Pictures(b"mp4", b"gif", b"png", b"png")))
    unfinished = [(job.row, job.attempt) for job in asked(database)]
    with database.writing() as session:
        if what == "surgeon":
            dropped = erase_surgeon(session, "kestrel", "test")
        else:
            dropped = erase_demo(session, playback.plan.policy.manifest.demos[0], "test")
    assert unfinished and set(unfinished) <= set(dropped)
    assert drawn(database) == asked(database) == []


def test_the_plot_shows_both_arms_bodies_and_the_line_between_the_nearest():
    """The line's length is the least distance, by the planned joints, and it is drawn from the side and from above."""
    motion = time_parametrise([hand_off()], rate_hz=60.0, psm_m=BESIDE)
    outer = bodies_clearance(motion, 2.0)
    report = REPORT | {"bodies": asdict(outer.report)}
    figure = pictures.draw_clearance(motion, ideal_playback(motion), report)
    views = [axes for axes in figure.axes if "PSM_A)" in axes.get_xlabel()]
    assert [axes.get_xlabel()[0] for axes in views] == ["y", "x"]
    (side, above) = (next(line for line in axes.lines if line.get_color() == pictures.FAILS) for axes in views)
    (y, z), (x, again) = side.get_data(), above.get_data()
    assert y == pytest.approx(again)
    least = distances_at(motion, np.arange(len(motion))).min()
    assert np.linalg.norm(np.ptp([x, y, z], axis=1)) == pytest.approx(least, abs=0.5)
    assert len(views[0].patches) == 2 * (len(names_of("400006")) * 2)  # each filled, and its outline
