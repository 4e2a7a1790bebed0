"""The OpenAPI document: responses and errors of every call, in the form that code generators need.

A route declares its own responses (`gives`, `makes`, `starts_job`, `ends`); `complete` adds the responses that any call
can have, and rewrites the document so that generators read it without loss (tests/api/test_generators.py):

- every content has a schema, so that a JSON model next to another media type does not become a union with "unknown";
- an optional field has no `default`, because generators treat such a field as always present; its description names
  the default instead;
- the headers Accept, Content-Type and Authorization are not parameters (OpenAPI 3.1, "Parameter Object").
"""

import json
from collections.abc import Iterable
from typing import Any

from fastapi import APIRouter, Response

from skills.api.gate import is_open
from skills.schemas import Given
from skills.schemas.given import Problem
from skills.schemas.operation import Job

PROBLEM = "application/problem+json"
TEXT, BINARY = {"type": "string"}, {"type": "string", "format": "binary"}
NO_PARAMETERS = ("accept", "content-type", "authorization")
REFUSALS = {
    400: "The request cannot be read, or is meant for another host.",
    401: "No key, or an invalid one.",
    403: "The key does not allow it.",
    404: "There is no such object; `detail` names those that exist.",
    408: "The body arrived too slowly.",
    409: "Not possible in the present state.",
    410: "Erased permanently.",
    412: "The object no longer matches the condition of the request.",
    413: "The body is over the limit.",
    415: "The format is not supported, or none of the formats in Accept is.",
    422: "The request does not have the form of this call, or a value is impossible; nothing was stored.",
    429: "Too many requests; retry after `Retry-After` seconds.",
    500: "An error of the service; nothing was stored.",
    507: "A disk of the service is full; nothing was stored.",
    503: "Busy, damaged or not ready; retry after `Retry-After` seconds, if that header is present.",
}
ANY, WITH_KEY, WITH_INPUT, WITH_BODY = (400, 500, 503, 507), (401, 403, 429), (422,), (408, 413, 415)
KEY = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "A key of this service."},
    "header": {"type": "apiKey", "in": "header", "name": "X-API-Key", "description": "The same."},
}
HEADERS = {
    "ETag": {"description": "The digest of these bytes.", "schema": {"type": "string"}},
    "Location": {"description": "The address of the object.", "schema": {"type": "string"}},
    "Link": {"description": 'The next page, as `rel="next"` (RFC 8288).', "schema": {"type": "string"}},
    "Retry-After": {"description": "Seconds.", "schema": {"type": "string"}},
}


def router_of(**options: Any) -> APIRouter:
    """Return a router whose operations have the names of their functions as ids."""
    return APIRouter(generate_unique_id_function=lambda route: route.name, **options)


def gives(model: Any, *refused: int, as_well: tuple[str, ...] = ()) -> dict[str, Any]:
    """Describe a GET: its model, further media types for `Accept`, and its error statuses."""
    ok: dict[str, Any] = {"headers": _headers("ETag")}
    if as_well:
        ok["content"] = {kind: {"schema": TEXT if kind.startswith("text/") else BINARY} for kind in as_well}
    return {"response_model": model, "responses": {200: ok, 304: UNCHANGED, **_refused(refused)}}


def gives_page(model: Any, *refused: int) -> dict[str, Any]:
    """Describe a GET of one page of a list."""
    described = gives(model, *refused)
    described["responses"][200]["headers"] = _headers("ETag", "Link")
    return described


def gives_file(kinds: Iterable[str], *refused: int) -> dict[str, Any]:
    """Describe a GET of binary content."""
    content = {kind: {"schema": BINARY} for kind in kinds}
    ok = {"headers": _headers("ETag"), "content": content}
    described = {200: ok, 304: UNCHANGED, **_refused(refused)}
    return {"response_model": None, "response_class": Response, "responses": described}


def gives_stream(name: str, model: type[Given], description: str, *refused: int) -> dict[str, Any]:
    """Describe a stream of server-sent events whose data are a model's JSON."""
    data = {"type": "string", "contentMediaType": "application/json", "contentSchema": _named(model)}
    event = {"type": "object", "properties": {"event": {"const": name}, "data": data}, "required": ["event", "data"]}
    content = {"text/event-stream": {"schema": TEXT, "itemSchema": event}}
    described = {200: {"description": description, "content": content}, **_refused(refused)}
    return {"response_model": None, "response_class": Response, "responses": described}


def makes(model: Any, *refused: int, located: bool = True) -> dict[str, Any]:
    """Describe a call that stores something: 201, or 200 if it exists already."""
    headers = {"headers": _headers("Location")} if located else {}
    there = {"description": "It existed already.", "model": model, **headers}
    return {
        "response_model": model,
        "status_code": 201,
        "responses": {200: there, 201: {"description": "It is stored.", **headers}, **_refused(refused)},
    }


def starts_job(*refused: int) -> dict[str, Any]:
    """Describe a call that requests a job: 202, or 200 if an equal request is done already."""
    headers = {"headers": _headers("Location")}
    done = {"description": "An equal request is done already.", "model": Job, **headers}
    return {
        "response_model": Job,
        "status_code": 202,
        "responses": {200: done, 202: {"description": "The job is queued.", **headers}, **_refused(refused)},
    }


def says(model: Any, *refused: int) -> dict[str, Any]:
    """Describe a call that returns a model and stores nothing under an address of its own."""
    return {"response_model": model, "responses": _refused(refused)}


def ends(*refused: int) -> dict[str, Any]:
    """Describe a call that removes something: 204."""
    return {"status_code": 204, "responses": _refused(refused)}


def complete(document: dict[str, Any]) -> dict[str, Any]:
    """Add to every operation the errors that any call can have, the problem schema, and the security schemes."""
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
            if "parameters" in call:
                call["parameters"] = [one for one in call["parameters"] if one["name"].lower() not in NO_PARAMETERS]
    for schema in schemas.values():
        for name, field in schema.get("properties", {}).items():
            if name not in schema.get("required", ()):
                _without_default(field)
    return document


def _without_default(field: dict[str, Any]) -> None:
    """Move the default of an optional field into its description."""
    default = field.pop("default", None)
    if default is not None:
        said = f"Left out: {json.dumps(default)}."
        field["description"] = f"{field['description']} {said}" if "description" in field else said


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


UNCHANGED = {"description": "The client has these bytes already.", "headers": _headers("ETag")}
