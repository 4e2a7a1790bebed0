"""Heads of a history in a file outside its database, by which an older copy of the database is recognised.

    signed checkpoint --save_head--> file --last_head--> the head that the database must still have

The file is beside the signing key unless `SKILLS_CHECKPOINTS` names another: whoever can replace the database must not
be able to write to it. Each place of a database has a file of its own, so that a copy of the database elsewhere, which
goes its own way, does not contradict the original.
"""

import fcntl
import hashlib
import logging
import os
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import URL

from skills.errors import BadSettings, Corrupt, NotReady
from skills.transparency.notes import Note, read_notes

TAIL_BYTES = 4096  # a note has some 250 bytes, and at most 1000 characters
ANOTHER = "Name another file in SKILLS_CHECKPOINTS."

log = logging.getLogger(__name__)


def heads_file_for(key_file: Path, url: URL) -> Path:
    """Return the file for the heads of the database at a URL, beside a signing key."""
    if url.get_backend_name() == "sqlite":
        place = str(Path(url.database or "").resolve())
    else:
        place = url.set(username=None, password=None).render_as_string()
    return key_file.with_name(f"checkpoints-{hashlib.sha256(place.encode()).hexdigest()[:16]}")


def last_head(file: Path) -> Note | None:
    """Return the head that was saved last; None if there is no file.

    Raises:
        NotReady: The file cannot be read, or does not end in a signed checkpoint.
    """
    try:
        with file.open("rb") as saved:
            size = saved.seek(0, os.SEEK_END)
            saved.seek(max(size - TAIL_BYTES, 0))
            tail = saved.read().decode(errors="replace")
        # a note has two paragraphs, and a blank line follows it
        return read_notes("\n\n".join(tail.split("\n\n")[-3:-1]) + "\n")[0] if size else None
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, Corrupt) as error:
        why = error.strerror if isinstance(error, OSError) else "it does not end in a signed checkpoint"
        raise NotReady(
            f"The saved heads of the history cannot be read ({why}), so an older copy of the database would not be "
            "noticed.",
            "Put the file back as the service wrote it.",
            ANOTHER,
        ) from error


def save_head(file: Path, note: str) -> None:
    """Append a signed checkpoint to a file, durably, unless the file ends in a later one of the same history.

    A failure is logged, because the next checkpoint will do as well.
    """
    (head,) = read_notes(note)
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)  # two processes sign one after the other, and come here in any order
            last = last_head(file)
            before = None if last is None else last.checkpoint
            if before is None or before.origin != head.checkpoint.origin or before.size < head.checkpoint.size:
                end, text = os.fstat(handle).st_size, f"{note}\n".encode()
                if os.write(handle, text) < len(text):  # the disk has space for a part of it
                    os.ftruncate(handle, end)  # otherwise the file would end in no checkpoint, and all be refused
                    raise OSError("no space left on its disk")
                os.fsync(handle)
        finally:
            os.close(handle)
    except (OSError, NotReady) as error:
        log.error("The head of the history could not be appended to %s (%s). %s", file, error, ANOTHER)


def archive_heads(file: Path) -> None:
    """Rename a file of saved heads, so that the next head begins a new one; the old one stays as evidence.

    Raises:
        BadSettings: It cannot be renamed.
    """
    try:
        file.rename(file.with_name(f"{file.name}.until-{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}"))
    except FileNotFoundError:
        return
    except OSError as error:
        raise BadSettings(f"The saved heads {file} cannot be set aside: {error.strerror}.", ANOTHER) from error
