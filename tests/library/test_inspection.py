"""`skills verify` of an installation: intact data are reported as such, and every change is named."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select, text

from skills.db import Base
from skills.db.models import Demonstration, ParsedChunk, RecordingChunk
from skills.db.packed import Packed
from skills.db.service_tables import DatasetChunk, Event
from skills.db.session import Database
from skills.errors import StorageFull
from skills.library.comparison.measuring import far_apart
from skills.library.operation import inspection
from skills.library.operation.inspection import AGREES, VERIFIED, WITH_OTHERS, inspect_installation, packed_values
from tests import backends
from tests.by_day import some
from tests.library import cases

MAPPERS = sorted(Base.registry.mappers, key=lambda one: one.local_table.name)


def looked_at(database: Database) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """Return the number of checked rows by kind, and the faults."""
    parts = [
        part
        for part in {id(part): part for part in inspect_installation(database)}.values()
        if part.what != inspection.HISTORY  # finds every one of these changes: see `test_history.py`
    ]
    return {part.what: part.count for part in parts}, [one for part in parts for one in part.wrong]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database with two styles, a withdrawn release and a plan, in which nothing is wrong."""
    folder = tmp_path_factory.mktemp("filled")
    database = Database(backends.fresh("sqlite", folder))
    for slug, shift in (("kestrel", 0.0), ("heron", 1.0)):
        cases.add_surgeon(database, slug)
        cases.add_demo(database, cases.hand_off((shift, 0.0, 0.0)), slug)
        cases.train(database, slug, release=True)
        cases.add_plan(database, slug)
    cases.train(database, "heron", seed=1, release=True)
    assert looked_at(database)[1] == []
    database.close()
    return Path(database.url.removeprefix("sqlite:///"))


@pytest.fixture
def damaged(filled: Path, tmp_path: Path) -> Iterator[Database]:
    """Yield a copy of it, to be changed."""
    copy = tmp_path / "damaged.sqlite"
    copy.write_bytes(filled.read_bytes())
    database = Database(f"sqlite:///{copy}")
    yield database
    database.close()


def tamper(database: Database, *statements: str) -> None:
    """Change rows as somebody with write access to the file would, bypassing triggers and references."""
    connection = database.engine.raw_connection()
    names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for statement in ("PRAGMA foreign_keys=OFF", *(f"DROP TRIGGER {name}" for (name,) in names), *statements):
        connection.execute(statement)
    connection.close()


def test_what_is_whole_is_found_whole(database: Database):
    cases.add_demo(database)
    cases.train(database, release=True)
    cases.add_plan(database)
    counts, wrong = looked_at(database)
    assert wrong == []
    tables = {mapper.local_table.name for mapper in MAPPERS if mapper.class_ not in WITH_OTHERS}
    assert tables <= set(counts)
    expected = {"recordings": 1, "demonstrations": 1, "policy_versions": 1, "releases": 1, "plans": 1, "jobs": 1}
    assert expected.items() <= counts.items()


BYTE = "CAST(substr({0}, 1, 900) || x'00' || substr({0}, 902) AS BLOB)"


CHANGES = [
    (
        f"UPDATE policy_versions SET learnt = {BYTE.format('learnt')} WHERE row = 2",
        "policy_versions 2", "learnt: A",
    ),
    (
        f"UPDATE demonstrations SET demo = {BYTE.format('demo')} WHERE row = 1",
        "demonstrations 1", "demo: A stored",
    ),
    (
        "UPDATE reward_maps SET map = (SELECT path FROM demonstrations) WHERE row = 2",
        "reward_maps 2", "a GridPath",
    ),
    (
        "UPDATE plans SET plan = x'00' WHERE row = 1",
        "plans 1", "plan: A stored value does not match its checksum",
    ),
    (
        "UPDATE recording_chunks SET data = CAST(data || x'00' AS BLOB) WHERE recording = 1",
        "recordings 1", "does not match its digest",
    ),
    (
        "DELETE FROM recording_chunks WHERE recording = 2",
        "recordings 2", "does not match its digest",
    ),
    (
        "UPDATE recordings SET size_bytes = 7 WHERE row = 1",
        "recordings 1", "its row has 7",
    ),
    (
        "UPDATE recordings SET about = '{' WHERE row = 2",
        "recordings 2", "it cannot be read (JSONDecodeError)",
    ),
    (
        "UPDATE demonstrations SET suture = 'simple-buried' WHERE row = 1",
        "demonstrations 1", "it does not match its digest",
    ),
    (
        "UPDATE demonstrations SET arm = 'PSM9' WHERE row = 2",
        "demonstrations 2", "its arm differs from the recording",
    ),
    (
        "UPDATE demonstrations SET hysteresis = 0.25 WHERE row = 1",
        "demonstrations 1", "its hysteresis",
    ),
    (
        "UPDATE reward_maps SET demonstration_row = 3 - demonstration_row + 90",
        "reward_maps 1", "has no row in",
    ),
    (
        "UPDATE policy_versions SET manifest = replace(manifest, '\"seed\": 0', '\"seed\": 7')",
        "policy_versions 1", "certi",
    ),
    (
        "UPDATE policy_versions SET releasable = 0 WHERE row = 1",
        "releases 1", "did not pass the gate",
    ),
    (
        "UPDATE policy_versions SET demonstration_row = 1 WHERE row = 2",
        "policy_versions 2", "another demonstration",
    ),
    (
        "UPDATE policy_versions SET covered = (SELECT covered FROM policy_versions WHERE row = 1)",
        "policy_versions 2", "coverage of a stored policy does not match",
    ),
    (
        "UPDATE releases SET policy_row = 1 WHERE row = 2",
        "releases 2", "a policy of another style",
    ),
    (
        "UPDATE demonstrations SET withdrawn_at = created_at WHERE row = 1",
        "releases 1", "it is not withdrawn, but its demonst",
    ),
    (
        "UPDATE plans SET policy_row = 2 WHERE row = 1",
        "plans 1", "A stored plan does not match its digest",
    ),
    (
        "UPDATE jobs SET request = replace(request, '\"seed\": 0', '\"seed\": 7') WHERE row = 1",
        "jobs 1", "does not match its identity",
    ),
    (
        "DELETE FROM surgeons WHERE slug = 'heron'",
        "jobs 2", "its surgeon_row has no row in surgeons",
    ),
    (
        "UPDATE alembic_version SET version_num = '0001'",
        "schema", "it is at 0001",
    ),
    (
        "INSERT INTO reward_maps SELECT 77, sha256, 77, map FROM reward_maps LIMIT 1",
        "reward_maps 77", "has no row in",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("statement", "what", "why"), some(CHANGES, 3))
def test_whatever_is_changed_is_named(damaged: Database, statement: str, what: str, why: str):
    tamper(damaged, statement)
    wrong = looked_at(damaged)[1]
    assert any(named == what and why in said for named, said in wrong), wrong
    assert not any("kestrel" in said or "heron" in said for one in wrong for said in one)


@pytest.mark.nightly  # some thirty inspections; by day every third change
def test_every_packed_value_is_read(damaged: Database):
    packed = [(m.local_table.name, name) for m in MAPPERS for name in packed_values(m)]
    assert len(packed) == sum(isinstance(c.type, Packed) for t in Base.metadata.tables.values() for c in t.columns)
    with damaged.reading() as session:
        demos = session.scalars(select(Demonstration.row)).all()
    far_apart(damaged, demos)  # as an atlas does, so that such rows exist
    for table, column in packed:
        key = Base.metadata.tables[table].primary_key.columns.keys()[0]
        with damaged.reading() as session:
            row = session.scalar(text(f"SELECT min({key}) FROM {table}"))
            kept = session.scalar(text(f"SELECT hex({column}) FROM {table} WHERE {key} = :row"), {"row": row})
        if row is None:
            continue
        at = f"WHERE {key} = {row}"
        tamper(damaged, f"UPDATE {table} SET {column} = x'{kept[:-2]}{int(kept[-2:], 16) ^ 1:02x}' {at}")
        named = [why for what, why in looked_at(damaged)[1] if what == f"{table} {row}"]
        assert any(f"{column}: A stored value does not match its checksum" in why for why in named), (table, column)
        tamper(damaged, f"UPDATE {table} SET {column} = x'{kept}' {at}")


def test_every_table_with_a_digest_is_compared_with_it():
    """A new table's packed values are inspected automatically; the input of its digest has to be declared."""
    known_by_digest = {
        mapper.class_
        for mapper in MAPPERS
        if {"sha256", "identity"} & {column.name for column in mapper.local_table.columns}
    }
    with_a_nonce = {Event}  # nobody can compute it again
    assert known_by_digest - with_a_nonce <= {*AGREES, *VERIFIED}
    assert {RecordingChunk, ParsedChunk, DatasetChunk} == WITH_OTHERS


def test_inspection_walks_all_pages_and_an_unreadable_row_hides_no_other(
    damaged: Database, monkeypatch: pytest.MonkeyPatch
):
    whole = looked_at(damaged)
    monkeypatch.setattr(inspection, "ROWS_AT_ONCE", 2)
    assert looked_at(damaged) == whole
    tamper(damaged, "UPDATE jobs SET request = '[' WHERE row = 2", "UPDATE jobs SET kind = 'playback' WHERE row = 1")
    assert sorted(looked_at(damaged)[1]) == [
        ("jobs 1", "its request does not match its identity"),
        ("jobs 2", "it cannot be read (JSONDecodeError)"),
    ]


def test_a_file_whose_pages_are_damaged_is_told(damaged: Database, tmp_path: Path):
    file = tmp_path / "damaged.sqlite"
    damaged.close()
    data = bytearray(file.read_bytes())
    for place in range(4096 * 8, len(data), 4096 * 5):
        data[place : place + 16] = b"\xff" * 16
    file.write_bytes(data)
    assert any(what == "database file" for what, _ in looked_at(damaged)[1])


def test_what_a_full_disk_keeps_from_being_decoded_is_left_out(damaged: Database):
    def parse(*_: Any, **__: Any) -> Any:
        raise StorageFull("The disk is full.")

    parts = {part.what: part for part in inspect_installation(damaged, parse)}
    assert not any(part.wrong for part in parts.values())
    ((name, why),) = parts["recordings decoded"].left_out
    assert (name.split()[0], why, parts["recordings decoded"].count) == ("recordings", "The disk is full.", 1)
