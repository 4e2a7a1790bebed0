"""Installations of older versions: this version migrates them and serves the same bytes."""

import gzip
import json
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

import psycopg
import pytest
from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import make_url, select, text
from typer.testing import CliRunner

from skills.cli import app
from skills.db import Base
from skills.db.models import ParsedRecording, PolicyVersion, StoredRecording
from skills.db.session import Database, alembic_config, revision_of
from skills.formats.reader_process import READER_VERSION, Told, read_told
from skills.learning.policy import LEARNER_VERSION
from skills.library.inspection import inspect_installation
from skills.library.recordings import stored_recording
from skills.settings import settings
from tests import backends
from tests.api.service import KESTREL, POLICY, assert_problem, serving
from tests.migrations.make_fixture import JSON, NPZ, RELEASES, answer_of
from tests.migrations.test_migrations import go, tables
from tests.waiting import END_S

KEPT = sorted(folder.name for folder in RELEASES.iterdir() if folder.is_dir())
HISTORY = {"history", "history_checkpoints", "history_tiles"}  # begun anew by migrations from before; verified below
# The downgrade to the first version removes these; the upgrade fills one of them again, from the events.
ADDED_LATER = {
    "retraining_styles", "playback_pictures", "keys", "key_surgeons", "sign_ins", "recording_uploads",
    "measured_shapes", "calibrations", "policy_demonstrations", "recording_surgeons",
    "demonstration_outcomes", "dataset_demonstrations", "datasets", "dataset_chunks",
    "parsed_recordings", "parsed_chunks", "pose_styles", "loose_chunks", "erased_surgeons", "proposal_marks",
    *HISTORY,
}  # fmt: skip
FILLED_AGAIN = {"recording_uploads", *HISTORY}
KEYS = {"keys", "key_surgeons", "sign_ins"}  # empty: with a key, the installation would answer its tests with 401
# a worker removes their rows after a while, or a backup, of which the PostgreSQL dumps are made, leaves them out
PASSING = {"executors", "loose_chunks", "erased_surgeons", "parsed_recordings", "parsed_chunks"}
REFUSED = "This database was written by a newer version of suture-skills"


NEWEST = [f"{KEPT[-1]} {backend}" for backend in backends.BACKENDS]
Released = tuple[Database, dict[str, Any]]


@pytest.fixture(params=[f"{version} {backend}" for version in KEPT for backend in backends.BACKENDS])
def release(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Released]:
    """Yield a copy of a version's installation, not migrated, and the responses of that version."""
    version, backend = request.param.split()
    kept = RELEASES / version
    if (key := kept / "signing.key").exists():  # version 0.1.0 had no history
        monkeypatch.setenv("SKILLS_SIGNING_KEY", str(key))
        settings.cache_clear()
    url = backends.blank(backend, tmp_path)
    if backend == "sqlite":
        shutil.copy(kept / "skills.sqlite", make_url(url).database or "")
    else:
        where = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)
        with psycopg.connect(where, autocommit=True) as connection:
            connection.execute(gzip.decompress((kept / "postgresql.sql.gz").read_bytes()))
    database = Database(url)
    yield database, json.loads((kept / "expected.json").read_text())
    database.close()
    backends.drop(url)
    monkeypatch.undo()
    settings.cache_clear()


def test_a_release_is_taken_over_and_serves_the_same_bytes(release: Released):
    database, expected = release
    with database.engine.connect() as connection:
        assert revision_of(connection) == expected["schema"]
    assert len(expected["policies"]) >= 4
    with serving(database.url) as service:  # it migrates
        for path, kinds in expected["policies"].items():
            assert answer_of(service, path, JSON) == kinds[JSON]
            assert service.http.get(path, headers={"If-None-Match": kinds[JSON]["etag"]}).status_code == 304
            arrays = answer_of(service, path, NPZ)
            assert arrays["numbers"] == kinds[NPZ]["numbers"]
            if expected["zlib"] == zlib.ZLIB_RUNTIME_VERSION:
                assert arrays == kinds[NPZ]
    if expected["zlib"] != zlib.ZLIB_RUNTIME_VERSION:
        pytest.skip("ARRAYS WERE COMPARED BY THEIR NUMBERS ALONE: this Python compresses with another zlib")


def test_the_version_of_a_release_is_served_again_after_a_new_one(release: Released):
    database, _ = release
    with serving(database.url) as service:
        kept = service.http.get(POLICY)
        assert (service.client.learnt(**KESTREL).ties is None) == ("ties" not in kept.json())
        service.train(seed=9, release=True)
        new = service.http.get(POLICY).json()
        assert new["version"] > kept.json()["version"] and new["ties"]["kind"] == "shortest-way"
        assert "ties" in kept.json() or new["actions"] != kept.json()["actions"]  # one of 0.1.0 has another rule
        service.client.release(**KESTREL, version=kept.json()["version"])
        again = service.http.get(POLICY)
        times = {"released_at", "released_by"}
        assert all(again.json()[name] == value for name, value in kept.json().items() if name not in times)


def test_all_of_a_release_is_whole_after_its_migration(release: Released):
    database, _ = release
    before = rows(database)
    assert {table for table, found in before.items() if not found} <= PASSING | KEYS
    database.migrate()
    assert kept_of(rows(database), before) == before
    found = {part.what: part for part in inspect_installation(database, relearn=settings())}
    assert {part.what: part.wrong for part in found.values() if part.wrong} == {}
    with database.reading() as session:
        learnt = session.scalars(select(PolicyVersion).order_by(PolicyVersion.row)).all()
        # other learners may give other results: such a version is never called whole
        older = {f"policy_versions {one.row}" for one in learnt if one.manifest["learner_version"] < LEARNER_VERSION}
    again = found["policies learnt again"]
    assert again.count == len(learnt)
    assert {name for name, why in again.left_out if "made by an older learner" in why} == older
    assert {name for name, _ in again.left_out} == older


def test_a_recording_of_a_release_is_decoded_once_and_then_cached(release: Released):
    database, _ = release
    database.migrate()
    with database.reading() as session:
        known = select(ParsedRecording.recording_row).where(ParsedRecording.version == READER_VERSION)
        cached = session.scalars(known).all()
        recordings = {one.row: one.sha256 for one in session.scalars(select(StoredRecording))}
        waiting = [sha256 for row, sha256 in recordings.items() if row not in cached]
    decoded: list[str] = []
    for one in [*recordings.values(), *recordings.values()]:

        def read(file: BinaryIO, of: str = one, **how: Any) -> Told:
            decoded.append(of)
            return read_told(file, **how)

        stored_recording(database, one, read)
    assert decoded == waiting
    assert {part.what: part.wrong for part in inspect_installation(database, decode_all=True) if part.wrong} == {}


def test_down_to_a_release_and_up_again_keeps_every_row_and_every_answer(release: Released):
    database, expected = release
    database.migrate()
    before = there = rows(database)
    # the first tables hold all that 0.1.0 stored; from 0.2.0 on, marks and combined policies forbid to go further
    oldest = "0001" if expected["schema"] == "0006" else expected["schema"]
    for script in ScriptDirectory.from_config(alembic_config()).iterate_revisions("head", oldest):
        go(database, command.downgrade, str(script.down_revision))
        there = rows(database)
        assert kept_of(before, there) == there
        assert before.keys() - there.keys() <= ADDED_LATER
    database.migrate()
    again = {table: there for table, there in rows(database).items() if table not in HISTORY}
    before = {table: there for table, there in before.items() if table not in HISTORY}
    assert again == before | {table: [] for table in before.keys() - there.keys() - FILLED_AGAIN}
    with serving(database.url) as service:
        for path, kinds in expected["policies"].items():
            assert answer_of(service, path, JSON) == kinds[JSON]
    assert {part.what: part.wrong for part in inspect_installation(database) if part.wrong} == {}


@pytest.mark.parametrize("release", NEWEST, indirect=True)  # which release the tables came from decides nothing here
@pytest.mark.parametrize("commands", [1, pytest.param(4, marks=pytest.mark.nightly)])
def test_code_that_is_older_than_the_tables_says_so_everywhere(release: Released, tmp_path: Path, commands: int):
    database, _ = release
    database.migrate()
    with serving(database.url) as service:
        with database.writing() as session:  # as a newer version does while this one runs
            session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
        said = assert_problem(service.http.get("/readyz"), 503, "not-ready")["detail"]
        assert said == "The database has a newer version; update the code of this process."
    before = rows(database)
    place = {"SKILLS_DATABASE_URL": database.url, "SKILLS_PORT": "0"}
    told = (
        (["serve"], REFUSED),
        (["train", "kestrel", "simple-running"], REFUSED),
        (["backup", str(tmp_path / "backup.zip")], "The tables are of another version"),
        (["verify"], "schema: it is at 9999"),
    )
    for words, said in told[:commands]:  # each takes seconds
        code, errors = run(words, place)
        assert code == 1, words
        assert said in errors, (words, errors)
        assert "Traceback" not in errors, (words, errors)
    assert rows(database) == before


@pytest.mark.nightly  # by day the service is refused
@pytest.mark.parametrize("release", NEWEST, indirect=True)
def test_a_worker_that_is_older_than_the_tables_says_so(release: Released):
    database, _ = release
    database.migrate()
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    code, errors = run(["worker"], {"SKILLS_DATABASE_URL": database.url})
    assert (code, REFUSED in errors, "Traceback" in errors) == (1, True, False), errors


def run(words: list[str], environment: dict[str, str]) -> tuple[int, str]:
    """Run a command, and return its exit code and its errors; only what would serve needs a process of its own."""
    if words[0] in ("serve", "worker"):
        command = [sys.executable, "-m", "skills", *words]
        process = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=END_S)
        return process.returncode, process.stderr
    settings.cache_clear()
    result = CliRunner().invoke(app, words, env={"SKILLS_SERVER": None, **environment})
    settings.cache_clear()
    return result.exit_code, result.stderr


Rows = dict[str, list[dict[str, str]]]


def rows(database: Database) -> Rows:
    """Read every row of every table of ours, with each of its values as a digest."""
    found = {}
    with database.reading() as session:
        for table in sorted(tables(database) & set(Base.metadata.tables)):
            read = session.execute(text(f"SELECT * FROM {table}")).mappings()
            every = [{name: sha256(repr(value).encode()).hexdigest() for name, value in row.items()} for row in read]
            found[table] = sorted(every, key=lambda row: sorted(row.items()))
    return found


def kept_of(of: Rows, like: Rows) -> Rows:
    """Reduce rows to the tables and columns that another database has."""
    return {
        table: sorted(
            ({name: row[name] for name in like[table][0]} for row in of[table]), key=lambda row: sorted(row.items())
        )
        if like[table]
        else of[table]
        for table in like
    }
