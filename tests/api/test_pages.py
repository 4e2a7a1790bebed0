"""The pages without a browser: their content, the markup that they escape, and the data of their views."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select
from starlette.testclient import TestClient

from skills.api.pages.assets import BORROWED, assets, build
from skills.api.pages.filters import number, share, size, triple
from skills.db.models import Demonstration, Plan, PolicyVersion, StoredRecording
from skills.db.service_tables import Job
from skills.learning.policy import rollout_from
from skills.library.operation.integrity import covered, learnt
from skills.library.operation.overview import MOST
from skills.library.operation.styles import matrix
from skills.library.operation.views import moves_to_goal
from skills.library.people.consent import may
from skills.library.people.surgeons import put_surgeon
from skills.library.policies.versions import find_version
from skills.schemas.people import SurgeonIn
from tests import backends
from tests.api.html import Html
from tests.api.keyed import As, copy_of_told, key
from tests.api.service import CSV, KESTREL, Service, assert_problem, serving
from tests.library import cases, hospital

STYLE = f"/pages/styles/kestrel/{cases.SUTURE}"
NASTY = """<script>alert(1)</script>'"><img src=x onerror=alert(2)>{{ 7 * 7 }}"""
USE = "not a medical device"


def every_page(service: Service) -> list[str]:
    """List an address of every kind of page, and of each object that exists once."""
    with service.database.reading() as session:
        recordings = session.scalars(select(StoredRecording.sha256)).all()
        plans = session.scalars(select(Plan.sha256)).all()
        jobs = session.scalars(select(Job.id).where(Job.kind != "retraining-part")).all()
        demos = session.scalars(select(Demonstration)).all()
        scored = [one.sha256 for one in demos if one.withdrawn_at is None and may(one.surgeon, "atlas")]
        styles = {(demo.surgeon.slug, demo.suture) for demo in demos}
    return [
        *("/", "/pages/recordings", "/pages/recordings/new", "/pages/plans", "/pages/plans/new", "/pages/jobs"),
        *("/pages/atlas", *(f"/pages/atlas/{one}?scaled=true&clusters=" for one in {suture for _, suture in styles})),
        *("/pages/catalogue", "/?q=kestrel&state=released&skill=expert"),
        *(f"/pages/styles/{surgeon}/{suture}" for surgeon, suture in sorted(styles)),
        *(f"/pages/surgeons/{surgeon}" for surgeon, _ in sorted(styles)),
        *("/pages/proposals", "/pages/proposals?state=", f"/pages/proposals?state=accepted&suture={cases.SUTURE}"),
        *(f"/pages/demos/{one}/score" for one in scored),
        *(f"/pages/recordings/{one}" for one in recordings),
        *(f"/pages/player/recordings/{one}" for one in recordings),
        *(f"/pages/player/plans/{one}" for one in plans),
        *(f"/pages/plans/{one}" for one in plans),
        *(f"/pages/plans/new?like={one}" for one in plans),
        *(f"/pages/jobs/{one}" for one in jobs),
    ]


def page_of(service: Service, path: str) -> Html:
    answer = service.http.get(path, headers={"Accept": "text/html"})
    assert answer.status_code == 200, (path, answer.text[:400])
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    return Html(answer.text)


def test_every_page_runs_our_files_alone_and_says_what_it_is_not(told: Service) -> None:
    for path in every_page(told):
        page = page_of(told, path)
        assert page.text.count(USE) >= 2, path
        for tag, about in page.tags:
            assert tag != "style" and "style" not in about and not any(name.startswith("on") for name in about), path
            assert tag != "script" or (about.get("src") or "").startswith("/static/"), path
        assert all(address.startswith(("/", "#")) and not address.startswith("//") for address in page.addresses), path
        assert all(f"/static/{build()}/" in address for address in page.addresses if address.startswith("/static/"))


def test_the_policy_lets_nothing_in_that_is_not_ours(told: Service) -> None:
    policy = told.http.get("/").headers["content-security-policy"]
    parts = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert parts["default-src"] == "'none'"
    assert parts["script-src"] == parts["style-src"] == parts["connect-src"] == "'self'"
    assert parts["frame-ancestors"] == parts["base-uri"] == "'none'"
    assert "unsafe" not in policy and "http" not in policy


def test_names_are_shown_as_they_are_and_never_run(tmp_path: Path) -> None:
    about = {"name": NASTY, "also_called": [NASTY], "family": NASTY, "description": NASTY}
    shown = 0
    with serving(copy_of_told(tmp_path)) as service:
        assert service.http.put(f"/suture-types/{cases.SUTURE}", json=about).status_code == 200
        assert service.http.put("/surgeons/plover", json={"protocol": NASTY[:200]}).status_code == 201
        for path in every_page(service):
            page = page_of(service, path)
            shown += NASTY in page.text
            assert not any(about.get("src") == "x" for _, about in page.tags), path
            assert all(about.get("src") for tag, about in page.tags if tag == "script"), path
    assert shown >= 5


def test_behind_a_prefix_every_address_has_it(tmp_path: Path) -> None:
    with serving(copy_of_told(tmp_path)) as service:
        service.http = TestClient(service.app, str(service.http.base_url), root_path="/lab/skills")
        for path in every_page(service):
            page = page_of(service, path)
            assert all(address.startswith(("/lab/skills/", "#")) for address in page.addresses), path
            assert ("meta", {"name": "root", "content": "/lab/skills"}) in page.tags


def test_an_empty_service_says_how_to_begin(service: Service) -> None:
    assert "No style yet" in page_of(service, "/").text
    for path in every_page(service):
        page_of(service, path)


def test_a_dropped_recording_belongs_to_nobody_until_its_surgeon_is_named(told: Service, service: Service) -> None:
    for one, suggested in ((told, ""), (service, "surgeon-1")):  # a service without surgeons cannot mistake them
        fields = [about for _, about in Html(one.http.get("/").text).tags if about.get("id") == "try-surgeon"]
        assert [about["value"] for about in fields] == [suggested]


def test_what_is_not_there_is_said_on_a_page(told: Service) -> None:
    for path in (
        "/pages/styles/nobody/simple-running",
        f"/pages/plans/{'0' * 64}",
        "/pages/jobs/no",
        f"{STYLE}?version=99",
    ):
        answer = told.http.get(path)
        assert answer.status_code == 404
        assert "Not found" in Html(answer.text).text


def test_an_erased_surgeon_is_gone_from_every_page(tmp_path: Path) -> None:
    with serving(copy_of_told(tmp_path)) as service:
        before = every_page(service)
        assert service.http.delete("/surgeons/kestrel").status_code == 204
        assert service.http.get(STYLE).status_code == 410
        assert "kestrel" not in "".join(service.http.get(path).text for path in before if "kestrel" not in path)


@pytest.mark.parametrize(
    ("role", "allowed"),
    [("reader", set()), ("trainer", {"Train"}), ("releaser", {"Train", "Release", "Withdraw the release", "Withdraw"})],
)
def test_a_button_works_only_for_those_who_may(tmp_path: Path, role: str, allowed: set[str]) -> None:
    with serving(copy_of_told(tmp_path)) as service:
        key(service, "somebody", "admin")
        text = As(service, key(service, "mine", role))("GET", STYLE).text
    buttons = re.findall(r"<button([^>]*data-call[^>]*)>([^<]+)</button>", text)
    assert {name for about, name in buttons if " disabled" not in about} == allowed
    assert {name for _, name in buttons} == {"Train", "Release", "Withdraw the release", "Withdraw"}


def test_a_search_finds_surgeons_sutures_and_other_names(told: Service) -> None:
    with told.database.reading() as session:

        def found(words: str, **how: str) -> list[tuple[str, list[str]]]:
            shown = matrix(session, words, **how)  # type: ignore[arg-type]
            return [(who.slug, [one.suture for one in styles if one.state != "empty"]) for who, styles in shown.rows]

        style = ("kestrel", [cases.SUTURE])
        assert found("kest") == [style]
        assert found("CONTINUOUS kestrel") == [style]
        assert found("over-and-over", state="released") == [style]
        assert found("%") == found("nobody") == []
        assert found("", skill="novice") == []
        assert ("heron", [cases.SUTURE]) in found("", state="stored")


def test_a_part_of_the_styles_follows_another(told: Service) -> None:
    with told.database.reading() as session:
        first = matrix(session, limit=1)
        second = matrix(session, limit=1, after=first.next)
    assert [who.slug for who, _ in (*first.rows, *second.rows)] == ["heron", "kestrel"]


def test_the_moves_to_the_goal_are_those_of_the_rollouts(told: Service) -> None:
    with told.database.reading() as session:
        for version in session.scalars(select(PolicyVersion)):
            policy, reaches = learnt(version), covered(version).reaches
            moves = moves_to_goal(policy, reaches)
            for state in (*policy.path.states.tolist(), *range(0, policy.path.grid.n_states, 7)):
                followed = rollout_from(policy, state)
                assert moves[state] == (len(followed.states) - 1 if reaches[state] else -1)


def test_the_view_shows_what_the_calls_give(told: Service) -> None:
    view = told.http.get(f"{STYLE}/versions/1/view").json()
    demo = told.client.policy(**KESTREL)["demos"][0]
    path = told.http.get(f"/demos/{demo}/path").json()
    rewards = told.http.get(f"/demos/{demo}/reward-map").json()
    assert view["path_mm"] == path["path_mm"]
    assert np.allclose(view["recorded_mm"], path["recorded_mm"], atol=1e-3)
    assert view["rewards"]["of"] == rewards["rewards"]
    with told.database.reading() as session:
        coverage = covered(find_version(session, "kestrel", cases.SUTURE, 1))
        assert view["starts"]["reaches"] == coverage.reaches.tolist()
        assert view["starts"]["nearest"] == coverage.joins_nearest.tolist()
    assert view["starts"]["at_mm"][1] == [-30.0, 25.0, -135.0]  # the states in their order, z fastest


def test_the_time_line_has_every_arms_speed_and_the_presses(told: Service) -> None:
    with told.database.reading() as session:
        recording = session.scalars(select(StoredRecording).where(StoredRecording.format == "mcap")).one()
        sha256, duration_s = recording.sha256, recording.about.duration_s
    traces = told.http.get(f"/pages/recordings/{sha256}/traces").json()
    (arm,) = traces["arms"]
    assert traces["duration_s"] == duration_s
    assert arm["speed"]["t_s"][-1] == pytest.approx(duration_s, abs=0.1)
    assert max(arm["speed"]["mm_s"]) > 10
    assert all(down < up <= duration_s for down, up in arm["clutch_s"])


@cache
def own() -> dict[str, bytes]:
    return {name: asset.content for name, asset in assets().items() if name not in BORROWED}


def test_a_file_is_kept_for_good_under_the_address_of_its_build(told: Service) -> None:
    for name, asset in assets().items():
        answer = told.http.get(f"/static/{build()}/{name}", headers={"Accept-Encoding": "gzip"})
        assert answer.content == asset.content
        assert answer.headers["content-encoding"] == "gzip"
        assert "immutable" in answer.headers["cache-control"]
        plain = told.http.get(f"/static/older/{name}", headers={"Accept-Encoding": "identity"})
        assert plain.content == asset.content
        assert plain.headers["cache-control"] == "no-cache"


@pytest.mark.parametrize("name", ["page.py", "..%2fpage.py", "%2e%2e/page.py", "site.css%00", "", ".js"])
def test_no_other_file_is_given(told: Service, name: str) -> None:
    assert told.http.get(f"/static/{build()}/{name}").status_code == 404


def test_our_files_know_no_outside_address() -> None:
    for name, content in own().items():
        addresses = set(re.findall(rb"https?://[^\"'\s)]+", content))
        assert addresses <= {b"http://www.w3.org/2000/svg"}, name


def scripts_of(page: Html) -> set[str]:
    """Return the names of the scripts that a page loads, with those that they import."""
    found: set[str] = set()
    new = {(about.get("src") or "").rpartition("/")[2] for tag, about in page.tags if tag == "script"}
    while new:
        found |= new
        texts = [assets()[name].content.decode() for name in new]
        new = {name for text in texts for name in re.findall(r'from "\./([\w.]+)"', text)} - found
    return found


def test_the_scripts_of_no_page_exceed_800_kilobytes(told: Service) -> None:
    heaviest = 0
    for path in [*every_page(told), "/docs"]:
        scripts = scripts_of(page_of(told, path))
        assert "site.js" in scripts or path == "/docs"
        heaviest = max(heaviest, sum(len(assets()[name].packed) for name in scripts))
        assert not scripts & BORROWED.keys() or path == "/docs", "no library is loaded for a page of data"
    assert 0 < heaviest <= 800_000


def test_numbers_are_written_with_their_units_and_never_rounded_up_to_all() -> None:
    assert [number(0.0, "mm"), number(1331), number(12.5, "s"), number(None)] == ["0 mm", "1,331", "12.5 s", "–"]
    assert [share(1.0), share(0.9998), share(0.5), share(None)] == ["100.0 %", "> 99.9 %", "50.0 %", "–"]
    assert [number(-0.001, "mm"), number(-0.3, digits=0)] == ["0 mm", "0"]
    assert triple((-0.001, 0.0, -1.5)) == "0.00, 0.00, -1.50 mm"
    assert [size(12), size(2048), size(3 << 20)] == ["12 bytes", "2.0 KiB", "3.0 MiB"]


def test_a_problem_of_a_call_is_no_page(told: Service) -> None:
    assert_problem(told.http.get("/policies/nobody/simple-running"), 404)
    assert told.http.post("/recordings", content=b"", headers={"Content-Type": CSV}).status_code == 422


# ---- more surgeons and styles than a form can list ---------------------------------------------------------------


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield a service with 220 surgeons, and 240 released styles of the first twenty."""
    with serving(backends.fresh("sqlite", tmp_path_factory.mktemp("crowded"))) as service:
        hospital.fill(service.database, 20)
        with service.database.writing() as session:
            for number in range(200):
                put_surgeon(session, f"wren-{number:03}", SurgeonIn(), "test")
        yield service


def test_the_catalogue_reaches_every_surgeon_page_by_page_and_by_search(crowded: Service) -> None:
    path, shown = "/pages/catalogue", []
    while path:
        page = page_of(crowded, path)
        here = [at.rpartition("/")[2] for at in page.addresses if at.startswith("/pages/surgeons/")]
        assert len(here) <= MOST
        shown += here
        path = next((at for at in page.addresses if "cursor=" in at), "")
    assert len(shown) == 220 and shown == sorted(set(shown))
    found = page_of(crowded, "/pages/catalogue?q=N-19")
    assert [at for at in found.addresses if at.startswith("/pages/surgeons/")] == [
        f"/pages/surgeons/wren-19{digit}" for digit in range(10)
    ]
    assert "No pseudonym contains nobody." in page_of(crowded, "/pages/catalogue?q=nobody").text


def test_forms_take_a_typed_pseudonym_where_surgeons_are_too_many_to_list(crowded: Service, told: Service) -> None:
    with crowded.database.reading() as session:
        recording = session.scalars(select(StoredRecording.sha256).limit(1)).one()
    paths = ("/pages/jobs", "/pages/proposals", "/pages/recordings/new?surgeon=wren-199")
    for path in (*paths, f"/pages/recordings/{recording}?surgeon=wren-199"):
        fields = [(tag, about) for tag, about in page_of(crowded, path).tags if about.get("name") == "surgeon"]
        assert fields and all(tag == "input" and "pattern" in about for tag, about in fields), path
        assert "surgeon=" not in path or fields[0][1]["value"] == "wren-199"
    few = [tag for tag, about in page_of(told, "/pages/jobs").tags if about.get("name") == "surgeon"]
    assert few == ["select"]


def test_a_released_style_beyond_the_list_is_not_called_unreleased(crowded: Service) -> None:
    page = page_of(crowded, f"/pages/plans/new?surgeon=surgeon-0019&suture={cases.SUTURE}").text
    assert "surgeon-0019" in page and "(not released)" not in page
    assert "Only the first 200 released styles are listed." in page
