"""Logging: one line per record, as text or JSON, with the id of its request or job.

A line may contain ids, routes, kinds, numbers and times. It never contains a pseudonym, a file name, a body or a path.
Of an exception it has the class and the places in the code, not the message, which may repeat data that was sent or
stored. Of a library's record it has the first line of the format string, without the arguments.
"""

import json
import logging
import sys
from contextvars import ContextVar
from datetime import UTC, datetime
from types import TracebackType
from typing import Any

OURS = "skills"
PLACES = 12  # innermost frames of a traceback that are logged

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)


def configure(level: str, *, as_json: bool) -> None:
    """Configure logging to standard error: our loggers from `level` on, those of libraries from warnings on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Lines(as_json=as_json))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger(OURS).setLevel(level.upper())


def log_fields(logger: logging.Logger, message: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log a record with fields."""
    logger.log(level, message, extra={"fields": fields})


class Lines(logging.Formatter):
    """Formatter that writes one line per record, without personal data."""

    def __init__(self, *, as_json: bool) -> None:
        super().__init__()
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line of text or JSON."""
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
    """Return the class of an exception, its places in the code, and the classes of its causes, without messages."""
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
