"""Answers that are broken, for every call of the client: each is an error of ours, and never one of Python."""

import inspect
import re
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest

from skills.client.blocking.client import Client
from skills.errors import SkillsError
from tests.client.peers import Script, Time, answer, at_once
from tests.client.test_answers import CALLS
from tests.client.test_waiting import DONE, ID, RUNNING

PROBLEM = {"content-type": "application/problem+json"}
EVENT = {"content-type": "text/event-stream"}
DOCUMENT = {"type": "urn:suture-skills:busy", "title": "Busy", "status": 409, "detail": "Try again."}
BROKEN = {
    "a list": httpx.Response(200, json=[1, {"items": None}]),
    "null": httpx.Response(200, content=b"null"),
    "a text": httpx.Response(200, json="kestrel"),
    "an object without fields": httpx.Response(200, json={}),
    "a page without next": httpx.Response(200, json={"items": []}),
    "a page of something else": httpx.Response(200, json={"items": [None, 7, "x"], "next": None}),
    "JSON that was cut off": httpx.Response(200, content=b'{"items": [{"surgeon": "kes'),
    "no UTF-8": httpx.Response(200, content=b"\xff\xfe{}"),
    "an event that was cut off": httpx.Response(200, content=b'data: {"id": "1", "sta\n\n', headers=EVENT),
    "an event with a list": httpx.Response(200, content=b"data: []\n\n", headers=EVENT),
    "a length of no number": httpx.Response(200, content=b"x", headers={"content-length": "many"}),
    "a digest of no digest": httpx.Response(200, content=b"x", headers={"etag": '"'}),
    "a problem that is a list": httpx.Response(422, json=[1, 2], headers=PROBLEM),
    "a problem that is null": httpx.Response(422, content=b"null", headers=PROBLEM),
    "a problem that was cut off": httpx.Response(422, content=b'{"type": "urn:', headers=PROBLEM),
    "remedies of another kind": httpx.Response(
        409, json=DOCUMENT | {"remedies": [{"action": "dance"}]}, headers=PROBLEM
    ),
    "errors of another kind": httpx.Response(422, json=DOCUMENT | {"errors": [3, {"where": 1}]}, headers=PROBLEM),
    "numbers that are none": httpx.Response(409, json=DOCUMENT | {"numbers": ["message", 2]}, headers=PROBLEM),
    "a refused field without a place": httpx.Response(
        422, json=DOCUMENT | {"errors": [{"where": "", "why": ""}]}, headers=PROBLEM
    ),
    "numbers with the names of arguments": httpx.Response(
        409, json=DOCUMENT | {"numbers": {"message": 1, "self": 2}}, headers=PROBLEM
    ),
    "a fraction of a second": httpx.Response(503, json=DOCUMENT, headers=PROBLEM | {"retry-after": "1.5"}),
    "a time to come again that is none": httpx.Response(503, json=DOCUMENT, headers=PROBLEM | {"retry-after": "soon"}),
    "a negative time to come again": httpx.Response(503, json=DOCUMENT, headers=PROBLEM | {"retry-after": "-1"}),
    "a time beyond all calendars": httpx.Response(
        503, json=DOCUMENT, headers=PROBLEM | {"retry-after": "Mon, 01 Jan 99999 00:00:00 GMT"}
    ),
    "a page of another program": httpx.Response(502, html="<h1>Bad gateway</h1>"),
    "no status of HTTP": httpx.Response(599, content=b""),
}


def arguments(name: str, folder: Path) -> dict[str, Any]:
    """Return a value for each argument that a call requires, by its type."""
    found: dict[str, Any] = {}
    for one in inspect.signature(getattr(Client, name)).parameters.values():
        if one.name == "self" or one.default is not one.empty or one.kind is one.VAR_KEYWORD:
            continue
        kind = str(one.annotation)
        if one.name == "method":
            found[one.name] = "GET"
        elif "Path" in kind and one.name.startswith("to"):
            found[one.name] = folder / f"{name}.json"
        elif "Path" in kind:
            found[one.name] = b"1,2,3\n"
        elif "datetime" in kind:
            found[one.name] = datetime(2026, 1, 2, tzinfo=UTC)
        elif re.search(r"\bint\b", kind) and "str" not in kind and "tuple" not in kind and "Sequence" not in kind:
            found[one.name] = 1
        elif "Sequence[str]" in kind or "Collection[str]" in kind:
            found[one.name] = ["kestrel"]
        elif "float" in kind:
            found[one.name] = (0.0, 0.0, 0.0)
        else:
            found[one.name] = "/surgeons" if one.name == "path" else "kestrel"
    return found


@pytest.mark.parametrize("broken", BROKEN.values(), ids=list(BROKEN))
def test_every_call_refuses_a_broken_answer_with_an_error_of_ours(broken, tmp_path):
    others = []
    if broken.is_success and "etag" not in broken.headers:  # so that what is verified first is not all that is wrong
        headers = {**broken.headers, "etag": f'"{sha256(broken.content).hexdigest()}"'}
        broken = httpx.Response(broken.status_code, content=broken.content, headers=headers)
    for name in CALLS:
        try:
            at_once(Script(broken), Time())(name, **arguments(name, tmp_path))
        except SkillsError as error:
            others += [] if error.message else [f"{name}: an error without words"]
        except Exception as error:
            others.append(f"{name}: {type(error).__name__}: {error}"[:150])
    assert not others, "\n".join(others)


def test_a_broken_event_of_a_job_is_an_error_of_ours():
    for line in (b'data: {"id": "1", "sta', b"data: []", b"data: null", b"data:"):
        script = Script(answer(RUNNING), httpx.Response(200, content=line + b"\n\n", headers=EVENT), answer(DONE))
        with pytest.raises(SkillsError):
            at_once(script, Time())("wait", ID)


def test_a_fraction_of_a_second_is_waited_for():
    passing, script = (
        Time(),
        Script(
            httpx.Response(503, json=DOCUMENT | {"status": 503}, headers=PROBLEM | {"retry-after": "1.5"}),
            httpx.Response(200, json={}),
        ),
    )
    at_once(script, passing)("get_json", "/surgeons")
    assert len(passing.slept) == 1
    assert passing.slept[0] >= 1.5


def test_a_number_that_json_has_not_is_refused_before_it_is_sent():
    for number in (float("nan"), float("inf"), -float("inf")):
        script = Script(httpx.Response(200, json={}))
        with pytest.raises(SkillsError, match="start_mm"):
            at_once(script, Time())("rollout", "kestrel", "simple-running", (0.0, number, 0.0))
        assert script.asked == []
