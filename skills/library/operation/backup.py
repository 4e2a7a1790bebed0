"""Backups of an installation, and their restoration.

Database --back_up--> backup --restore, Erasures--> Database
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import inspect, update

from skills import __version__
from skills.db import Base, dump
from skills.db.dump import Manifest
from skills.db.saved_heads import archive_heads
from skills.db.service_tables import Job, record_event
from skills.db.session import Database
from skills.db.tiles import fill_tiles
from skills.errors import Conflict, NotReady
from skills.library.operation.erasure_list import NOTHING, Erasures, apply_erasures
from skills.library.operation.files import appearing_file
from skills.library.operation.history import sign_history
from skills.library.operation.jobs import ACTIVE, BATCH
from skills.library.operation.sweep import sweep_erased

Progress = Callable[[str], None]  # progress callback; its argument is the name of the table or step


@dataclass(frozen=True)
class Restored:
    """The result of a restoration: the backup's manifest, and the numbers of items ended again because of the list."""

    manifest: Manifest
    surgeons_erased: int = 0
    demos_erased: int = 0
    recordings_deleted: int = 0
    demos_withdrawn: int = 0
    styles_stopped: int = 0  # released in the backup, and not any more
    keys_revoked: int = 0
    consents_narrowed: int = 0
    demos_marked: int = 0


def back_up(database: Database, target: Path, progress: Progress = lambda _: None) -> Manifest:
    """Write a backup of the present state into a new file, without blocking other users.

    Raises:
        Conflict: The file exists, or the tables are of another version.
    """
    if target.exists():
        raise Conflict(f"{target} exists; a backup never overwrites a file, so choose another name.")
    with appearing_file(target) as file, database.reading() as session:
        return dump.write(file, session.connection(), __version__, progress)


def check_backup(source: Path) -> Manifest:
    """Verify every byte of a backup and return its manifest.

    Raises:
        UnknownFormat: It is not a backup.
        Corrupt: It is damaged; the message names the place.
        Conflict: It is of a newer version.
    """
    with source.open("rb") as file:
        return dump.check(file)


def restore(
    database: Database, source: Path, erasures: Erasures = NOTHING, progress: Progress = lambda _: None
) -> Restored:
    """Fill a database without tables from a backup and apply a list of erasures, in one transaction.

    Jobs that had not ended are submitted to the engine again by the first worker.

    Args:
        database: The target; it has no tables yet.
        source: The backup.
        erasures: The list to apply. Without it, everything that ended after the backup is in force again.
        progress: Progress callback, called with the name of the current table or step.

    Raises:
        Conflict: The database is not empty, or the backup is newer than this version.
        UnknownFormat: The file is not a backup.
        Corrupt: The backup is damaged.
    """
    with source.open("rb") as file:
        manifest = dump.check(file)
        with database.writing() as session:
            if set(inspect(session.connection()).get_table_names()) & set(Base.metadata.tables):
                raise Conflict("There is a database already; restore a backup only into an empty one.")
            dump.load(file, manifest, session.connection(), progress)
            progress("history")
            database.history.go_on_after_restore(session.connection())
            fill_tiles(session.connection())
            progress("erasures")
            restored = Restored(manifest, **apply_erasures(session, erasures))
            session.execute(update(Job).where(Job.state.in_(ACTIVE), Job.kind != BATCH).values(submitted_at=None))
            record_event(session, "local", "restore", "installation", manifest.created_at)
    sweep_erased(database)
    return restored


def accept_rollback(database: Database, erasures: Erasures = NOTHING) -> dict[str, int]:
    """Go on with a database that is not the one whose history was saved last, and apply a list of erasures.

    An event says so, with the size of the head that was given up; the file of saved heads is set aside.

    Returns:
        The numbers of what the list ended again, by name as in `Restored`.

    Raises:
        Conflict: It is the database that was saved last.
        NotReady: It was signed with another key.
        BadSettings: The file of saved heads cannot be set aside.
    """
    history = database.history
    saved = history.saved_head()
    with database.writing() as session:
        connection = session.connection()
        with suppress(NotReady):
            history.compare(connection, saved)
            raise Conflict("The database is the one whose history was saved last: there is nothing to accept.")
        history.compare(connection, None)
        archive_heads(history.heads_file)
        ended = apply_erasures(session, erasures)
        session.execute(update(Job).where(Job.state.in_(ACTIVE), Job.kind != BATCH).values(submitted_at=None))
        size = 0 if saved is None else saved.checkpoint.size
        record_event(session, "local", "accept", "rollback", f"{size} leaves")
    sign_history(database)
    sweep_erased(database)
    return ended
