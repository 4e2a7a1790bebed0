"""Running and failed jobs on the pages: the first page shows them, and a failed one is requested again as it was."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import select, update

from skills.api.pages.filters import again
from skills.db.service_tables import Job
from tests.api.html import Html
from tests.api.keyed import As, key
from tests.api.service import CSV, GOAL_MM, KESTREL, Service
from tests.library import cases
from tests.library.test_scenes import SCENE

STYLE = f"/pages/styles/kestrel/{cases.SUTURE}"
WHY = "All 3 attempts failed inside the service."


def fail(service: Service, job: str) -> Job:
    """End a job as a worker does that has failed at it, and return its row."""
    with service.database.writing() as session:
        session.execute(update(Job).where(Job.id == job).values(state="failed", error=WHY, ended_at=Job.created_at))
        return session.scalars(select(Job).where(Job.id == job)).one()


def page_of(service: Service, path: str = "/") -> Html:
    return Html(service.http.get(path, headers={"Accept": "text/html"}).text)


def buttons(page: Html) -> list[dict[str, str | None]]:
    return [about for tag, about in page.tags if tag == "button" and "data-call" in about]


def renewed_ms(page: Html) -> list[str | None]:
    return [about["data-renew"] for _, about in page.tags if about.get("id") == "styles"]


def tile_of(page: Html) -> str:
    """Return the words of the first page from the table of styles on."""
    return page.text.partition("Styles by surgeon")[2]


def test_a_style_whose_training_failed_says_so_and_is_trained_again(here: Service):
    here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    assert "stored" in tile_of(page_of(here))
    job = here.client.train(**KESTREL, release=True)
    page = page_of(here)
    assert (renewed_ms(page), "queued" in tile_of(page), "stored" in tile_of(page)) == (["1000"], True, False)
    assert [one["data-call"] for one in buttons(page)] == [f"DELETE /jobs/{job['id']}"]
    fail(here, job["id"])
    page = page_of(here)
    assert (renewed_ms(page), "failed" in tile_of(page), "stored" in tile_of(page)) == (["5000"], True, False)
    assert WHY in page.text
    (button,) = buttons(page)
    for other in ("/pages/jobs", f"/pages/jobs/{job['id']}"):
        assert button["data-json"] in [one.get("data-json") for one in buttons(page_of(here, other))]
    assert WHY in page_of(here, STYLE).text
    assert "failed" in page_of(here, "/pages/surgeons/kestrel").text
    method, path = (button["data-call"] or "").split()
    assert here.http.request(method, path, json=json.loads(button["data-json"] or "")).status_code == 202
    page = page_of(here)
    assert (WHY in page.text, "queued" in tile_of(page)) == (False, True)
    here.work()
    page = page_of(here)
    assert "Running and failed jobs" not in page.text
    assert "released" in tile_of(page)
    assert buttons(page) == []


def test_a_failed_training_of_a_style_with_a_version_leaves_its_state(trained: Service):
    fail(trained, trained.client.train(**KESTREL, seed=7)["id"])
    page = page_of(trained)
    assert "released" in tile_of(page)
    assert "failed" not in tile_of(page)
    assert WHY in page.text


def test_an_empty_service_follows_what_is_added_to_it(service: Service):
    assert renewed_ms(page_of(service)) == ["5000"]


def test_only_who_may_release_tries_a_release_again(trained: Service):
    for seed, release in ((7, False), (8, True)):
        fail(trained, trained.client.train(**KESTREL, seed=seed, release=release)["id"])
    key(trained, "somebody", "admin")
    page = Html(As(trained, key(trained, "mine", "trainer"))("GET", "/").text)
    may_press = {json.loads(one["data-json"] or "")["release"]: "disabled" not in one for one in buttons(page)}
    assert may_press == {False: True, True: False}


PLAN = {"suture_points": [{"position_mm": GOAL_MM}], "handoff": "none"}
TRIED = {"release": False, "tissue_mm": "none", "errors": "calibrated", "cell_mm": 4.0}


def training(**more: Any) -> Callable[[Service], str]:
    return lambda service: service.client.train(**KESTREL, **more)["id"]


def playback(**more: Any) -> Callable[[Service], str]:
    def ask(service: Service) -> str:
        return service.client.play(service.client.plan(**KESTREL, **PLAN)["id"], **more)["id"]

    return ask


def tried(service: Service) -> str:
    with service.database.reading() as session:
        recording = session.scalars(select(cases.Demonstration)).first().recording.sha256
    return service.client.try_recording(recording, **KESTREL, **TRIED)["id"]


ASKED: dict[str, Callable[[Service], str]] = {
    "training": training(seed=3),
    "training with a learner": training(learner={"kind": "value-iteration", "gamma": 0.1}, release=True),
    "training in a scene": training(
        learner={"kind": "value-iteration", "gamma": 0.95, "slip": 0.1},
        scene=SCENE.as_json(),
        scene_costs={"close": 0.2},
    ),
    "training from any outcome": training(outcomes="any"),
    "batch": lambda service: service.client.retrain(surgeon="kestrel")["id"],
    "batch with a learner": lambda service: service.client.retrain(learner={"kind": "cell-q-learning"})["id"],
    "playback": playback(),
    "playback under its own errors": playback(errors="calibrated"),
    "try": tried,
}


@pytest.mark.parametrize("which", ASKED)
def test_a_failed_job_is_requested_again_as_it_was(trained: Service, which: str):
    job = fail(trained, ASKED[which](trained))
    call, body = again(job) or ("", {})
    method, path = call.split()
    answer = trained.http.request(method, path, json=body or None)
    assert answer.status_code == 202, answer.text
    with trained.database.reading() as session:
        later = session.scalars(select(Job).where(Job.id == answer.json()["id"])).one()
    assert (later.id != job.id, later.identity, later.request) == (True, job.identity, job.request)


def test_pictures_that_failed_are_requested_again(told: Service):
    with told.database.reading() as session:
        job = session.scalars(select(Job).where(Job.kind == "pictures")).first()
    assert again(job) == (f"POST /playbacks/{job.request['playback']}/pictures", {})


def test_an_export_is_not_requested_again_from_what_is_stored_of_it():
    assert again(Job(kind="dataset", request={"episodes": 1})) is None


def test_the_bar_of_a_job_that_failed_or_was_cancelled_is_not_full(here: Service):
    here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    job = here.client.train(**KESTREL)
    for state, done in (("failed", 0.25), ("cancelled", 0.0)):
        with here.database.writing() as session:
            changed = update(Job).where(Job.id == job["id"])
            session.execute(changed.values(state=state, progress=done, ended_at=Job.created_at))
        bars = [about for tag, about in page_of(here, f"/pages/jobs/{job['id']}").tags if tag == "progress"]
        assert [float(bar["value"] or "nan") for bar in bars] == [done], state
