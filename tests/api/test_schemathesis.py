"""Requests generated from the OpenAPI document, valid and invalid: no 5xx, and only documented responses.

schemathesis generates them and checks the responses; `conformance`, which checks the responses of all tests, does too.
Response bodies are left to `conformance`: it allows no undescribed field, while schemathesis rewrites `prefixItems` in
the document while it generates requests, and then checks against its own rewriting.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.api.conformance import conformance
from tests.api.service import GOAL_MM, KESTREL, Service, copy_of_trained, serving
from tests.by_day import some

BASE = "http://localhost"
JUDGED_BY = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
)
A_FEW, MANY = 3, 200  # requests for each operation


LABELS = [f"{method.upper()} {path}" for path, calls in conformance().document["paths"].items() for method in calls]


@cache
def operations() -> dict[str, Any]:
    import schemathesis  # here and below, because the import takes a second
    from schemathesis.config import GenerationConfig, ProjectConfig, ProjectsConfig, SchemathesisConfig

    generation = GenerationConfig(deterministic=True)
    projects = ProjectsConfig(default=ProjectConfig(generation=generation))
    schema = schemathesis.openapi.from_dict(conformance().document, config=SchemathesisConfig(projects=projects))
    found = (result.ok() for result in schema.get_all_operations())
    return {one.label: one for one in found}


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(copy_of_trained(tmp_path_factory.mktemp("made-up"))) as service:
        yield service


@pytest.fixture
def service(request: pytest.FixtureRequest, label: str) -> Service:
    """Return the shared service, or a new one for operations that delete, and at night: many requests change more."""
    shared = not label.startswith("DELETE") and request.node.get_closest_marker("nightly") is None
    found: Service = request.getfixturevalue("lasting" if shared else "trained")
    return found


def known(service: Service, label: str) -> dict[str, Any]:
    """Return the ids of existing objects that are in an operation's path, of those without the simulator."""
    client, http = service.client, service.http
    found = {
        "surgeon": lambda: KESTREL["surgeon"],
        "suture": lambda: KESTREL["suture"],
        "demo": lambda: client.demos()[0]["id"],
        "recording": lambda: client.demos()[0]["recording"],
        "plan": lambda: client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")["id"],
        "job": lambda: http.get("/jobs?state=succeeded").json()["items"][0]["id"],  # a waiting job's events never end
        "policy": lambda: client.policy(**KESTREL)["sha256"],
        "version": lambda: 1,
    }
    return {name: find() for name, find in found.items() if f"{{{name}}}" in label}


def sweep(service: Service, label: str, examples: int) -> int:
    """Send the requests generated for one operation, half of them to existing objects, and return their number."""
    from schemathesis.checks import CHECKS
    from schemathesis.generation import GenerationMode

    operation, sent = operations()[label], 0
    judged_by = JUDGED_BY[1:] if label == "GET /readyz" else JUDGED_BY  # there is no worker, so 503 is correct
    names = known(service, label)
    modes = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
    parts = [{}, {"path_parameters": names}] if names else [{}]
    made_up = st.one_of(*(operation.as_strategy(generation_mode=mode, **part) for mode in modes for part in parts))

    @settings(
        max_examples=examples,
        phases=[Phase.generate],  # failures are reported unshrunk: shrinking takes longer than the diagnosis
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[*HealthCheck],
    )
    @given(made_up)
    def run(case: Any) -> None:
        nonlocal sent
        asked = case.as_transport_kwargs(base_url=BASE)
        body, _ = asked.pop("data", None), asked.pop("cookies", None)
        headers = {name: value.encode("latin-1") for name, value in asked.pop("headers").items()}  # as sent
        answer = service.http.request(**asked, headers=headers, **({} if body is None else {"content": body}))
        sent += 1
        case.validate_response(answer, checks=CHECKS.get_by_names(judged_by))

    run()
    return sent


@pytest.mark.parametrize("label", some(LABELS, 2))  # by day the others get those of test_bad_requests
def test_no_generated_request_causes_a_5xx_or_an_undocumented_response(service: Service, label: str):
    assert sweep(service, label, A_FEW) > 0


@pytest.mark.nightly
@pytest.mark.parametrize("label", LABELS)
def test_two_hundred_made_up_requests_for_each_operation(service: Service, label: str):
    assert sweep(service, label, MANY) > 0
