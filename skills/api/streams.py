"""Streams of stored files.

A stream waits for its client between two chunks, perhaps for long, and is abandoned there when the client disconnects.
Its generator therefore holds no session, file or lock across a `yield` (`tests/test_architecture.py` checks sessions).
A recording, or a dataset, is read in one transaction per chunk.
"""

import hashlib
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing

from anyio import CapacityLimiter, to_thread
from fastapi import Response
from fastapi.responses import StreamingResponse
from sqlalchemy.orm import Session
from starlette.types import Send

from skills.api.responses import Give, as_asked
from skills.db.models import StoredRecording
from skills.db.service_tables import StoredDataset
from skills.db.session import Database
from skills.library.recordings.recordings import damaged

PIECE_BYTES = 64 << 10  # written at once; at most two of them are buffered for a slow client
DOWNLOADS_READ = 4  # chunks read at once for all downloads: limits threads, and thereby database connections


class Stream(StreamingResponse):
    """A streamed response that sends its status with the first chunk: an error before that becomes a problem document.

    A later error aborts the connection, so a response that ends regularly is complete. The generator is closed at the
    end in every case, and not when the garbage collector finds it.
    """

    def __init__(self, pieces: AsyncGenerator[bytes, None], media_type: str, headers: dict[str, str]) -> None:
        super().__init__(pieces, headers=headers, media_type=media_type)
        self._pieces = pieces

    async def stream_response(self, send: Send) -> None:
        """Send the status with the first chunk, then the rest."""
        try:
            piece = await anext(self._pieces, None)
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            while piece is not None:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                piece = await anext(self._pieces, None)
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            await self._pieces.aclose()


def stored_file(
    give: Give,
    database: Database,
    find: Callable[[Session], StoredRecording | StoredDataset],
    read: Callable[[int], bytes | None],
    accept: str,
    attachment: str | None = None,
) -> Response:
    """Return the bytes of a stored file; all of them are verified before the first one is sent.

    Args:
        give: The answer to the request.
        database: The database, restricted to the rows that the caller may see.
        find: Returns the file's row; raises if it was erased, or may not be passed on.
        read: Returns a chunk by its number, in a transaction of its own; None after the last one.
        accept: The header of this name.
        attachment: The name under which a browser stores it, with a place for its digest.
    """
    with database.reading() as session:
        found = find(session)
        sha256, kind, tag = found.sha256, as_asked(accept, found.media_type), {"ETag": f'"{found.sha256}"'}
        headers = {"Content-Length": str(found.size_bytes), **tag}
    if give.is_known(tag["ETag"]):
        return Response(status_code=304, headers=tag)
    if attachment is not None:
        headers["Content-Disposition"] = f'attachment; filename="{attachment.format(sha256[:12])}"'

    def refuse() -> None:
        with database.reading() as session:
            find(session)

    # outside the session, because a slow client may keep the stream open for long
    return Stream(stored_pieces(read, refuse, sha256, give.request.app.state.downloads), kind, headers)


async def stored_pieces(
    read: Callable[[int], bytes | None], refuse: Callable[[], object], sha256: str, limiter: CapacityLimiter
) -> AsyncGenerator[bytes, None]:
    """Yield the bytes of a stored file, after all of them were compared with its digest.

    Every chunk is read in a transaction of its own, so the file is read twice: to check it before the first byte
    is sent, and to send it. The second pass is checked as well, and withholds its last chunk until the digest agrees.

    Args:
        read: Returns a chunk by its number, in a transaction of its own; None after the last one.
        refuse: Called if the digest differs; raises if the file was erased, or may not be passed on any more.
        sha256: The file's digest.
        limiter: Limit on reading threads, shared by the application; see `DOWNLOADS_READ`.

    Raises:
        Corrupt: The bytes do not match the digest.
        SkillsError: As `read` and `refuse`.
    """
    async for _ in _chunks(read, refuse, sha256, limiter):
        pass
    async with aclosing(_chunks(read, refuse, sha256, limiter)) as chunks:
        async for chunk in chunks:
            for at in range(0, len(chunk), PIECE_BYTES):
                yield chunk[at : at + PIECE_BYTES]


async def _chunks(
    read: Callable[[int], bytes | None], refuse: Callable[[], object], sha256: str, limiter: CapacityLimiter
) -> AsyncGenerator[bytes, None]:
    """Yield the chunks of a file; the last one only if all of them together match the digest."""
    hasher, held, number = hashlib.sha256(), b"", 0

    def read_next() -> bytes | None:
        chunk = read(number)
        if isinstance(chunk, str):  # SQLite does not enforce the column's type
            raise damaged()
        if chunk is not None:
            hasher.update(chunk)
        return chunk

    while (chunk := await to_thread.run_sync(read_next, limiter=limiter)) is not None:
        if held:
            yield held
        held, number = chunk, number + 1
    if hasher.hexdigest() != sha256:
        await to_thread.run_sync(refuse)
        raise damaged()
    yield held
