"""Suture points from a simulator's recording, and a plan with them."""

import numpy as np
import pytest

from tests.api.service import GOAL_MM, KESTREL, MCAP, Service, assert_problem
from tests.formats.test_suture_points import scene, world

UNTURNED = (0.0, 0.0, 0.0, 1.0)
MARKS = {f"{kind}{k + 1}": ((x + 0.006 * k, 0.055, -0.125), UNTURNED) for kind, x in (("Entry", 0.0), ("Exit", 0.005)) for k in range(3)}  # fmt: skip  # noqa: E501


def test_the_exits_of_a_scene_become_the_suture_points_of_a_plan(still: Service):
    before = still.counts()
    found = still.client.suture_points(scene(world(marks=MARKS)), arm="PSM2")
    assert still.counts() == before
    assert (found["arm"], found["frame"]) == ("PSM2", "PSM2_base")
    assert [one["name"] for one in found["points"]] == ["Entry1", "Exit1", "Entry2", "Exit2", "Entry3", "Exit3"]
    goals = [one for one in found["points"] if one["is_goal"]]
    assert {one["kind"] for one in goals} == {"exit"}
    points = [{"position_mm": one["position_mm"], "rotation_xyzw": one["turn_xyzw"]} for one in goals]
    plan = still.client.plan(**KESTREL, suture_points=points, handoff="none")
    for k, one in enumerate(plan["passes"]):
        np.testing.assert_allclose(one["path_mm"][-1], np.add(GOAL_MM, [6.0 * k, 0.0, 0.0]), atol=1e-6)


@pytest.mark.parametrize(
    ("body", "query", "status", "words"),
    [
        (scene(world(base=None)), {}, 422, "T_b_w"),
        (scene(world()), {"arm": "PSM1"}, 422, "T_b_w"),
        (scene([("/CRTK/psm2/measured_cp", (0, 0.05, -0.1), UNTURNED, "b")]), {}, 422, "Entry or Exit"),
        (scene(world())[:500], {}, 422, "truncated"),
        (b"t_s,x_mm\n1,2\n", {}, 415, "table"),
        (scene(world()), {"colour": "red"}, 422, ""),
    ],
)
def test_what_holds_no_suture_points_for_an_arm_is_refused(still: Service, body, query, status, words):
    answer = still.http.post("/suture-points", content=body, params=query, headers={"Content-Type": MCAP})
    problem = assert_problem(answer, status)
    assert words in problem["detail"], problem["detail"]


def test_a_statement_about_tables_is_no_parameter_of_a_scene(still: Service):
    for name, said in (("rate_hz", 30), ("unit", "mm"), ("decimal", "comma"), ("table_arm", "PSM2")):
        answer = still.http.post(
            "/suture-points", content=scene(world()), params={name: said}, headers={"Content-Type": MCAP}
        )
        (error,) = assert_problem(answer, 422)["errors"]
        assert "unknown field" in error["why"]
    call = still.http.get("/openapi.json").json()["paths"]["/suture-points"]["post"]
    assert {one["name"] for one in call["parameters"] if one["in"] == "query"} == {"arm", "frame"}


def test_the_frame_may_be_named_as_the_arms(still: Service):
    local = [("/CRTK/Exit1/measured_cp", (0.005, 0.055, -0.125), UNTURNED, "psm2/baselink")]
    found = still.client.suture_points(scene(local), frame="psm2/baselink")
    assert found["frame"] == "psm2/baselink"
    assert found["points"][0]["position_mm"] == pytest.approx(GOAL_MM)
