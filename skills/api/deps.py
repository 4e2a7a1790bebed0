"""What routes ask for: the database, the engine, the reader, who is asking, and an upload on its way in."""

import asyncio
import hashlib
import tempfile
import time
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request
from starlette.requests import ClientDisconnect

from skills.api.access import Asking
from skills.api.limits import Limits
from skills.db.session import Database
from skills.errors import TooLarge, TooSlow, UnknownFormat, UnreadableRecording
from skills.jobs.engine import Engine
from skills.library.jobs import refuse_too_many
from skills.library.recordings import Reader, Upload, check_digest
from skills.recordings import MEDIA_TYPES
from skills.settings import Settings

SLUG = r"^[a-z0-9][a-z0-9_-]{0,63}$"
DIGEST = r"^[0-9a-f]{64}$"
SPOOL_BYTES = 8 << 20


# All of these are `async`, for FastAPI sends what is not to a thread.


async def _database(request: Request, caller: Asking) -> Database:
    """Give the database, as far as the caller may see it."""
    database: Database = request.app.state.database
    return database.seen_by(caller.only)


async def _engine(request: Request) -> Engine:
    engine: Engine = request.app.state.engine
    return engine


async def _reader(request: Request) -> Reader:
    reader: Reader = request.app.state.reader
    return reader


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _actor(caller: Asking) -> str:
    """Name who asks, for events."""
    return caller.name


Db = Annotated[Database, Depends(_database)]
Jobs = Annotated[Engine, Depends(_engine)]
Read = Annotated[Reader, Depends(_reader)]
Configured = Annotated[Settings, Depends(_settings)]
Actor = Annotated[str, Depends(_actor)]
Slug = Annotated[str, Path(pattern=SLUG)]
Digest = Annotated[str, Path(pattern=DIGEST)]
Limit = Annotated[int, Query(ge=1, le=200)]
RowCursor = Annotated[int | None, Query(alias="cursor", ge=1, le=2**62)]
SlugCursor = Annotated[str | None, Query(alias="cursor", pattern=SLUG)]


def _refuse_too_many_jobs(request: Request, caller: Asking, settings: Configured) -> None:
    """Refuse to take on more work for somebody than the settings allow; whoever is on this machine may ask for any.

    Requests that come at the same moment are counted before either has asked: each may be let in.
    """
    if caller.key is not None:
        database: Database = request.app.state.database
        with database.reading() as session:
            refuse_too_many(session, caller.name, settings.key_jobs)


room_for_a_job = Depends(_refuse_too_many_jobs)


async def receive(
    request: Request,
    settings: Configured,
    caller: Asking,
    content_type: Annotated[str, Header()] = "",
    content_digest: Annotated[str | None, Header(max_length=500)] = None,
    content_encoding: Annotated[str | None, Header(max_length=100)] = None,
    rate_hz: Annotated[float | None, Query(gt=0, le=10_000, allow_inf_nan=False)] = None,
    frame: Annotated[str | None, Query(pattern=r"^[A-Za-z0-9_./-]{1,64}$")] = None,
) -> AsyncIterator[Upload]:
    """Spool the raw body to a temporary file, counting and digesting it on the way.

    Raises:
        UnknownFormat: The content type is none that is read here.
        TooLarge: The body is over the limit.
        TooSlow: It did not come in time.
        UnreadableRecording: It ended early, or is not what its Content-Digest says.
        TooMany: The key has sent as much today as it may.
    """
    limits: Limits = request.app.state.access.limits
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type not in MEDIA_TYPES:
        known = ", ".join(f"{kind} ({name})" for kind, name in MEDIA_TYPES.items())
        raise UnknownFormat(f"Send the recording as the raw body with one of these as its Content-Type: {known}.")
    if content_encoding not in (None, "identity"):
        raise UnknownFormat("Send the body without Content-Encoding; MCAP compresses itself.")
    seen, size = hashlib.sha256(), 0
    with tempfile.SpooledTemporaryFile(max_size=SPOOL_BYTES) as file:
        async for data in _in_time(request, settings):
            size += len(data)
            if caller.key is not None:
                limits.upload(caller.key, len(data))
            if size > settings.max_upload_bytes:
                raise TooLarge(f"A recording has at most {settings.max_upload_bytes} bytes; cut it.")
            seen.update(data)
            file.write(data)
        sha256 = seen.hexdigest()
        vouched = check_digest(content_digest, sha256)
        yield Upload(file, sha256, size, media_type, rate_hz, frame, vouched)  # type: ignore[arg-type]


async def _in_time(request: Request, settings: Settings) -> AsyncIterator[bytes]:
    """Give a body piece by piece, for as long as it comes fast enough and is not given up.

    Raises:
        TooSlow: It is slower than the settings' rate, their patience granted, or not there at their deadline.
        UnreadableRecording: The sender went away.
    """
    began, size, pieces = time.monotonic(), 0, request.stream()
    while True:
        allowed_s = min(settings.upload_patience_s + size / settings.upload_bytes_per_s, settings.upload_deadline_s)
        try:
            data = await asyncio.wait_for(anext(pieces, None), began + allowed_s - time.monotonic())
        except TimeoutError:
            raise TooSlow("The body came too slowly; send it again over a better line.") from None
        except ClientDisconnect:
            raise UnreadableRecording("The body ended early; send it again.") from None
        if data is None:
            return
        size += len(data)
        yield data


Incoming = Annotated[Upload, Depends(receive)]
