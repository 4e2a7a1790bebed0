"""Permissions: every route with every role gets exactly the allowed status, and undeclared routes are found."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import APIRouter
from sqlalchemy import update

from skills.api.authorisation import Needs
from skills.api.gate import is_open
from skills.db import now
from skills.db.service_tables import Key
from skills.library.people.keys import LADDER, revoke_key
from tests import backends
from tests.api.keyed import As, key, routes
from tests.api.service import Service, serving

EVERYBODY, READER, UPLOADER, TRAINER, RELEASER, ADMIN = None, *LADDER
NEEDED = {
    "GET /healthz": EVERYBODY,
    "GET /openapi.json": EVERYBODY,
    "GET /docs": EVERYBODY,
    "GET /sign-in": EVERYBODY,
    "POST /sign-in": EVERYBODY,
    "POST /sign-out": READER,
    "GET /static/{version}/{name}": EVERYBODY,
    "GET /readyz": READER,
    "GET /metrics": READER,
    "PUT /surgeons/{surgeon}": ADMIN,
    "DELETE /surgeons/{surgeon}": ADMIN,
    "PUT /suture-types/{suture}": ADMIN,
    "POST /recordings": UPLOADER,
    "POST /recordings/preview": UPLOADER,
    "POST /demos": UPLOADER,
    "POST /recordings/{recording}/demos": UPLOADER,
    "DELETE /recordings/{recording}": UPLOADER,
    "PUT /recordings/{recording}/proposals/{number}": UPLOADER,
    "POST /suture-points": UPLOADER,
    "PUT /demos/{demo}/outcome": RELEASER,
    "DELETE /demos/{demo}": RELEASER,
    "POST /trainings": TRAINER,
    "POST /retrainings": TRAINER,
    "POST /tries": TRAINER,
    "DELETE /jobs/{job}": TRAINER,
    "POST /plans": TRAINER,
    "POST /reach": TRAINER,
    "POST /playbacks": TRAINER,
    "POST /datasets": TRAINER,
    "DELETE /datasets/{dataset}": TRAINER,
    "POST /playbacks/{playback}/pictures": TRAINER,
    "POST /policies/{surgeon}/{suture}/versions/{version}/release": RELEASER,
    "DELETE /policies/{surgeon}/{suture}/release": RELEASER,
    "POST /policies/{surgeon}/{suture}/rollouts": READER,
    "POST /policies/{surgeon}/{suture}/next": READER,
    "POST /scores": READER,
    "GET /keys": ADMIN,
    "POST /keys": ADMIN,
    "DELETE /keys/{key}": ADMIN,
}  # every other GET: reader
SHAPES = {
    "surgeon": "nobody",
    "suture": "simple-running",
    "job": "0" * 16,
    "key": "0" * 8,
    "version": "1",
    "number": "1",
    "name": "site.css",
}


def path_of(path: str) -> str:
    """Fill a path with ids that do not exist."""
    for name in [part[1:-1] for part in path.split("/") if part.startswith("{")]:
        path = path.replace(f"{{{name}}}", SHAPES.get(name, "0" * 64))
    return path


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setattr("skills.api.rate_limits.BAD_AT_ONCE", 10**6)
    monkeypatch.setattr("skills.api.rate_limits.BAD_OF_ALL_AT_ONCE", 10**6)
    with serving(backends.fresh("sqlite", tmp_path), key_requests_per_s=1e6) as service:
        yield service


@pytest.mark.parametrize("of", [2, pytest.param(1, marks=pytest.mark.nightly)])
def test_every_route_answers_every_role_as_the_table_says(service: Service, of: int):
    credentials = {role: key(service, f"a {role}", role) for role in LADDER}
    revoked, expired = key(service, "gone", "admin"), key(service, "late", "admin")
    with service.database.writing() as session:
        revoke_key(session, revoked.split("_")[1], "local")
        session.execute(update(Key).where(Key.id == expired.split("_")[1]).values(expires_at=now()))
    other = credentials["admin"][:-43] + "A" * 43
    strangers = {"nothing": "", "not a key": "letmein", "a wrong key": other, "revoked": revoked, "expired": expired}
    declared = set()
    for number, (method, path, _) in enumerate(routes(service)):
        named = f"{method} {path}"
        needed = NEEDED.get(named, READER) if method == "GET" else NEEDED[named]
        declared.add(named)
        refused = dict(list(strangers.items())[number % of :: of])  # by day every second, others at the next route
        for who, text in (refused | credentials).items():
            ask = As(service, text) if text else service.http.request
            status = ask(method, path_of(path), follow_redirects=False).status_code
            if needed is None:
                assert status not in (401, 403) or (named, status) == ("POST /sign-in", 401), (named, who, status)
            elif who in strangers:
                assert status == 401, (named, who, status)
            elif LADDER.index(who) < LADDER.index(needed):
                assert status == 403, (named, who, status)
            else:
                assert status not in (401, 403), (named, who, status)
    assert set(NEEDED) <= declared


def undeclared(service: Service) -> list[str]:
    """Find the routes that declare no permission, or another one than the authorisation knows."""
    found = []
    for method, path, dependencies in routes(service):
        needs = [one.dependency for one in dependencies if isinstance(one.dependency, Needs)]
        if path == "/openapi.json":
            continue  # FastAPI's own
        if len(needs) != 1 or (needs[0].role is None) != is_open(path):
            found.append(f"{method} {path}")
    return found


def test_every_route_declares_its_role_and_an_undeclared_one_is_refused(service: Service):
    assert undeclared(service) == []
    forgotten = APIRouter()
    forgotten.get("/forgotten")(lambda: "everything")
    service.app.include_router(forgotten)
    assert undeclared(service) == ["GET /forgotten"]
    key(service, "anna", "reader")
    assert service.http.get("/forgotten").status_code == 401


def test_only_releasers_train_with_release_and_only_admins_erase_a_demo(service: Service):
    asked = {"surgeon": "nobody", "suture": "simple-running"}
    trainer, releaser, admin = (As(service, key(service, role, role)) for role in ("trainer", "releaser", "admin"))
    for path, body in (("/trainings", asked), ("/retrainings", asked), ("/tries", asked | {"recording": "0" * 64})):
        assert trainer("POST", path, json=body).status_code == 404
        assert trainer("POST", path, json=body | {"release": True}).status_code == 403
        assert releaser("POST", path, json=body | {"release": True}).status_code == 404
    for who, erase, status in (
        (releaser, "false", 404),
        (releaser, "true", 403),
        (releaser, "1", 403),
        (admin, "1", 404),
    ):
        assert who("DELETE", f"/demos/{'0' * 64}?erase={erase}").status_code == status


def test_who_did_what_is_known_by_the_owner_of_the_key(service: Service):
    admin = As(service, key(service, "anna", "admin"))
    assert admin("PUT", "/surgeons/kestrel", json={}).status_code == 201
    from sqlalchemy import text

    with service.database.reading() as session:
        said = session.execute(text("SELECT actor, action, object_kind FROM events ORDER BY row")).all()
    assert [tuple(one) for one in said[-2:]] == [("local", "create", "key"), ("anna", "add", "surgeon")]
