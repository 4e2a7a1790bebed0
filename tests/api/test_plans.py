"""Plans, their motion, and the simulator's verdict."""

import csv
import io

import numpy as np
import pytest

from tests.api.service import GOAL_MM, KESTREL, Service, assert_problem

POINTS = [[5.0, 55.0, -125.0], [11.0, 55.0, -125.0], [17.0, 55.0, -125.0]]
QUARTER = [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]  # about z


def plan(service: Service, *points: list[float], **asked: object) -> dict:
    return service.client.plan(**KESTREL, suture_points=[{"position_mm": p} for p in points], **asked)


def test_every_pass_ends_on_its_suture_point(still: Service):
    made = plan(still, *POINTS)
    policy = still.client.policy(**KESTREL)
    assert [one["path_mm"][-1] for one in made["passes"]] == POINTS
    shape = np.subtract(made["passes"][0]["path_mm"], POINTS[0])
    for one, point in zip(made["passes"], POINTS, strict=True):
        assert one["states"] == policy["waypoints"]
        np.testing.assert_allclose(np.subtract(one["path_mm"], point), shape, rtol=0, atol=1e-9)
    assert (made["arm"], made["frame"], made["instrument"]) == (policy["arm"], policy["frame"], policy["instrument"])
    assert made["path"] == "fitted"
    assert made["policy"] == {"version": 1, "sha256": policy["sha256"]}
    assert still.client.plan_of(made["id"]) == made


def test_a_turned_suture_point_turns_the_pass_about_it(still: Service):
    straight = plan(still, POINTS[0])["passes"][0]
    points = [{"position_mm": POINTS[0], "rotation_xyzw": QUARTER}]
    turned = still.client.plan(**KESTREL, suture_points=points)["passes"][0]
    x, y, z = np.subtract(straight["path_mm"], POINTS[0]).T
    np.testing.assert_allclose(np.subtract(turned["path_mm"], POINTS[0]), np.stack([-y, x, z], axis=1), atol=1e-9)


def test_the_same_plan_is_stored_once(still: Service):
    body = KESTREL | {"suture_points": [{"position_mm": GOAL_MM}], "speed_mm_s": 12.5}
    first, second = (still.http.post("/plans", json=body) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json() == second.json()
    assert first.headers["Location"] == f"/plans/{first.json()['id']}"


@pytest.mark.parametrize(
    ("asked", "status", "words"),
    [
        ({"arm": "PSM9"}, 422, "arm"),
        ({"frame": "ECM"}, 422, "frame"),
        ({"instrument": "420000"}, 422, "instrument"),
        ({"starts_mm": [[100.0, 55.0, -125.0]]}, 422, "Pass 0"),
        ({"starts_mm": [None, None]}, 422, "one start for each"),
        ({"suture_points": [{"position_mm": GOAL_MM}, {"position_mm": [400.0, 0.0, -20.0]}]}, 422, "pass 1"),
        ({"suture_points": []}, 422, ""),
        ({"suture_points": [{"position_mm": GOAL_MM, "rotation_xyzw": [0, 0, 0, 0]}]}, 422, ""),
        ({"psm_m": {"approach": [0.0, 0.0, 0.0]}}, 422, ""),
        ({"version": 9}, 404, "no version 9"),
        ({"surgeon": "nobody"}, 404, "nobody"),
        ({"speed_mm_s": 0}, 422, ""),
    ],
)
def test_a_plan_that_the_arm_cannot_follow_is_refused(still: Service, asked: dict, status: int, words: str):
    before = still.counts()
    body = KESTREL | {"suture_points": [{"position_mm": GOAL_MM}]} | asked
    problem = assert_problem(still.http.post("/plans", json=body), status)
    assert words.lower() in problem["detail"].lower(), problem["detail"]
    assert still.counts() == before


def test_the_trajectory_is_the_same_as_json_and_as_a_table(still: Service):
    made = plan(still, *POINTS[:2])
    path = f"/plans/{made['id']}/trajectory"
    as_json = still.http.get(path).json()
    table = list(csv.reader(io.StringIO(still.http.get(path, headers={"Accept": "text/csv"}).text)))
    assert table[0] == as_json["columns"]
    assert [[float(cell) for cell in row] for row in table[1:]] == as_json["rows"]
    assert len(as_json["rows"]) == made["trajectory"]["samples"]
    at = as_json["columns"].index("x_mm")
    np.testing.assert_allclose(as_json["rows"][-1][at : at + 3], POINTS[1], atol=1e-6)
    assert_problem(still.http.get(path, headers={"Accept": "application/zip"}), 415)


def test_a_plan_is_played_in_the_simulator_and_found_feasible(trained: Service):
    made = plan(trained, GOAL_MM)
    answer = trained.http.post("/playbacks", json={"plan": made["id"]})
    assert answer.status_code == 202
    assert trained.client.play(made["id"])["id"] == answer.json()["id"]
    [job] = trained.work()
    assert job["state"] == "succeeded", job["error"]
    assert trained.http.post("/playbacks", json={"plan": made["id"]}).status_code == 200
    playback = trained.client.playback(job["result"]["playback"])
    assert playback["feasible"]
    assert playback["plan"] == made["id"]
    assert playback["report"]["failure"] is None
    assert trained.client.picture(playback["id"]).startswith(b"\x89PNG\r\n\x1a\n")
    assert_problem(trained.http.post("/playbacks", json={"plan": "0" * 64}), 404)
    assert_problem(trained.http.get(f"/playbacks/{'0' * 64}/picture.png"), 404)
