"""The table of docs/keys.md: of each operation, in each format, the answer while a surgeon allows no use."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx2 as httpx
import pytest
from starlette.testclient import WebSocketDenialResponse

from skills.db import now, rfc3339
from skills.formats import write_mcap
from skills.library.operation.history import sign_some_history
from tests.api.keyed import copy_of_told, routes
from tests.api.service import GOAL_MM, KESTREL, MCAP, Service, serving
from tests.library import cases, exports

PAGE = (Path(__file__).parents[2] / "docs" / "keys.md").read_text()
NO_USE = {"uses": [], "until": None}
POSED = "figure-of-eight"  # the suture type of kestrel's style with a pose style
START_MM = [-10, 55, -135]
EXPORTED = {"name": "d", "licence": "CC-BY-4.0", "procedure": "p", "description": "d", "fps": cases.RATE_HZ}
DRAWN = 40  # numbers of a line in a drawing; the page's own icons have fewer
LONG = 12  # numbers, or triples of them, in a row: a motion


class Row(NamedTuple):
    """An operation in one format, the use that it needs, and the answer without it."""

    method: str
    path: str
    media: str | None
    use: str
    answer: str

    @property
    def named(self) -> str:
        return f"{self.method} {self.path}{f' ({self.media})' if self.media else ''}"


def table() -> list[Row]:
    rows = []
    for line in PAGE[PAGE.index("| use | without it |") :].split("\n\n")[0].splitlines()[2:]:
        use, answer, operations = (cell.strip() for cell in line.strip("|").split("|"))
        for method, path, media in re.findall(r"`([A-Z]+) ([^ `]+)`(?: \(([^;)]+))?", operations):
            rows.append(Row(method, path, media or None, use.strip("`"), answer))
    return rows


TABLE = table()
ENDING = {"storing, ending", "no surgeon's"}  # operations that hand out nothing of a surgeon


def asked_of(row: Row) -> bool:
    return row.use.removeprefix("none: ") not in ENDING


def named_in(source_path: str) -> str:
    """Return the path of the document that a path of the table is an instance of."""
    return re.sub(r"^/timelines/[a-z-]+/", "/timelines/{source}/", source_path)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(copy_of_told(tmp_path_factory.mktemp("told")), key_requests_per_s=1e6) as service:
        style = {"surgeon": "kestrel", "suture": POSED}
        recording = write_mcap(exports.session_of())
        service.client.add_demo(recording, media_type=MCAP, **style, arm="PSM1", segment="whole")
        service.client.train(**style, release=True)
        asked = EXPORTED | {"surgeons": ["kestrel"], "sutures": [POSED]}
        assert service.http.post("/datasets", json=asked).status_code == 202
        service.work()
        yield service


@pytest.fixture(scope="module")
def ids(service: Service) -> dict[str, str]:
    """Return kestrel's objects, by the names of parameters."""
    client = service.client
    jobs = client.get_json("/jobs")["items"]
    demo = next(one for one in client.demos("kestrel") if one["suture"] == cases.SUTURE)
    played = next(job["result"]["playback"] for job in jobs if job["kind"] == "playback")
    served = client.get_json(f"/policies/kestrel/{cases.SUTURE}")
    return {
        **KESTREL,
        **{"demo": demo["id"], "recording": demo["recording"], "policy": served["sha256"], "playback": played},
        **{"version": str(served["version"]), "plan": client.playback(played)["plan"], "source": "demos"},
        "job": next(job["id"] for job in jobs if job["kind"] == "retraining"),
        "dataset": next(job["result"]["dataset"] for job in jobs if job["kind"] == "dataset"),
        "at": rfc3339(now()),
        "posed": client.get_json(f"/policies/kestrel/{POSED}")["sha256"],
    }


def ask(service: Service, row: Row, ids: dict[str, str]) -> httpx.Response | int:
    """Call an operation of the table; the status with which a session is closed or refused, 101 for an open one."""
    about, path = dict(ids), row.path
    if "pose-style" in path or "session" in path:
        about["suture"] = POSED
    source = path.split("/")[2] if path.startswith("/timelines") else "demos"
    of = {"demos": "demo", "recordings": "recording", "plans": "plan", "policy-versions": "posed"}
    about["digest"] = ids[of[source]]
    for name, value in about.items():
        path = path.replace(f"{{{name}}}", value)
    if row.method == "WEBSOCKET":
        return opened(service, path)
    how: dict[str, Any] = {"params": QUERIES.get(row.path, {})}
    how["params"] = {name: value.format(**ids) for name, value in how["params"].items()}
    if (body := BODIES.get(row.path)) is not None and row.method == "POST":
        how["json"] = json.loads(re.sub(r"\$(\w+)", lambda found: ids[found[1]], json.dumps(body)))
    headers = {"Accept": row.media} if row.media else {}
    return service.http.request(row.method, path, headers=headers, **how)


def opened(service: Service, path: str) -> int:
    try:
        with service.http.websocket_connect(f"ws://localhost{path}") as socket:
            socket.receive_json()
    except WebSocketDenialResponse as refused:
        return refused.status_code
    return 101


POINT = {"suture_points": [{"position_mm": GOAL_MM}], "handoff": "none"}
QUERIES = {
    "/plans/{plan}/trajectory": {"handoff": "none"},
    "/plans/{plan}/comparison": {"demo": "{demo}"},
    "/surgeons/{surgeon}/progress": {"suture": cases.SUTURE, "against": "kestrel"},
    "/styles/{suture}/recognition": {"recording": "{recording}"},
    "/history": KESTREL | {"at": "{at}"},
    "/pages/plans/new": KESTREL | {"version": "{version}"},
}
BODIES: dict[str, dict[str, Any]] = {
    "/datasets": EXPORTED | {"demos": ["$demo"]},
    "/trainings": KESTREL | {"seed": 7},
    "/retrainings": {"surgeon": "kestrel"},
    "/tries": KESTREL | {"recording": "$recording"},
    "/plans": KESTREL | POINT | {"version": 1},
    "/reach": KESTREL | {"handoff": "none", "version": 1, "size_mm": [0, 0, 0], "step_mm": 5},
    "/playbacks": {"plan": "$plan"},
    "/scores": KESTREL | {"demo": "$demo"},
    "/policies/{surgeon}/{suture}/next": {"position_mm": START_MM},
    "/policies/{surgeon}/{suture}/rollouts": {"start_mm": START_MM},
}


def test_every_operation_has_its_row(service: Service) -> None:
    listed = {f"{row.method} {named_in(row.path)}" for row in TABLE}
    there = {f"{method} {path}" for method, path, _ in routes(service)} | {"HEAD /policies/{surgeon}/{suture}"}
    assert listed == there | {"WEBSOCKET /policies/{surgeon}/{suture}/session"}
    assert len({row.named for row in TABLE}) == len(TABLE)
    formats = {(row.method, named_in(row.path), row.media) for row in TABLE}
    for path, operations in service.app.openapi()["paths"].items():
        for method, described in operations.items():
            others = {*described["responses"].get("200", {}).get("content", {})} - {"application/json"}
            if "application/json" in described["responses"].get("200", {}).get("content", {}):
                for media in others:
                    assert (method.upper(), path, media) in formats, (path, media)


OTHER = {"/styles/{suture}/recognition": 422, "/policies/{surgeon}/{suture}/release": 404}  # too few surgeons; not done
WALKED = [row for row in TABLE if asked_of(row) and "/events" not in row.path]


def status_of(said: httpx.Response | int) -> int:
    return said if isinstance(said, int) else said.status_code


def test_a_prefix_of_each_digest_gives_the_answer_of_the_digest(service: Service, ids: dict[str, str]) -> None:
    short = {name: value[:12] if len(value) == 64 else value for name, value in ids.items()}
    wrong = []
    for row in WALKED:
        if row.method == "GET":
            whole, begun = (ask(service, row, of) for of in (ids, short))
            if (whole.status_code, whole.content) != (begun.status_code, begun.content) and "/pages" not in row.path:
                wrong.append((row.named, whole.status_code, begun.status_code, begun.text[:80]))
            if status_of(whole) != status_of(begun):
                wrong.append(row.named)
    assert wrong == []


def test_without_any_use_each_operation_answers_as_the_table_says(service: Service, ids: dict[str, str]) -> None:
    for row in WALKED:
        if row.method != "DELETE":
            said = ask(service, row, ids)
            assert status_of(said) in (OTHER.get(row.path, 200), 101, 201, 202), (
                row.named,
                getattr(said, "text", said),
            )
    service.client.put_surgeon("kestrel", skill_level="expert", consent=NO_USE)
    sign_some_history(service.database)
    wrong = {}
    for row in WALKED:
        said = ask(service, row, ids)
        wanted = int(row.answer[:3]) if row.answer[:3].isdigit() else 200
        shown = isinstance(said, httpx.Response) and status_of(said) == 200 and has_motion(said)
        if status_of(said) != wanted or shown:
            wrong[row.named] = status_of(said)
        elif isinstance(said, httpx.Response) and wanted == 409:
            assert "consent" in said.text, row.named
    assert wrong == {}


def test_jobs_that_wait_when_the_uses_end_store_nothing(service: Service) -> None:
    before = service.counts()
    done = service.work()
    assert {one["kind"] for one in done} == {"training", "try", "dataset"}
    assert {one["state"] for one in done} == {"failed"}
    assert all("does not cover" in one["error"] for one in done)
    after = service.counts()
    changed = {name for name in before if after[name] != before[name]}
    assert changed <= {"history", "history_checkpoints", "history_tiles", "events"}


def has_motion(said: httpx.Response) -> bool:
    """Return whether a response has a long row of numbers, or is a file or a picture."""
    kind = said.headers["content-type"].partition(";")[0]
    if kind == "application/json":
        return longest(said.json()) > LONG
    drawn = re.findall(r' (?:d|points)="([^"]*)"', said.text) if kind == "text/html" else [said.text]
    return max((len(re.findall(r"\d+(?:\.\d+)?", one)) for one in drawn), default=0) > DRAWN


def longest(value: Any) -> int:
    if isinstance(value, dict):
        return max((longest(one) for one in value.values()), default=0)
    if not isinstance(value, list):
        return 0
    numbers = [one for one in value if isinstance(one, int | float) and not isinstance(one, bool)]
    triples = [one for one in value if isinstance(one, list) and all(isinstance(part, int | float) for part in one)]
    return max(len(numbers), len(triples), *(longest(one) for one in value), 0)
