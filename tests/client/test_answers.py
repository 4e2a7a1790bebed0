"""Responses as the client returns them: models, or errors; the same in both clients."""

import inspect
import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest

from skills.api.app import create_app
from skills.client import Problem
from skills.client.blocking.client import Client
from skills.client.client import AsyncClient
from skills.client.problems import NotUnderstood
from skills.errors import BadSettings, SkillsError
from skills.formats.bag_writer import write_mcap
from skills.schemas.people import Surgeon
from skills.schemas.policies import Policy
from skills.schemas.responses import Problem as ProblemDocument
from skills.settings import Settings
from tests.client.peers import BOTH, SURGEON, Script, Time, answer, asked, at_once
from tests.formats import bags

both = pytest.mark.parametrize("made", BOTH)
CALLS = [
    name
    for name, call in inspect.getmembers(AsyncClient, inspect.iscoroutinefunction)
    if name[0] != "_" and name != "aclose"
]


def test_both_clients_have_the_same_calls_with_the_same_parameters():
    assert len(CALLS) > 45
    for name in CALLS:
        one, other = getattr(Client, name), getattr(AsyncClient, name)
        assert inspect.signature(one) == inspect.signature(other)
        assert one.__doc__
        assert not inspect.iscoroutinefunction(one)


@both
def test_a_response_becomes_a_model_and_unknown_fields_are_ignored(made):
    found = made(Script(answer(SURGEON | {"favourite_needle": "CT-1"})), Time())("surgeon", "kestrel")
    assert isinstance(found, Surgeon)
    assert (found.surgeon, found.created_at) == ("kestrel", datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC))
    as_sent = made(Script(answer(SURGEON | {"favourite_needle": "CT-1"})), Time())("get_json", "/surgeons/kestrel")
    assert as_sent["favourite_needle"] == "CT-1"


@both
def test_what_is_no_answer_of_this_service_is_said_to_be_none(made):
    for strange in (
        answer({"name": "somebody"}),
        answer([1, 2]),
        httpx.Response(200, html="<h1>Welcome to the hospital's network</h1>"),
        httpx.Response(200, content=b""),
    ):
        with pytest.raises(NotUnderstood):
            made(Script(strange), Time())("surgeon", "kestrel")


@both
def test_a_list_is_all_of_its_pages(made):
    pages = [answer({"items": [SURGEON] * 3, "next": "k"}), answer({"items": [SURGEON], "next": None})]
    script = Script(*pages)
    assert len(made(script, Time())("surgeons")) == 4
    assert asked(script) == ["GET /surgeons?limit=200", "GET /surgeons?limit=200&cursor=k"]


@both
def test_a_problem_tells_what_the_service_told(made):
    body = {
        **{"type": "urn:suture-skills:invalid-request", "title": "t", "status": 422, "detail": "Mend it."},
        "errors": [
            {"where": "body.start_mm.1", "why": "must be at most 5"},
            {"where": "path.surgeon", "why": "is odd"},
        ],
    }
    said = httpx.Response(422, json=body, headers={"content-type": "application/problem+json"})
    with pytest.raises(
        Problem, match=r"^start_mm.1 must be at most 5\nsurgeon is odd; 'kestrel' was given$"
    ) as refused:
        made(Script(said), Time())("rollout", "kestrel", "simple-running", (0, 0, 0))
    assert (refused.value.kind, refused.value.document) == ("invalid-request", ProblemDocument.model_validate(body))


@both
def test_a_refusal_by_somebody_between_is_told_by_its_number(made):
    with pytest.raises(Problem, match="502") as refused:
        made(Script(httpx.Response(502, html="<h1>Bad gateway</h1>")), Time())("surgeons")
    assert refused.value.kind == ""


@both
def test_what_a_caller_names_is_one_part_of_a_path(made):
    script = Script(answer())
    made(script, Time())("surgeon", "kestrel/../../policies?x=1")
    assert asked(script) == ["GET /surgeons/kestrel%2F..%2F..%2Fpolicies%3Fx%3D1"]


def test_a_policy_is_shown_in_a_line_or_two_in_a_notebook():
    numbers = Policy.model_construct(surgeon="kestrel", actions=[[0] * 1331] * 30, waypoints=list(range(30)))
    assert len(repr(numbers)) < 2000


@pytest.mark.nightly
def test_type_checkers_know_what_both_clients_take_and_answer(tmp_path):
    from mypy import api

    file = tmp_path / "typed.py"
    file.write_text(
        "from typing import assert_type\n"
        "from skills.schemas.operation import Job\n"
        "from skills.schemas.policies import Policy\n"
        "from skills.client import AsyncClient, Client\n"
        "def now(client: Client) -> None:\n"
        "    assert_type(client.policy('a', 'b', version=1), Policy)\n"
        "    assert_type(client.jobs(), list[Job])\n"
        "    client.policy(1, 'b')  # type: ignore[arg-type]\n"
        "    client.train('a', 'b', sede=1)  # type: ignore[call-arg]\n"
        "async def later(client: AsyncClient) -> None:\n"
        "    assert_type(await client.policy('a', 'b', version=1), Policy)\n"
        "    client.policy('a', 'b').actions  # type: ignore[attr-defined]\n"
    )
    out, _, code = api.run(["--strict", "--cache-dir", str(tmp_path / "cache"), str(file)])
    assert code == 0, out


WORDS: dict[str, Any] = {
    **dict.fromkeys(("surgeon", "suture", "recording", "demo", "job", "policy", "plan", "playback", "key"), "a"),
    **{
        "version": 1,
        "start_mm": (0, 0, 0),
        "position_mm": (0, 0, 0),
        "rotation_xyzw": (0, 0, 0, 1),
        "suture_points": [],
        "owner": "me",
        "moment": datetime(2026, 1, 31, 12, tzinfo=UTC),
    },
    **{
        "name": "n",
        "family": "f",
        "of": "joints",
        "method": "GET",
        "path": "/healthz",
        "scene": write_mcap(bags.recording()),
    },
}
NOT_OF_A_CLIENT = {"GET /metrics"}


def test_every_call_of_the_service_is_one_of_the_client(tmp_path: Path):
    described = create_app(Settings(database_url=f"sqlite:///{tmp_path / 'x.sqlite'}")).openapi()["paths"]
    service = {(method.upper(), path) for path, methods in described.items() for method in methods}
    script = Script(answer({}))
    for name in CALLS:
        wanted = inspect.signature(getattr(Client, name)).parameters.values()
        needed = [one.name for one in wanted if one.default is one.empty and one.kind is not one.VAR_KEYWORD]
        words = {one: WORDS.get(one) for one in needed if one != "self"}
        if "recording" in words and name.startswith(("add_", "preview_")):
            words["recording"] = write_mcap(bags.recording())
        if "to" in words:
            words["to"] = tmp_path / "file.json"
        with suppress(SkillsError, LookupError, AttributeError):
            at_once(script, Time())(name, **words)
    for name, *further in (("animation", "a", "gif"), ("plot", "a", "clearance"), ("policy", "a", "b", 1)):
        with suppress(SkillsError):
            at_once(script, Time())(name, *further)
    made = [(one.method, one.url.path) for one in script.asked]
    ways = {way: re.compile(re.sub(r"\\{\w+\\}", "[^/]+", re.escape(way))) for _, way in service}
    missing = {
        f"{method} {way}"
        for method, way in service
        if not any(method == asked and ways[way].fullmatch(path) for asked, path in made)
    }
    by_waiting, by_digest = {"GET /jobs/{job}/events"}, {"GET /policy-versions/{policy}/card"}
    assert missing == NOT_OF_A_CLIENT | by_waiting | by_digest


@pytest.mark.parametrize(
    "server", ["127.0.0.1:8000", "localhost:8000", "", "ftp://example.org", "http://", "http://here:there"]
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_what_is_no_address_is_said_to_be_none(kind, server: str):
    with pytest.raises(BadSettings, match=r"http://127\.0\.0\.1:8000"):
        kind(server)
