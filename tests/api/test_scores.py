"""`POST /scores` and the page of a score, on the real application."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from skills.api.pages.filters import share
from skills.library.comparison.calibrations import calibrate_on, put_calibration, read_cohort
from skills.seeds.recordings import sample_recordings
from tests import backends
from tests.api.keyed import As, key
from tests.api.service import CSV, KESTREL, MCAP, Service, assert_problem, serving
from tests.library import cases, rated

SAMPLES = {sample.surgeon: sample for sample in sample_recordings() if len(sample.segments) == 1}
LEVELS = {"kestrel": "expert", "heron": "expert", "plover": "novice"}


@pytest.fixture(scope="module")
def stored() -> dict[str, str]:
    return {}


@pytest.fixture(scope="module")
def scoring(tmp_path_factory: pytest.TempPathFactory, stored: dict[str, str]) -> Iterator[Service]:
    """Yield a service with three surgeons of the samples, and a calibration."""
    folder = tmp_path_factory.mktemp("scoring")
    with serving(backends.fresh("sqlite", folder)) as service:
        for surgeon, level in LEVELS.items():
            service.client.put_surgeon(surgeon, skill_level=level)
            start_s, end_s = SAMPLES[surgeon].segments[0]
            about = {"surgeon": surgeon, "suture": cases.SUTURE, "start_s": start_s, "end_s": end_s}
            demo = service.client.add_demo(SAMPLES[surgeon].data, media_type=MCAP, **about)
            stored[surgeon], stored["recording of " + surgeon] = demo["id"], demo["recording"]
        trial = rated.text(rated.trial(0.5, np.random.default_rng(0))[0])
        about = {"surgeon": "plover", "suture": cases.SUTURE, "arm": "PSM_right", "start_s": 1.0, "end_s": 4.0}
        stored["trial"] = service.client.add_demo(trial, media_type="text/plain", **about)["id"]
        with service.database.writing() as session:
            put_calibration(session, calibrate_on(read_cohort(rated.folder(folder / "lab")), permutations=39), "test")
        yield service


def test_a_hesitant_novice_is_told_from_an_even_expert(scoring: Service, stored: dict[str, str]) -> None:
    score = scoring.client.score("kestrel", cases.SUTURE, demo=stored["plover"])
    figures: dict[str, Any] = {one["name"]: one for one in score["figures"]}
    assert score["reference"]["demo"] == stored["kestrel"]
    assert figures["duration_s"]["ratio"] > 3
    assert figures["clutch_presses"]["value"] == 2 and figures["clutch_presses"]["ratio"] is None
    for smoothness in ("spectral_arc_length", "log_dimensionless_jerk"):
        assert figures[smoothness]["value"] < figures[smoothness]["reference"] < 0
    assert score["deviation"]["words"]
    assert not score["skill"]["calibrated"] and "two instruments" in score["skill"]["words"][0]  # jaw and arm are one


def test_the_same_part_of_the_recording_has_the_same_score(scoring: Service, stored: dict[str, str]) -> None:
    start_s, end_s = SAMPLES["plover"].segments[0]
    of_demo = scoring.client.score("kestrel", cases.SUTURE, demo=stored["plover"])
    of_part = scoring.client.score(
        "kestrel", cases.SUTURE, recording=stored["recording of plover"], start_s=start_s, end_s=end_s
    )
    assert of_part["demo"] is None and of_part["curve"] == []
    for same in ("figures", "deviation", "as_recorded", "skill", "reference"):
        assert of_part[same] == of_demo[same]


def test_a_score_is_asked_for_and_never_stored(scoring: Service, stored: dict[str, str]) -> None:
    before = scoring.counts()
    body = {**KESTREL, "demo": stored["heron"]}
    one, other = (scoring.http.post("/scores", json=body) for _ in range(2))
    assert one.status_code == other.status_code == 200
    assert one.content == other.content
    assert scoring.counts() == before


@pytest.mark.parametrize(
    ("body", "status", "kind"),
    [
        ({}, 422, "invalid-request"),
        ({"demo": "0" * 64, "recording": "0" * 64}, 422, "invalid-request"),
        ({"demo": "0" * 64, "start_s": 1.0}, 422, "invalid-request"),
        ({"demo": "0" * 64}, 404, "not-found"),
        ({"recording": "0" * 64}, 404, "not-found"),
        ({"demo": "../etc/passwd"}, 422, "invalid-request"),
        ({"demo": "0" * 64, "surgeon": "nobody"}, 404, "not-found"),
        ({"demo": "0" * 64, "suture": "sewing"}, 404, "not-found"),
        ({"demo": "0" * 64, "reference": "0" * 64}, 404, "not-found"),
    ],
)
def test_what_cannot_be_scored_is_a_problem(scoring: Service, body: dict[str, Any], status: int, kind: str) -> None:
    assert_problem(scoring.http.post("/scores", json=KESTREL | body), status, kind)


def test_a_part_that_is_not_in_the_recording_is_refused(scoring: Service, stored: dict[str, str]) -> None:
    body = {**KESTREL, "recording": stored["recording of plover"], "start_s": 900.0, "end_s": 901.0}
    assert_problem(scoring.http.post("/scores", json=body), 422, "bad-segment")


def test_a_restricted_key_sees_only_its_surgeons(service: Service) -> None:
    demos = {}
    for number, surgeon in enumerate(("kestrel", "plover")):
        service.client.put_surgeon(surgeon, skill_level="expert")
        tip = cases.points_mm((0.0, 0.0, 2.0 * number))
        demos[surgeon] = service.client.add_demo(
            cases.table(tip), media_type=CSV, surgeon=surgeon, suture=cases.SUTURE
        )["id"]
    ask = As(service, key(service, "plovers", "reader", surgeons=["plover"]))
    mine = {"surgeon": "plover", "suture": cases.SUTURE, "demo": demos["plover"]}
    assert ask("POST", "/scores", json=mine).status_code == 200
    for other in (mine | {"surgeon": "kestrel"}, mine | {"demo": demos["kestrel"]}):
        assert_problem(ask("POST", "/scores", json=other), 404, "not-found")
    shown = ask("GET", f"/pages/demos/{demos['plover']}/score")
    assert shown.status_code == 200
    assert "kestrel" not in shown.text


def test_a_trial_is_rated_with_its_interval_its_terms_and_its_thirds(scoring: Service, stored: dict[str, str]) -> None:
    skill = scoring.client.score("kestrel", cases.SUTURE, demo=stored["trial"])["skill"]
    assert skill["calibrated"] and skill["task"] == "Suturing"
    assert skill["interval"][0] < skill["rating"] < skill["interval"][1]
    assert len(skill["terms"]) == 17 and len(skill["terms"][0]["thirds"]) == 3 and not skill["outside"]
    text = page(scoring, f"/pages/demos/{stored['trial']}/score?surgeon=kestrel")
    assert "Of the whole recording, as a trial of Suturing." in text and "First third" in text and "<h2>Rating" in text
    for term in skill["terms"]:
        assert f'<th scope="row">{term["label"]}</th>' in text
        if term["name"].endswith("_share"):  # in percent, as in the table of figures
            assert f'data-name="Here">{share(term["value"], 0)}</td>' in text
    assert "nan" not in text.lower().replace("nanometre", "")


def test_another_task_is_not_rated_in_words(scoring: Service, stored: dict[str, str]) -> None:
    skill = scoring.client.score("kestrel", cases.SUTURE, demo=stored["trial"], task="Sewing")["skill"]
    assert not skill["calibrated"] and "has no task Sewing" in skill["words"][0]


# ---- the page ----------------------------------------------------------------------------------------------------


def page(service: Service, path: str, status: int = 200) -> str:
    answer = service.http.get(path, headers={"Accept": "text/html"})
    assert answer.status_code == status, answer.text[:400]
    return answer.text


def test_the_page_draws_the_way_in_steps_and_says_where(scoring: Service, stored: dict[str, str]) -> None:
    score = scoring.client.score("kestrel", cases.SUTURE, demo=stored["plover"])
    text = page(scoring, f"/pages/demos/{stored['plover']}/score?surgeon=kestrel")
    assert text.count('role="img"') == 4  # three views and the curve along the path; no earlier demonstration
    steps = set(np.searchsorted((2.5, 5, 10, 20), score["deviation"]["apart_mm"]).tolist())
    drawn = {int(step) for step in re.findall(r'<polyline class="apart-(\d)" points="\d+\.\d,', text)}
    assert drawn == steps
    for sentence in (*score["deviation"]["words"], "not a credential", "Not rated", "not a medical device"):
        assert sentence.replace("'", "&#39;") in text
    assert "nan" not in text.lower().replace("nanometre", "")


def test_differences_and_progress_are_given_and_shown(scoring: Service, stored: dict[str, str]) -> None:
    scored = scoring.client.score("kestrel", cases.SUTURE, demo=stored["plover"])
    assert scored["differences"]["named"][0]["kind"] == "time in motion"
    shown = page(scoring, f"/pages/demos/{stored['plover']}/score?surgeon=kestrel")
    assert "What this motion does differently from kestrel" in shown
    assert all(words.split(";")[-1][:30] in shown for words in scored["differences"]["words"])
    path = f"/surgeons/plover/progress?suture={cases.SUTURE}&against=kestrel"
    found = scoring.http.get(path).json()
    assert sum(one["demos"] for one in found["sessions"]) == len(found["demos"]) == 2
    assert found["demos"][0]["distance_mm"] == pytest.approx(scored["deviation"]["distance_mm"])
    assert_problem(scoring.http.get(path.replace("plover", "nobody")), 404, "not-found")
    over_time = page(scoring, f"/pages/surgeons/plover?suture={cases.SUTURE}&against=kestrel")
    assert "2 demonstrations in the order" in over_time and "not a credential" in over_time
    assert f"{found['sessions'][0]['distance_mm']:.2f}".rstrip("0").rstrip(".") + " mm" in over_time
    first, newest = found["demos"]
    assert f"/pages/player/demos/{first['demo']}?beside=demos/{newest['demo']}" in over_time
    assert "There is no surgeon" in page(scoring, "/pages/surgeons/plover?against=nobody")


def test_left_out_the_style_is_an_experts_and_another_ones(scoring: Service, stored: dict[str, str]) -> None:
    assert "plover beside heron" in page(scoring, f"/pages/demos/{stored['plover']}/score")
    assert "heron beside kestrel" in page(scoring, f"/pages/demos/{stored['heron']}/score")


def test_the_page_is_reached_from_the_style_and_the_recording(scoring: Service, stored: dict[str, str]) -> None:
    link = f'href="/pages/demos/{stored["plover"]}/score"'
    assert link in page(scoring, f"/pages/styles/plover/{cases.SUTURE}")
    assert link in page(scoring, f"/pages/recordings/{stored['recording of plover']}")


def test_what_cannot_be_shown_is_said_on_a_page(scoring: Service, stored: dict[str, str]) -> None:
    assert "Not found" in page(scoring, f"/pages/demos/{'0' * 64}/score", 404)
    assert "no surgeon" in page(scoring, f"/pages/demos/{stored['plover']}/score?surgeon=nobody", 404)


def test_without_consent_the_page_says_so(service: Service) -> None:
    service.client.put_surgeon("kestrel", consent={"uses": ["training"]})
    demo = service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    text = page(service, f"/pages/demos/{demo['id']}/score", 409)
    assert "Cannot be shown" in text and "does not cover atlas" in text


def test_over_time_every_demonstration_is_drawn(service: Service) -> None:
    service.client.put_surgeon("kestrel")
    for number in range(3):
        tip = cases.points_mm() + np.sin(np.linspace(0, np.pi, 60))[:, None] * np.array([0.0, 3.0 - number, 0.0])
        demo = service.client.add_demo(cases.table(tip), media_type=CSV, **KESTREL)
    text = page(service, f"/pages/demos/{demo['id']}/score")
    assert text.count('class="before"') == 2 and text.count('class="scored"') == 1
    assert "This demonstration is the reference itself" in text
