"""Invalid backups, damaged, of another version or for another place: refused by name, and nothing is written."""

import io
import json
import random
import zipfile
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import pytest
from sqlalchemy import func, inspect, select

from skills.db import dump
from skills.db.session import Database
from skills.errors import Conflict, Corrupt, SkillsError, UnknownFormat
from skills.library.operation.backup import back_up, check_backup, restore
from skills.packing import sha256
from tests import backends
from tests.library import cases


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a backup with one row in most tables, to be damaged."""
    folder = tmp_path_factory.mktemp("small")
    database = Database(backends.fresh("sqlite", folder))
    cases.add_surgeon(database)
    cases.add_demo(database)
    cases.train(database, release=True)
    back_up(database, folder / "small.zip")
    database.close()
    return folder / "small.zip"


def how_many(database: Database) -> dict[str, int]:
    """Count the rows of every table that is backed up."""
    with database.reading() as session:
        return {t.name: session.scalar(select(func.count()).select_from(t)) or 0 for t in dump.tables()}


def test_a_backup_is_a_zip_file_that_others_can_look_into(small: Path):
    with zipfile.ZipFile(small) as opened:
        assert opened.testzip() is None
        assert json.loads(opened.read("manifest.json"))["format"] == dump.FORMAT
        (line,) = opened.read("surgeons.rows").splitlines()
        assert "kestrel" in json.loads(line)


def test_it_is_restored_into_an_empty_database_only(database: Database, small: Path):
    before = how_many(database)
    with pytest.raises(Conflict, match="only into an empty one"):
        restore(database, small)
    assert how_many(database) == before


def refused(data: bytes, folder: Path, expected: type[SkillsError] | tuple[type[SkillsError], ...] = Corrupt) -> str:
    """Restore bytes, which must be refused before anything is written; return the message."""
    (folder / "damaged.zip").write_bytes(data)
    database = Database(f"sqlite:///{folder / 'restored.sqlite'}")
    with pytest.raises(expected) as caught:
        restore(database, folder / "damaged.zip")
    assert inspect(database.engine).get_table_names() == []
    database.close()
    return str(caught.value)


def test_a_flipped_bit_anywhere_is_refused(small: Path, tmp_path: Path):
    whole, chance = small.read_bytes(), random.Random(7)
    places = (
        [chance.randrange(len(whole)) for _ in range(150)] + list(range(8)) + list(range(len(whole) - 90, len(whole)))
    )
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << chance.randrange(8)
        (tmp_path / "damaged.zip").write_bytes(damaged)
        with pytest.raises((Corrupt, UnknownFormat)):
            check_backup(tmp_path / "damaged.zip")


def test_what_is_damaged_is_named(small: Path, tmp_path: Path):
    whole = small.read_bytes()
    with zipfile.ZipFile(small) as opened:
        places = {info.filename: info.header_offset + 30 + len(info.filename) for info in opened.infolist()}
    for name in ("demonstrations.rows", "policy_versions.rows", "recording_chunks.rows", "manifest.json"):
        at = places[name] + 60
        damaged = whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]
        assert f"{name} is " in refused(damaged, tmp_path), name
    assert "its last bytes" in refused(whole[:-1], tmp_path)
    assert "truncated file" in refused(whole[: len(whole) // 2], tmp_path)
    assert "its directory" in refused(whole[:10] + b"\x7f" + whole[11:], tmp_path)


def test_a_missing_part_is_named(small: Path, tmp_path: Path):
    kept = io.BytesIO()
    with zipfile.ZipFile(small) as old, zipfile.ZipFile(kept, "w") as new:
        for info in old.infolist():
            if info.filename != "releases.rows":
                new.writestr(info, old.read(info))
        new.comment = old.comment
    assert "releases.rows is missing" in refused(kept.getvalue(), tmp_path)


def resealed(small: Path, **changes: Any) -> bytes:
    """Return a backup with a changed manifest that is otherwise complete."""
    out = io.BytesIO()
    with zipfile.ZipFile(small) as old, zipfile.ZipFile(out, "w") as new:
        for info in old.infolist():
            data = old.read(info)
            if info.filename == dump.MANIFEST:
                data = json.dumps(json.loads(data) | changes).encode()
            new.writestr(info, data)
        new.comment = b"0" * dump.SEAL_BYTES
    body = out.getvalue()[: -dump.SEAL_BYTES]
    return body + sha256(body).encode()


def test_what_is_no_backup_or_of_another_version_is_refused(small: Path, tmp_path: Path):
    assert "not a backup" in refused(b"", tmp_path, UnknownFormat)
    assert "not a backup" in refused(b"SQLite format 3\x00" * 100, tmp_path, UnknownFormat)
    assert "that this version can read" in refused(
        resealed(small, format="suture-skills backup 2"), tmp_path, UnknownFormat
    )
    assert "another version" in refused(resealed(small, revision="9999"), tmp_path, Conflict)


def test_a_backup_that_fails_half_way_through_restoring_leaves_nothing(small: Path, tmp_path: Path):
    database = Database(f"sqlite:///{tmp_path / 'new.sqlite'}")

    def fail(name: str) -> None:
        if name == "releases":
            raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input"):
        restore(database, small, progress=fail)
    assert inspect(database.engine).get_table_names() == []
    restore(database, small)
    expected = {one.name: one.rows for one in check_backup(small).tables}
    assert how_many(database) == expected | {"events": ANY, "history": ANY}
    database.close()
