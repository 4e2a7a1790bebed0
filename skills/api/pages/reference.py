"""The OpenAPI document as a person reads it: the calls by what they are about, then the models."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import orjson

Document = dict[str, Any]
MODEL = "#/components/schemas/"


@dataclass(frozen=True)
class Answer:
    """What a call may answer with one status."""

    status: str
    means: str
    as_what: list[str]
    model: str | None


@dataclass(frozen=True)
class Operation:
    """One call."""

    name: str
    method: str
    path: str
    summary: str
    more: str
    parameters: list[dict[str, Any]]
    body: list[str]
    body_model: str | None
    answers: list[Answer]
    refusals: list[str]


@dataclass(frozen=True)
class Field:
    """One field of a model."""

    name: str
    kind: str
    required: bool
    means: str


@dataclass(frozen=True)
class Model:
    """What is sent or said under one name."""

    name: str
    means: str
    fields: list[Field]
    examples: list[str]


def operations(document: Document) -> dict[str, list[Operation]]:
    """List the calls, by tag."""
    by_tag: dict[str, list[Operation]] = defaultdict(list)
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            by_tag[call.get("tags", ["other"])[0]].append(_operation(method.upper(), path, call))
    return dict(by_tag)


def models(document: Document) -> list[Model]:
    """List the models, by name."""
    schemas: dict[str, Any] = document["components"]["schemas"]
    return [
        Model(
            name,
            schema.get("description", ""),
            [
                Field(field, kind_of(of), field in schema.get("required", ()), of.get("description", ""))
                for field, of in schema.get("properties", {}).items()
            ],
            [orjson.dumps(one, option=orjson.OPT_INDENT_2).decode() for one in schema.get("examples", ())],
        )
        for name, schema in sorted(schemas.items())
    ]


def kind_of(schema: Document) -> str:
    """Say in a word or two what a value is."""
    if "$ref" in schema:
        return str(schema["$ref"]).removeprefix(MODEL)
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return " or ".join(dict.fromkeys(kind_of(one) for one in schema[several]))
    if "enum" in schema:
        return " or ".join(str(one) for one in schema["enum"])
    if "const" in schema:
        return str(schema["const"])
    if "prefixItems" in schema:
        return f"[{', '.join(kind_of(one) for one in schema['prefixItems'])}]"
    if "items" in schema:
        return f"list of {kind_of(schema['items'])}"
    return str(schema.get("format", schema.get("type", "anything")))


def _operation(method: str, path: str, call: Document) -> Operation:
    body: Document = call.get("requestBody", {}).get("content", {})
    answers = [_answer(status, said) for status, said in call["responses"].items()]
    return Operation(
        name=call["operationId"],
        method=method,
        path=path,
        summary=call.get("summary", ""),
        more=call.get("description", ""),
        parameters=[one | {"kind": kind_of(one["schema"])} for one in call.get("parameters", ())],
        body=[*body],
        body_model=_model(body),
        answers=[one for one in answers if one.status < "400"],
        refusals=[one.status for one in answers if one.status >= "400"],
    )


def _answer(status: str, said: Document) -> Answer:
    content = said.get("content", {})
    return Answer(status, said.get("description", ""), [*content], _model(content))


def _model(content: Document) -> str | None:
    schema = content.get("application/json", {}).get("schema")
    return None if schema is None else kind_of(schema)
