"""Waiting of the blocking client: the functions of `skills.client.waiting`, which is of the asynchronous one."""

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from skills.client.files import FileUpload, Progress

T = TypeVar("T")

sleep = time.sleep


def in_thread(work: Callable[[], T]) -> T:
    """Run a function that reads or writes a file, in this thread: its caller waits anyway."""
    return work()


def upload_body(upload: FileUpload, progress: Progress | None) -> Iterator[bytes]:
    """Yield the chunks of a request's body; `progress` is called after each was sent."""
    sent = 0
    for chunk in upload.chunks():
        yield chunk
        sent += len(chunk)
        if progress is not None:
            progress(sent, upload.size_bytes)
