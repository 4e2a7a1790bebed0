"""Restoring a backup does not restore anything that ended after it: releases, demonstrations, keys, consent."""

import json
import time
from collections.abc import Callable
from datetime import timedelta
from functools import partialmethod
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from skills.db import now
from skills.db.models import Demonstration, PolicyVersion, Release, StoredRecording
from skills.db.service_tables import Key
from skills.db.session import Database
from skills.errors import BadSettings, Corrupt, NotFound
from skills.library.operation.backup import back_up, restore
from skills.library.operation.erasure_list import keep_erasures, read_erasures
from skills.library.operation.inspection import inspect_installation
from skills.library.people.erasure import delete_recording, erase_demo, erase_surgeon
from skills.library.people.keys import create_key, revoke_key
from skills.library.people.surgeons import find_surgeon, put_surgeon
from skills.library.policies.releases import release, withdraw
from skills.library.policies.versions import served_release
from skills.library.recordings.demos import mark_demo, withdraw_demo
from skills.library.recordings.recordings import store_recording
from skills.schemas.people import Consent, SurgeonIn
from skills.serving import keeping_erasures
from skills.settings import Settings
from tests import backends
from tests.library import cases

BOTH = {"uses": ["training", "export"], "until": None}


@pytest.fixture
def restored(database: Database, empty: Callable[[str], Database], tmp_path: Path) -> Callable[[], Database]:
    """Restore `b.zip` with the list of endings in `database` since, into a database of the other back end."""

    def make() -> Database:
        made = empty(backends.OTHER[database.engine.dialect.name])
        keep_erasures(database, tmp_path / "list.json")
        restore(made, tmp_path / "b.zip", read_erasures(str(tmp_path / "list.json")))
        return made

    return make


def served(database: Database) -> str | None:
    with database.reading() as session:
        try:
            return served_release(session, "kestrel", cases.SUTURE).policy.sha256
        except NotFound:
            return None


def two_releases(database: Database) -> tuple[str, str]:
    """Release a policy of one demonstration and then one of another; return their demonstrations."""
    demos = [cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0))).sha256 for shift in (0.0, 1.0)]
    for demo in demos:
        cases.train(database, demos=[demo], release=True)
    return demos[0], demos[1]


def whole(database: Database) -> bool:
    return not any(checked.wrong for checked in inspect_installation(database))


def test_erasing_what_is_served_never_lets_an_older_release_come_back(database: Database):
    _, second = two_releases(database)
    cases.committed(database, erase_demo, second, "test")
    assert served(database) is None


def test_a_demonstration_erased_after_the_backup_leaves_nothing_served(
    database: Database, restored: Callable[[], Database], tmp_path: Path
):
    _, second = two_releases(database)
    back_up(database, tmp_path / "b.zip")
    with database.writing() as session:
        withdraw_demo(session, second, "test")
        erase_demo(session, second, "test")
    assert served(database) is None
    after = restored()
    assert served(after) is None
    assert whole(after)


@pytest.mark.parametrize("what", ["release", "demonstration", "superseded"])
def test_what_was_no_longer_served_is_not_served_again(
    what: str, database: Database, restored: Callable[[], Database], tmp_path: Path
):
    _, second = two_releases(database)
    back_up(database, tmp_path / "b.zip")
    in_backup = served(database)
    with database.writing() as session:
        if what == "release":
            withdraw(session, find_surgeon(session, "kestrel"), cases.SUTURE, "test")
        elif what == "demonstration":
            withdraw_demo(session, second, "test")
    if what == "superseded":
        cases.add_demo(database, cases.hand_off((5.0, 0.0, 0.0)))
        cases.train(database, release=True)
    assert served(database) != in_backup
    after = restored()
    assert served(after) is None
    with after.reading() as session:
        gone = session.scalars(select(Demonstration.sha256).where(Demonstration.withdrawn_at.is_not(None))).all()
    assert gone == ([second] if what == "demonstration" else [])
    assert whole(after)


def test_what_ended_and_was_allowed_again_before_the_backup_stands(
    database: Database, restored: Callable[[], Database], tmp_path: Path
):
    """The list names only what the backup does not know. A restored installation knows the endings recorded in it."""
    demo = cases.add_demo(database).sha256
    policy = cases.train(database, release=True)
    with database.writing() as session:
        withdraw(session, find_surgeon(session, "kestrel"), cases.SUTURE, "test")
        cases.agree(session, {"uses": ["training"], "until": None})
    keep_erasures(database, tmp_path / "list.json")
    with database.writing() as session:
        cases.agree(session, BOTH)
        release(session, session.get_one(PolicyVersion, policy.row), "test")
    back_up(database, tmp_path / "b.zip")
    after = restored()
    assert served(after) == policy.sha256
    with after.reading() as session:
        assert find_surgeon(session, "kestrel").consent == Consent.model_validate(BOTH)
    cases.committed(database, erase_demo, demo, "test")
    again = restored()
    with again.reading() as session:
        assert session.scalars(select(Demonstration)).all() == []
    assert cases.add_demo(again).sha256 == demo
    back_up(again, tmp_path / "again.zip")
    last = Database(f"sqlite:///{tmp_path / 'last.sqlite'}")
    assert restore(last, tmp_path / "again.zip", read_erasures(str(tmp_path / "list.json"))).demos_erased == 0
    last.close()


def test_a_deleted_recording_that_is_used_again_does_not_block_a_restore(
    database: Database, restored: Callable[[], Database], tmp_path: Path
):
    back_up(database, tmp_path / "b.zip")
    sent, _ = store_recording(database, cases.upload(cases.hand_off()), "test")
    cases.committed(database, delete_recording, sent.sha256, "test", as_admin=True)
    again = restored()  # it knows nothing of the deletion; the list does
    cases.add_surgeon(again)
    demo = cases.add_demo(again).sha256
    back_up(again, tmp_path / "later.zip")
    (tmp_path / "later.zip").rename(tmp_path / "b.zip")
    with restored().reading() as session:
        assert session.scalars(select(Demonstration.sha256)).all() == [demo]
        assert session.scalars(select(StoredRecording.sha256)).all() == [sent.sha256]


def test_a_recording_deleted_after_the_backup_is_deleted_again(
    database: Database, restored: Callable[[], Database], tmp_path: Path
):
    kept, gone = (
        store_recording(database, cases.upload(cases.hand_off((shift, 0.0, 0.0))), "test")[0].sha256
        for shift in (0.0, 1.0)
    )
    back_up(database, tmp_path / "b.zip")
    cases.committed(database, delete_recording, gone, "test", as_admin=True)
    with restored().reading() as session:
        assert session.scalars(select(StoredRecording.sha256)).all() == [kept]


def test_a_key_that_was_revoked_stays_revoked(database: Database, restored: Callable[[], Database], tmp_path: Path):
    with database.writing() as session:
        ids = [create_key(session, owner, "reader", "test")[0].id for owner in ("anna", "bert")]
    back_up(database, tmp_path / "b.zip")
    cases.committed(database, revoke_key, ids[0], "test")
    with restored().reading() as session:
        assert {key.id: key.revoked_at is None for key in session.scalars(select(Key))} == {ids[0]: False, ids[1]: True}


@pytest.mark.parametrize(
    ("before", "after", "left"),
    [
        (None, {"uses": ["export"], "until": None}, {"uses": ["export"], "until": None}),
        (BOTH, {"uses": [], "until": None}, {"uses": [], "until": None}),
        (BOTH, BOTH | {"until": "2026-01-31"}, BOTH | {"until": "2026-01-31"}),
        (BOTH | {"until": "2026-01-31"}, BOTH | {"until": "2030-01-31"}, BOTH | {"until": "2026-01-31"}),
        ({"uses": ["training"], "until": None}, BOTH, {"uses": ["training"], "until": None}),
        (BOTH, None, BOTH),
    ],
)
def test_a_consent_that_was_narrowed_stays_narrow_and_none_is_widened(
    before: Any, after: Any, left: Any, database: Database, restored: Callable[[], Database], tmp_path: Path
):
    cases.committed(
        database, put_surgeon, "kestrel", SurgeonIn.model_validate({"consent": before, "protocol": "IRB 1"}), "test"
    )
    back_up(database, tmp_path / "b.zip")
    cases.committed(
        database, put_surgeon, "kestrel", SurgeonIn.model_validate({"consent": after, "protocol": "IRB 1"}), "test"
    )
    with restored().reading() as session:
        surgeon = find_surgeon(session, "kestrel")
        assert (surgeon.consent, surgeon.protocol) == (Consent.model_validate(left), "IRB 1")


def test_the_list_names_nobody_and_another_format_is_refused(database: Database, tmp_path: Path):
    demo = cases.add_demo(database).sha256
    with database.writing() as session:
        cases.agree(session, BOTH, "canary-7f3a91")
        put_surgeon(session, "canary-77", SurgeonIn(), "test")
        erase_surgeon(session, "canary-77", "test")
        erase_demo(session, demo, "test")
    listed = keep_erasures(database, tmp_path / "list.json")
    assert "canary" not in (tmp_path / "list.json").read_text()
    assert read_erasures(str(tmp_path / "list.json")) == listed
    about = json.loads((tmp_path / "list.json").read_text()) | {"format": "suture-skills erasures 2"}
    (tmp_path / "first.json").write_text(json.dumps(about))
    with pytest.raises(Corrupt, match="not a list of erasures"):
        read_erasures(str(tmp_path / "first.json"))


def test_the_service_keeps_the_list_up_while_it_runs(database: Database, tmp_path: Path):
    """The service reads the events, so that endings by a worker or by a command in another process are listed too."""
    demo = cases.add_demo(database).sha256
    file = tmp_path / "kept" / "erasures.json"
    with keeping_erasures(Settings(database_url=database.url, erasures_file=file)):
        assert read_erasures(str(file)).demos == set()
        cases.committed(database, erase_demo, demo, "test")
        deadline_s = time.monotonic() + 60
        while read_erasures(str(file)).demos != {demo}:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        cases.committed(database, erase_surgeon, "kestrel", "test")
    assert len(read_erasures(str(file)).surgeons) == 1  # written once more at the end


def test_a_list_that_cannot_be_written_keeps_the_service_from_starting(database: Database, tmp_path: Path):
    (tmp_path / "taken").touch()
    settings = Settings(database_url=database.url, erasures_file=tmp_path / "taken" / "erasures.json")
    with pytest.raises(BadSettings, match="SKILLS_ERASURES_FILE"), keeping_erasures(settings):
        pass


def test_what_ended_again_while_the_clock_was_wrong_ends_again(
    database: Database, restored: Callable[[], Database], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """An hour ahead everything ended once, and all of it came back; after the correction it ended for good."""
    first, second = two_releases(database)
    surgeon = "kestrel"

    def end() -> None:
        with database.writing() as session:
            cases.agree(session, {"uses": ["training"], "until": None}, surgeon)
            erase_demo(session, second, "test")
            mark_demo(session, first, "failure", None, "test")

    with monkeypatch.context() as ahead:
        ahead.setattr("skills.db.service_tables.now", lambda: now() + timedelta(hours=1))
        end()
        with database.writing() as session:
            mark_demo(session, first, "success", None, "test")
            cases.agree(session, BOTH, surgeon)
    cases.add_demo(database, cases.hand_off((1.0, 0.0, 0.0)))
    back_up(database, tmp_path / "b.zip")
    end()
    after = restored()
    with after.reading() as session:
        assert [(one.sha256, one.outcome) for one in session.scalars(select(Demonstration))] == [(first, "failure")]
        assert find_surgeon(session, surgeon).consent == Consent(uses=["training"])


def test_a_release_superseded_while_the_clock_was_wrong_stays_superseded(
    database: Database, restored: Callable[[], Database], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    cases.add_surgeon(database)
    cases.add_demo(database)
    one, other = (cases.train(database, seed=seed) for seed in (1, 2))

    def serve(version: PolicyVersion) -> None:
        with database.writing() as session:
            release(session, session.get_one(PolicyVersion, version.row), "test")

    with monkeypatch.context() as ahead:
        an_hour = timedelta(hours=1)
        ahead.setattr("skills.db.service_tables.now", lambda: now() + an_hour)
        ahead.setattr(Release, "__init__", partialmethod(Release.__init__, released_at=now() + an_hour))
        serve(one)
        serve(other)
    serve(one)
    back_up(database, tmp_path / "b.zip")
    serve(other)
    assert served(database) == other.sha256
    assert served(restored()) is None
