"""Backups: during writes, between the back ends, damaged, of other versions; and erasures persist."""

import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, text

from skills.db import Base, dump
from skills.db.logged_rows import KINDS
from skills.db.models import Demonstration, Erasure, Surgeon
from skills.db.service_tables import Executor, Job
from skills.db.session import Database
from skills.errors import Conflict, Corrupt, Erased
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import Erasures, erasures_of, keep_erasures, read_erasures
from skills.library.people.erasure import erase_demo, erase_surgeon
from skills.library.people.surgeons import put_surgeon
from skills.library.policies.versions import served_release
from skills.library.recordings.demos import withdraw_demo
from skills.schemas.people import SurgeonIn
from tests import backends
from tests.api.service import Service
from tests.jobs.house import House
from tests.library import cases
from tests.library.cases import wrong


def rows(database: Database) -> dict[str, list[tuple[Any, ...]]]:
    """Read everything that is backed up, as stored, except the events of restoring."""
    found = {}
    with database.reading() as session:
        for table in dump.tables():
            raw = dump.raw_table(table.name, [(c.name, dump.kind_of(c)) for c in table.columns])
            query = select(raw).order_by(*(raw.c[key.name] for key in table.primary_key))
            found[table.name] = [tuple(row) for row in session.execute(query)]
    found["events"] = [row for row in found["events"] if "restore" not in row]
    for table in ("history", "history_checkpoints"):  # goes on with a restore; `wrong` verifies it
        del found[table]
    return found


def etags(database: Database) -> dict[str, str]:
    """Request every served policy from the service, and return its ETag."""
    service = Service(database.url)
    with service.http as http:
        served = http.get("/policies").json()["items"]
        paths = [f"/policies/{one['surgeon']}/{one['suture']}" for one in served]
        paths += [f"/policy-versions/{one['sha256']}" for one in served]
        return {path: http.get(path).headers["etag"] for path in paths}


def test_a_backup_under_writes_is_one_state_and_restores_on_both_databases(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    acknowledged = [cases.add_demo(database).sha256]
    cases.train(database, release=True)
    over, errors = threading.Event(), []

    def traffic() -> None:
        shift = 0.0
        while not over.is_set():
            shift += 0.01
            try:
                acknowledged.append(cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0))).sha256)
                cases.train(database, release=True, seed=int(shift * 100))
            except Exception as error:
                errors.append(error)

    others = [threading.Thread(target=traffic)]
    for other in others:
        other.start()
    try:
        taken = []
        for number in range(2):
            before = list(acknowledged)
            manifest = back_up(database, tmp_path / f"{number}.zip")
            taken.append((before, manifest))
    finally:
        over.set()
        for other in others:
            other.join()
    assert errors == []
    for number, (before, manifest) in enumerate(taken):
        kind = database.engine.dialect.name
        for backend in (backends.OTHER[kind],) if number == 1 else (kind,):
            restored = empty(backend)
            restore(restored, tmp_path / f"{number}.zip")
            found = rows(restored)
            assert set(before) <= {row[1] for row in found["demonstrations"]}
            assert {name: len(of) for name, of in found.items()}.items() <= {
                one.name: one.rows for one in manifest.tables
            }.items()
            assert wrong(restored) == []
    same = rows(database)
    back_up(database, tmp_path / "last.zip")
    last = empty(backends.OTHER[database.engine.dialect.name])
    restore(last, tmp_path / "last.zip")
    assert rows(last) == same
    assert etags(last) == etags(database) != {}


def test_row_numbers_go_on_and_what_is_append_only_still_is(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    cases.add_demo(database)
    with database.writing() as session:
        session.add(Job(id="one", kind="training", identity="1" * 64, request={}, state="failed"))
    with database.writing() as session:
        session.add(Executor(id="a worker of that installation"))
        session.execute(text("DELETE FROM jobs"))
    back_up(database, tmp_path / "b.zip")
    for backend in backends.BACKENDS:
        restored = empty(backend)
        restore(restored, tmp_path / "b.zip")
        with restored.writing() as session:
            assert session.scalars(select(Executor)).all() == []
            session.add(job := Job(id="two", kind="training", identity="2" * 64, request={}))
            session.flush()
            assert job.row == 2
        with pytest.raises(Exception, match="demonstrations is append-only"), restored.writing() as session:
            session.execute(text("UPDATE demonstrations SET arm = 'other'"))


def test_jobs_that_had_not_ended_are_told_again_and_done(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    cases.add_demo(database)
    waiting, begun = cases.ask_training(database), cases.ask_training(database, seed=1)
    with database.writing() as session:
        session.execute(text("UPDATE jobs SET submitted_at = created_at"))
        session.execute(text("UPDATE jobs SET state = 'running' WHERE row = :row"), {"row": begun.row})
    back_up(database, tmp_path / "b.zip")
    restored = empty(backends.OTHER[database.engine.dialect.name])
    restore(restored, tmp_path / "b.zip")
    for job in (waiting, begun):
        with restored.reading() as session:
            assert session.get_one(Job, job.row).submitted_at is None
        assert cases.work(restored, job).state == "succeeded"


@pytest.mark.nightly  # a worker's start; by day the next test's jobs are told again
def test_a_worker_of_the_restored_installation_carries_on(tmp_path: Path):
    """The database's engine knew the jobs; the restored one has a new engine that does not."""
    before = House(backends.fresh("sqlite", tmp_path), tmp_path)
    row, begun = before.ask(), before.ask(state="running")
    with before.database.writing() as session:
        session.execute(text("UPDATE jobs SET submitted_at = created_at"))
    back_up(before.database, tmp_path / "b.zip")
    before.close()
    url = backends.blank("sqlite", tmp_path)
    restored = Database(url)
    restore(restored, tmp_path / "b.zip")
    restored.close()
    after = House(url, tmp_path)
    with after.workers(1):
        assert {after.ended(row).state, after.ended(begun).state} == {"succeeded"}
    after.close()


def test_it_never_overwrites_and_leaves_nothing_behind_when_it_fails(database: Database, tmp_path: Path):
    back_up(database, tmp_path / "one.zip")
    assert (tmp_path / "one.zip").stat().st_mode & 0o777 == 0o600
    before = (tmp_path / "one.zip").read_bytes()
    with pytest.raises(Conflict, match="never overwrites"):
        back_up(database, tmp_path / "one.zip")
    assert (tmp_path / "one.zip").read_bytes() == before

    def fail(name: str) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        back_up(database, tmp_path / "two.zip", fail)
    assert [file.name for file in tmp_path.iterdir() if "zip" in file.name] == ["one.zip"]


def test_a_database_of_another_version_is_not_backed_up(database: Database, tmp_path: Path):
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(Conflict, match="of another version"):
        back_up(database, tmp_path / "refused.zip")


# ---- erasures ------------------------------------------------------------------------------------------------------


def test_who_was_erased_after_the_backup_does_not_come_back(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    canary = "canary-7f3a91"
    cases.add_surgeon(database, canary)
    table = cases.hand_off((1.25, 0.0, 0.0))
    kept = cases.add_demo(database).sha256
    gone = cases.add_demo(database, cases.hand_off((2.5, 0.0, 0.0))).sha256
    cases.add_demo(database, table, canary)
    cases.train(database, canary, release=True)
    back_up(database, tmp_path / "b.zip")
    with database.writing() as session:
        put_surgeon(session, "after-the-backup", SurgeonIn(), "test")
        for slug in (canary, "after-the-backup"):
            erase_surgeon(session, slug, "test")
        withdraw_demo(session, gone, "test")
        erase_demo(session, gone, "test")
    listed = keep_erasures(database, tmp_path / "erasures.json")
    assert (len(listed.surgeons), listed.demos) == (2, {gone})
    assert canary not in (tmp_path / "erasures.json").read_text()
    for source, backend in ((str(tmp_path / "erasures.json"), "sqlite"), (database.url, "postgresql")):
        restored = empty(backend)
        done = restore(restored, tmp_path / "b.zip", read_erasures(source))
        assert (done.surgeons_erased, done.demos_erased) == (1, 1)
        with restored.writing() as session:
            assert [d.sha256 for d in session.scalars(select(Demonstration))] == [kept]
            assert [s.slug for s in session.scalars(select(Surgeon))] == ["kestrel"]
            for slug in (canary, "after-the-backup"):
                with pytest.raises(Erased):
                    put_surgeon(session, slug, SurgeonIn(), "test")
        assert wrong(restored) == []
        assert erasures_of(restored).demos == {gone}
        if backend == "sqlite":
            file = Path(restored.url.removeprefix("sqlite:///"))
            left = b"".join(one.read_bytes() for one in file.parent.glob(f"{file.name}*"))
            assert canary.encode() not in left
            assert table[1000:1064] not in left
    without = empty("sqlite")
    restore(without, tmp_path / "b.zip")
    with without.reading() as session:
        assert served_release(session, canary, cases.SUTURE).policy.releasable


def test_a_demo_erased_and_added_again_before_the_backup_is_not_erased(
    database: Database, empty: Callable[[str], Database], tmp_path: Path
):
    demo = cases.add_demo(database).sha256
    cases.committed(database, erase_demo, demo, "test")
    assert cases.add_demo(database).sha256 == demo
    back_up(database, tmp_path / "b.zip")
    keep_erasures(database, tmp_path / "list.json")
    listed = read_erasures(str(tmp_path / "list.json"))
    restored = empty(backends.OTHER[database.engine.dialect.name])
    assert restore(restored, tmp_path / "b.zip", listed).demos_erased == 0
    cases.committed(database, erase_demo, demo, "test")
    keep_erasures(database, tmp_path / "list.json")
    again = empty("sqlite")
    assert restore(again, tmp_path / "b.zip", read_erasures(str(tmp_path / "list.json"))).demos_erased == 1


def test_a_list_of_erasures_never_shrinks_and_is_refused_if_altered(database: Database, tmp_path: Path):
    kept = tmp_path / "erasures.json"
    at = datetime(2026, 1, 1, tzinfo=UTC)
    earlier = Erasures({"11" * 32: ("00", at)}, {"demonstrations": {"ab" * 32: at}})
    assert keep_erasures(database, kept).surgeons == {}
    cases.committed(database, erase_surgeon, "kestrel", "test")
    now_listed = keep_erasures(database, kept)
    other = Database(backends.fresh("sqlite", tmp_path))
    assert keep_erasures(other, kept) == now_listed == read_erasures(str(kept))
    other.close()
    assert len((now_listed | earlier).surgeons) == 2
    for damaged in (kept.read_bytes()[:-20], kept.read_bytes().replace(b"surgeons", b"surgeans"), b"[]", b"\xff"):
        (tmp_path / "damaged.json").write_bytes(damaged)
        with pytest.raises(Corrupt, match="not a list of erasures"):
            read_erasures(str(tmp_path / "damaged.json"))


def test_a_copied_list_may_be_given_to_an_installation_that_knows_it(database: Database, tmp_path: Path):
    with database.writing() as session:
        session.add(Erasure(salt="0" * 64, digest="1" * 64))
    back_up(database, tmp_path / "b.zip")
    restored = Database(f"sqlite:///{tmp_path / 'r.sqlite'}")
    assert restore(restored, tmp_path / "b.zip", erasures_of(database)).surgeons_erased == 0
    with restored.reading() as session:
        assert len(session.scalars(select(Erasure)).all()) == 1
    restored.close()


def test_every_column_of_every_table_is_known_to_the_backup():
    assert {t.name for t in dump.tables()} | dump.LEFT_OUT == set(Base.metadata.tables)
    assert all(dump.kind_of(column) in KINDS for table in dump.tables() for column in table.columns)
