"""Backups of an installation, and its return from one; who was erased meanwhile does not return with it."""

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO

from sqlalchemy import inspect, select, update
from sqlalchemy.orm import Session

from skills import __version__
from skills.db import archive
from skills.db.archive import Manifest
from skills.db.base import Base, rfc3339
from skills.db.books import Event, Job
from skills.db.models import Demonstration, Erasure, Surgeon
from skills.db.session import Database
from skills.errors import Conflict, Corrupt
from skills.library.catalogue import salted
from skills.library.erasure import erase_demo, erase_surgeon
from skills.library.events import record
from skills.library.jobs import ACTIVE
from skills.packing import canonical, sha256

Told = Callable[[str], None]  # called with the name of what is worked on
ERASURES = "suture-skills erasures 1"


@dataclass(frozen=True)
class Erasures:
    """Who and what was erased, told so that it can be known again but not be read.

    `surgeons` holds the salt, salted digest of the pseudonym and moment of each, `demos` digest and moment.
    """

    surgeons: frozenset[tuple[str, str, str]] = frozenset()
    demos: frozenset[tuple[str, str]] = frozenset()

    def __or__(self, other: "Erasures") -> "Erasures":
        """Join two lists."""
        return Erasures(self.surgeons | other.surgeons, self.demos | other.demos)

    def __sub__(self, other: "Erasures") -> "Erasures":
        """Leave out what another list has."""
        return Erasures(self.surgeons - other.surgeons, self.demos - other.demos)


NOTHING = Erasures()


@dataclass(frozen=True)
class Restored:
    """What came of a backup: what it said of itself, and how many surgeons and demonstrations were erased again."""

    manifest: Manifest
    surgeons_erased: int
    demos_erased: int


def back_up(database: Database, target: Path, told: Told = lambda _: None) -> Manifest:
    """Write a backup of the present state into a new file, while others go on working.

    Raises:
        Conflict: The file exists, or the tables are of another version.
    """
    if target.exists():
        raise Conflict(f"{target} exists; a backup never overwrites anything, so give another name.")
    with _appearing(target) as file, database.reading() as session:
        return archive.write(file, session.connection(), __version__, told)


def check_backup(source: Path) -> Manifest:
    """Check every byte of a backup: what it says of itself.

    Raises:
        UnknownFormat: It is no backup.
        Corrupt: It is damaged; the message says where.
        Conflict: It is of a newer version.
    """
    with source.open("rb") as file:
        return archive.check(file)


def restore(database: Database, source: Path, erasures: Erasures = NOTHING, told: Told = lambda _: None) -> Restored:
    """Fill a database without tables from a backup, and erase again what was erased since; all of it or nothing.

    Jobs that had not ended are told to the engine again by the first worker.

    Raises:
        Conflict: The database is not empty.
        UnknownFormat, Corrupt, Conflict: The backup is none, damaged, or newer than this version.
    """
    with source.open("rb") as file:
        manifest = archive.check(file)
        with database.writing() as session:
            if set(inspect(session.connection()).get_table_names()) & set(Base.metadata.tables):
                raise Conflict("There is a database already; a backup is restored into an empty one only.")
            archive.load(file, manifest, session.connection(), told)
            told("erasures")
            surgeons, demos = _erase_again(session, erasures)
            session.execute(update(Job).where(Job.state.in_(ACTIVE)).values(told_at=None))
            record(session, "local", "restore", "installation", manifest.created_at)
    database.forget()
    return Restored(manifest, surgeons, demos)


def erasures_of(database: Database) -> Erasures:
    """List what was erased in an installation."""
    with database.reading() as session:
        return _listed(session)


def keep_erasures(database: Database, target: Path) -> Erasures:
    """Write the list of erasures, together with what the file listed before; it never gets shorter."""
    listed = erasures_of(database) | (read_erasures(str(target)) if target.exists() else NOTHING)
    content = {"surgeons": sorted(map(list, listed.surgeons)), "demonstrations": sorted(map(list, listed.demos))}
    with _appearing(target) as file:
        about = {"format": ERASURES, "erasures": content, "sha256": sha256(canonical(content))}
        file.write(json.dumps(about, indent=1).encode() + b"\n")
    return listed


def read_erasures(source: str) -> Erasures:
    """Read a list of erasures: from a file, or by its URL from the database of an installation.

    Raises:
        Corrupt: The file is no such list, or not as it was written.
    """
    if "://" in source:
        database = Database(source)
        try:
            return erasures_of(database)
        finally:
            database.close()
    try:
        said = json.loads(Path(source).read_bytes())
        listed = said["erasures"]
        if (said["format"], said["sha256"]) != (ERASURES, sha256(canonical(listed))):
            raise ValueError
    except (ValueError, KeyError, TypeError) as error:
        raise Corrupt("This is no list of erasures, or it was changed; take another copy of it.") from error
    return Erasures(frozenset(map(tuple, listed["surgeons"])), frozenset(map(tuple, listed["demonstrations"])))


def _listed(session: Session) -> Erasures:
    surgeons = {(one.salt, one.digest, rfc3339(one.erased_at) or "") for one in session.scalars(select(Erasure))}
    erased = select(Event).where(Event.action == "erase", Event.object_kind == "demonstration")
    return Erasures(
        frozenset(surgeons), frozenset((one.object_id, rfc3339(one.at) or "") for one in session.scalars(erased))
    )


def _erase_again(session: Session, erasures: Erasures) -> tuple[int, int]:
    """Erase what a list names and the backup does not know of: what it does know of may have been added anew since.

    Whom the list names and nobody here is stays listed, so that nobody takes the pseudonym.
    """
    later = erasures - _listed(session)
    slugs = list(session.scalars(select(Surgeon.slug)))
    surgeons: set[str] = set()
    for salt, digest, erased_at in sorted(later.surgeons):
        surgeons.update(slug for slug in slugs if salted(salt, slug) == digest)
        session.add(Erasure(salt=salt, digest=digest, erased_at=datetime.fromisoformat(erased_at)))
    for slug in sorted(surgeons):
        erase_surgeon(session, slug, "restore")
    demos = {digest for digest, _ in later.demos}.intersection(session.scalars(select(Demonstration.sha256)))
    for demo in sorted(demos):
        erase_demo(session, demo, "restore")
    return len(surgeons), len(demos)


@contextmanager
def _appearing(target: Path) -> Iterator[IO[bytes]]:
    """Write a file under another name beside its place, and let it appear there whole and durable, or not at all."""
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{target.name}-", dir=target.parent)  # only its owner may read it
    try:
        with os.fdopen(handle, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        Path(name).rename(target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    folder = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
