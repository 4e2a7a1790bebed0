"""The atlas over HTTP: typed, with conditional requests, and without surgeons that the key may not see."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from skills.api.pages import drawings
from skills.comparison.distances import STATES
from skills.comparison.recognition import NUMBERS
from skills.library.comparison.atlas import _atlas, _Compared
from skills.library.comparison.members import Member
from skills.library.comparison.recognition import recognise_arms
from skills.schemas.comparison import Atlas, LeftOutOfAtlas
from tests import backends
from tests.api.keyed import As, key
from tests.api.service import Service, assert_problem, serving
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts

ATLAS = f"/styles/{cases.SUTURE}/atlas"


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield a service with two surgeons in three sessions each."""
    with serving(backends.fresh("sqlite", tmp_path_factory.mktemp("atlas"))) as service:
        cohorts.add_cohort(service.database, cohort(1, surgeons=2, sessions=3))
        yield service


@pytest.mark.nightly  # by day tests/api/test_conditions.py
def test_it_is_the_same_bytes_until_something_changes(compared: Service):
    first = compared.http.get(ATLAS)
    assert first.status_code == 200
    again = compared.http.get(ATLAS, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    scaled = compared.http.get(f"{ATLAS}?scaled=true")
    assert scaled.json()["unit"] == "lengths of start to goal"
    assert scaled.headers["etag"] != first.headers["etag"]


def test_the_client_reads_it_and_asks_whose_style_one_is(compared: Service):
    demo = compared.client.demos()[0]["id"]
    found = compared.client.atlas(cases.SUTURE, clusters=2, demo=demo)
    assert [one["demos"] for one in found["clusters"]] == [3, 3]
    assert found["recognised"]["demo"] == demo
    assert found["recognised"]["likely"][0]["surgeon"] == found["recognised"]["surgeon"] == cohorts.name(1)
    assert [(one["arm"], one["right"]) for one in found["recognition"]] == [("PSM", 6)]
    assert sum(len(row) for row in found["distances"]) == 15


def test_a_whole_recording_is_recognised_by_its_movements(compared: Service):
    demos = compared.client.demos()
    of = {one["recording"]: one["surgeon"] for one in demos}
    for recording, surgeon in of.items():
        found = compared.client.recognise(recording, cases.SUTURE)
        assert (found["surgeon"], found["voted"]) == (surgeon, surgeon) and found["voters"] >= 1
    assert (found["votes"]["recordings"], found["votes"]["right"]) == (6, 6)
    assert found["recognition"][0]["tested"] >= 6 and found["recognition"][0]["curve"]
    path = f"/styles/{cases.SUTURE}/recognition?recording="
    assert_problem(compared.http.get(path + "0" * 64), 404, "not-found")
    assert_problem(compared.http.get(path + "nothing"), 422, "invalid-request")


def test_the_nearest_are_those_of_the_atlas(compared: Service):
    found = compared.client.atlas(cases.SUTURE)
    demo, rows = found["demos"][0]["id"], found["distances"]
    answer = compared.client.nearest(demo, count=2)
    order = sorted(range(1, 6), key=lambda one: rows[one][0])[:2]
    assert [one["demo"] for one in answer["nearest"]] == [found["demos"][one]["id"] for one in order]
    assert [one["distance"] for one in answer["nearest"]] == [rows[one][0] for one in order]
    assert answer["searched"] == 5 and compared.client.nearest(demo, scaled=True)["unit"] == "lengths of start to goal"
    first = compared.http.get(f"/demos/{demo}/nearest")
    again = compared.http.get(f"/demos/{demo}/nearest", headers={"If-None-Match": first.headers["etag"]})
    assert (first.status_code, again.status_code) == (200, 304)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        (f"/demos/{'0' * 64}/nearest", 404),
        (f"/demos/{'0' * 64}/nearest?count=101", 422),
        (f"/demos/{'0' * 64}/nearest?count=0", 422),
        ("/styles/nothing/atlas", 404),
        ("/styles/simple-interrupted/atlas", 404),
        (f"{ATLAS}?demo={'0' * 64}", 404),
        (f"{ATLAS}?demo=kestrel", 422),
        (f"{ATLAS}?clusters=0", 422),
        (f"{ATLAS}?clusters=7", 422),
        (f"{ATLAS}?scaled=perhaps", 422),
    ],
)
def test_what_cannot_be_answered_is_a_problem(compared: Service, path: str, status: int):
    assert_problem(compared.http.get(path), status)


def test_a_key_sees_an_atlas_of_its_surgeons_and_nothing_of_others(tmp_path: Path):
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        cohorts.add_cohort(service.database, cohort(1, surgeons=2, sessions=2))
        anna, ben = (
            As(service, key(service, "anna", "admin")),
            As(service, key(service, "ben", "reader", surgeons=[cohorts.name(0)])),
        )
        assert len(anna("GET", ATLAS).json()["demos"]) == 4
        answer = ben("GET", ATLAS)
        assert [one["surgeon"] for one in answer.json()["demos"]] == [cohorts.name(0)] * 2
        assert cohorts.name(1) not in answer.text
        others = anna("GET", f"/demos?surgeon={cohorts.name(1)}").json()["items"][0]["id"]
        assert ben("GET", f"{ATLAS}?demo={others}").status_code == 404


PAGE = f"/pages/atlas/{cases.SUTURE}"


@pytest.mark.nightly  # a page; by day tests/api/test_pages.py opens it
def test_the_page_draws_every_demonstration_and_every_distance(compared: Service):
    said = compared.http.get(PAGE).text
    assert said.count('class="mark c0" d="M') > 3 and said.count('class="mark c1" d="M') > 3
    assert len(re.findall(r'<g transform="translate\([\d. -]+\)"><title>surgeon-\d, session', said)) == 6
    assert len(re.findall(r'<rect class="s\d" [^>]*><title>', said)) == 36
    assert said.count('class="medoid"') == 2
    assert "Set-up and day are confounded with the surgeon" in said and "6 of 6" in said
    demo = compared.client.demos()[0]["id"]
    asked = compared.http.get(f"{PAGE}?demo={demo}&clusters=2").text
    assert f"stored as {cohorts.name(1)}" in asked.replace("&#39;", "'") and 'class="asked"' in asked
    assert re.search(r"In the (first|middle|last) third, the path of surgeon-0 is", asked)


@pytest.mark.parametrize(
    ("query", "said"), [("clusters=7", "1 to 6 clusters"), (f"demo={'0' * 64}", "no demonstration with this digest")]
)
def test_a_page_that_cannot_be_drawn_says_why(compared: Service, query: str, said: str):
    answer = compared.http.get(f"{PAGE}?{query}")
    assert (answer.status_code, said in answer.text) == (404, True)


@pytest.mark.nightly  # rarely breaks
def test_more_than_can_be_seen_is_drawn_in_groups_that_hold_all_of_it():
    shapes = np.random.default_rng(3).normal(0, 1, (70, 2))
    far = np.abs(shapes[:, None] - shapes[None, :]).sum(axis=2)
    drawn = drawings.matrix(drawn_from(far))
    assert drawn.count("<title>") == drawings.MOST_GROUPS**2
    groups = drawings._leaves(drawn_from(far))
    assert sorted(one for group in groups for one in group.members) == list(range(70))
    means = drawings._between(far, groups)
    np.testing.assert_allclose(means[0, 5], far[np.ix_(groups[0].members, groups[5].members)].mean())
    tree = re.search(r'class="tree" d="([^"]*)"', drawn)
    assert tree is not None and tree[1].count("V") == drawings.MOST_GROUPS - 1


def drawn_from(far: np.ndarray) -> Atlas:
    """Return an atlas in which demonstrations have nothing but distances."""
    members = [
        Member(at, f"{at:064x}", f"surgeon-{at % 3}", None, at, "PSM2", "PSM2_base", 0.0, 1.0) for at in range(len(far))
    ]
    shapes, signatures = np.zeros((len(far), STATES, 3)), np.random.default_rng(4).normal(size=(len(far), NUMBERS))
    left_out = LeftOutOfAtlas(without_consent=0, without_direction=[], overlapped=[], not_sampled=0, because=[])
    compared, recognised = _Compared(members, shapes, far, False, {}), recognise_arms(members, signatures)
    return _atlas(cases.SUTURE, compared, recognised, left_out, 4, None)
