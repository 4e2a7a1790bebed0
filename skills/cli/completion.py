"""Completion of surgeons and suture types in a shell.

A shell waits for it at every press of Tab, so it has a short timeout and ignores all errors.
"""

import atexit
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Literal

from skills.cli.connecting import installation

if TYPE_CHECKING:
    from skills.client import Client

LIMIT_S = 1.5  # timeout of completion, ours: longer than a warm response takes, shorter than a user waits
MOST = 200


def complete_surgeons(incomplete: str) -> list[str]:
    """Return the surgeons that complete an input."""
    return _in_time(lambda: _found(lambda client: [one.surgeon for one in client.surgeons()], "Surgeon"), incomplete)


def complete_sutures(incomplete: str) -> list[str]:
    """Return the suture types that complete an input."""
    return _in_time(
        lambda: _found(lambda client: [one.suture for one in client.suture_types()], "SutureType"), incomplete
    )


def _in_time(find: Callable[[], list[str]], incomplete: str) -> list[str]:
    found: list[str] = []

    def look() -> None:
        with suppress(Exception):
            found.extend(name for name in find() if name.startswith(incomplete))

    # a daemon, so that a look-up that hangs does not keep the process alive
    thread = Thread(target=look, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    atexit.register(_end_without, thread)
    return list(found)


def _end_without(thread: Thread) -> None:
    """End the process at once if a thread still runs: the interpreter's end kills it, within a library by abort()."""
    if thread.is_alive():
        sys.stdout.flush()
        os._exit(0)


def _found(served: "Callable[[Client], list[str]]", row: Literal["Surgeon", "SutureType"]) -> list[str]:
    """Return names from the service, if one is configured, else from the rows in the database, if it exists."""
    from skills.settings import settings

    if settings().server:
        from skills.client import Client, Retrying

        with Client(str(settings().server), timeout_s=LIMIT_S, retrying=Retrying(attempts=1)) as client:
            return served(client)
    url = settings().database_url
    file = url.removeprefix("sqlite:///")
    if file != url and not Path(file).is_file():
        return []
    from sqlalchemy import select

    from skills.db import models

    slugs = getattr(models, row).slug
    with installation(patience_ms=int(LIMIT_S * 1000)) as database, database.reading() as session:
        return list(session.scalars(select(slugs).order_by(slugs).limit(MOST)))
