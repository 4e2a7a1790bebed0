"""The JSON and the arrays of a policy by another joining rule, and a client that follows them."""

import io

import numpy as np
import pytest

from skills.errors import Corrupt
from skills.learning.policy import rollout_from
from tests.api.service import KESTREL, POLICY, Service, assert_problem
from tests.client.peers import rebuilt
from tests.gridworld.paths import follow

NPZ = {"Accept": "application/x-npz"}
HALF = {"kind": "phase-q-learning", "join_share": 0.5}


def by_rule(service: Service) -> dict:
    service.client.train(**KESTREL, learner=HALF, release=True)
    service.work()
    return service.http.get(POLICY).json()


def test_a_client_follows_the_json_by_its_joining_table_from_every_start(trained: Service):
    about = by_rule(trained)
    assert about["joining"]["join_share"] == 0.5
    table = dict(zip(about["joining"]["states"], about["joining"]["phases"], strict=True))
    actions, shape = np.array(about["actions"]), tuple(about["grid"]["shape"])
    policy = rebuilt(about, trained.http.get(POLICY, headers=NPZ).content, demo_of(trained, about))
    for start in range(0, np.prod(shape), 7):
        states, finished = follow(actions, shape, about["waypoints"], start, table)
        assert finished
        assert states == rollout_from(policy, start).states.tolist()
        assert share_followed(states, about["waypoints"]) >= 0.5


def share_followed(states: list[int], waypoints: list[int]) -> float:
    alike = next((k for k in range(len(waypoints)) if states[-len(waypoints) + k :] == waypoints[k:]), len(waypoints))
    return (len(waypoints) - 1 - alike) / (len(waypoints) - 1)


def demo_of(service: Service, about: dict) -> dict:
    return service.http.get(f"/demos/{about['demos'][0]}").json()


def test_the_joining_table_is_in_the_json_the_arrays_and_the_digest(trained: Service):
    assert trained.http.get(POLICY).json()["joining"] is None, "by the rule nearest"
    about = by_rule(trained)
    sent, demo = trained.http.get(POLICY, headers=NPZ).content, demo_of(trained, about)
    with np.load(io.BytesIO(sent)) as arrays:
        table = {int(state): int(arrays["joins"][state]) for state in np.flatnonzero(arrays["joins"])}
        assert table == dict(zip(about["joining"]["states"], about["joining"]["phases"], strict=True))
        actions = np.array(about["actions"])[arrays["phase"], arrays["state"]]
        assert actions.tolist() == arrays["action"].tolist()
        assert arrays["share"].mean() == about["coverage"]["mean_share"]
    rebuilt(about, sent, demo)
    moved = about["joining"] | {"phases": [phase + 1 for phase in about["joining"]["phases"]]}
    for other in (moved, None):
        with pytest.raises(Corrupt, match="does not match its digest"):
            rebuilt(about | {"joining": other}, sent, demo)


def test_next_and_rollouts_follow_the_rule_and_older_versions_come_back(trained: Service):
    about = by_rule(trained)
    goal = trained.http.post(f"{POLICY}/next", json={"position_mm": about["goal_mm"]}).json()
    assert (goal["done"], goal["phase"]) == (False, 0), "the goal is no place to join"
    walk = trained.http.post(f"{POLICY}/rollouts", json={"start_mm": about["goal_mm"]}).json()
    assert walk["finished"]
    assert share_followed(walk["states"], about["waypoints"]) >= 0.5
    assert trained.client.release(**KESTREL, version=1)["version"] == 1
    assert "actions" in trained.http.get(POLICY).json()


@pytest.mark.parametrize("learner", [{"kind": "cell-q-learning", "join_share": 0.5}, HALF | {"join_share": 1.5}])
def test_a_rule_that_a_learner_cannot_follow_is_refused_at_once(still: Service, learner: dict):
    assert_problem(still.http.post("/trainings", json=KESTREL | {"learner": learner}), 422)
