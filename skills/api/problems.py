"""Errors as `application/problem+json` (RFC 9457). Only this module knows HTTP status codes.

A problem has a stable `type`; its `detail` states the error and the remedy in terms of HTTP, and never repeats text
that the client sent. `reason` has the error alone and `remedies` the remedies as data, so that the client and the
command line can word them in their own terms.
"""

import errno
import logging
import math
import re
import secrets
from collections.abc import Iterable, Sequence
from typing import Any, get_args, get_origin

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from pydantic_core import ErrorDetails
from starlette.exceptions import HTTPException

from skills import errors
from skills.remedies import Action, Door, Remedy, did_you_mean
from skills.schemas.requests import describe

log = logging.getLogger("skills.api")

STATUS: tuple[tuple[type[errors.SkillsError], int, str], ...] = (
    (errors.WrongHost, 400, "Unknown host name"),
    (errors.NotSignedIn, 401, "Not signed in"),
    (errors.NotAllowed, 403, "Not allowed"),
    (errors.TooMany, 429, "Too many"),
    (errors.UnknownFormat, 415, "Unsupported format"),
    (errors.TooLarge, 413, "Too large"),
    (errors.TooSlow, 408, "Too slow"),
    (errors.NotFound, 404, "Not found"),
    (errors.Erased, 410, "Erased permanently"),
    (errors.PreconditionFailed, 412, "Changed meanwhile"),
    (errors.Conflict, 409, "Not possible in the present state"),
    (errors.Corrupt, 503, "Stored data is damaged"),
    (errors.StorageFull, 507, "The disk is full"),
    (errors.Busy, 503, "Busy"),
    (errors.SimulationFailed, 503, "The simulator failed"),
    (errors.LearningFailed, 503, "Learning failed"),
    (errors.BadInput, 422, "The input cannot be used"),
)
HEADERS = {
    errors.Busy: {"Retry-After": "1"},
    errors.TooSlow: {"Connection": "close"},
    errors.NotSignedIn: {"WWW-Authenticate": 'Bearer realm="suture-skills"'},
}
DETAILS = {
    400: "The body is not valid JSON; correct it.",
    404: "See /openapi.json for the available calls.",
    405: "See /openapi.json for the available calls.",
    413: "The body is over the limit of this call; send less.",
}
TITLES = {404: "Not found", 405: "This call does not exist here", 413: "Too large", 400: "Bad request"}


def problem(
    status: int, kind: str, title: str, detail: str, *, headers: dict[str, str] | None = None, **more: Any
) -> Response:
    """Return a problem document as a response, with the further fields that are not empty."""
    body = {"type": f"urn:suture-skills:{kind}", "title": title, "status": status, "detail": detail}
    body |= {name: value for name, value in more.items() if value}
    return Response(orjson.dumps(body, default=str), status, headers=headers, media_type="application/problem+json")


SHOWN = 1e12  # larger numbers are not repeated in messages
# Errors of the system in a request, outside of the database: each is over as soon as its cause is.
SYSTEM: dict[int, errors.Busy] = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT),
        errors.StorageFull("The disk for temporary files is full, so nothing was stored; free some space on it."),
    ),
    **dict.fromkeys(
        (errno.EMFILE, errno.ENFILE), errors.Busy("The service has too many files open; try again in a moment.")
    ),
    **dict.fromkeys(
        (errno.EIO, errno.EROFS),
        errors.Busy(
            "The disk for temporary files failed.",
            "Ask the operator of the service to check the disk and its log, then send the same request again.",
        ),
    ),
}
# The kinds of pydantic's errors, each with the words for it.
DATE_KINDS = ("date_type", "date_parsing", "date_from_datetime_parsing")
TIME_KINDS = ("datetime_type", "datetime_parsing", "datetime_from_date_parsing")
LIMITS = {
    "missing": "is missing",
    "greater_than": "must be more than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "finite_number": "must be a finite number",
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "must be a whole number"),
    "int_parsing_size": "must be a smaller whole number",
    **dict.fromkeys(("bool_type", "bool_parsing"), "must be true or false"),
    **dict.fromkeys(("string_type", "string_unicode"), "must be a text"),
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
    "list_type": "must be a list",
    "tuple_type": "must be a list of numbers",
    "too_short": "must have at least {min_length} entries, and has {actual_length}",
    "too_long": "must have at most {max_length} entries",
    **dict.fromkeys(("model_attributes_type", "model_type", "dict_type"), "must be an object with named fields"),
    "union_tag_not_found": "needs a kind",
    **dict.fromkeys(DATE_KINDS, "must be a date such as 2030-12-31"),
    **dict.fromkeys(TIME_KINDS, "must be a time such as 2030-12-31T12:00:00Z"),
    "timezone_aware": "must have a time zone, such as 2030-12-31T12:00:00Z",
}
TOO_LARGE = problem(413, "http-413", TITLES[413], DETAILS[413])  # replaces Starlette's plain-text response


def _where(one: ErrorDetails) -> str:
    """Return the path of a refused field; the name of an unknown field is omitted, as text that the client sent."""
    known = one["loc"][:-1] if one["type"] == "extra_forbidden" else one["loc"]
    return ".".join(str(part) for part in known)[:200]


def _meant(given: object, known: Iterable[str]) -> str:
    """Return a suggestion of similar names, in parentheses, or nothing."""
    near = did_you_mean(str(given), known)
    return f" (did you mean {near[0].removeprefix('Did you mean ')})" if near else ""


def _names(kind: Any, path: Sequence[str | int]) -> list[str]:
    """Return the names of the fields of the model at a path below a type; none if there is no model."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        if not path:
            return [field.alias or name for name, field in kind.model_fields.items()]
        if (field := kind.model_fields.get(str(path[0]))) is not None:
            return _names(field.annotation, path[1:])
        # the tag of a union, which is no field, precedes the fields of its model
        tag = kind.model_fields.get("kind")
        return _names(kind, path[1:]) if tag is not None and path[0] in get_args(tag.annotation) else []
    parts = get_args(kind)
    if get_origin(kind) in (list, tuple) and path:
        return _names(parts[0], path[1:])
    return next((found for part in parts if (found := _names(part, path))), [])


def _why(one: ErrorDetails, body: Any = None) -> str:
    """Return why a field is refused, as a phrase that follows its name: the limit in words, and the given number.

    Text that was sent is not repeated: the client, which has it, adds it to the message.

    Args:
        one: An error of pydantic.
        body: The type of the request's body.
    """
    kind, about, given = one["type"], one.get("ctx", {}), one.get("input")
    if kind == "extra_forbidden":
        _, *path, name = one["loc"]
        return f"has an unknown field{_meant(name, _names(body, path))}"
    if kind == "json_invalid":
        return f"{about['error']}."
    if kind == "missing" and isinstance(one["loc"][-1], int):
        return "is missing; give more numbers"
    if kind == "string_pattern_mismatch":
        one_of = re.fullmatch(r"\^\(([\w|-]+)\)\$", about["pattern"])
        if one_of is None:
            return describe(about["pattern"])
        return f"must be one of {one_of[1].replace('|', ', ')}{_meant(given, one_of[1].split('|'))}"
    if kind in ("literal_error", "union_tag_invalid"):
        known = re.findall(r"'([^']+)'", about.get("expected") or about["expected_tags"])
        return f"must be one of {', '.join(known)}{_meant(about.get('tag', given), known)}"
    words = LIMITS.get(kind)
    limits = {name: f"{value:g}" if isinstance(value, float) else value for name, value in about.items()}
    said = str(one["msg"]).removeprefix("Value error, ") if words is None else words.format(**limits)
    given = _number(given)
    if given is None or not abs(given) < SHOWN:
        return said
    # a small positive number below the minimum in mm was probably meant in metres
    metres = str(one["loc"][-1]).endswith("_mm") and kind.startswith("greater") and 0 < given < 1
    return f"{said}; {given:g} was given" + (f" (if metres were meant, give {1000 * given:g})" if metres else "")


def _number(given: object) -> float | None:
    """Return a given value as a number, or None; values from a query are strings."""
    try:
        return float(given) if isinstance(given, int | float | str) and not isinstance(given, bool) else None
    except (ValueError, OverflowError):
        return None


def answer_to(error: errors.SkillsError) -> Response:
    """Return the response to an error; the location of the database is logged but never sent."""
    if isinstance(error, errors.DatabaseUnusable):
        log.error("%s", error.message)
        error = errors.Busy("The database cannot be used now; the service's log has the cause.")
    for family, status, title in STATUS:
        if isinstance(error, family):
            headers = HEADERS.get(family)
            if isinstance(error, errors.TooMany):
                headers = {"Retry-After": str(max(1, math.ceil(error.wait_s)))}
            remedies = [one if isinstance(one, str) else one.as_json() for one in error.remedies]
            more = {"numbers": error.numbers, "reason": error.message, "remedies": remedies}
            return problem(status, error.kind, title, error.words(Door.HTTP), headers=headers, **more)
    raise error


def answer_refusals(app: FastAPI) -> None:
    """Register the exception handlers that answer every error of an application with a problem document."""

    @app.exception_handler(errors.SkillsError)
    def refused(_request: Request, error: errors.SkillsError) -> Response:
        return answer_to(error)

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> Response:
        bodies = getattr(getattr(request.scope.get("route"), "dependant", None), "body_params", ())
        body = bodies[0].field_info.annotation if bodies else None
        wrong = [{"where": _where(one), "why": _why(one, body)} for one in error.errors()[:20]]
        return problem(
            422,
            "invalid-request",
            "The request does not have the form of this call",
            "Correct the values named in `errors`; /openapi.json describes the call.",
            reason="The request does not have the form of this call.",
            errors=wrong,
        )

    @app.exception_handler(HTTPException)
    def http(_request: Request, error: HTTPException) -> Response:
        title = TITLES.get(error.status_code, "Refused")
        detail = DETAILS.get(error.status_code, str(error.detail))
        kind, headers = f"http-{error.status_code}", dict(error.headers or {})
        unknown = {"reason": f"{title}.", "remedies": [Remedy(Action.SEE_CALLS).as_json()]}
        more = unknown if error.status_code in (404, 405) else {}
        return problem(error.status_code, kind, title, detail, headers=headers, **more)

    @app.exception_handler(OSError)
    def refused_by_system(_request: Request, error: OSError) -> Response:
        if error.errno not in SYSTEM:
            raise error
        log.error("The system refused what a request needs: %s", error.strerror)
        return answer_to(SYSTEM[error.errno])

    @app.exception_handler(Exception)
    def unexpected(_request: Request, error: Exception) -> Response:
        case = secrets.token_hex(8)
        log.error("unexpected error, case %s", case, exc_info=error)
        return problem(
            500,
            "unexpected",
            "Internal error",
            "Nothing was stored. Report the case number and the request.",
            case=case,
        )
