"""Every error as `application/problem+json` (RFC 9457). Only this file knows status codes.

A problem names its kind by a stable `type`, says in `detail` what is wrong and what to do next, and never repeats what
the caller sent.
"""

import logging
import math
import re
import secrets
from typing import Any

import orjson
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException

from skills import errors

log = logging.getLogger("skills.api")

STATUS: tuple[tuple[type[errors.SkillsError], int, str], ...] = (
    (errors.WrongHost, 400, "Not a name of this service"),
    (errors.NotSignedIn, 401, "Who are you?"),
    (errors.NotAllowed, 403, "Not allowed"),
    (errors.TooMany, 429, "Too many"),
    (errors.UnknownFormat, 415, "This format is not read here"),
    (errors.TooLarge, 413, "Too large"),
    (errors.TooSlow, 408, "Too slow"),
    (errors.NotFound, 404, "Not found"),
    (errors.Erased, 410, "Erased for good"),
    (errors.PreconditionFailed, 412, "It changed meanwhile"),
    (errors.Conflict, 409, "Not possible in the present state"),
    (errors.Corrupt, 503, "What is stored is damaged"),
    (errors.Busy, 503, "Busy"),
    (errors.SimulationFailed, 503, "The simulator failed"),
    (errors.LearningFailed, 503, "What learns failed"),
    (errors.BadInput, 422, "What was sent cannot be used"),
)
HEADERS = {
    errors.Busy: {"Retry-After": "1"},
    errors.TooSlow: {"Connection": "close"},
    errors.NotSignedIn: {"WWW-Authenticate": 'Bearer realm="suture-skills"'},
}
DETAILS = {
    400: "The body cannot be read as JSON; mend it.",
    404: "See /openapi.json for the calls there are.",
    405: "See /openapi.json for the calls there are.",
    413: "The body is over the limit of this call; send less.",
}
TITLES = {404: "Not found", 405: "This call does not exist here", 413: "Too large", 400: "Bad request"}


def problem(
    status: int, kind: str, title: str, detail: str, *, headers: dict[str, str] | None = None, **more: Any
) -> Response:
    """Write a problem."""
    body = {"type": f"urn:suture-skills:{kind}", "title": title, "status": status, "detail": detail, **more}
    return Response(
        orjson.dumps(body, default=str),
        status,
        headers=headers,
        media_type="application/problem+json",
    )


TOO_LARGE = problem(413, "http-413", TITLES[413], DETAILS[413])  # where Starlette would answer with plain text


def kind_of(error: errors.SkillsError) -> str:
    """Turn an error's name into its stable kind: OutsideGrid becomes outside-grid."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", type(error).__name__).lower()


def _where(one: dict[str, Any]) -> str:
    """Say which field is refused; the name of one that there is not is the caller's, and is left out."""
    known = one["loc"][:-1] if one["type"] == "extra_forbidden" else one["loc"]
    return ".".join(str(part) for part in known)[:200]


def _why(one: dict[str, Any]) -> str:
    """Say why a field is refused, without what was sent."""
    if one["type"] == "union_tag_invalid":
        return f"The kind must be one of {one['ctx']['expected_tags']}."
    if one["type"] == "json_invalid":
        return f"{one['ctx']['error']}."
    return str(one["msg"])


def answer_to(error: errors.SkillsError) -> Response:
    """Write what a refusal is answered with."""
    for family, status, title in STATUS:
        if isinstance(error, family):
            headers = HEADERS.get(family)
            if isinstance(error, errors.TooMany):
                headers = {"Retry-After": str(max(1, math.ceil(error.wait_s)))}
            numbers = {"numbers": error.numbers} if error.numbers else {}
            return problem(status, kind_of(error), title, str(error), headers=headers, **numbers)
    raise error


def answer_refusals(app: FastAPI) -> None:
    """Make an app answer everything that goes wrong with a problem."""

    @app.exception_handler(errors.SkillsError)
    def refused(_request: Request, error: errors.SkillsError) -> Response:
        return answer_to(error)

    @app.exception_handler(RequestValidationError)
    def invalid(_request: Request, error: RequestValidationError) -> Response:
        wrong = [{"where": _where(one), "why": _why(one)} for one in error.errors()[:20]]
        return problem(
            422,
            "invalid-request",
            "The request does not have the form of this call",
            "Mend what `errors` names; /openapi.json describes the call.",
            errors=wrong,
        )

    @app.exception_handler(HTTPException)
    def http(_request: Request, error: HTTPException) -> Response:
        title = TITLES.get(error.status_code, "Refused")
        detail = DETAILS.get(error.status_code, str(error.detail))
        return problem(error.status_code, f"http-{error.status_code}", title, detail, headers=dict(error.headers or {}))

    @app.exception_handler(Exception)
    def unexpected(_request: Request, error: Exception) -> Response:
        case = secrets.token_hex(8)
        log.error("unexpected error, case %s", case, exc_info=error)
        return problem(
            500, "unexpected", "Our mistake", "Nothing was kept. Report the case number with what you did.", case=case
        )
