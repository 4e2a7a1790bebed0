"""What the OpenAPI document says of every call beyond its parameters: its answers, and what it may refuse.

A route names what is its own (`gives`, `makes`, `starts_job`, `ends`); `complete` adds what any call may answer.
"""

from collections.abc import Iterable
from typing import Any

from fastapi import Response

from skills.api.gate import is_open
from skills.api.schemas.given import Job, Problem
from skills.api.schemas.shapes import Given

PROBLEM = "application/problem+json"
REFUSALS = {
    400: "The request cannot be read, or is meant for another host.",
    401: "No key, or none that is valid.",
    403: "The key does not allow it.",
    404: "There is no such thing; `detail` says what there is instead.",
    408: "The body came too slowly.",
    409: "Not possible in the present state.",
    410: "Erased for good.",
    412: "It is not what the condition names any more.",
    413: "The body is over the limit.",
    415: "A format that is not read here, or none of those that are given.",
    422: "It does not have the form of this call, or cannot be meant; nothing was kept.",
    429: "Too many requests; `Retry-After` says when to come again.",
    500: "Our mistake; nothing was kept.",
    503: "Busy, damaged or not ready; `Retry-After` says when to come again, where that helps.",
}
ANY, WITH_KEY, WITH_INPUT, WITH_BODY = (400, 500, 503), (401, 403, 429), (422,), (408, 413, 415)
KEY = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "A key of this service."},
    "header": {"type": "apiKey", "in": "header", "name": "X-API-Key", "description": "The same."},
}
HEADERS = {
    "ETag": {"description": "The digest of exactly these bytes.", "schema": {"type": "string"}},
    "Location": {"description": "Where it is.", "schema": {"type": "string"}},
    "Link": {"description": 'The next page, as `rel="next"` (RFC 8288).', "schema": {"type": "string"}},
    "Retry-After": {"description": "Seconds.", "schema": {"type": "string"}},
}


def gives(model: Any, *refused: int, as_well: tuple[str, ...] = ()) -> dict[str, Any]:
    """Describe a GET: its model, what else it can be asked as by `Accept`, and what it may refuse."""
    ok: dict[str, Any] = {"headers": _headers("ETag")}
    if as_well:
        ok["content"] = {kind: {} for kind in as_well}
    return {"response_model": model, "responses": {200: ok, 304: UNCHANGED, **_refused(refused)}}


def gives_page(model: Any, *refused: int) -> dict[str, Any]:
    """Describe a GET of a list."""
    described = gives(model, *refused)
    described["responses"][200]["headers"] = _headers("ETag", "Link")
    return described


def gives_file(kinds: Iterable[str], *refused: int) -> dict[str, Any]:
    """Describe a GET of bytes."""
    content = {kind: {"schema": {"type": "string", "format": "binary"}} for kind in kinds}
    ok = {"headers": _headers("ETag"), "content": content}
    described = {200: ok, 304: UNCHANGED, **_refused(refused)}
    return {"response_model": None, "response_class": Response, "responses": described}


def gives_stream(name: str, model: type[Given], description: str, *refused: int) -> dict[str, Any]:
    """Describe server-sent events, whose data are a model's JSON."""
    data = {"type": "string", "contentMediaType": "application/json", "contentSchema": _named(model)}
    event = {"type": "object", "properties": {"event": {"const": name}, "data": data}, "required": ["event", "data"]}
    content = {"text/event-stream": {"itemSchema": event}}
    described = {200: {"description": description, "content": content}, **_refused(refused)}
    return {"response_model": None, "response_class": Response, "responses": described}


def makes(model: Any, *refused: int, located: bool = True) -> dict[str, Any]:
    """Describe what stores a thing: 201, or 200 where it is there already."""
    headers = {"headers": _headers("Location")} if located else {}
    there = {"description": "It was there already.", "model": model, **headers}
    return {
        "response_model": model,
        "status_code": 201,
        "responses": {200: there, 201: {"description": "It is stored.", **headers}, **_refused(refused)},
    }


def starts_job(*refused: int) -> dict[str, Any]:
    """Describe what asks for work: 202, or 200 where an equal request is done already."""
    headers = {"headers": _headers("Location")}
    done = {"description": "It is done already.", "model": Job, **headers}
    return {
        "response_model": Job,
        "status_code": 202,
        "responses": {200: done, 202: {"description": "It is to be done.", **headers}, **_refused(refused)},
    }


def says(model: Any, *refused: int) -> dict[str, Any]:
    """Describe what answers with a model, and stores nothing under its own address."""
    return {"response_model": model, "responses": _refused(refused)}


def ends(*refused: int) -> dict[str, Any]:
    """Describe what takes a thing away."""
    return {"status_code": 204, "responses": _refused(refused)}


def complete(document: dict[str, Any]) -> dict[str, Any]:
    """Add to every operation what any call may refuse, and the problem that says so."""
    schemas = document["components"]["schemas"]
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    problem = Problem.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    schemas.update(problem.pop("$defs"), Problem=problem)
    document["components"]["securitySchemes"] = KEY
    document["security"] = [{name: []} for name in KEY]
    for path, calls in document["paths"].items():
        for call in calls.values():
            wrong = [*ANY]
            if is_open(path):
                call["security"] = []
            else:
                wrong += WITH_KEY
            if "requestBody" in call:
                wrong += [*WITH_INPUT, *WITH_BODY]
            elif "parameters" in call:
                wrong += WITH_INPUT
            call["responses"] |= {str(status): _refusal(status) for status in wrong}
    return document


def _refused(statuses: tuple[int, ...]) -> dict[Any, Any]:
    return {status: _refusal(status) for status in statuses}


def _refusal(status: int) -> dict[str, Any]:
    headers = {"headers": _headers("Retry-After")} if status in (429, 503) else {}
    content = {PROBLEM: {"schema": _named(Problem)}}
    return {"description": REFUSALS[status], "content": content, **headers}


def _named(model: type[Given]) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{model.__name__}"}


def _headers(*named: str) -> dict[str, Any]:
    return {name: HEADERS[name] for name in named}


UNCHANGED = {"description": "The client has exactly these bytes already.", "headers": _headers("ETag")}
