"""Rows that decide about serving, edited past the service: they are compared with the history when they are read."""

from pathlib import Path

import pytest
from sqlalchemy import text

from skills.api.gate import COOKIE
from skills.db import now, rfc3339
from skills.jobs.watch import Leases, Watch
from skills.library.operation.history import sign_history
from skills.library.people.keys import digest_of
from tests import backends
from tests.api.keyed import As, key
from tests.api.service import KESTREL, POLICY, Service, assert_problem, serving
from tests.library import cases

AT = f"/history?surgeon=kestrel&suture={cases.SUTURE}&at="


def assert_not_served(service: Service) -> None:
    for headers in ({}, {"Accept": "application/x-npz"}):
        assert_problem(service.http.get(POLICY, headers=headers), 503, "corrupt")
    assert_problem(service.http.post(f"{POLICY}/next", json={"position_mm": [0.0, 55.0, -125.0]}), 503, "corrupt")


def test_a_withdrawal_that_was_cleared_stays(trained: Service):
    trained.client.withdraw(**KESTREL)
    trained.tamper("UPDATE releases SET withdrawn_at = NULL")
    assert_not_served(trained)


def test_an_older_release_does_not_come_back_by_an_edit(trained: Service):
    trained.train(seed=1, release=True)
    trained.tamper("UPDATE releases SET withdrawn_at = released_at WHERE row = (SELECT max(row) FROM releases)")
    assert_not_served(trained)


def test_consent_that_was_cleared_stays_withdrawn(trained: Service):
    trained.client.put_surgeon("kestrel", consent={"uses": ["atlas"]})
    trained.tamper("UPDATE surgeons SET consent = NULL", "UPDATE releases SET withdrawn_at = NULL")
    assert_not_served(trained)


def test_a_policy_that_was_served_before_the_edit_is_not_served_after_it(trained: Service):
    assert trained.http.get(POLICY).status_code == 200
    trained.client.withdraw(**KESTREL)
    trained.tamper("UPDATE releases SET withdrawn_at = NULL")  # before anybody asks again
    assert_not_served(trained)


def test_a_planted_leaf_does_not_help(trained: Service):
    trained.client.withdraw(**KESTREL)
    with trained.database.reading() as session:
        leaf = session.execute(text("SELECT * FROM history WHERE table_name = 'releases' ORDER BY row LIMIT 1")).one()
    planted = leaf._asdict()
    columns = ", ".join(name for name in planted if name not in ("row", "number"))
    names = ", ".join(f":{name}" for name in planted if name not in ("row", "number"))
    trained.tamper(
        "UPDATE releases SET withdrawn_at = NULL",
        "DELETE FROM history WHERE table_name = 'releases' AND row > (SELECT min(row) FROM history WHERE table_name = "
        "'releases')",
        f"INSERT INTO history ({columns}) VALUES ({names})",
        **planted | {"seal": b"0" * 32},
    )
    assert_not_served(trained)


def test_a_proof_of_an_edited_row_is_refused_and_not_given(trained: Service):
    sign_history(trained.database)
    trained.tamper("UPDATE releases SET released_by = 'nobody'")
    assert_problem(trained.http.get(AT + rfc3339(now()).replace("+", "%2B")), 503, "corrupt")


def test_edited_and_planted_keys_let_nobody_in(trained: Service):
    trained.client.put_surgeon("heron")
    texts = {name: key(trained, name, role) for name, role in (("ann", "reader"), ("eve", "admin"), ("bo", "admin"))}
    texts["liz"] = key(trained, "liz", "reader", surgeons=["kestrel"])
    assert As(trained, texts["bo"])("DELETE", f"/keys/{texts['eve'].split('_')[1]}").status_code == 200
    planted = "skills_0badc0de_" + "A" * 43
    trained.tamper(
        "UPDATE keys SET role = 'admin' WHERE owner = 'ann'",
        "UPDATE keys SET revoked_at = NULL WHERE owner = 'eve'",
        "INSERT INTO key_surgeons SELECT keys.row, surgeons.row FROM keys, surgeons "
        "WHERE owner = 'liz' AND slug = 'heron'",
        "INSERT INTO keys (id, digest, owner, role, restricted, created_at, created_by) "
        "SELECT '0badc0de', :digest, 'eve', 'admin', restricted, created_at, 'eve' FROM keys WHERE owner = 'bo'",
        digest=digest_of(planted),
    )
    trained.app.state.access.forget()
    for text_of in (texts["ann"], texts["eve"], texts["liz"], planted):
        assert_problem(As(trained, text_of)("GET", "/surgeons"), 401)
    assert As(trained, texts["bo"])("GET", "/surgeons").status_code == 200


def test_a_planted_sign_in_lets_nobody_in(trained: Service):
    key(trained, "bo", "admin")
    trained.tamper(
        "INSERT INTO sign_ins SELECT :digest, row, created_at, created_at FROM keys", digest=digest_of("a cookie")
    )
    trained.app.state.access.forget()
    assert_problem(trained.http.get("/surgeons", headers={"Cookie": f"{COOKIE}=a cookie"}), 401)


def test_an_edited_sign_in_lets_nobody_in(trained: Service):
    key(trained, "bo", "admin")
    form = {"key": key(trained, "ann", "reader")}
    said = trained.http.post("/sign-in", data=form, follow_redirects=False).headers["set-cookie"].partition(";")[0]
    trained.http.cookies.clear()
    assert trained.http.get("/surgeons", headers={"Cookie": said}).status_code == 200
    trained.tamper("UPDATE sign_ins SET key_row = (SELECT row FROM keys WHERE owner = 'bo')")
    trained.app.state.access.forget()
    assert_problem(trained.http.get("/surgeons", headers={"Cookie": said}), 401)


def test_keys_that_were_deleted_do_not_open_the_installation(trained: Service):
    key(trained, "bo", "admin")
    trained.tamper("DELETE FROM keys")
    trained.app.state.access.forget()
    assert_problem(trained.http.get("/surgeons"), 401)


@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_the_first_worker_verifies_the_rest_and_tells(backend: str, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    url = backends.fresh(backend, tmp_path)
    with serving(url) as service:
        database = service.database
        cases.add_surgeon(database)
        one, two = (Watch(database, None, name, Leases(2.0), lambda _: None) for name in ("one", "two"))
        for watch in (one, two):
            watch.beat()
        one.verify()
        assert "skills_history_faults 0.0" in service.http.get("/metrics").text
        with database.engine.connect() as connection:
            connection.exec_driver_sql("DELETE FROM surgeons")
            connection.commit()
        two.verify()  # not the first
        assert "skills_history_faults 0.0" in service.http.get("/metrics").text
        one.verify()
        said = service.http.get("/metrics").text
        assert "skills_history_faults 1.0" in said
        assert "skills_history_verified_timestamp_seconds" in said
    assert "The history is not whole: surgeons 1: it is missing" in caplog.text
    backends.drop(url)
