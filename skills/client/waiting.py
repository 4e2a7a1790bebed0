"""Waiting of the asynchronous client: sleeping, file access in a thread, and the body of an upload.

`skills.client.blocking.waiting` has the same functions for the blocking client.
"""

from collections.abc import AsyncIterator, Callable
from typing import TypeVar

import anyio
from anyio import to_thread

from skills.client.files import FileUpload, Progress

T = TypeVar("T")

sleep = anyio.sleep


async def in_thread(work: Callable[[], T]) -> T:
    """Run a function that reads or writes a file without blocking other coroutines."""
    return await to_thread.run_sync(work)


async def upload_body(upload: FileUpload, progress: Progress | None) -> AsyncIterator[bytes]:
    """Yield the chunks of a request's body; `progress` is called, in this thread, after each was sent."""
    sent, chunks = 0, upload.chunks()
    while chunk := await in_thread(lambda: next(chunks, b"")):
        yield chunk
        sent += len(chunk)
        if progress is not None:
            progress(sent, upload.size_bytes)
