"""A policy learnt in a scene over HTTP: requested, served, verified by a client, on its card and page, and refused."""

import io
from dataclasses import replace

import numpy as np
import pytest

from skills.errors import Corrupt
from skills.gridworld.scene import Box, Scene, Tissue
from skills.learning.policy import rollout_from
from skills.library.operation.inspection import inspect_installation
from skills.library.plans.description import differences
from tests.api.service import GOAL_MM, KESTREL, POLICY, Service, assert_problem
from tests.client.peers import rebuilt
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


def test_an_older_client_that_runs_the_actions_as_they_are_never_touches(trained: Service):
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


def test_in_a_forbidden_cell_nothing_is_commanded(trained: Service):
    about = in_scene(trained)
    inside = {"position_mm": [-20.0, 40.0, -120.0]}
    step = trained.http.post(f"{POLICY}/next", json=inside | {"phase": 0}).json()
    assert (step["action"], step["next_position_mm"], step["done"]) == (None, None, False)
    rollout = trained.client.rollout(**KESTREL, start_mm=inside["position_mm"])
    assert (rollout["finished"], len(rollout["states"])) == (False, 1)
    assert (rollout["finishing"], rollout["touching"]) == (0, 1)
    view = trained.http.get(f"/pages/styles/kestrel/simple-running/versions/{about['version']}/view")
    assert view.status_code == 200
    planned(trained, scene=FREE.as_json())
    assert [wrong for checked in inspect_installation(trained.database) for wrong in checked.wrong] == []


@pytest.mark.nightly  # pages; by day the served policy states them
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


FREE = replace(SCENE, tissue=Tissue.plane((0.0, 0.0, -160.0), (0.0, 0.0, 1.0)), boxes=())


def planned(service: Service, **asked) -> dict:
    return service.client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none", **asked)


def verdict_of(service: Service, plan: dict) -> dict:
    """Play a plan in the simulator, and return the playback."""
    service.client.play(plan["id"])
    done = [job for job in service.work() if job["kind"] == "playback"]
    return service.client.playback(done[-1]["result"]["playback"])


def test_a_plan_takes_the_scene_of_its_policy_and_its_tool_touches(trained: Service):
    """The fingers reach 10 mm below the tip, which is all that the grid world knows of the tool."""
    about = in_scene(trained)
    made = planned(trained)
    assert made["scene"]["sha256"] == made["scene"]["learnt_sha256"] == about["scene"]["sha256"]
    assert (made["scene"]["scene"], made["scene"]["differs"]) == (SCENE.as_json(), [])
    assert "It is checked against the scene of its policy" in made["description"]
    playback = verdict_of(trained, made)
    assert not playback["feasible"]
    assert playback["report"]["failure"]["quantity"] == "clearance of the scene"
    nearest = playback["report"]["scene"]["nearest"][0]
    assert (nearest["part"], nearest["body"]) == ("tissue", "PSM_A")
    assert nearest["least_mm"] < 0
    assert (
        f"{nearest['link']} is {nearest['least_mm']:.2f} mm from tissue, in pass 0, A1" in playback["headline"]["text"]
    )
    assert "Arms from tissue and obstacles" in trained.http.get(f"/pages/plans/{made['id']}").text
    bag = trained.http.get(f"/plans/{made['id']}/trajectory?handoff=none", headers={"Accept": "application/zip"})
    assert_problem(bag, 409)


def test_a_plan_may_state_another_scene_and_says_how_it_differs(trained: Service):
    in_scene(trained)
    made = planned(trained, scene=FREE.as_json())
    assert made["scene"]["sha256"] != made["scene"]["learnt_sha256"]
    assert made["scene"]["differs"] == ["box 0 of the learnt scene is not in this one", "the tissue is another one"]
    assert "not the one that its policy was learnt in: box 0 of the learnt scene" in made["description"]
    assert made["id"] != planned(trained)["id"]
    stranger = trained.http.post(
        "/plans",
        json={
            **KESTREL,
            "suture_points": [{"position_mm": GOAL_MM}],
            "handoff": "none",
            "scene": FREE.as_json() | {"frame": "PSM2_base"},
        },
    )
    assert "give the scene in that frame" in assert_problem(stranger, 422)["detail"]


@pytest.mark.nightly
def test_a_plan_far_from_its_scene_is_feasible_and_states_the_distance(trained: Service):
    made = planned(trained, scene=FREE.as_json())
    playback = verdict_of(trained, made)
    report = playback["report"]["scene"]
    assert playback["feasible"]
    assert report["limit_mm"] == 1.0 < report["at_least_mm"] <= report["nearest"][0]["least_mm"]
    assert "of which its policy knows nothing" in playback["headline"]["text"]


def test_a_plan_without_a_scene_says_that_no_tissue_is_checked(trained: Service):
    made = planned(trained)
    assert made["scene"] is None
    assert "Tissue: not given, so nothing is checked against it" in made["description"]
    stated = planned(trained, scene=FREE.as_json())
    assert (stated["scene"]["learnt_sha256"], stated["scene"]["differs"]) == (None, [])
    assert "of which its policy knows nothing" in stated["description"]


def test_the_differences_of_scenes_are_named():
    more = replace(SCENE, boxes=(Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), *SCENE.boxes), tissue=None, margin_mm=1.0)
    assert differences(more, SCENE) == [
        "box 0 is not in the learnt scene",
        "the tissue is missing",
        "the margin is 1 mm and not 0.5 mm",
    ]
    assert differences(SCENE, replace(SCENE, capsules=())) == ["capsule 0 is not in the learnt scene"]
    assert differences(SCENE, SCENE) == []
