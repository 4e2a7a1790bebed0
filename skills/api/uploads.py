"""Uploads: the raw body of a request, spooled to a temporary file, within the limits of size and speed."""

import asyncio
import hashlib
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

from fastapi import Depends, Header, Request
from starlette.requests import ClientDisconnect

from skills.api.authorisation import Asking
from skills.api.dependencies import Configured
from skills.api.rate_limits import RateLimits
from skills.errors import TooLarge, TooSlow, UnknownFormat, UnreadableRecording
from skills.formats import BYTES, MEDIA_TYPES, media_type_of
from skills.library.recordings.recordings import SharedReading, Upload, check_digest
from skills.settings import Settings

SPOOL_BYTES = 8 << 20


class EqualUploads(SharedReading):
    """Uploads of equal bytes to one route that are handled at once: the first is read, and the others wait for it.

    They wait on the event loop and not in a thread, so that others are answered, however many they are.
    """

    def __init__(self) -> None:
        super().__init__()
        self._reading = asyncio.Lock()

    @asynccontextmanager
    async def one(self) -> AsyncIterator["EqualUploads"]:
        """Wait until these bytes were read, or until it is this upload's turn to have them read."""
        async with self._reading:
            if self.outcome is None:
                yield self
                return
        yield self


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
    hasher, size = hashlib.sha256(), 0
    with tempfile.SpooledTemporaryFile(max_size=SPOOL_BYTES) as file:
        async for data in _in_time(request, settings):
            size += len(data)
            if caller.key is not None:
                limits.upload(caller.key, len(data))
            if size > settings.max_upload_bytes:
                raise TooLarge(f"The recording is larger than {settings.max_upload_bytes} bytes; cut it.")
            hasher.update(data)
            file.write(data)
        sha256 = hasher.hexdigest()
        vouched = check_digest(content_digest, sha256)
        if media_type == BYTES:
            media_type = media_type_of(file)  # type: ignore[arg-type]
        equal = request.app.state.equal_uploads.setdefault((request.url.path, sha256), EqualUploads())
        async with equal.one() as shared:
            yield Upload(file, sha256, size, media_type, vouched, shared=shared)  # type: ignore[arg-type]


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


Incoming = Annotated[Upload, Depends(receive, scope="function")]
