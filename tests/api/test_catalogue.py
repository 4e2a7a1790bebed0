"""Surgeons, suture types, and their lists."""

import tomllib
from importlib import resources

import pytest

from skills.client import Problem
from tests.api.service import CSV, KESTREL, Service, assert_problem
from tests.by_day import some
from tests.library import cases

ELEVEN = {
    "simple-interrupted",
    "simple-running",
    "running-locked",
    "horizontal-mattress",
    "vertical-mattress",
    "half-buried-mattress",
    "figure-of-eight",
    "simple-buried",
    "running-subcuticular",
    "interrupted-subcuticular",
    "purse-string",
}


def test_an_empty_database_starts_with_the_eleven_suture_types(service: Service):
    listed = service.client.suture_types()
    assert {one["suture"] for one in listed} == ELEVEN
    text = (resources.files("skills") / "seeds" / "suture_types.toml").read_text()
    assert {one["slug"] for one in tomllib.loads(text)["suture_type"]} == ELEVEN
    assert all(one["name"] and one["family"] for one in listed)


def test_put_writes_a_surgeon_whole(service: Service):
    full = {"skill_level": "novice", "handedness": "left", "protocol": "IRB 1", "consent": {"uses": ["training"]}}
    first = service.http.put("/surgeons/kestrel", json=full)
    assert first.status_code == 201
    assert first.json()["consent"] == {"uses": ["training"], "until": None}
    second = service.http.put("/surgeons/kestrel", json={"skill_level": "expert"})
    assert second.status_code == 200
    about = service.client.surgeon("kestrel")
    assert about["created_at"] == first.json()["created_at"]
    assert (about["skill_level"], about["handedness"], about["protocol"], about["consent"]) == (
        "expert",
        None,
        None,
        None,
    )


def test_put_writes_a_suture_type_whole(service: Service):
    about = {"name": "Lembert", "also_called": ["inverting"], "family": "running", "description": "For bowel."}
    assert service.http.put("/suture-types/lembert", json=about).status_code == 201
    answer = service.http.put("/suture-types/lembert", json={"name": "Lembert", "family": "running"})
    assert answer.status_code == 200
    assert answer.json() == {
        "suture": "lembert", "name": "Lembert", "also_called": [], "family": "running", "description": ""
    }  # fmt: skip
    assert service.http.get("/suture-types/lembert").json() == answer.json()


def test_what_is_unknown_is_404_and_says_what_to_do(service: Service):
    problem = assert_problem(service.http.get("/surgeons/nobody"), 404, "not-found")
    assert "PUT /surgeons/nobody" in problem["detail"]
    assert "GET /suture-types" in assert_problem(service.http.get("/suture-types/nothing"), 404)["detail"]
    service.client.put_surgeon("kestrel")
    for path in (
        "/policies/kestrel/nothing",
        "/policies/nobody/simple-running",
        "/policies/kestrel/nothing/versions/1",
    ):
        assert_problem(service.http.get(path), 404, "not-found")


def test_an_erased_surgeon_is_gone_for_good(service: Service):
    service.client.put_surgeon("kestrel")
    service.client.erase_surgeon("kestrel")
    for answer in (
        service.http.get("/surgeons/kestrel"),
        service.http.put("/surgeons/kestrel", json={}),
        service.http.delete("/surgeons/kestrel"),
        service.http.get("/policies/kestrel/simple-running"),
        service.http.get("/demos?surgeon=kestrel"),
        service.http.post("/demos", params=KESTREL, content=cases.hand_off(), headers={"Content-Type": CSV}),
        service.http.post("/trainings", json=KESTREL),
    ):
        assert_problem(answer, 410, "erased")
    assert service.counts()["recordings"] == 0
    assert "kestrel" not in str(service.client.surgeons())
    assert service.http.put("/surgeons/kestrel-2", json={}).status_code == 201


def walk(service: Service, path: str, limit: int) -> list[dict]:
    items, cursor = [], None
    path += "&" if "?" in path else "?"
    while True:
        page = service.http.get(f"{path}limit={limit}" + ("" if cursor is None else f"&cursor={cursor}")).json()
        assert len(page["items"]) <= limit
        items += page["items"]
        cursor = page["next"]
        if cursor is None:
            return items


@pytest.mark.parametrize("limit", some([5, 1, 2, 3, 4, 6, 7], 4))
def test_walking_a_list_by_its_cursors_meets_everything_once(many: Service, limit: int):
    for path, key, number in (
        ("/surgeons", "surgeon", 6),
        ("/suture-types", "suture", 11),
        ("/demos", "id", 6),
        ("/demos?surgeon=s0", "id", 1),
        ("/jobs", "id", 6),
        ("/jobs?state=queued", "id", 6),
        ("/jobs?state=failed", "id", 0),
        ("/policies", "surgeon", 0),
    ):
        items = walk(many, path, limit)
        assert len({one[key] for one in items}) == len(items) == number, path
    newest = [one["surgeon"] for one in walk(many, "/demos", limit)]
    assert newest == [f"s{i}" for i in reversed(range(6))]


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory):
    from tests import backends
    from tests.api.service import serving

    with serving(backends.fresh("sqlite", tmp_path_factory.mktemp("many"))) as service:
        for i in range(6):
            service.client.put_surgeon(f"s{i}")
            service.client.add_demo(cases.hand_off(), surgeon=f"s{i}", suture=cases.SUTURE, media_type=CSV)
            service.client.train(f"s{i}", cases.SUTURE)
        yield service


@pytest.mark.parametrize("query", ["limit=0", "limit=201", "limit=x", "cursor=-1", "cursor=x", "cursor=" + "9" * 40])
def test_a_limit_or_cursor_that_cannot_be_meant_is_refused(many: Service, query: str):
    assert_problem(many.http.get(f"/demos?{query}"), 422, "invalid-request")


@pytest.mark.parametrize("kind", ["fail", "ran out"])
def test_consent_that_does_not_cover_training_stops_it(trained: Service, kind: str):
    consent = {"uses": ["export"]} if kind == "fail" else {"uses": ["training"], "until": "2020-01-01"}
    trained.client.put_surgeon("kestrel", consent=consent)
    before = trained.counts()
    with pytest.raises(Problem, match="does not cover training" if kind == "fail" else "expired on 2020") as refused:
        trained.client.train(**KESTREL, seed=1)
    assert (refused.value.status, refused.value.kind) == (409, "conflict")
    assert trained.counts() == before
    trained.client.put_surgeon("kestrel", consent={"uses": ["training"], "until": "2999-12-31"})
    assert trained.client.train(**KESTREL, seed=1)["state"] == "queued"
