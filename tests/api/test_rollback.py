"""A database that was put back to an older copy, or is used with another key, is neither served nor written."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import select, text

from skills.api import policy_cache
from skills.db.leaves import CHECKPOINTS
from skills.db.service_tables import Event
from skills.db.session import Database
from skills.errors import Conflict, NotReady
from skills.library.operation.backup import accept_rollback, back_up, restore
from skills.library.operation.erasure_list import erasures_of
from skills.library.operation.history import Verified, sign_history, sign_some_history, verify_history
from skills.library.people.erasure import erase_surgeon
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.policies.releases import withdraw
from skills.schemas.people import SurgeonIn
from skills.settings import Settings
from skills.transparency.notes import read_notes
from skills.transparency.signing_keys import SigningKey
from tests import backends
from tests.api.service import POLICY, Service, assert_problem, serving
from tests.library import cases
from tests.put_back import copy_away, put_back
from tests.waiting import until

OLDER = "older than the one whose history was saved last"
CLOSED = (("GET", POLICY), ("GET", "/readyz"), ("GET", "/surgeons"), ("GET", "/"), ("PUT", "/surgeons/heron"))


@pytest.fixture(params=backends.BACKENDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Yield a database in which kestrel's policy is released, and that is signed."""
    here = backends.fresh(request.param, tmp_path)
    with closing(Database(here)) as database:
        cases.add_surgeon(database)
        cases.add_demo(database)
        cases.train(database, release=True)
        sign_history(database)
    yield here
    backends.drop(here)


def stop_serving(database: Database) -> None:
    with database.writing() as session:
        withdraw(session, find_surgeon(session, "kestrel"), cases.SUTURE, "test")
    sign_history(database)


def roll_back(url: str) -> None:
    """Withdraw the policy, and put back the database of before."""
    older = copy_away(url)
    with closing(Database(url)) as database:
        stop_serving(database)
    put_back(older, url)


def heads_of(url: str) -> list[int]:
    with closing(Database(url)) as database:
        return [note.checkpoint.size for note in read_notes(database.history.heads_file.read_text())]


def assert_closed(service: Service, why: str) -> None:
    """Assert that nothing is served or written, and that every answer says why."""
    before = service.counts()
    for method, path in CLOSED:
        answer = service.http.request(method, path, json={} if method == "PUT" else None)
        said = assert_problem(answer, 503, "not-ready")["detail"]
        assert why in said
        assert "/" not in said.replace("/readyz", "")  # no path of the machine
    assert service.http.get("/healthz").status_code == 200
    with pytest.raises(NotReady, match=why), service.database.writing() as session:
        put_surgeon(session, "wren", SurgeonIn(), "test")
    assert service.counts() == before


def test_an_older_copy_that_was_put_back_is_not_served(url: str, caplog: pytest.LogCaptureFixture):
    older = copy_away(url)
    with closing(Database(url)) as database:
        stop_serving(database)
    right, kept = copy_away(url), heads_of(url)
    put_back(older, url)
    with serving(url) as service:
        assert_closed(service, OLDER)
        assert "skills accept-rollback" in service.http.get(POLICY).json()["detail"]
        assert not sign_some_history(service.database)
    assert heads_of(url) == kept  # no fork is appended
    assert OLDER in caplog.text
    put_back(right, url)
    with serving(url) as service:
        assert_problem(service.http.get(POLICY), 404)


@pytest.mark.parametrize("url", ["postgresql"], indirect=True)  # connections keep a SQLite file that is replaced
def test_a_rollback_under_a_running_service_is_noticed(url: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(policy_cache, "SWEEP_S", 0.05)
    older = copy_away(url)
    with serving(url) as service:
        stop_serving(service.database)
        assert_problem(service.http.get(POLICY), 404)
        service.database.engine.dispose()
        put_back(older, url)
        assert_problem(service.http.get(POLICY), 503, "not-ready")  # never the policy, not even before it is noticed
        until(lambda: service.http.get("/surgeons").status_code == 503)
        assert_closed(service, OLDER)


def test_a_rollback_is_accepted_by_a_command_that_is_logged(url: str):
    older = copy_away(url)
    with closing(Database(url)) as database:
        stop_serving(database)
        listed, size = erasures_of(database), heads_of(url)[-1]
    put_back(older, url)
    with closing(Database(url)) as database:
        ended = accept_rollback(database, listed)
        assert ended["styles_stopped"] == 1
        with database.reading() as session:
            said = select(Event.object_id).where(Event.action == "accept", Event.object_kind == "rollback")
            assert session.scalars(said).all() == [f"{size} leaves"]
            assert list(verify_history(session.connection(), database.history, None, Verified())) == []
        with pytest.raises(Conflict, match="nothing to accept"):
            accept_rollback(database)
        beside = database.history.heads_file
        (aside,) = beside.parent.glob(f"{beside.name}.until-*")
        assert read_notes(aside.read_text())[-1].checkpoint.size == size
    with serving(url) as service:
        assert_problem(service.http.get(POLICY), 404)  # withdrawn again, by the list
        service.client.put_surgeon("heron")


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_a_surgeon_that_the_list_erases_again_is_nowhere_in_the_files(url: str):
    with closing(Database(url)) as database:
        cases.add_surgeon(database, "waxwing")
        sign_history(database)
    older = copy_away(url)
    with closing(Database(url)) as database:
        cases.committed(database, erase_surgeon, "waxwing", "test")
        sign_history(database)
        listed = erasures_of(database)
    put_back(older, url)
    file = Path(url.removeprefix("sqlite:///"))
    with closing(Database(url)) as database:
        assert b"waxwing" in file.read_bytes()
        assert accept_rollback(database, listed)["surgeons_erased"] == 1
        assert not [one.name for one in file.parent.glob(f"{file.name}*") if b"waxwing" in one.read_bytes()]


def test_a_history_that_went_another_way_is_not_served(url: str):
    older = copy_away(url)
    with closing(Database(url)) as database:
        stop_serving(database)
    with closing(Database(older)) as database:  # its place has heads of its own
        for surgeon in ("heron", "lark", "wren", "finch"):
            cases.add_surgeon(database, surgeon)
        sign_history(database)
    put_back(older, url)
    with serving(url) as service:
        assert_closed(service, "another than the one whose history was saved last")


def test_a_backup_that_is_restored_in_its_place_is_accepted(tmp_path: Path):
    url = backends.fresh("sqlite", tmp_path)
    with closing(Database(url)) as database:
        cases.add_surgeon(database)
        cases.add_demo(database)
        sign_history(database)
        back_up(database, tmp_path / "backup")
        cases.add_surgeon(database, "heron")
        sign_history(database)
        database.forget()
    Path(url.removeprefix("sqlite:///")).unlink()
    with closing(Database(url)) as database:
        restore(database, tmp_path / "backup")
        sign_history(database)
    with serving(url) as service:
        service.client.put_surgeon("wren")


def test_a_database_begun_anew_is_served_and_the_one_of_before_is_not(tmp_path: Path):
    url = backends.blank("sqlite", tmp_path)
    with serving(url) as service:
        service.client.put_surgeon("heron")
    before = copy_away(url)
    Path(url.removeprefix("sqlite:///")).unlink()
    with serving(url) as service:
        service.client.put_surgeon("kestrel")
    put_back(before, url)
    with serving(url) as service:
        assert_closed(service, "another than the one whose history was saved last")


def test_another_key_serves_and_writes_nothing(url: str, tmp_path: Path):
    key = tmp_path / "another.key"
    key.write_text(str(SigningKey(b"another key of thirty-two bytes!")))
    with serving(url, signing_key=key) as service:
        assert_closed(service, "was signed with another key")
        with pytest.raises(NotReady, match="signed with another key"):
            accept_rollback(service.database)
    with serving(url) as service:  # nothing was written with it
        service.client.put_surgeon("wren")
        with service.database.reading() as session:
            assert list(verify_history(session.connection(), service.database.history, None, Verified())) == []


def test_heads_that_cannot_be_read_are_no_reason_to_serve(url: str):
    with closing(Database(url)) as database:
        database.history.heads_file.write_text("nothing\n")
    with serving(url) as service:
        assert_closed(service, "does not end in a signed checkpoint")


def test_a_history_whose_checkpoints_were_all_removed_is_not_served(url: str):
    with closing(Database(url)) as database, database.engine.connect() as connection:
        on = "" if url.startswith("sqlite") else " ON history_checkpoints"
        connection.exec_driver_sql(f"DROP TRIGGER history_checkpoints_kept{on}")
        connection.execute(CHECKPOINTS.delete())
        connection.commit()
    with serving(url) as service:
        assert_closed(service, "history of this database was removed")


def test_rows_whose_history_was_removed_are_not_logged_anew(url: str):
    on = "" if url.startswith("sqlite") else " ON {}"
    with closing(Database(url)) as database, database.engine.connect() as connection:
        for table in ("history_checkpoints", "history"):
            connection.exec_driver_sql(f"DROP TRIGGER {table}_kept{on.format(table)}")
            connection.exec_driver_sql(f"DELETE FROM {table}")
        connection.exec_driver_sql("UPDATE surgeons SET skill_level = 'expert'")
        connection.commit()
    with closing(Database(url)) as database, pytest.raises(NotReady, match="history of this database was removed"):
        database.migrate()


def test_a_clean_stop_signs_what_is_not_signed_yet(url: str):
    with serving(url) as service:
        service.client.put_surgeon("heron")
    with closing(Database(url)) as database, database.reading() as session:
        assert session.scalar(text("SELECT count(*) FROM history WHERE number IS NULL")) == 0
        newest = session.scalar(select(CHECKPOINTS.c.size).order_by(CHECKPOINTS.c.row.desc()).limit(1))
    assert heads_of(url)[-1] == newest


def test_checkpoints_that_were_removed_are_reported(url: str):
    with closing(Database(url)) as database:
        for surgeon in ("heron", "lark"):
            cases.add_surgeon(database, surgeon)
            sign_history(database)
        on = "" if url.startswith("sqlite") else " ON history_checkpoints"
        with database.engine.connect() as connection:
            connection.exec_driver_sql(f"DROP TRIGGER history_checkpoints_kept{on}")
            removed = CHECKPOINTS.c.size == heads_of(url)[-2]
            connection.execute(CHECKPOINTS.delete().where(removed))
            found = dict(verify_history(connection, database.history, None, Verified()))
            connection.rollback()
        assert "was removed from the database" in found[f"head of {heads_of(url)[-2]} leaves"]


def test_copies_of_a_database_have_heads_of_their_own(url: str, tmp_path: Path):
    older = copy_away(url)
    with closing(Database(url)) as database, closing(Database(older)) as copy:
        assert database.history.heads_file != copy.history.heads_file
        one = Database(url, checkpoints=tmp_path / "heads")
        assert one.history.heads_file == tmp_path / "heads"
        one.close()
    of_settings = Database.of(Settings(database_url=url, checkpoints=tmp_path / "kept"))
    assert of_settings.history.heads_file == tmp_path / "kept"
    of_settings.close()
