"""Invalid requests: every JSON route and every path answers 4xx with a message, and never 5xx."""

import json
from collections.abc import Iterable, Iterator
from typing import Any

import pytest

from tests.api.conformance import conformance
from tests.api.service import KESTREL, POLICY, Service, assert_problem

CANARY = "Zaphod-42"
JSON = {"Content-Type": "application/json"}
SOUND: dict[tuple[str, str], Any] = {
    ("PUT", "/surgeons/{surgeon}"): {
        "skill_level": "expert", "handedness": "left", "protocol": "p",
        "consent": {"uses": ["training"], "until": "2999-01-01"},
    },
    ("PUT", "/suture-types/{suture}"): {"name": "n", "family": "f", "also_called": ["a"], "description": "d"},
    ("POST", "/recordings/{recording}/demos"): {
        **KESTREL, "arm": "PSM", "topic": "table", "start_s": 0.0, "end_s": 0.5, "grid": "fit",
        "cell_mm": 5.0, "hysteresis": 0.25, "session": "s",
    },
    ("POST", "/trainings"): {
        **KESTREL, "demos": ["0" * 64], "combine": {"kind": "medoid"}, "seed": 0, "release": True,
        "learner": {"kind": "phase-q-learning", "alpha": 1.0, "gamma": 0.1, "max_steps": 1},
    },
    ("POST", "/tries"): {
        **KESTREL, "recording": "0" * 64, "segment": 1, "loss_mm": 2.6, "cell_mm": 5.0, "hysteresis": 0.25,
        "release": False, "tissue_mm": -165.0, "errors": "calibrated",
    },
    ("POST", "/retrainings"): {
        **KESTREL, "only_stale": False, "release": False, "learner": {"kind": "phase-q-learning", "alpha": 1.0},
    },
    ("POST", "/policies/{surgeon}/{suture}/rollouts"): {"start_mm": [0.0, 50.0, -120.0], "version": 1},
    ("POST", "/policies/{surgeon}/{suture}/next"): {"position_mm": [0.0, 50.0, -120.0], "phase": 0},
    ("POST", "/plans"): {
        **KESTREL, "version": 1,
        "suture_points": [{"position_mm": [5.0, 55.0, -125.0], "rotation_xyzw": [0.0, 0.0, 0.0, 1.0]}],
        "starts_mm": [[0.0, 50.0, -120.0]], "arm": "PSM", "frame": "PSM_base", "instrument": "400006",
        "speed_mm_s": 20.0, "rate_hz": 150.0, "tip_offset_mm": 0.0, "psm_m": {
            "approach": [-0.94, 0.1, -0.33], "instrument": "400006", "enters": "start", "source": "invented",
            "base": {"position_mm": [160.0, 20.0, 20.0], "rotation_xyzw": [0.0, 0.0, 0.38, 0.92]},
        },
    },
    ("POST", "/reach"): {
        **KESTREL, "version": 1, "centre_mm": [5.0, 55.0, -125.0], "size_mm": [20.0, 20.0, 0.0], "step_mm": 10.0,
        "rotations_xyzw": [[0.0, 0.0, 0.0, 1.0]], "tip_offset_mm": 0.0, "handoff": "none",
    },
    ("PUT", "/demos/{demo}/outcome"): {"outcome": "failure", "reason": "It fell."},
    ("PUT", "/recordings/{recording}/proposals/{number}"): {"state": "rejected", "note": "Idle."},
    ("POST", "/playbacks"): {"plan": "0" * 64},
    ("POST", "/datasets"): {
        "demos": ["0" * 64], "outcomes": "any", "whole": True, "version": "v3.0", "fps": 30, "split": "session",
        "arms": ["PSM1"], "name": "Sutures", "licence": "CC-BY-4.0", "description": "Many.", "procedure": "By hand.",
    },
    ("POST", "/scores"): {
        **KESTREL, "recording": "0" * 64, "arm": "PSM", "topic": "table", "start_s": 0.0, "end_s": 0.5,
        "reference": "0" * 64,
    },
    ("POST", "/keys"): {
        "owner": "somebody", "role": "reader", "expires_at": "2999-01-01T00:00:00Z", "surgeons": ["kestrel"],
    },
}  # fmt: skip
TOKENS = (
    "NaN", "Infinity", "-Infinity", "1e400", "9" * 400, "-" + "9" * 400, '"\\ud800"', '"\\u0000"', '"a\\u0000b"', "{}",
    '{"a": 1}', '[["b"]]', f'"{CANARY}"', '"' + "x" * 5000 + '"', "1.5e308", '"; DROP TABLE jobs; --"',
)  # fmt: skip
# A request for an atlas fills this cache, which the history notes, and changes nothing else.
CACHED = {"measured_shapes": 0, "history": 0, "history_checkpoints": 0, "history_tiles": 0}
FREE_TEXT = {
    "owner",
    "reason",
    "name",
    "family",
    "description",
    "also_called",
    "protocol",
    "source",
    "licence",
    "procedure",
}
NUMBERS_ONLY = ("true", '"1"')  # sent in place of a number
WHOLE_ONLY = ("1.5", "true", '"1"', "1e400", "-1")
BODIES = (
    b"", b"{", b"null", b"[]", b'"text"', b"NaN", b"1", b"\xff\xfe", b"[" * 100_000,
    b'{"a":' * 50_000, b'{"\\ud800": 1}', b'{"' + CANARY.encode() + b'": 1}', b'{"a": ' + b"9" * 10_000 + b"}",
    b'{"x": "' + b"x" * 10_000_000 + b'"}',
)  # fmt: skip
SEGMENTS = (
    "%00",
    "%0d%0a",
    "..",
    "%2e%2e",
    "%2f",
    "a%2f..%2fb",
    "%ff",
    "x" * 60_000,
    "KESTREL",
    "-a",
    "a b",
    "%E2%80%AE",
    "' OR 1=1",
)


# By day every eighth of the requests, which are other ones for each route or value.
OF_ALL = pytest.mark.parametrize("of", [8, pytest.param(1, marks=pytest.mark.nightly)], ids=["an eighth", "all"])


def some(values: Iterable[Any], number: int, of: int) -> list[Any]:
    """Return every `of`-th of the values; which of them depends on a number."""
    return list(values)[number % of :: of]


def routes() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, calls in conformance().document["paths"].items():
        for method, call in calls.items():
            yield method.upper(), path, call


def filled(path: str, **parts: str) -> str:
    known = {**KESTREL, "version": "1", "number": "1", "job": "0" * 16, **parts}
    for name in [part[1:-1] for part in path.split("/") if part.startswith("{")]:
        path = path.replace(f"{{{name}}}", known.get(name, "0" * 64))
    return path


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(part, (*path, key))
    else:
        yield path, value


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = value.copy()
    copy[path[0]] = replaced(value[path[0]], path[1:], new)
    return copy


def tokens_for(leaf: Any) -> tuple[str, ...]:
    if isinstance(leaf, bool):
        return (*TOKENS, "1", "0", '"true"')
    if isinstance(leaf, int):
        return (*TOKENS, *WHOLE_ONLY)
    return (*TOKENS, *NUMBERS_ONLY) if isinstance(leaf, float) else TOKENS


@pytest.fixture
def untouched(still: Service) -> Iterator[None]:
    before = still.counts() | CACHED
    yield
    assert still.counts() | CACHED == before


def test_every_route_that_takes_json_is_in_the_table_above():
    with_json = {
        (method, path)
        for method, path, call in routes()
        if "application/json" in call.get("requestBody", {}).get("content", {})
    }
    assert with_json == set(SOUND)


@pytest.mark.parametrize("route", SOUND, ids=" ".join)
def test_a_body_that_is_no_request_is_refused(still: Service, untouched: None, route: tuple[str, str]):
    for body in BODIES:
        answer = still.http.request(route[0], filled(route[1]), content=body, headers=JSON)
        assert_problem(answer, range(400, 500))
        assert CANARY not in answer.text


@OF_ALL
@pytest.mark.parametrize("route", SOUND, ids=" ".join)
def test_a_value_of_the_wrong_kind_anywhere_is_refused(
    still: Service, untouched: None, route: tuple[str, str], of: int
):
    for number, (path, leaf) in enumerate(leaves(SOUND[route])):
        for token in some(tokens_for(leaf), number, of):
            if FREE_TEXT & {*path} and token.startswith('"') and "\\u" not in token and len(token) < 200:
                continue  # any short text is valid there
            body = json.dumps(replaced(SOUND[route], path, "@@")).replace('"@@"', token)
            answer = still.http.request(route[0], filled(route[1]), content=body, headers=JSON)
            assert answer.status_code in range(400, 500), (path, token[:40], answer.text[:300])
            assert_problem(answer, range(400, 500))
            assert CANARY not in answer.text


@pytest.mark.parametrize("route", SOUND, ids=" ".join)
def test_an_unknown_field_is_refused_and_not_repeated(still: Service, untouched: None, route: tuple[str, str]):
    answer = still.http.request(route[0], filled(route[1]), json=SOUND[route] | {CANARY: 1})
    assert_problem(answer, 422, "invalid-request")
    assert CANARY not in answer.text


@OF_ALL
@pytest.mark.parametrize("segment", SEGMENTS, ids=lambda segment: segment[:12])
def test_no_path_is_ours_to_blame(still: Service, untouched: None, segment: str, of: int):
    for method, path, _ in some(routes(), SEGMENTS.index(segment), of):
        for name in [part[1:-1] for part in path.split("/") if part.startswith("{")]:
            if segment in ("..", "%2e%2e") and path.endswith(f"{{{name}}}"):
                continue  # the client itself resolves it to the parent folder
            answer = still.http.request(method, filled(path, **{name: segment}), json=SOUND.get((method, path)))
            fine = (200, 404) if method == "GET" and segment == "%2f" else ()  # %2f addresses the list itself
            assert answer.status_code in (*fine, 404, 405, 414, 415, 422), (method, path, answer.status_code)
            assert answer.headers["x-request-id"]


LIMITS = ("-1", "0", "201", "1e2", "1.5", "NaN", "", " ", "0x10", "9" * 400, "1;2", "null", "\u0661\u0660", "%00")
CURSORS = (
    "-1",
    "0",
    "9" * 30,
    "NaN",
    "",
    "..",
    "a" * 65,
    "KESTREL",
    "' OR 1=1 --",
    "\x00",
    "\r\nX: 1",
    "\ud83d",
    "null",
)
HEADERS = (
    {"Accept": ""}, {"Accept": ","}, {"Accept": "q=1;;;"}, {"Accept": "*/*;q=NaN"}, {"Accept": "x" * 5000},
    {"If-None-Match": ""}, {"If-None-Match": ","}, {"If-None-Match": '"' + "x" * 5000}, {"If-None-Match": 'W/"'},
    {"If-Match": '"'}, {"If-Match": "x" * 5000}, {"Range": "bytes=-1"}, {"Range": "bytes=5-1,7-"},
    {"Expect": "nothing"}, {"Accept-Encoding": "zstd;q=9"}, {"Accept-Language": "x" * 5000},
    {"X-Request-ID": "x" * 5000}, {"Content-Digest": "sha-256=:====:"}, {"Content-Encoding": "gzip"},
    {"Cookie": "a=" + "b" * 5000},
    {"X-Forwarded-For": "' OR 1=1"}, {"X-HTTP-Method-Override": "DELETE"}, {"Origin": "null"},
)  # fmt: skip
NOT_JSON = (
    "text/plain", "application/xml", "multipart/form-data", "multipart/form-data; boundary=x", "text/csv", "",
    "application/x-www-form-urlencoded", "application/json; charset=nothing", "application/jsonx", "json", "x" * 5000,
)  # fmt: skip


def lists() -> list[str]:
    """Name the routes that return lists, according to their documentation."""
    found = (path for method, path, call in routes() if method == "GET" and "Link" in str(call["responses"]))
    return [filled(path) for path in found]


def test_no_limit_and_no_cursor_is_ours_to_blame(still: Service, untouched: None):
    assert len(lists()) == 11
    for path in lists():
        for name, values in (("limit", LIMITS), ("cursor", CURSORS)):
            for value in values:
                answer = still.http.get(path, params={name: value.encode("utf-8", "surrogatepass")})
                taken = answer.status_code == 200 and (name == "cursor" or value == "\u0661\u0660")  # int() parses it
                if not taken:
                    assert_problem(answer, range(400, 500))
                assert "OR 1=1" not in answer.text


def test_the_cursor_of_one_list_is_refused_by_another_or_is_a_place_in_it(still: Service):
    given = {str(still.http.get(path, params={"limit": 1}).json().get("next")) for path in lists()} - {"None"}
    assert len(given) > 1
    for path in lists():
        for cursor in given:
            answer = still.http.get(path, params={"cursor": cursor})
            if answer.status_code != 200:
                assert_problem(answer, range(400, 500))


@pytest.mark.parametrize("of", [3, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_parameter_that_there_is_not_or_that_comes_twice_harms_nobody(still: Service, untouched: None, of: int):
    queries = ("limit=1&limit=200&limit=-1", "a=b&" * 1000, "=&&;=", "%00=%00", "limit[]=1", "x" * 50_000)
    for number, (method, path, _) in enumerate(routes()):
        for query in ("?" + one for one in some(queries, number, of)):
            if method == "GET":
                answer = still.http.get(filled(path) + query)
                assert answer.status_code < 500 or path == "/readyz", (path, query[:20], answer.text)
                if answer.status_code >= 400:
                    assert_problem(answer, range(400, 504))


@OF_ALL
@pytest.mark.parametrize("header", HEADERS, ids=lambda header: str(header)[:30])
def test_no_header_is_ours_to_blame(still: Service, untouched: None, header: dict[str, str], of: int):
    for method, path, _ in some(routes(), HEADERS.index(header), of):
        if method == "DELETE":
            continue  # an unsupported header does not cause a refusal
        answer = still.http.request(method, filled(path), headers=header, json=None if method == "GET" else [])
        assert answer.status_code < 500 or path == "/readyz", (method, path, answer.text)
        if answer.status_code >= 400:
            assert_problem(answer, range(400, 504))


@pytest.mark.parametrize("route", SOUND, ids=" ".join)
def test_json_under_another_name_or_with_a_name_twice_is_refused(
    still: Service, untouched: None, route: tuple[str, str]
):
    for kind in NOT_JSON:
        body = json.dumps(SOUND[route] | {CANARY: 1}).encode()
        answer = still.http.request(route[0], filled(route[1]), content=body, headers={"Content-Type": kind})
        assert_problem(answer, range(400, 500))
        assert CANARY not in answer.text
    twice = body[:-1] + b', "' + CANARY.encode() + b'": 2}'
    problem = assert_problem(still.http.request(route[0], filled(route[1]), content=twice, headers=JSON), 422)
    assert problem["errors"][0]["why"] == "An object has the same name twice."


def test_every_answer_has_a_request_id_of_its_own_and_forbids_guessing(still: Service):
    asked = [("GET", "/healthz"), ("GET", "/nothing"), ("DELETE", "/healthz"), ("GET", "/surgeons/nobody")]
    asked += [("GET", POLICY), ("POST", "/plans"), ("GET", "/openapi.json")]
    seen = set()
    for method, path in asked:
        answer = still.http.request(method, path)
        seen.add(answer.headers["x-request-id"])
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        if answer.status_code >= 400:
            assert_problem(answer, range(400, 500))
    assert len(seen) == len(asked)


def test_an_unexpected_failure_tells_a_case_number_and_nothing_else(trained: Service):
    trained.tamper("ALTER TABLE surgeons RENAME COLUMN slug TO was_slug", "UPDATE plans SET about = 'x'")
    for path in ("/surgeons", "/surgeons/kestrel", POLICY, "/demos"):
        answer = trained.http.get(path)
        assert_problem(answer, range(500, 600))
        assert not any(word in answer.text for word in ("slug", "column", "surgeons", ".py", "sqlite"))


def test_a_failure_in_our_code_is_500_with_a_case_number(trained: Service):
    """The row is one that our own code could not have written: the JSON of a demonstration's report is truncated."""
    trained.tamper("UPDATE demonstrations SET report = '{\"cut'")
    problem = assert_problem(trained.http.get("/demos"), 500, "unexpected")
    assert len(problem["case"]) == 16
    assert "cut" not in str(problem)
