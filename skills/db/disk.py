"""The disk below a database: private files, and the difference between a full disk and a failed one.

A full disk is reported as such (`StorageFull`); earlier data stay valid, and requests succeed again once there is
space. A write or fsync that fails is different: the operating system may have dropped data that SQLite and this process
assume to be stored, and a second fsync would report success. So the process exits, with `EXIT_CODE`, and the next
process reads what is really stored (Rebello et al., "Can Applications Recover from fsync Failures?", USENIX ATC 2020).
"""

import fcntl
import logging
import os
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from sqlalchemy import Engine, event
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import DBAPIError

EXIT_CODE = 74  # EX_IOERR of sysexits.h
POSTGRESQL_FULL, POSTGRESQL_FAILED = "53100", "58030"  # disk_full, io_error
# SQLite's codes for a full disk; the index of the write-ahead log cannot grow on one either.
_FULL = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE)
# I/O errors that leave the stored data unchanged: reading, memory, locks.
_HARMLESS = (
    *(sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ, sqlite3.SQLITE_IOERR_NOMEM),
    *(sqlite3.SQLITE_IOERR_BLOCKED, sqlite3.SQLITE_IOERR_LOCK, sqlite3.SQLITE_IOERR_RDLOCK),
    *(sqlite3.SQLITE_IOERR_CHECKRESERVEDLOCK, sqlite3.SQLITE_IOERR_ACCESS, sqlite3.SQLITE_IOERR_GETTEMPPATH),
)

# Ours: a step of an erasure writes 4 MiB of content to the write-ahead log; a withdrawal writes some 100 KiB.
RESERVE_BYTES, RESERVE_STEP_BYTES = 8 << 20, 256 << 10

log = logging.getLogger(__name__)


class Reserve:
    """Allocated space beside a SQLite file, so that something can be withdrawn or erased on a disk that others filled.

    The lock on its file lasts from the release of the space to its allocation, so that no process allocates it again
    while a transaction of another one uses it.
    """

    def __init__(self, database: Path) -> None:
        """Name the file; nothing is allocated yet."""
        self._file = Path(f"{database}.reserve")

    def allocate(self) -> None:
        """Allocate what is missing, as far as there is space, unless it is in use."""
        with suppress(BlockingIOError), self._locked(fcntl.LOCK_EX | fcntl.LOCK_NB):
            pass

    @contextmanager
    def released(self) -> Iterator[None]:
        """Release the space for the duration of the block if the disk has less than that left.

        A caller that writes to the database has its write lock already: others that write to it get nothing.
        """
        with self._locked(fcntl.LOCK_EX) as handle:
            left = os.fstatvfs(handle)
            if left.f_bavail * left.f_frsize < RESERVE_BYTES:
                os.ftruncate(handle, 0)
            yield

    @contextmanager
    def _locked(self, how: int) -> Iterator[int]:
        handle = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, how)
            try:
                yield handle
            finally:
                _allocate(handle)
        finally:
            os.close(handle)


def _allocate(handle: int) -> None:
    """Allocate the rest of a file up to `RESERVE_BYTES`, in steps, so that a fuller disk gives some of it."""
    with suppress(OSError):  # it is full: a later transaction takes the rest
        for at in range(os.fstat(handle).st_size, RESERVE_BYTES, RESERVE_STEP_BYTES):
            os.posix_fallocate(handle, at, RESERVE_STEP_BYTES)


def make_private(database: Path) -> None:
    """Create a SQLite file that only this user can read, or restrict the permissions of an existing one.

    A new file has mode 0600, and a new folder 0700; SQLite gives its auxiliary files the permissions of the database.
    Wider permissions of an existing file are restricted, which is logged; an existing folder is left alone, because it
    may hold other files.
    """
    database.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path in (database, *(Path(f"{database}{ending}") for ending in ("-wal", "-shm"))):
        try:
            mode = stat.S_IMODE(path.stat().st_mode)
        except FileNotFoundError:
            continue
        if mode & 0o077:
            try:
                path.chmod(0o600)
                log.warning("%s could be read by others; its permissions are 0600 now.", path.name)
            except PermissionError:
                log.warning("%s can be read by others and belongs to another user; run chmod 600 on it.", path.name)
    with suppress(FileExistsError):  # never opened where it exists: see `skills.db.engines`
        os.close(os.open(database, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))


def is_full(error: DBAPIError) -> bool:
    """Return whether a statement failed because the database's disk is full."""
    code = getattr(error.orig, "sqlite_errorcode", None)
    return code in _FULL or getattr(error.orig, "sqlstate", None) == POSTGRESQL_FULL


def is_failed(error: BaseException | None) -> bool:
    """Return whether SQLite failed to write, or does not know whether it has written.

    No cached state of this process can be trusted then.
    """
    code = getattr(error, "sqlite_errorcode", None)
    if code is None or code & 0xFF != sqlite3.SQLITE_IOERR:
        return False
    return code not in _FULL and code not in _HARMLESS


def end_process(error: BaseException) -> NoReturn:
    """Exit this process at once, without rollbacks, flushing of caches or exit handlers."""
    name = getattr(error, "sqlite_errorname", "")
    log.critical(
        "The database's disk failed (%s, %s). The last writes may be lost, so this process ends; check the disk, "
        "run `skills verify`, and start again.",
        name,
        error,
    )
    logging.shutdown()
    os._exit(EXIT_CODE)


@event.listens_for(Engine, "handle_error")
def _end_on_failure(context: ExceptionContext) -> None:
    """Check the errors of every engine in this process, including the job engine's."""
    if is_failed(context.original_exception):
        end_process(context.original_exception)
