"""Dependencies of routes: database, job engine, recording reader, caller, strict JSON bodies, and uploads.

JSON bodies are parsed strictly: a repeated name in an object is refused, and so are NaN and infinity. A component that
parses the request before this service, such as a proxy, may use the first of two values where Python uses the last.
"""

import asyncio
import hashlib
import json
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from functools import partial
from typing import Annotated, Any, NoReturn

from fastapi import Depends, Header, Path, Query, Request, Response
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect

from skills.api.authentication import RateLimits
from skills.api.authorisation import Asking
from skills.db.session import Database
from skills.errors import TooLarge, TooSlow, UnknownFormat, UnreadableRecording
from skills.formats import BYTES, MEDIA_TYPES, media_type_of
from skills.jobs import Engine
from skills.library.operation.jobs import refuse_too_many
from skills.library.recordings.recordings import Reader, Teller, Upload, check_digest
from skills.schemas.requests import DIGEST, JOB, SLUG
from skills.settings import Settings


class Strict(APIRoute):
    """A route whose JSON body is parsed strictly."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return a handler that replaces the request by one with strict JSON parsing."""
        handle = super().get_route_handler()

        async def strictly(request: Request) -> Response:
            return await handle(_Strictly(request.scope, request.receive))

        return strictly


class _Strictly(Request):
    async def json(self) -> Any:
        """Return the parsed body.

        Raises:
            JSONDecodeError: It is not JSON, an object repeats a name, or a number is not finite.
        """
        return strictly_read(await self.body())


def strictly_read(text: str | bytes) -> Any:
    """Return parsed JSON.

    Raises:
        JSONDecodeError: It is not JSON, an object repeats a name, or a number is not finite.
    """
    return json.loads(text, object_pairs_hook=_once, parse_constant=_refuse)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        raise json.JSONDecodeError("An object has the same name twice", "", 0)
    return made


def _refuse(_constant: str) -> NoReturn:
    raise json.JSONDecodeError("A number is not finite", "", 0)


SPOOL_BYTES = 8 << 20


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


async def _teller(request: Request, caller: Asking) -> Teller:
    """Return the reader that also describes a recording, with the caller's name as the key of its queue."""
    return partial(request.app.state.reader.tell, key=caller.name)


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _actor(caller: Asking) -> str:
    """Return the caller's name, for events."""
    return caller.name


Db = Annotated[Database, Depends(_database)]
Jobs = Annotated[Engine, Depends(_engine)]
Read = Annotated[Reader, Depends(_reader)]
Tell = Annotated[Teller, Depends(_teller)]
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


async def receive(
    request: Request,
    settings: Configured,
    caller: Asking,
    content_type: Annotated[str, Header()] = "",
    content_digest: Annotated[str | None, Header(max_length=500)] = None,
    content_encoding: Annotated[str | None, Header(max_length=100)] = None,
) -> AsyncIterator[Upload]:
    """Spool the raw body to a temporary file, and compute its size and SHA-256 meanwhile.

    Raises:
        UnknownFormat: The content type is not supported, or the body has a content encoding.
        TooLarge: The body exceeds the size limit.
        TooSlow: It did not arrive in time.
        UnreadableRecording: It ended early, or does not match its Content-Digest.
        TooMany: The key exceeds its upload allowance of a day.
    """
    limits: RateLimits = request.app.state.access.limits
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type not in (BYTES, *MEDIA_TYPES):
        known = ", ".join(f"{kind} ({name})" for kind, name in MEDIA_TYPES.items())
        known += f", {BYTES} (any of them, detected from the content)"
        raise UnknownFormat(
            f"The Content-Type is not one of a recording; send the recording as the raw body with one of: {known}."
        )
    if content_encoding not in (None, "identity"):
        raise UnknownFormat("Send the body without Content-Encoding; MCAP compresses itself.")
    seen, size = hashlib.sha256(), 0
    with tempfile.SpooledTemporaryFile(max_size=SPOOL_BYTES) as file:
        async for data in _in_time(request, settings):
            size += len(data)
            if caller.key is not None:
                limits.upload(caller.key, len(data))
            if size > settings.max_upload_bytes:
                raise TooLarge(f"The recording is larger than {settings.max_upload_bytes} bytes; cut it.")
            seen.update(data)
            file.write(data)
        sha256 = seen.hexdigest()
        vouched = check_digest(content_digest, sha256)
        if media_type == BYTES:
            media_type = media_type_of(file)  # type: ignore[arg-type]
        yield Upload(file, sha256, size, media_type, vouched)  # type: ignore[arg-type]


async def _in_time(request: Request, settings: Settings) -> AsyncIterator[bytes]:
    """Yield the chunks of a body as they arrive, as long as it arrives fast enough.

    Raises:
        TooSlow: It is slower than the settings' rate after their grace period, or misses their deadline.
        UnreadableRecording: The client disconnected.
    """
    began, size, pieces = time.monotonic(), 0, request.stream()
    while True:
        allowed_s = min(settings.upload_patience_s + size / settings.upload_bytes_per_s, settings.upload_deadline_s)
        try:
            data = await asyncio.wait_for(anext(pieces, None), began + allowed_s - time.monotonic())
        except TimeoutError:
            raise TooSlow("The body arrived too slowly; send it again over a faster connection.") from None
        except ClientDisconnect:
            raise UnreadableRecording("The body ended early; send it again.") from None
        if data is None:
            return
        size += len(data)
        yield data


Incoming = Annotated[Upload, Depends(receive)]
