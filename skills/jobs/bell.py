"""The bell: whoever enqueues a job rings it, and it wakes the resting workers of all machines; nobody polls for it.

On PostgreSQL it is a notification. On SQLite it is the time stamp of the engine's file, of whose changes the kernel
notifies (inotify). After a stroke that is lost the next heartbeat finds the job, 1.5 s later at the latest.
"""

import ctypes
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from select import select
from threading import Event
from typing import TYPE_CHECKING, Any, NoReturn

from sqlalchemy import Engine, text

from skills.db.engines import open_for_statements
from skills.settings import Settings

if TYPE_CHECKING:
    from dbos import DBOSClient

CHANNEL = "skills_jobs"
GAP_S = 0.1
AGAIN_S = 1.0  # between two attempts to listen
_IN_CLOEXEC, _IN_ATTRIB = 0o2000000, 0x4  # linux/inotify.h
log = logging.getLogger(__name__)


class Turn(Event):
    """The stop event of the engine's thread of one queue, which polls its queue whenever `wait` ends without a stop.

    That is when its turn comes, whatever the interval of the engine, and not sooner than `GAP_S` after the last: the
    engine counts what it has just begun a moment later.
    """

    def __init__(self) -> None:
        super().__init__()
        self._come, self._came_s = Event(), 0.0

    def come(self) -> None:
        """End the current wait, or the next one."""
        self._come.set()

    def set(self) -> None:
        """Stop the thread."""
        super().set()
        self.come()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the turn; return whether to stop."""
        super().wait(max(0.0, self._came_s + GAP_S - time.monotonic()))
        self._come.wait()
        self._come.clear()
        self._came_s = time.monotonic()
        return self.is_set()


def ring(client: "DBOSClient") -> None:
    """Wake the resting workers."""
    engine = client._sys_db.engine
    if engine.dialect.name == "sqlite":
        os.utime(str(engine.url.database))
    else:
        with engine.begin() as connection:
            connection.execute(text(f"NOTIFY {CHANNEL}"))


def listen(settings: Settings, rung: Callable[[], object]) -> NoReturn:
    """Call a function at each stroke, and where one may have been missed."""
    while True:
        try:
            for _ in strokes(settings):
                rung()
        except Exception as error:  # the database is away, or this user has as many watches as it may
            log.info("Cannot listen for new jobs (%s); heartbeats look for them.", type(error).__name__)
        time.sleep(AGAIN_S)


def strokes(settings: Settings) -> Iterator[None]:
    """Yield at once, and then at each stroke."""
    engine = open_for_statements(settings.engine_url)
    return _touches(engine) if engine.dialect.name == "sqlite" else _notifications(engine)


def _touches(engine: Engine) -> Iterator[None]:
    libc = ctypes.CDLL(None, use_errno=True)
    with open(libc.inotify_init1(_IN_CLOEXEC), "rb", buffering=0) as strokes:
        if libc.inotify_add_watch(strokes.fileno(), os.fsencode(str(engine.url.database)), _IN_ATTRIB) < 0:
            raise OSError(ctypes.get_errno(), "inotify_add_watch")
        while True:
            yield
            strokes.read(4096)


def _notifications(database: Engine) -> Iterator[None]:
    with closing(database.raw_connection()) as pooled:
        pooled.detach()  # it is closed then, not given to others
        line: Any = pooled.dbapi_connection
        line.execute(f"LISTEN {CHANNEL}")
        while True:
            yield
            select([line], [], [])
            line.pgconn.consume_input()
            while line.pgconn.notifies() is not None:
                pass  # several strokes are one
