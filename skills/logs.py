"""What the processes say while they run: lines of text or of JSON, with the request or the job that they belong to.

A line may hold ids, routes, kinds, numbers and times. It never holds a pseudonym, a file's name, a body or a path: of
an exception it gives the class and the places in the code, not the words, which may repeat what was sent or stored;
of a library's message it gives the first line as that was written, without what would have been filled in.
"""

import json
import logging
import sys
from contextvars import ContextVar
from datetime import UTC, datetime
from types import TracebackType
from typing import Any

OURS = "skills"
PLACES = 12  # of a traceback, the innermost

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)


def configure(level: str, *, as_json: bool) -> None:
    """Send what this process says to standard error: of ours all from a level on, of the libraries their warnings."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Lines(as_json=as_json))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger(OURS).setLevel(level.upper())
    logging.getLogger("dbos").addHandler(logging.NullHandler())  # where it finds none, it writes past us


def told(logger: logging.Logger, message: str, level: int = logging.INFO, **fields: Any) -> None:
    """Write a line with fields."""
    logger.log(level, message, extra={"fields": fields})


class Lines(logging.Formatter):
    """One line for each record."""

    def __init__(self, *, as_json: bool) -> None:
        super().__init__()
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        """Write a record, and nothing of anybody in it."""
        line = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _message(record),
            **getattr(record, "fields", {}),
            **{name: value.get() for name, value in (("request_id", request_id), ("job_id", job_id)) if value.get()},
        }
        if record.exc_info and record.exc_info[1] is not None:
            line |= _without_words(record.exc_info[1])
        if self._as_json:
            return json.dumps(line, ensure_ascii=True)
        head = " ".join(str(line.pop(name)) for name in ("at", "level", "logger", "message"))
        return " ".join([head, *(f"{name}={value}" for name, value in line.items())])


def _message(record: logging.LogRecord) -> str:
    if record.name.partition(".")[0] == OURS or record.name == "__main__":
        return record.getMessage().replace("\n", " ")
    return next(iter(str(record.msg).splitlines()), "")


def _without_words(error: BaseException) -> dict[str, Any]:
    """Say what was raised and where, and what that came from."""
    causes: list[str] = []
    one = error
    while (cause := one.__cause__ or one.__context__) is not None and len(causes) < PLACES:
        causes.append(type(cause).__name__)
        one = cause
    found = {"error": type(error).__name__, "raised_at": _places(error.__traceback__)}
    return found | ({"because_of": causes} if causes else {})


def _places(traceback: TracebackType | None) -> list[str]:
    places = []
    while traceback is not None:
        code = traceback.tb_frame.f_code
        module = traceback.tb_frame.f_globals.get("__name__", "?")
        places.append(f"{module}:{traceback.tb_lineno} {code.co_name}")
        traceback = traceback.tb_next
    return places[-PLACES:]
