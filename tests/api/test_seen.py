"""A key restricted to heron: every call answers for kestrel's objects as if they did not exist."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from skills.api.gate import is_open
from skills.db import Base
from skills.db.row_visibility import UNRESTRICTED_TABLES, Only
from skills.db.service_tables import Job
from skills.library.operation.jobs import attempts_to_submit
from skills.library.people.keys import held, list_keys
from tests.api.keyed import HERON, As, copy_of_told, key, routes
from tests.api.service import CSV, GOAL_MM, KESTREL, Service, serving
from tests.library import cases


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(copy_of_told(tmp_path_factory.mktemp("told")), key_requests_per_s=1e6) as service:
        yield service


@pytest.fixture
def admin(service: Service) -> As:
    return As(service, key(service, "anna", "admin"))


@pytest.fixture
def heron(service: Service) -> As:
    """Return a user with the highest role that can be restricted."""
    return As(service, key(service, "of heron", "releaser", surgeons=["heron"]))


def ids(admin: As, surgeon: str) -> dict[str, str]:
    """Find a surgeon's objects, by the parameter names that they have in paths."""
    demo = admin("GET", f"/demos?surgeon={surgeon}").json()["items"][0]
    found = {"surgeon": surgeon, "suture": cases.SUTURE, "demo": demo["id"], "recording": demo["recording"]}
    found["number"] = "1"
    jobs = admin("GET", "/jobs").json()["items"]
    if surgeon == "kestrel":
        played = next(job["result"] for job in jobs if job["kind"] == "playback")
        served = admin("GET", f"/policies/kestrel/{cases.SUTURE}").json()
        found |= {"job": next(job["id"] for job in jobs if job["kind"] == "retraining"), "version": "2"}
        found |= {"policy": served["sha256"], "playback": played["playback"]}
        found["plan"] = admin("GET", f"/playbacks/{played['playback']}").json()["plan"]
    return found


def filled(path: str, about: dict[str, str]) -> str | None:
    """Fill a path with ids; None if it names nothing that belongs to a surgeon."""
    names = [part[1:-1] for part in path.split("/") if part.startswith("{")]
    if not set(names) & set(about) - {"suture", "version", "number"}:
        return None
    for name in names:
        path = path.replace(f"{{{name}}}", about[name])
    return path


def test_paths_to_kestrels_objects_are_404_for_heron_and_exist_for_admin(service: Service, admin: As, heron: As):
    kestrels, seen = ids(admin, "kestrel"), 0
    query = {
        "/plans/{plan}/comparison": f"?demo={kestrels['demo']}",
        "/surgeons/{surgeon}/progress": f"?suture={cases.SUTURE}&against=kestrel",
    }
    for method, path, _ in routes(service):
        if (where := filled(path, kestrels)) is None:
            continue
        where += query.get(path, "")
        answer = heron(method, where)
        bodiless = method in ("POST", "PUT") and "{surgeon}" not in path  # refused before the look-up
        refused = {403} if path == "/surgeons/{surgeon}" and method != "GET" else {404, 422} if bodiless else {404}
        assert answer.status_code in refused, (method, path, answer.status_code)
        assert "kestrel" not in answer.text, (method, path)
        if method == "GET" and not path.endswith("/events"):
            there = admin("GET", where).status_code
            assert there == 200 or path.endswith((".png", ".gif", ".mp4", "comparison", "pose-style")), (path, there)
            seen += there == 200
    assert seen > 20


def test_what_is_herons_own_is_there(service: Service, admin: As, heron: As):
    own, seen = ids(admin, "heron"), 0
    for method, path, _ in routes(service):
        names = {part[1:-1] for part in path.split("/") if part.startswith("{")}
        if method == "GET" and names and names <= set(own) and names & {"surgeon", "demo", "recording"}:
            status = heron("GET", filled(path, own) or "").status_code
            assert status == admin("GET", filled(path, own) or "").status_code, path
            seen += status == 200
    assert seen >= 8


def test_no_list_and_no_page_has_anything_of_kestrels(service: Service, admin: As, heron: As):
    full = 0
    for method, path, _ in routes(service):
        if method != "GET" or "{" in path or is_open(path):
            continue
        answer = heron("GET", path)
        refused = {"/readyz": 403, "/metrics": 403, "/keys": 403, "/history": 422}  # the last one needs a query
        assert answer.status_code == refused.get(path, 200), path
        assert "kestrel" not in answer.text, path
        full += "kestrel" in admin("GET", path).text
    assert full >= 5
    assert [one["surgeon"] for one in heron("GET", "/surgeons").json()["items"]] == ["heron"]
    assert len(heron("GET", "/demos").json()["items"]) == 1
    assert heron("GET", "/policies").json()["items"] == []
    assert heron("GET", "/jobs").json()["items"] == []


def test_no_body_or_query_reaches_anything_of_kestrels(service: Service, admin: As, heron: As):
    kestrels, own = ids(admin, "kestrel"), ids(admin, "heron")
    asked: list[tuple[str, str, dict[str, Any]]] = [
        ("GET", "/history", {"params": KESTREL | {"at": "2100-01-01T00:00:00Z"}}),
        ("POST", "/trainings", {"json": KESTREL}),
        ("POST", "/trainings", {"json": HERON | {"demos": [kestrels["demo"]]}}),
        ("POST", "/retrainings", {"json": {"surgeon": "kestrel"}}),
        ("PUT", f"/demos/{kestrels['demo']}/outcome", {"json": {"outcome": "success"}}),
        ("POST", "/plans", {"json": KESTREL | {"suture_points": [{"position_mm": GOAL_MM}], "handoff": "none"}}),
        ("POST", "/playbacks", {"json": {"plan": kestrels["plan"]}}),
        ("POST", "/datasets", {"json": {"surgeons": ["kestrel"]}}),
        ("POST", "/datasets", {"json": {"demos": [kestrels["demo"]]}}),
        ("POST", f"/recordings/{own['recording']}/demos", {"json": KESTREL}),
        ("POST", f"/recordings/{kestrels['recording']}/demos", {"json": HERON}),
        ("POST", "/demos", {"params": KESTREL, "content": cases.hand_off(), "headers": {"Content-Type": CSV}}),
        ("GET", "/demos?surgeon=kestrel", {}),
        ("GET", f"/policies?surgeon=kestrel&suture={cases.SUTURE}", {}),
    ]
    for method, path, how in asked:
        answer = heron(method, path, **how)
        assert answer.status_code in (404, 409), (path, answer.text)
        assert answer.status_code == 404 or "demos" in how["json"], path


def test_a_batch_for_all_is_one_for_the_surgeons_of_the_key(service: Service, admin: As, heron: As):
    asked = heron("POST", "/retrainings", json={})
    assert asked.status_code == 202
    job = asked.json()["id"]
    about = heron("GET", f"/retrainings/{job}").json()
    assert [one["surgeon"] for one in about["items"]] == ["heron"]
    assert job in [one["id"] for one in heron("GET", "/jobs").json()["items"]]
    alike = As(service, key(service, "another of heron", "trainer", surgeons=["heron"]))
    assert alike("POST", "/retrainings", json={}).json()["id"] == job
    assert job in [one["id"] for one in alike("GET", "/jobs").json()["items"]]
    everybodys = admin("POST", "/retrainings", json={}).json()["id"]
    for where in (f"/jobs/{everybodys}", f"/retrainings/{everybodys}"):
        assert (heron("GET", where).status_code, admin("GET", where).status_code) == (404, 200)
    with service.database.seen_by(held_by(service, "of heron")).reading() as session:
        found = session.scalar(select(Job).where(Job.id == job))
        assert found is not None
        assert (
            len(attempts_to_submit(session, found)) == 1
        )  # its parts are visible too, otherwise the engine would never get them
    assert heron("DELETE", f"/jobs/{job}").json()["state"] == "cancelled"
    assert admin("DELETE", f"/jobs/{everybodys}").json()["state"] == "cancelled"


def held_by(service: Service, owner: str) -> Only | None:
    with service.database.reading() as session:
        return next(held(one).only for one in list_keys(session) if one.owner == owner)


def test_a_duplicate_upload_reveals_nothing_and_grants_access_from_then_on(service: Service, admin: As, heron: As):
    recording = ids(admin, "kestrel")["recording"]
    assert heron("GET", f"/recordings/{recording}").status_code == 404
    sent = [heron("POST", "/recordings", content=cases.hand_off(), headers={"Content-Type": CSV}) for _ in range(2)]
    assert [one.status_code for one in sent] == [201, 200]
    assert heron("GET", f"/recordings/{recording}").status_code == 200
    assert "kestrel" not in heron("GET", f"/recordings/{recording}").text
    other = As(service, key(service, "beside heron", "releaser", surgeons=["heron"]))
    assert other("GET", f"/recordings/{recording}").status_code == 404
    cut = heron("POST", f"/recordings/{recording}/demos", json=HERON)
    assert cut.status_code == 201
    assert other("GET", f"/recordings/{recording}").status_code == 200


def test_a_key_whose_surgeon_is_erased_sees_nobody_rather_than_everybody(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        admin, heron = (
            As(service, key(service, "anna", "admin")),
            As(service, key(service, "h", "reader", surgeons=["heron"])),
        )
        assert heron("GET", "/surgeons/heron").status_code == 200
        assert admin("DELETE", "/surgeons/heron").status_code == 204
        service.app.state.access.forget()
        assert heron("GET", "/surgeons").json()["items"] == []
        assert heron("GET", "/surgeons/kestrel").status_code == 404
        assert admin("GET", "/keys").json()["items"][1]["surgeons"] == []


def naming(service: Service, name: str) -> list[tuple[str, str, dict[str, Any]]]:
    """List calls that name a surgeon in a path, a query or a body."""
    style = f"surgeon={name}&suture={cases.SUTURE}"
    queries = ("/demos?", "/policies?", "/proposals?", "/history?at=2100-01-01T00:00:00Z&")
    body, about = {"surgeon": name, "suture": cases.SUTURE}, {"suture": cases.SUTURE, "version": "1", "surgeon": name}
    paths = [(method, filled(path, about)) for method, path, _ in routes(service) if "{surgeon}" in path]
    return [
        *(("GET", f"{where}{style}", {}) for where in queries),
        ("GET", f"/surgeons/heron/progress?suture={cases.SUTURE}&against={name}", {}),
        ("POST", "/trainings", {"json": body}),
        ("POST", "/retrainings", {"json": {"surgeon": name}}),
        ("POST", "/datasets", {"json": {"surgeons": [name]}}),
        ("POST", f"/recordings?surgeon={name}", {"content": cases.hand_off(), "headers": {"Content-Type": CSV}}),
        ("POST", f"/demos?{style}", {"content": cases.hand_off(), "headers": {"Content-Type": CSV}}),
        *((method, path or "", {"json": {}} if method in ("POST", "PUT") else {}) for method, path in paths),
    ]


def test_an_erased_surgeon_is_as_unknown_to_a_restricted_key_as_nobody(tmp_path: Path):
    with serving(copy_of_told(tmp_path)) as service:
        admin, heron = (
            As(service, key(service, "anna", "admin")),
            As(service, key(service, "h", "releaser", surgeons=["heron"])),
        )
        assert admin("DELETE", "/surgeons/kestrel").status_code == 204

        def said(who: As, name: str, most: int) -> list[tuple[str, int, str]]:
            calls = naming(service, name)[:most]
            answers = [(path, who(method, path, **how)) for method, path, how in calls]
            return [(path.replace(name, "-"), one.status_code, one.text.replace(name, "-")) for path, one in answers]

        erased, unknown = said(heron, "kestrel", 99), said(heron, "nestrel", 99)
        assert erased == unknown
        assert {status for _, status, _ in erased} <= {403, 404, 422}
        assert [status for _, status, _ in said(admin, "kestrel", 10)] == [410] * 10


def test_every_table_has_a_rule_or_is_said_to_need_none():
    ruled = {table.__tablename__ for table in Only("somebody", frozenset({1})).rules}
    assert ruled | set(UNRESTRICTED_TABLES) == set(Base.metadata.tables)
    assert not ruled & set(UNRESTRICTED_TABLES)
