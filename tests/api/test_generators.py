"""The OpenAPI document in the form that client generators read without loss; `tests/clients` runs two of them."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from tests.api.conformance import conformance
from tests.api.service import KESTREL, POLICY, Service

BYTES = "application/octet-stream"  # the one binary type that all generators support


def calls() -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in conformance().document["paths"].items():
        for method, call in methods.items():
            yield f"{method.upper()} {path}", call


def parts(part: Any) -> Iterator[dict[str, Any]]:
    """Yield every object of the document."""
    if isinstance(part, dict):
        yield part
        part = [*part.values()]
    if isinstance(part, list):
        for one in part:
            yield from parts(one)


def schemas() -> dict[str, dict[str, Any]]:
    return conformance().document["components"]["schemas"]


def test_every_model_has_a_name_of_its_own():
    titles = Counter(schema["title"] for schema in schemas().values())
    assert not [title for title, count in titles.items() if count > 1]
    assert not [name for name in schemas() if "__" in name]  # FastAPI's names for two classes of one name


def test_every_reference_is_there():
    named = {one["$ref"] for one in parts(conformance().document) if isinstance(one.get("$ref"), str)}
    assert named <= {f"#/components/schemas/{name}" for name in schemas()}


def test_every_operation_has_a_name_of_its_own():
    names = Counter(call["operationId"] for _, call in calls())
    assert max(names.values()) == 1


def test_every_content_has_a_schema():
    for what, call in calls():
        for said in (call.get("requestBody", {}), *call["responses"].values()):
            for kind, content in said.get("content", {}).items():
                assert content.get("schema"), f"{what}: {kind}"


def test_bodies_and_files_are_in_a_form_that_generators_take():
    for what, call in calls():
        body = call.get("requestBody", {}).get("content")
        assert body is None or {BYTES, "application/json"} & {*body}, what
        for status, said in call["responses"].items():
            kinds = [*said.get("content", {})]
            known = ("application/json", "application/problem+json", BYTES, "text/event-stream", "text/plain")
            # a generated client parses the response as the first type that it supports
            assert not kinds or kinds[0] in known, f"{what} {status}: {kinds}"


def test_a_field_that_may_be_left_out_has_no_default():
    for name, schema in schemas().items():
        for field, said in schema.get("properties", {}).items():
            assert field in schema.get("required", ()) or "default" not in said, f"{name}.{field}"


def test_headers_that_http_negotiates_with_are_no_parameters():
    for what, call in calls():
        names = {one["name"].lower() for one in call.get("parameters", ())}
        assert not names & {"accept", "content-type", "authorization"}, what


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/surgeons", POLICY, "/openapi.json", "/metrics", "/nowhere"])
def test_head_answers_as_get_without_the_body(trained: Service, path: str):
    head, got = trained.http.head(path), trained.http.get(path)
    assert head.status_code == got.status_code
    assert head.content == b""
    assert head.headers.get("etag") == got.headers.get("etag")
    assert head.headers["content-type"] == got.headers["content-type"]


def test_head_of_a_call_that_only_posts_is_refused(trained: Service):
    assert trained.http.head("/trainings").status_code == 405


def test_bytes_are_taken_for_what_they_are_and_given_as_bytes(trained: Service):
    demo = trained.client.demos()[0]
    given = trained.http.get(f"/demos/{demo['id']}/recording", headers={"Accept": BYTES})
    assert given.headers["content-type"] == BYTES
    again = trained.http.post("/demos", params=KESTREL, content=given.content, headers={"Content-Type": BYTES})
    assert (again.status_code, again.json()["id"]) == (200, demo["id"])
    assert trained.http.get(f"/recordings/{demo['recording']}").json()["media_type"] == "text/csv"
