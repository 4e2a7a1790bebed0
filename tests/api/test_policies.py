"""Training, releasing, serving and following a policy, and the requests that are refused."""

import hashlib
import io
import threading
import time

import numpy as np
import orjson
import pytest

from skills.client import Problem
from skills.client.blocking.client import Client
from skills.errors import BadSettings
from skills.gridworld.reward import sparse_reward
from skills.learning.policy import learn_tabular, learner_of
from skills.learning.q_learning import CellQLearning
from tests import backends
from tests.api.service import CSV, GOAL_MM, KESTREL, POLICY, Service, assert_problem, copy_of_trained, serving
from tests.library import cases

FIELDS = (
    {"version", "sha256", "surgeon", "suture", "arm", "frame", "instrument", "grid", "start_mm", "goal_mm", "waypoints"}
    | {"phases", "actions", "learner", "settings", "seed", "demos", "metrics", "coverage", "grid_certificate"}
    | {"released_at", "released_by"}
)
NPZ = {"Accept": "application/x-npz"}
PUBLISHED = {"kind": "cell-q-learning", "alpha": 0.1, "gamma": 0.01, "epsilon_end": 0.0, "epsilon_falls_over": 0.5}


# ---- training


def test_a_request_is_resolved_at_once_and_gives_one_job(trained: Service):
    first = trained.http.post("/trainings", json=KESTREL | {"seed": 7})
    job = first.json()
    assert (first.status_code, job["state"], first.headers["Location"]) == (202, "queued", f"/jobs/{job['id']}")
    assert job["request"]["demos"] == [trained.client.demos()[0]["id"]]
    assert job["request"]["learner"]["kind"] == "phase-q-learning"
    assert trained.http.post("/trainings", json=KESTREL | {"seed": 7}).json()["id"] == job["id"]
    assert trained.client.train(**KESTREL, seed=8)["id"] != job["id"]
    assert trained.client.train(**KESTREL, seed=7, release=True)["id"] != job["id"]
    trained.work()
    again = trained.http.post("/trainings", json=KESTREL | {"seed": 7})
    assert (again.status_code, again.json()["id"], again.json()["state"]) == (200, job["id"], "succeeded")


def test_after_a_failure_or_a_cancellation_the_same_request_is_a_new_job(trained: Service):
    job = trained.client.train(**KESTREL, seed=7)
    assert trained.client.cancel(job["id"])["state"] == "cancelled"
    assert trained.work() == []
    assert [v["version"] for v in trained.client.versions(**KESTREL)] == [1]
    second = trained.client.train(**KESTREL, seed=7)
    assert second["id"] != job["id"]
    with trained.database.writing() as session:
        session.get_one(cases.Job, 3).state = "failed"
    third = trained.client.train(**KESTREL, seed=7)
    assert third["id"] not in (job["id"], second["id"])
    assert trained.work()[-1]["state"] == "succeeded"
    assert trained.client.versions(**KESTREL)[0]["seed"] == 7
    with pytest.raises(Problem, match="ended already"):
        trained.client.cancel(third["id"])


def test_training_does_not_release_unless_asked(service: Service):
    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    result = service.train()["result"]
    assert (result["releasable"], result["released"], result["not_released_because"]) == (True, False, None)
    problem = assert_problem(service.http.get(POLICY), 404, "not-found")
    assert problem["numbers"]["candidates"] == [{"version": 1, "sha256": result["sha256"], "releasable": True}]
    assert "versions/1/release" in problem["detail"]


def test_the_events_of_a_job_tell_its_states_to_the_end(trained: Service):
    job = trained.client.train(**KESTREL, seed=9)
    worker = threading.Thread(target=lambda: (time.sleep(0.5), trained.work()))
    worker.start()
    answer = trained.http.get(f"/jobs/{job['id']}/events")
    worker.join()
    assert answer.headers["content-type"].startswith("text/event-stream")
    told = [orjson.loads(line[6:]) for line in answer.text.splitlines() if line.startswith("data: ")]
    assert (told[0]["state"], told[-1]["state"]) == ("queued", "succeeded")
    assert told[-1] == trained.client.job(job["id"])
    assert_problem(trained.http.get(f"/jobs/{'0' * 16}/events"), 404, "not-found")


# ---- serving


def test_a_policy_has_every_field_of_the_interface(still: Service):
    policy = still.client.policy(**KESTREL)
    assert set(policy) >= FIELDS
    assert (policy["version"], policy["surgeon"], policy["released_by"]) == (1, "kestrel", "local")
    n_states = np.prod(policy["grid"]["shape"])
    assert np.shape(policy["actions"]) == (policy["phases"], n_states)
    assert policy["phases"] == len(policy["waypoints"]) == policy["metrics"]["path_states"]
    assert (policy["start_mm"], policy["goal_mm"]) == (cases.CORNERS_MM[0].tolist(), GOAL_MM)
    assert policy["coverage"]["starts_reaching_goal"] == policy["coverage"]["n_states"] == n_states
    assert policy["metrics"]["dtw_total_mm"] == 0
    assert policy["grid_certificate"]["refused_because"] == []
    assert "accuracy" in policy["grid_certificate"]["note"]


def test_above_its_limit_the_json_has_the_actions_of_the_domain_alone(tmp_path, monkeypatch):
    with serving(copy_of_trained(tmp_path)) as service:
        policy = service.client.policy(**KESTREL)
        entries = policy["phases"] * policy["coverage"]["n_states"]
        monkeypatch.setattr("skills.schemas.policy_document.MAX_JSON_ACTIONS", entries - 1)
        served = service.http.get(f"/policy-versions/{policy['sha256']}").json()
        assert served["actions"] is None
        assert policy["live_actions"] is None
        for row, box in zip(policy["actions"], served["live_actions"], strict=True):
            cells = [range(low, low + size) for low, size in zip(box["low"], box["size"], strict=True)]
            inside = np.ravel_multi_index(np.meshgrid(*cells, indexing="ij"), policy["grid"]["shape"]).ravel()
            assert box["actions"] == np.array(row)[inside].tolist()
            assert set(np.delete(row, inside).tolist()) <= {-2}
        client = Client(service.http)
        assert client.learnt(**KESTREL, version=1).table().tolist() == policy["actions"]
        typed = client.policy(**KESTREL, version=1).live_actions
        assert [box.model_dump() for box in typed or ()] == served["live_actions"]
        path, _, accept = served["arrays"].partition(" with Accept: ")
        arrays = np.load(io.BytesIO(service.http.get(path, headers={"Accept": accept}).content))
        table = np.full(np.shape(policy["actions"]), -2)
        table[arrays["phase"], arrays["state"]] = arrays["action"]
        assert table.tolist() == policy["actions"]


def test_the_arrays_agree_with_the_json(still: Service):
    policy = still.client.policy(**KESTREL)
    answer = still.http.get(POLICY, headers=NPZ)
    assert answer.headers["content-type"] == NPZ["Accept"]
    arrays = np.load(io.BytesIO(answer.content))
    table = np.full(np.shape(policy["actions"]), -2)
    table[arrays["phase"], arrays["state"]] = arrays["action"]
    assert table.tolist() == policy["actions"]
    live = arrays["action"] >= 0
    q, chosen = arrays["q"][live], arrays["action"][live]
    assert q[np.arange(len(q)), chosen] == pytest.approx(q.max(axis=1), rel=1e-9, abs=0)  # of equals, as `ties` says
    assert arrays["waypoints"].tolist() == policy["waypoints"]
    assert arrays["sha256"].tobytes().hex() == policy["sha256"]
    assert int(arrays["reaches_goal"].sum()) == policy["coverage"]["starts_reaching_goal"]
    assert still.client.policy_arrays(policy["sha256"]) == answer.content


def test_an_etag_names_the_exact_bytes(still: Service):
    tags = set()
    for path, headers in ((POLICY, {}), (POLICY, NPZ), (f"{POLICY}/versions/1", {})):
        answer = still.http.get(path, headers=headers)
        tag = answer.headers["etag"]
        assert tag == f'"{hashlib.sha256(answer.content).hexdigest()}"'
        assert answer.headers["vary"] == "Accept"
        assert still.http.get(path, headers=headers).content == answer.content
        for match in (tag, f'"other", {tag}'):
            unchanged = still.http.get(path, headers=headers | {"If-None-Match": match})
            assert (unchanged.status_code, unchanged.content, unchanged.headers["etag"]) == (304, b"", tag)
        assert still.http.get(path, headers=headers | {"If-None-Match": '"other"'}).status_code == 200
        tags.add(tag)
    assert len(tags) == 3
    assert_problem(still.http.get(POLICY, headers={"Accept": "text/html"}), 415, "unknown-format")


def test_a_release_may_ask_that_nobody_was_faster(trained: Service):
    trained.train(seed=2)
    tag = trained.http.get(POLICY).headers["etag"]
    second = f"{POLICY}/versions/2/release"
    assert_problem(trained.http.post(second, headers={"If-Match": '"other"'}), 412, "precondition-failed")
    assert trained.client.policy(**KESTREL)["version"] == 1
    assert trained.http.post(second, headers={"If-Match": tag}).status_code == 200
    assert_problem(trained.http.post(f"{POLICY}/versions/1/release", headers={"If-Match": tag}), 412)
    assert trained.http.get(POLICY, headers={"If-None-Match": tag}).json()["version"] == 2


def test_releasing_an_older_version_rolls_back(trained: Service):
    trained.train(seed=2, release=True)
    assert trained.client.policy(**KESTREL)["version"] == 2
    trained.client.release(**KESTREL, version=1)
    assert trained.client.policy(**KESTREL)["version"] == 1
    rows = trained.counts()["releases"]
    trained.client.release(**KESTREL, version=1)
    assert trained.counts()["releases"] == rows
    assert [p["version"] for p in trained.client.policies()] == [1]


def test_after_a_withdrawal_nothing_older_comes_back_by_itself(trained: Service):
    trained.train(seed=2, release=True)
    trained.client.withdraw(**KESTREL)
    problem = assert_problem(trained.http.get(POLICY), 404, "not-found")
    assert [c["version"] for c in problem["numbers"]["candidates"]] == [2, 1]
    assert trained.client.policies() == []
    assert_problem(trained.http.delete(f"{POLICY}/release"), 404)
    assert trained.client.policy(**KESTREL, version=1)["released_at"] is None


# ---- the gate


def test_what_the_published_parameters_learn_is_refused_with_reasons(trained: Service):
    assert CellQLearning.published().alpha == PUBLISHED["alpha"]
    result = trained.train(learner=PUBLISHED, release=True)["result"]
    assert (result["releasable"], result["released"]) == (False, False)
    assert "do not reach the goal" in result["not_released_because"]
    problem = assert_problem(trained.http.post(f"{POLICY}/versions/2/release"), 409, "conflict")
    assert any("starts do not reach" in reason for reason in problem["numbers"]["reasons"])
    assert trained.client.policy(**KESTREL)["version"] == 1


def test_what_value_iteration_finds_is_released_without_a_move_of_the_arm(trained: Service):
    result = trained.train(learner={"kind": "value-iteration"}, release=True)["result"]
    assert result["released"]
    policy = trained.client.policy(**KESTREL)
    assert (policy["version"], policy["learner"], policy["settings"]) == (
        2,
        "value-iteration",
        {"gamma": 0.1, "slip": 0.0, "join_share": 0.0},
    )
    assert (policy["training"]["steps"], policy["training"]["settled"]) == (0, True)
    assert policy["actions"] == trained.client.policy(**KESTREL, version=1)["actions"]


def test_a_slip_policy_is_released_if_exact_and_refused_if_sampled(trained: Service):
    result = trained.train(learner={"kind": "value-iteration", "slip": 0.1}, release=True)["result"]
    assert result["released"]
    assert trained.client.policy(**KESTREL)["settings"] == {"gamma": 0.1, "slip": 0.1, "join_share": 0.0}
    sampled = {"kind": "phase-q-learning", "slip": 0.1, "alpha": 0.1, "max_sweeps": 50}
    result = trained.train(learner=sampled, release=True)["result"]
    assert not result["released"]
    assert "greedy actions are not optimal" in result["not_released_because"]


def test_every_state_from_which_the_policy_finishes_is_counted(trained: Service):
    certificate = trained.client.policy(**KESTREL)["grid_certificate"]
    assert certificate["states_finishing"] == certificate["states_checked"] > 1331


def test_a_policy_states_its_rule_among_equally_good_actions(trained: Service):
    policy = trained.client.policy(**KESTREL)
    assert policy["ties"] == {"depth_from_mm": [0.0, 0.0, 0.0], "depth_along": None, "kind": "shortest-approach"}
    assert policy["grid_certificate"]["actions_off_rule"] == 0
    assert "depth is the distance from the remote centre" in card(trained, 1)["learner"]["in_words"]
    assert trained.client.learnt(**KESTREL).ties is not None
    assert "Actions off the rule" in trained.http.get("/pages/styles/kestrel/simple-running").text
    trained.train(learner={"kind": "cell-q-learning"})
    cell = trained.client.policy(**KESTREL, version=2)
    assert trained.http.get(f"/policy-versions/{cell['sha256']}").json()["ties"] is None
    assert cell["grid_certificate"]["actions_off_rule"] is None
    assert "lowest index" in card(trained, 2)["learner"]["in_words"]


def card(service: Service, version: int) -> dict:
    return service.http.get(f"{POLICY}/versions/{version}/card").json()


def test_a_rule_that_is_broken_is_no_release(trained: Service, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("skills.learning.policy.choose", lambda domain, q, rule: q.argmax(axis=1))
    result = trained.train(seed=5, release=True)["result"]
    assert not result["released"]
    assert "not the ones that the rule among equally good actions selects" in result["not_released_because"]
    assert "are not optimal" not in result["not_released_because"]


def test_depth_in_another_frame_is_measured_along_a_given_direction(service: Service):
    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL, frame="ECM")
    service.train()
    assert service.client.policy(**KESTREL, version=1)["ties"]["depth_along"] is None
    service.train(depth_along=[0.0, 0.0, 1.0])
    along = service.client.policy(**KESTREL, version=2)
    assert along["ties"] == {"depth_from_mm": None, "depth_along": [0.0, 0.0, 1.0], "kind": "shortest-approach"}
    assert service.client.learnt(**KESTREL, version=2).ties.depth_along == (0.0, 0.0, 1.0)
    assert "along (0, 0, 1)" in card(service, 2)["learner"]["in_words"]


@pytest.mark.parametrize(
    ("frame", "more", "says"),
    [
        ("PSM2_base", {"depth_along": [0, 0, 1]}, "depth is the distance from the remote centre"),
        ("ECM", {"depth_along": [0, 0, 0]}, "must not be"),
        ("ECM", {"depth_along": [0, 0, 1], "learner": {"kind": "cell-q-learning"}}, "does not compare depths"),
        ("ECM", {"depth_along": [0, 0, 1], "scene": {"frame": "ECM"}}, "In a scene depths are not compared"),
    ],
)
def test_a_direction_of_depth_that_is_not_used_is_refused(service: Service, frame: str, more: dict, says: str):
    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL, frame=frame)
    assert says in assert_problem(service.http.post("/trainings", json=KESTREL | more), 422)["detail"]


def test_the_papers_failed_baseline_is_learnt_and_refused_with_reasons(trained: Service):
    result = trained.train(learner={"kind": "max-ent-irl", "iterations": 30}, release=True)["result"]
    assert (result["releasable"], result["released"]) == (False, False)
    assert "greedy actions are not optimal" in result["not_released_because"]
    assert "starts do not reach the goal" in result["not_released_because"]
    assert trained.client.policy(**KESTREL)["version"] == 1
    assert not trained.client.rollout(**KESTREL, version=2, start_mm=[-10, 55, -135])["finished"]


@pytest.mark.parametrize(
    "learner",
    [
        {"kind": "value-iteration", "gamma": 1.0},
        {"kind": "value-iteration", "alpha": 1.0},
        {"kind": "max-ent-irl", "iterations": 0},
        {"kind": "max-ent-irl", "iterations": 1e3},
        {"kind": "max-ent-irl", "l2": -1.0},
        {"kind": "no-such-learner"},
    ],
    ids=str,
)
def test_a_learner_with_settings_that_cannot_be_meant_is_refused_at_once(still: Service, learner: dict):
    before = still.counts()
    assert_problem(still.http.post("/trainings", json={**KESTREL, "learner": learner}), 422)
    assert still.counts() == before


@pytest.mark.parametrize("asks", ["/trainings", "/retrainings"])
@pytest.mark.parametrize(
    "learner",
    [
        {"kind": "cell-q-learning", "gamma": 0.95},
        {"kind": "cell-q-learning", "gamma": 1.0},
        {"kind": "max-ent-irl", "gamma": 0.9},
    ],
    ids=str,
)
def test_a_learner_that_could_only_learn_to_loop_is_refused(still: Service, asks: str, learner: dict):
    before = still.counts()
    refused = assert_problem(still.http.post(asks, json={**KESTREL, "learner": learner}), 422)
    assert refused["detail"].endswith("use a gamma below 0.9.")
    assert still.counts() == before
    with pytest.raises(BadSettings, match=r"use a gamma below 0\.9"):  # as a training would have failed
        learn_tabular(sparse_reward(still.client.learnt(**KESTREL).path), learner_of(learner))


def test_a_demo_in_a_frame_other_than_the_arms_base_is_not_released(service: Service):
    service.client.put_surgeon("kestrel")
    service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL, frame="ECM")
    result = service.train(release=True)["result"]
    assert not result["released"]
    assert "'ECM' is not the arm's base" in result["not_released_because"]


# ---- following


STARTS_MM = [(-10, 55, -135), (5, 55, -125), (-30, 25, -140), (20, 75, -90), (-11, 56, -121), (0, 50, -100)]


@pytest.mark.parametrize("start", STARTS_MM)
def test_next_says_step_by_step_what_a_rollout_says_at_once(still: Service, start: tuple[float, float, float]):
    followed = still.client.rollout(**KESTREL, start_mm=start)
    assert followed["finished"]
    position, phase, states = list(start), None, []
    for _ in range(200):
        step = still.client.next(**KESTREL, position_mm=position, phase=phase)
        states.append(step["phase"])
        if step["done"]:
            break
        assert step == still.client.next(**KESTREL, position_mm=position, phase=phase)
        assert 0 <= step["confidence"] <= 1
        position, phase = step["next_position_mm"], step["phase"]
    assert position == followed["path_mm"][-1] or position == list(start)
    assert len(states) == len(followed["states"])
    assert followed["path_mm"][-1] == GOAL_MM


def test_off_the_path_next_points_back_to_it(still: Service):
    off = still.client.next(**KESTREL, position_mm=[-10.0, 60.0, -135.0], phase=1)
    assert off["correction_mm"] == [0.0, -5.0, 0.0]
    assert still.client.next(**KESTREL, position_mm=[-10.0, 55.0, -135.0])["correction_mm"] is None


def test_a_place_outside_the_grid_is_refused(still: Service):
    for place in ([100.0, 50.0, -120.0], [0.0, 50.0, 9999.0]):
        assert_problem(still.http.post(f"{POLICY}/rollouts", json={"start_mm": place}), 422, "outside-grid")
        assert_problem(still.http.post(f"{POLICY}/next", json={"position_mm": place}), 422, "outside-grid")
    inside = {"position_mm": GOAL_MM, "phase": 10**6}
    assert_problem(still.http.post(f"{POLICY}/next", json=inside), 422, "outside-grid")
    assert_problem(still.http.post(f"{POLICY}/rollouts", json={"start_mm": GOAL_MM, "version": 9}), 404)


def test_the_service_serves_on_postgresql_too(tmp_path):
    url = backends.fresh("postgresql", tmp_path)
    with serving(url) as service:
        service.client.put_surgeon("kestrel", consent={"uses": ["training", "export"]})
        demo = service.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
        assert service.train(release=True)["result"]["released"]
        assert service.client.rollout(**KESTREL, start_mm=STARTS_MM[0])["dtw_total_mm"] == 0
        assert service.client.demo_recording(demo["id"]) == cases.hand_off()
        service.client.erase_surgeon("kestrel")
        assert_problem(service.http.get(POLICY), 410, "erased")
    backends.drop(url)
