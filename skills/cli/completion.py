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
    return _in_time(lambda: _found(lambda client: [one.surgeon for one in client.surgeons()], "surgeons"), incomplete)


def complete_sutures(incomplete: str) -> list[str]:
    """Return the suture types that complete an input."""
    return _in_time(lambda: _found(lambda client: [one.suture for one in client.suture_types()], "sutures"), incomplete)


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


def _found(served: "Callable[[Client], list[str]]", of: Literal["surgeons", "sutures"]) -> list[str]:
    """Return names from the service, if one is configured, else from the database, if it exists."""
    from skills.settings import settings

    if settings().server:
        from skills.client import Client, Retrying

        with Client(str(settings().server), timeout_s=LIMIT_S, retrying=Retrying(attempts=1)) as client:
            return served(client)
    url = settings().database_url
    file = url.removeprefix("sqlite:///")
    if file != url and not Path(file).is_file():
        return []
    from skills.library.people.surgeons import list_surgeons
    from skills.library.people.suture_types import list_suture_types

    with installation(patience_ms=int(LIMIT_S * 1000)) as database, database.reading() as session:
        if of == "surgeons":
            return [row.slug for row in list_surgeons(session, MOST, None)]
        return [row.slug for row in list_suture_types(session, MOST, None)]
