"""`POST /reach`: its places agree with the plans and playbacks of the same service, and it is bounded."""

import numpy as np
import pytest

from tests.api.service import GOAL_MM, KESTREL, Service, assert_problem

PSM_M = {
    "approach": [-0.94, 0.10, -0.33],
    "base": {"position_mm": [160, 20, 20], "rotation_xyzw": [0, 0, 0.382683, 0.92388]},
}
QUARTER = [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]


def test_places_are_where_plans_are_made(still: Service):
    """Beyond the arm's reach the plan of a place is refused, and where it is `yes` it is made."""
    asked = {"psm_m": PSM_M, "tissue_mm": -165.0}
    found = still.client.reach(
        **KESTREL, size_mm=(300, 0, 200), step_mm=50, rotations_xyzw=[[0, 0, 0, 1], QUARTER], **asked
    )
    places = found["places"]
    assert (found["counts"], found["rotations"], len(places)) == ([7, 1, 5], 2, 70)
    at = np.array([one["position_mm"] for one in places])
    np.testing.assert_allclose(at[:35].mean(axis=0), GOAL_MM, atol=1e-6)
    np.testing.assert_allclose(at[35:], at[:35])
    for kind, status in (("yes", 201), ("no", 422)):
        one = next(place for place in places if place["reach"] == kind and "bodies" != place["limited_by"] != "scene")
        point = {name: one[name] for name in ("position_mm", "rotation_xyzw")}
        answer = still.http.post("/plans", json=KESTREL | asked | {"suture_points": [point]})
        assert answer.status_code == status, (one, answer.text)
    assert f"{sum(one['reach'] == 'yes' for one in places)} of 70 places can be planned" in found["description"]


def test_a_map_is_bounded(still: Service):
    answer = still.http.post("/reach", json=KESTREL | {"size_mm": [400, 400, 400], "step_mm": 10, "handoff": "none"})
    assert_problem(answer, 422)
    assert "Give a step of 41 mm" in answer.text
    coarse = still.client.reach(**KESTREL, size_mm=(400, 400, 400), step_mm=41, handoff="none")
    assert len(coarse["places"]) == 1000


@pytest.mark.parametrize(
    "wrong", [{"step_mm": 0.5}, {"rotations_xyzw": []}, {"size_mm": [-1, 0, 0]}, {"suture_points": []}]
)
def test_what_is_no_map_is_refused(still: Service, wrong):
    assert_problem(still.http.post("/reach", json=KESTREL | {"handoff": "none"} | wrong), 422)


def test_a_map_without_psm_m_says_so(still: Service):
    assert_problem(still.http.post("/reach", json=KESTREL), 422)
