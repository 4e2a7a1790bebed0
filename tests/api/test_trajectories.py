"""The motion of a plan: as numbers, and as the bag that a robot replays, which needs permission."""

import csv
import io
import json
import zipfile
from unittest.mock import ANY

import numpy as np
import pytest
from sqlalchemy import select

from skills.client import Problem
from skills.db.service_tables import Job
from skills.formats.verify import verify_bag
from tests.api.service import GOAL_MM, KESTREL, Service, assert_problem
from tests.library import cases
from tests.needs import need

ZIP = {"Accept": "application/zip"}
POINTS = [[5.0, 55.0, -125.0], [11.0, 55.0, -125.0]]


def plan(service: Service, *points: list[float], **asked: object) -> dict:
    """Plan passes; unless PSM_M is given they have no hand-off."""
    if "psm_m" not in asked:
        asked = {"handoff": "none"} | asked
    points_of = [{"position_mm": p} for p in points]
    return service.client.plan(**KESTREL, suture_points=points_of, **({"tissue_mm": -170.0} | asked))


def play(service: Service, made: dict) -> dict:
    """Play a plan in the simulator, and return the verdict."""
    need("simulator")
    asked = service.client.play(made["id"])["id"]
    with service.database.reading() as session:
        job = session.scalars(select(Job).where(Job.id == asked)).one()
    done = cases.work(service.database, job)  # this job only: another one draws the pictures, which takes seconds
    assert done.state == "succeeded", done.error
    return service.client.playback(done.result["playback"])


# ---- numbers


def test_the_trajectory_is_the_same_as_json_and_as_a_table(still: Service):
    made = plan(still, *POINTS)
    path = f"/plans/{made['id']}/trajectory"
    as_json = still.client.trajectory(made["id"])
    table = list(csv.reader(io.StringIO(still.http.get(path, headers={"Accept": "text/csv"}).text)))
    assert table[0] == as_json["columns"]
    assert [[float(cell) for cell in row] for row in table[1:]] == as_json["rows"]
    assert len(as_json["rows"]) == made["trajectory"]["samples"]
    assert as_json["rate_hz"] == made["trajectory"]["rate_hz"]
    at = as_json["columns"].index("x_mm")
    np.testing.assert_allclose(as_json["rows"][-1][at : at + 3], POINTS[1], atol=1e-6)


def test_one_pass_alone_is_a_part_of_the_whole(still: Service):
    made = plan(still, *POINTS)
    whole = still.client.trajectory(made["id"])["rows"]
    first, second = (still.client.trajectory(made["id"], number)["rows"] for number in (0, 1))
    assert first + second == whole
    assert {row[1] for row in second} == {1}
    path = f"/plans/{made['id']}/trajectory"
    assert_problem(still.http.get(path, params={"pass": 2}), 422, "bad-plan")
    for none in (-1, 200, "one"):
        assert_problem(still.http.get(path, params={"pass": none}), 422, "invalid-request")


def test_the_first_accepted_format_is_sent_and_an_unchanged_one_gives_304(still: Service):
    path = f"/plans/{plan(still, GOAL_MM)['id']}/trajectory"
    first = still.http.get(path, headers={"Accept": "image/png, text/csv, application/json"})
    assert first.headers["content-type"].startswith("text/csv")
    assert still.http.get(path).headers["content-type"] == "application/json"
    again = still.http.get(path, headers={"Accept": "text/csv", "If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert_problem(still.http.get(path, headers={"Accept": "image/png"}), 415, "unknown-format")
    for accept in ("application/json", "text/csv", "application/zip"):
        nowhere = still.http.get(f"/plans/{'0' * 64}/trajectory", headers={"Accept": accept})
        assert_problem(nowhere, 404, "not-found")


# ---- the bag


def test_a_bag_needs_a_playback_release_consent_and_demo_that_still_stand(trained: Service):
    made, other = plan(trained, GOAL_MM), plan(trained, GOAL_MM, speed_mm_s=10.0)
    path = f"/plans/{made['id']}/trajectory"
    assert "has no hand-off" in assert_problem(trained.http.get(path, headers=ZIP), 409, "conflict")["detail"]
    path += "?handoff=none"

    def refused() -> str:
        return assert_problem(trained.http.get(path, headers=ZIP), 409, "conflict")["detail"]

    assert "POST /playbacks" in refused()
    assert play(trained, other)["feasible"]
    assert "POST /playbacks" in refused()  # another plan's playback does not count
    verdict = play(trained, made)
    assert verdict["feasible"], verdict["report"]

    answer = trained.http.get(path, headers=ZIP)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == f'attachment; filename="replay-{made["id"][:12]}.zip"'
    assert answer.content == trained.client.replay_bag(made["id"], handoff="none")
    file = io.BytesIO(answer.content)
    lines = verify_bag(file)
    assert verdict["id"][:12] in lines[1]
    with zipfile.ZipFile(file) as archive:
        assert json.loads(archive.read("verdict.json"))["report"] == verdict["report"]
        index = trained.client.segments(made["id"])
        assert json.loads(archive.read("segments.json")) == index | {"use": ANY}
    assert [one["name"] for one in index["segments"]] == ["000-A1"]

    trained.client.withdraw(**KESTREL)
    assert "none is released" in refused()
    with pytest.raises(Problem, match="none is released"):
        trained.client.replay_bag(made["id"], handoff="none")
    assert trained.http.get(path).status_code == 200  # the numbers alone move no robot
    trained.client.release(**KESTREL, version=1)
    assert trained.http.get(path, headers=ZIP).content == answer.content
    trained.client.put_surgeon("kestrel", consent={"uses": ["training"]})
    assert "does not cover export" in refused()
    trained.client.put_surgeon("kestrel", consent={"uses": ["training", "export"]})
    trained.client.withdraw_demo(trained.client.demos()[0]["id"])
    assert "demonstration" in refused()
