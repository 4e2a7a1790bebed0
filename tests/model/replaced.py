"""The replaced parts of an installation under random actions: the date, the reader of uploads, and the job engine.

Uploads are read in this process instead of a confined one. The engine may miss any notification and here misses all of
them. `settled` makes the databases that the installations begin with.
"""

import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import date, datetime
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, ClassVar

import pytest
from sqlalchemy import make_url
from sqlalchemy.orm import Session

import skills.api.app
import skills.db
from skills.db.session import Database
from skills.demonstration.recording import Recording
from skills.formats import read_recording
from skills.formats.parsed import parse_recording
from skills.library.people.keys import create_key
from skills.library.plans import tries
from skills.library.policies import retraining
from skills.settings import Settings
from tests import backends

FIRST_DAY = date(2026, 3, 1)
ADMIN = "admin"


class Clock(datetime):
    """A clock with the simulated date and the real time of day."""

    day: ClassVar[date] = FIRST_DAY

    @classmethod
    def now(cls, tz: Any = None) -> datetime:  # type: ignore[override]
        return datetime.now(tz).replace(year=cls.day.year, month=cls.day.month, day=cls.day.day)


class Interruptible(Database):
    """A database with a callback before each of its transactions."""

    pause: ClassVar[Callable[[], None]] = staticmethod(lambda: None)

    def reading(self) -> AbstractContextManager[Session]:
        self.pause()
        return super().reading()

    def writing(self, names: Iterable[str] | None = None) -> AbstractContextManager[Session]:
        self.pause()
        return super().writing(names)


class Deaf:
    """A job engine that misses every notification."""

    def submit(self, *_job: object) -> None: ...

    def cancel(self, *_job: object) -> None: ...

    def close(self) -> None: ...


def read_here(file: BinaryIO, *, rate_hz: float | None, frame: str | None, **_who: object) -> Recording:
    return read_recording(file, rate_hz=rate_hz, frame=frame)


read_here.parse = lambda file, *, key="", **how: parse_recording(file, **how)  # type: ignore[attr-defined]


@contextmanager
def in_our_hands() -> Iterator[None]:
    """Replace the clock, the reader and the engine; and put several styles into a part of a batch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(skills.db, "datetime", Clock)
        patch.setattr(skills.api.app, "confined_reader", lambda _settings: nullcontext(read_here))
        patch.setattr(tries, "confined_reader", lambda _settings: SimpleNamespace(server=Deaf(), parse=parse_recording))
        patch.setattr(skills.api.app, "Engine", lambda _settings: Deaf())
        patch.setattr(retraining, "FEWEST_PARTS", 2)
        yield


def settled(backend: str, folder: Path) -> tuple[str, str]:
    """Copy a database with a catalogue and an admin's key; return its URL, and the key."""
    template, key = _settled(backend)
    if backend == "sqlite":
        return f"sqlite:///{shutil.copy(template, folder / 'settled.sqlite')}", key
    name = f"i{uuid.uuid4().hex[:12]}"
    backends.on_server(f"CREATE DATABASE {name} TEMPLATE {template}")
    return backends.server_url(name), key


@cache
def _settled(backend: str) -> tuple[str, str]:
    """Make that database, once; return its file or name, and the key."""
    url = backends.fresh(backend, backends.migrated_file().parent)
    database = Database(url)
    skills.api.app.prepare_database(database, Settings())
    with database.writing() as session:
        key = create_key(session, ADMIN, "admin", "local")[1]
    database.close()
    return url.removeprefix("sqlite:///") if backend == "sqlite" else str(make_url(url).database), key
