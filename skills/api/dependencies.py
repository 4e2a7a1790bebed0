"""Dependencies of routes: database, job engine, recording reader, caller."""

from functools import partial
from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request

from skills.api.authorisation import Asking
from skills.db.session import Database
from skills.jobs import Engine
from skills.library.operation.jobs import refuse_too_many
from skills.library.recordings.recordings import Parser, Reader
from skills.schemas.requests import DIGEST, JOB, SLUG
from skills.settings import Settings


# All of these are `async`, because FastAPI runs a plain function in a thread, which costs more than these do.
async def _database(request: Request, caller: Asking) -> Database:
    """Return the database, restricted to the rows that the caller may see."""
    database: Database = request.app.state.database
    return database.seen_by(caller.only)


async def _engine(request: Request) -> Engine:
    engine: Engine = request.app.state.engine
    return engine


async def _reader(request: Request, caller: Asking) -> Reader:
    """Return the reader of recordings; its queue is shared fairly between callers, so the caller's name is its key."""
    return partial(request.app.state.reader, key=caller.name)


async def _parser(request: Request, caller: Asking) -> Parser:
    """Return the reader that also describes a recording, with the caller's name as the key of its queue."""
    return partial(request.app.state.reader.parse, key=caller.name)


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _actor(caller: Asking) -> str:
    """Return the caller's name, for events."""
    return caller.name


Db = Annotated[Database, Depends(_database)]
Jobs = Annotated[Engine, Depends(_engine)]
Read = Annotated[Reader, Depends(_reader)]
Parse = Annotated[Parser, Depends(_parser)]
Configured = Annotated[Settings, Depends(_settings)]
Actor = Annotated[str, Depends(_actor)]
Slug = Annotated[str, Path(pattern=SLUG)]
Digest = Annotated[str, Path(pattern=DIGEST)]
Limit = Annotated[int, Query(ge=1, le=200)]
JobId = Annotated[str, Path(pattern=JOB)]
Version = Annotated[int, Path(ge=1, le=2**31)]
Accept = Annotated[str, Header(max_length=500)]
RowCursor = Annotated[int | None, Query(alias="cursor", ge=1, le=2**62)]
SlugCursor = Annotated[str | None, Query(alias="cursor", pattern=SLUG)]


def _refuse_too_many_jobs(request: Request, caller: Asking, settings: Configured) -> None:
    """Check that the caller has fewer unfinished jobs than the settings allow; a local caller has no limit.

    Concurrent requests are counted before any of them has inserted its job, so a few more may pass.
    """
    if caller.key is not None:
        database: Database = request.app.state.database
        with database.reading() as session:
            refuse_too_many(session, caller.name, settings.key_jobs)


room_for_a_job = Depends(_refuse_too_many_jobs)
