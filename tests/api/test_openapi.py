"""The OpenAPI document: complete, stable, with correct examples, and readable without external addresses."""

import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest
from fastapi import APIRouter

from skills.api.routes import ROUTERS
from skills.seeds.recordings import sample_recordings
from tests.api.conformance import conformance
from tests.api.html import Html
from tests.api.service import GOAL_MM, KESTREL, Service

OPERATIONS = {
    "add_demo", "add_recording", "alive", "cancel_job", "compare", "decide_proposal",
    "delete_recording", "draw_pictures", "end_key",
    "erase_surgeon",
    "get_animation", "get_animation_gif", "get_atlas", "get_clearance_plot", "get_demo", "get_demo_recording",
    "get_job", "get_joints_plot", "get_nearest", "get_path", "get_picture", "get_plan", "get_playback", "get_policy",
    "get_pose_style", "get_policy_card", "get_policy_card_signature", "get_policy_signature", "get_policy_version",
    "get_policy_version_card", "get_recording", "get_report", "get_retraining",
    "get_reward_map", "get_segments", "get_surgeon", "get_suture_type", "get_timeline", "get_trajectory", "get_version",
    "list_all_keys", "list_demos", "list_jobs", "list_policies", "list_plans", "list_proposals",
    "list_recordings",
    "list_surgeons", "list_suture_types",
    "list_versions", "make_key", "make_plan", "map_reach", "mark_demo", "metrics", "newest_head", "next_action", "play",
    "preview_recording",
    "put_surgeon", "put_suture_type",
    "read_suture_points", "ready", "recognise", "release", "retrain", "roll_out", "score", "served_at",
    "surgeon_progress", "train", "try_recording",
    "upload_demo", "watch_job",
    "withdraw", "withdraw_demo",
    "delete_dataset", "export_dataset", "get_dataset", "get_dataset_episodes",
}  # fmt: skip
EVERY_CALL = {"400", "500", "503"}
PATH = {**KESTREL, "version": "1"}


def operations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, calls in conformance().document["paths"].items():
        for method, call in calls.items():
            yield method.upper(), path, call


def test_operation_ids_stay_as_clients_know_them():
    assert {call["operationId"] for _, _, call in operations()} == OPERATIONS


@pytest.mark.parametrize(
    ("method", "path", "call"), [*operations()], ids=lambda part: part if isinstance(part, str) else ""
)
def test_every_call_says_what_it_does_and_what_it_may_refuse(method: str, path: str, call: dict[str, Any]):
    assert call["tags"] and call["summary"] and call["description"]
    answers = call["responses"]
    assert answers.keys() >= EVERY_CALL
    assert ("401" in answers) == ("403" in answers) == ("security" not in call)
    assert ("422" in answers) == bool(call.get("parameters") or "requestBody" in call)
    assert ("413" in answers) == ("requestBody" in call)
    for status, answer in answers.items():
        kinds = answer.get("content", {})
        assert answer["description"]
        if status >= "400":
            assert [*kinds] == ["application/problem+json"]
        elif status in ("204", "304"):
            assert not kinds
        else:
            assert kinds, f"{status} has no content"
            assert kinds.get("application/json", {"schema": 1}).get("schema"), "its model is named"


def test_every_model_of_ours_names_its_fields():
    for name, schema in conformance().document["components"]["schemas"].items():
        assert schema.get("description") or name.startswith("Page_"), name
        assert schema["properties"], name


def test_every_list_is_paged_in_the_same_way():
    lists = [call for method, _, call in operations() if method == "GET" and "Link" in str(call["responses"]["200"])]
    assert len(lists) == 11
    for call in lists:
        names = {one["name"] for one in call["parameters"]}
        assert {"limit", "cursor", "if-none-match"} <= names


# ---- examples ---------------------------------------------------------------------------------------------------


def examples() -> Iterator[tuple[str, Any]]:
    for name, schema in conformance().document["components"]["schemas"].items():
        for example in schema.get("examples", ()):
            yield name, example


@pytest.mark.parametrize(("name", "example"), [*examples()])
def test_every_example_is_of_its_schema(name: str, example: Any):
    conformance().check_json({"$ref": f"#/components/schemas/{name}"}, example, name)


def asked() -> Iterator[Any]:
    for method, path, call in operations():
        body = call.get("requestBody", {}).get("content", {}).get("application/json")
        if body is not None:
            name = body["schema"]["$ref"].rpartition("/")[2]
            for example in conformance().document["components"]["schemas"][name]["examples"]:
                yield pytest.param(method, path, example, id=f"{method} {path} {json.dumps(example)[:40]}")


def test_everything_that_takes_json_shows_how():
    with_json = [
        call for _, _, call in operations() if "application/json" in call.get("requestBody", {}).get("content", {})
    ]
    assert len({(one.values[0], one.values[1]) for one in asked()}) == len(with_json) >= 10


@pytest.mark.parametrize(("method", "path", "example"), [*asked()])
def test_every_example_of_a_request_does_what_it_shows(trained: Service, method: str, path: str, example: Any):
    """Only digests are filled in: an example cannot know them."""
    there = trained.client.demos()[0]
    if "plan" in example:
        example = {
            "plan": trained.client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")["id"]
        }
    digests = {"demo": there["id"], "demos": [there["id"]], "recording": there["recording"]}
    example = {name: digests.get(name, value) for name, value in example.items()}
    recording = there["recording"]
    if "{number}" in path:  # of a proposal at which nothing was cut
        recording = trained.client.add_recording(sample_recordings()[0].data)["id"]
    path = path.format(**PATH, number=1, recording=recording, demo=there["id"])
    answer = trained.http.request(method, path, json=example)
    assert answer.is_success, answer.text


# ---- readability for people and clients -------------------------------------------------------------------------


def test_the_calls_are_shown_on_a_page_without_an_outside_address(still: Service):
    answer = still.http.get("/docs")
    assert answer.status_code == 200
    assert "Loading the calls" in answer.text  # until Swagger UI, which is large, has been loaded
    policy = answer.headers["content-security-policy"]
    assert "script-src 'self'; style-src 'self';" in policy
    assert "unsafe" not in policy and "http" not in policy
    addresses = Html(answer.text).addresses
    assert all(one.startswith(("/", "#")) and not one.startswith("//") for one in addresses), addresses
    for name in ("swagger-ui-bundle.js", "swagger-ui.css", "reference.js"):
        (file,) = (one for one in addresses if one.endswith(f"/{name}"))
        assert still.http.get(file).status_code == 200


def test_the_document_is_given_as_it_is_described(still: Service):
    assert still.http.get("/openapi.json").json() == conformance().document


def test_a_client_reads_answers_without_a_server_or_a_compiler():
    """The modules that the response models import determine how fast the command line starts."""
    look = "import sys, skills.schemas.responses; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"sqlalchemy", "fastapi", "starlette", "numba", "scipy", "sklearn", "orjson", "httpx2", "numpy"}
    assert not heavy & {*loaded}
    assert {"pydantic", "skills"} <= {*loaded}


def test_a_client_passes_over_what_a_newer_service_adds():
    from skills.schemas import Page
    from skills.schemas.people import SutureType

    newer = {"suture": "a", "name": "A", "also_called": [], "family": "f", "description": "", "colour": "red"}
    page = Page[SutureType].model_validate({"items": [newer], "next": None, "total": 1})
    assert page.items[0].name == "A"
    assert "colour" not in page.items[0].model_dump()


def test_an_application_by_path_has_the_routes_of_each_path():
    """The table of routers says which paths each of them has: a missing one would be a 404 on the command line."""
    modules = [(import_module(f"skills.api.routes.{module}"), name, parts) for module, name, parts in ROUTERS]
    for module, name, parts in modules:
        routes = {one.path.split("/")[1] for one in getattr(module, name).routes}
        assert routes == parts, f"{module.__name__}.{name}"
    routers = {id(one) for module, _, _ in modules for one in vars(module).values() if isinstance(one, APIRouter)}
    assert routers == {id(getattr(module, name)) for module, name, _ in modules}
