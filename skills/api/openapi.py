"""Declarations of routes, and the OpenAPI document, in the form that code generators need.

A route's decorator declares the role that it needs and its own responses (`gives`, `makes`, `starts_job`, `ends`);
`complete` adds the responses that any call can have, and rewrites the document so that generators read it without loss
(tests/api/test_generators.py):

- every content has a schema, so that a JSON model next to another media type does not become a union with "unknown";
- an optional field has no `default`, because generators treat such a field as always present; its description names
  the default instead;
- the headers Accept, Content-Type and Authorization are not parameters (OpenAPI 3.1, "Parameter Object").
"""

import json
from collections.abc import Iterable, Mapping
from typing import Any, TypedDict

from fastapi import APIRouter, Response
from fastapi.routing import APIRoute

from skills.api.authorisation import Role, needs
from skills.api.dependencies import room_for_a_job
from skills.api.gate import is_open
from skills.api.strict_json import Strict
from skills.schemas import Given, Page
from skills.schemas.operation import Job
from skills.schemas.responses import Problem
from skills.settings import MEBIBYTE

Json = dict[str, Any]  # a part of the document
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


class Declared(TypedDict, total=False):
    """Arguments of a route's decorator."""

    dependencies: list[Any]
    response_model: Any
    response_class: type[Response]
    status_code: int
    responses: dict[int | str, Json]


def router_of(tag: str, **options: Any) -> APIRouter:
    """Return a router with strict JSON of at most a mebibyte; the ids of its operations are the functions' names."""
    # a limit for each router, because that of the application is the largest upload
    options = {"route_class": Strict, "max_body_size": MEBIBYTE, **options}
    return APIRouter(generate_unique_id_function=lambda route: route.name, tags=[tag], **options)


def uploads_of(tag: str) -> APIRouter:
    """Return a router of uploads, whose raw bodies are as large as the settings of the application allow."""
    return router_of(tag, route_class=APIRoute, max_body_size=None)


def gives(role: Role, model: Any, *refused: int, as_well: tuple[str, ...] = ()) -> Declared:
    """Describe a GET: its model, further media types for `Accept`, and its error statuses."""
    listed = isinstance(model, type) and issubclass(model, Page)
    ok: Json = {"headers": _headers("ETag", *["Link"] * listed)}
    if as_well:
        ok["content"] = {kind: {"schema": TEXT if kind.startswith("text/") else BINARY} for kind in as_well}
    return says(role, model, *refused, answers={200: ok, 304: UNCHANGED})


def gives_file(role: Role, kinds: Iterable[str], *refused: int) -> Declared:
    """Describe a GET of binary content."""
    ok: Json = {"headers": _headers("ETag"), "content": {kind: {"schema": BINARY} for kind in kinds}}
    return says(role, None, *refused, answers={200: ok, 304: UNCHANGED}) | {"response_class": Response}


def gives_stream(role: Role, name: str, model: type[Given], description: str, *refused: int) -> Declared:
    """Describe a stream of server-sent events whose data are a model's JSON."""
    data = {"type": "string", "contentMediaType": "application/json", "contentSchema": _named(model)}
    event = {"type": "object", "properties": {"event": {"const": name}, "data": data}, "required": ["event", "data"]}
    content = {"text/event-stream": {"schema": TEXT, "itemSchema": event}}
    answers: dict[Any, Json] = {200: {"description": description, "content": content}}
    return says(role, None, *refused, answers=answers) | {"response_class": Response}


def makes(role: Role, model: Any, *refused: int, located: bool = True) -> Declared:
    """Describe a call that stores something: 201, or 200 if it exists already."""
    headers = {"headers": _headers("Location")} if located else {}
    there = {"description": "It existed already.", "model": model, **headers}
    answers = {200: there, 201: {"description": "It is stored.", **headers}}
    return says(role, model, *refused, answers=answers) | {"status_code": 201}


def starts_job(*refused: int) -> Declared:
    """Describe a trainer's request for a job, with room for one more: 202, or 200 if an equal request is done."""
    headers = _headers("Location")
    done = {"description": "An equal request is done already.", "model": Job, "headers": headers}
    answers: dict[Any, Json] = {200: done, 202: {"description": "The job is queued.", "headers": headers}}
    described = says("trainer", Job, *refused, answers=answers)
    return described | {"status_code": 202, "dependencies": [*described["dependencies"], room_for_a_job]}


def says(
    role: Role | None, model: Any, *refused: int, whole: bool = False, answers: Mapping[Any, Json] = {}
) -> Declared:
    """Describe a call by the role that it needs and by its answers.

    Args:
        role: The lowest role that may call it; None: it needs no authentication.
        model: The model of its answer.
        refused: The statuses of its errors.
        whole: Refuse keys that are restricted to some surgeons.
        answers: Further facts about its answers, by status.
    """
    responses: dict[int | str, Json] = {**answers, **{status: _refusal(status) for status in refused}}
    return {"dependencies": [needs(role, whole=whole)], "response_model": model, "responses": responses}


def ends(role: Role, *refused: int) -> Declared:
    """Describe a call that removes something: 204."""
    return says(role, None, *refused) | {"status_code": 204}


def complete(document: Json) -> Json:
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


def _without_default(field: Json) -> None:
    """Move the default of an optional field into its description."""
    default = field.pop("default", None)
    if default is not None:
        said = f"Left out: {json.dumps(default)}."
        field["description"] = f"{field['description']} {said}" if "description" in field else said


def _refusal(status: int) -> Json:
    headers = {"headers": _headers("Retry-After")} if status in (429, 503) else {}
    content = {PROBLEM: {"schema": _named(Problem)}}
    return {"description": REFUSALS[status], "content": content, **headers}


def _named(model: type[Given]) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{model.__name__}"}


def _headers(*named: str) -> Json:
    return {name: HEADERS[name] for name in named}


UNCHANGED = {"description": "The client has these bytes already.", "headers": _headers("ETag")}
