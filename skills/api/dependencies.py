"""Dependencies of routes: database, job engine, recording reader, caller, and the page of a list."""

from functools import partial
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Query, Request
from fastapi.requests import HTTPConnection

from skills.api.authentication import Access
from skills.api.authorisation import Asking
from skills.api.encoded_policies import Encoded
from skills.api.policy_cache import PolicyCache
from skills.api.responses import Giving, Listing
from skills.db.session import Database
from skills.jobs import Engine
from skills.library.operation.jobs import refuse_too_many
from skills.library.recordings.recordings import Parser, Reader
from skills.schemas.requests import DIGEST, JOB, SLUG
from skills.settings import Settings


# All of these are `async`, because FastAPI runs a plain function in a thread, which costs more than these do.
def _state(name: str) -> Any:
    """Declare the dependency on an attribute of the application's state."""

    async def attribute(request: HTTPConnection) -> Any:
        return getattr(request.app.state, name)

    return Depends(attribute)


async def _database(request: Request, caller: Asking) -> Database:
    """Return the database, restricted to the rows that the caller may see."""
    database: Database = request.app.state.database
    return database.seen_by(caller.only)


async def _reader(request: Request, caller: Asking) -> Reader:
    """Return the reader of recordings; its queue is shared fairly between callers, so the caller's name is its key."""
    return partial(request.app.state.reader, key=caller.name)


async def _parser(request: Request, caller: Asking) -> Parser:
    """Return the reader that also describes a recording, with the caller's name as the key of its queue."""
    return partial(request.app.state.reader.parse, key=caller.name)


async def _accept(accept: Annotated[str, Header(max_length=500)] = "*/*") -> str:
    """Return the media types that the client accepts."""
    return accept


async def _actor(caller: Asking) -> str:
    """Return the caller's name, for events."""
    return caller.name


Db = Annotated[Database, Depends(_database)]
Read = Annotated[Reader, Depends(_reader)]
Parse = Annotated[Parser, Depends(_parser)]
Accept = Annotated[str, Depends(_accept)]
Actor = Annotated[str, Depends(_actor)]
Jobs = Annotated[Engine, _state("engine")]
Configured = Annotated[Settings, _state("settings")]
Callers = Annotated[Access, _state("access")]
Served = Annotated[PolicyCache, _state("served")]
Encoder = Annotated[Encoded, _state("encoded")]
Slug = Annotated[str, Path(pattern=SLUG)]
Digest = Annotated[str, Path(pattern=DIGEST)]
OfSurgeon = Annotated[str | None, Query(pattern=SLUG)]
OfSuture = Annotated[str | None, Query(pattern=SLUG)]
OfRecording = Annotated[str | None, Query(pattern=DIGEST)]
Limit = Annotated[int, Query(ge=1, le=200)]
JobId = Annotated[str, Path(pattern=JOB)]
Version = Annotated[int, Path(ge=1, le=2**31)]
RowCursor = Annotated[int | None, Query(alias="cursor", ge=1, le=2**62)]
SlugCursor = Annotated[str | None, Query(alias="cursor", pattern=SLUG)]


async def _by_row(give: Giving, limit: Limit = 50, cursor: RowCursor = None) -> Listing[int]:
    return Listing(give, limit, cursor)


async def _by_slug(give: Giving, limit: Limit = 50, cursor: SlugCursor = None) -> Listing[str]:
    return Listing(give, limit, cursor)


ListingByRow = Annotated[Listing[int], Depends(_by_row)]
ListingBySlug = Annotated[Listing[str], Depends(_by_slug)]


def _refuse_too_many_jobs(request: Request, caller: Asking, settings: Configured) -> None:
    """Check that the caller has fewer unfinished jobs than the settings allow; a local caller has no limit.

    Concurrent requests are counted before any of them has inserted its job, so a few more may pass.
    """
    if caller.key is not None:
        database: Database = request.app.state.database
        with database.reading() as session:
            refuse_too_many(session, caller.name, settings.key_jobs)


room_for_a_job = Depends(_refuse_too_many_jobs)
