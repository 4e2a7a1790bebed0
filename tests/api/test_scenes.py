"""A policy learnt in a scene over HTTP: requested, served, verified by a client, on its card and page, and refused."""

import io

import numpy as np
import pytest

from skills.client.policies import rebuilt
from skills.errors import Corrupt
from skills.gridworld.scene import Scene
from skills.learning.policy import rollout_from
from tests.api.service import KESTREL, POLICY, Service, assert_problem
from tests.gridworld.paths import follow
from tests.library.test_scenes import SCENE

EXACT = {"kind": "value-iteration", "gamma": 0.95, "slip": 0.1}
TISSUE = SCENE.as_json()["tissue"]
NPZ = {"Accept": "application/x-npz"}


def in_scene(service: Service, **more) -> dict:
    """Train and release kestrel's style in a scene, and return the policy as it is served."""
    job = service.train(**{"learner": EXACT, "scene": SCENE.as_json(), "release": True} | more)
    assert job["result"]["released"], job
    return service.http.get(POLICY).json()


def test_the_served_policy_carries_its_scene_and_a_client_verifies_it(trained: Service):
    about = in_scene(trained, scene_costs={"close": 0.2})
    assert Scene.of_json(about["scene"]["scene"]) == SCENE
    assert about["scene"]["costs"]["close"] == 0.2
    assert about["scene"]["near"]["touching"] <= 0.05
    arrays, demo = trained.http.get(POLICY, headers=NPZ).content, trained.client.get_json(f"/demos/{about['demos'][0]}")
    policy = rebuilt(about, arrays, demo)
    assert policy.surroundings.scene == SCENE
    with np.load(io.BytesIO(arrays)) as sent:
        start = policy.path.start
        rollout = trained.client.rollout(**KESTREL, start_mm=about["start_mm"])
        assert (sent["finishing"][start], sent["touching"][start]) == (rollout["finishing"], rollout["touching"])
    thinner = about["scene"] | {"scene": about["scene"]["scene"] | {"margin_mm": 0.25}}
    with pytest.raises(Corrupt, match="does not match its digest"):
        rebuilt(about | {"scene": thinner}, arrays, demo)


def test_a_client_of_before_that_runs_the_actions_as_they_are_never_touches(trained: Service):
    about = in_scene(trained)
    assert not {"format", "actions_joining"} & set(about)
    actions, shape = np.array(about["actions"]), tuple(about["grid"]["shape"])
    policy = rebuilt(
        about, trained.http.get(POLICY, headers=NPZ).content, trained.client.get_json(f"/demos/{about['demos'][0]}")
    )
    for start in range(0, np.prod(shape), 5):
        states, finished = follow(actions, shape, about["waypoints"], start)
        assert finished == rollout_from(policy, start).finished == (not policy.hazards.forbidden[start])
        centres = policy.path.grid.centres_mm(np.array(states))
        assert not finished or not SCENE.touches(centres[:-1], centres[1:]).any()


def test_card_and_page_state_the_scene_and_its_odds(trained: Service):
    about = in_scene(trained)
    near = about["scene"]["near"]
    card = trained.client.get_json(f"{POLICY}/versions/{about['version']}/card")
    assert "learnt in a scene (1 box, 1 capsule, tissue; SHA-256" in card["coverage"]["in_words"]
    assert f"finishes with a probability of at least {near['finishing']:.1%}" in card["coverage"]["in_words"]
    assert not any("the grid world has none" in one for one in card["limits"]["not_checked"])
    page = trained.http.get("/pages/styles/kestrel/simple-running").text
    assert "Learnt in a scene" in page
    assert "Touches, near the demonstrated start" in page


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        ({"frame": "PSM_base", "boxes": [{"low_mm": [0, 0, 0]}]}, "high_mm"),
        ({"frame": "PSM_base", "boxes": [{"low_mm": [0, 0, 0], "high_mm": [0, 1, 1]}]}, "below high_mm"),
        ({"frame": "PSM_base", "meshes": []}, "unknown field"),
        ({"frame": "PSM_base", "margin_mm": 1e300}, "margin_mm"),
        ({"frame": "PSM_base", "boxes": [{"low_mm": [0, 0, 0], "high_mm": [1, 1, 1]}] * 65}, "64"),
        (SCENE.as_json() | {"tissue": TISSUE | {"step_mm": 1e-9}}, "0.1 or more"),
        (
            SCENE.as_json() | {"tissue": TISSUE | {"heights_mm": [[0.0] * 101] * 100}},
            "10000 heights",
        ),
        (SCENE.as_json() | {"tissue": TISSUE | {"along": [0, 0, 1]}}, "perpendicular"),
        (SCENE.as_json() | {"frame": "PSM2_base"}, "PSM2_base"),
        (SCENE.as_json() | {"margin_mm": 9.0}, "itself touches the scene"),
    ],
)
def test_an_impossible_scene_is_refused_and_says_why(trained: Service, scene, says):
    before = trained.counts()
    answer = trained.http.post("/trainings", json={**KESTREL, "learner": EXACT, "scene": scene})
    assert says in str(assert_problem(answer, 422))
    assert trained.counts() == before


def test_a_learner_without_phases_is_refused_in_a_scene(trained: Service):
    body = {**KESTREL, "learner": {"kind": "q-learning"}, "scene": SCENE.as_json()}
    kinds = trained.http.get("/openapi.json").json()["components"]["schemas"]
    body["learner"]["kind"] = kinds["CellQLearning"]["properties"]["kind"]["const"]
    assert "does not learn in a scene" in assert_problem(trained.http.post("/trainings", json=body), 422)["detail"]


def test_a_gamma_that_lets_the_goal_vanish_fails_the_job_and_says_so(trained: Service):
    job = trained.train(learner={**EXACT, "gamma": 0.001}, scene=SCENE.as_json(), scene_costs={"touch": 1e6})
    assert job["state"] == "failed"
    assert "use a gamma nearer to 1" in job["error"]
