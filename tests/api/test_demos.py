"""Recordings and demonstrations: stored once, returned exactly, withdrawn permanently."""

import httpx2 as httpx
import numpy as np
import pytest

from skills.client import Problem
from skills.gridworld import paper
from skills.seeds.recordings import sample_recordings
from tests.api.service import CSV, KESTREL, MCAP, Service, assert_problem
from tests.library import cases


def post(service: Service, path: str, data: bytes, media_type: str = CSV, **query: object) -> httpx.Response:
    return service.http.post(path, params=query, content=data, headers={"Content-Type": media_type})


def test_the_same_bytes_are_one_recording(here: Service):
    first, second = (post(here, "/recordings", cases.bag(), MCAP) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json() == second.json()
    about = first.json()
    assert first.headers["Location"] == f"/recordings/{about['sha256']}"
    assert (about["format"], about["integrity"], about["size_bytes"]) == ("mcap", "full", len(cases.bag()))
    assert [t["name"] for t in about["topics"]] == ["/PSM2/local/measured_cp"]
    assert here.http.get(first.headers["Location"]).json() == about
    assert here.counts()["recordings"] == 1


def test_the_same_demonstration_is_stored_once(here: Service):
    first, second = (post(here, "/demos", cases.hand_off(), **KESTREL) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json() == second.json()
    demo = first.json()
    assert first.headers["Location"] == f"/demos/{demo['id']}"
    assert here.http.get(first.headers["Location"]).json() == demo
    assert demo["report"]["grid"]["chosen"] == "paper"
    assert demo["frame"] == "PSM_base"
    assert here.counts() | dict.fromkeys(["suture_types", "events", "history", "history_checkpoints"], 0) == {
        **dict.fromkeys(here.counts(), 0), "surgeons": 1, "recordings": 1, "recording_chunks": 1,
        "recording_uploads": 1, "demonstrations": 1, "reward_maps": 1, "parsed_recordings": 1, "parsed_chunks": 1,
    }  # fmt: skip


def test_two_segments_of_one_recording_are_two_demonstrations(here: Service):
    sample = sample_recordings()[4]
    about = here.client.add_recording(sample.data)
    demos = [
        here.client.cut_demo(about["sha256"], **KESTREL, start_s=s["start_s"], end_s=s["end_s"])
        for s in about["segments"][:2]
    ]
    assert demos[0]["id"] != demos[1]["id"]
    assert {demo["recording"] for demo in demos} == {about["sha256"]}
    assert [d["id"] for d in here.client.demos("kestrel")] == [d["id"] for d in demos[::-1]]
    for demo, part in zip(demos, about["segments"], strict=False):
        assert demo["start_s"] == pytest.approx(part["start_s"], abs=0.011)
        assert demo["end_s"] == pytest.approx(part["end_s"], abs=0.011)


def test_storing_a_demonstration_never_trains(here: Service):
    post(here, "/demos", cases.hand_off(), **KESTREL)
    assert here.counts()["jobs"] == 0


def test_the_path_and_the_reward_map_are_those_of_the_paper(here: Service):
    demo = here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    path = here.client.demo_path(demo["id"])
    assert path["recorded_mm"] == cases.points_mm().tolist()
    assert path["path_mm"][0], path["path_mm"][-1] == (cases.CORNERS_MM[0], cases.CORNERS_MM[-1])
    grid = path["grid"]
    assert (grid["cell_mm"], grid["shape"]) == (paper.CELL_MM, [11, 11, 11])
    steps = np.abs(np.diff(path["path_mm"], axis=0)).max(axis=1)
    assert (steps == 5.0).all()
    rewards = here.http.get(f"/demos/{demo['id']}/reward-map").json()
    assert rewards["levels"] == {"goal": 10.0, "visited": 1.0, "other": 0.0, "off_grid": -1.0}
    expected = dict.fromkeys(path["states"], 1.0) | {path["states"][-1]: 10.0}
    assert dict(zip(rewards["states"], rewards["rewards"], strict=True)) == expected


def test_another_grid_is_another_demonstration_of_the_same_recording(here: Service):
    one = here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    other = here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL, grid="fit", cell_mm=2.5)
    assert one["id"] != other["id"]
    assert one["recording"] == other["recording"]
    assert other["report"]["grid"] | {"origin_mm": 0} == {
        "chosen": "fit", "cell_mm": 2.5, "shape": other["report"]["grid"]["shape"], "origin_mm": 0
    }  # fmt: skip


def test_hysteresis_makes_another_demonstration_and_says_what_it_costs(here: Service):
    plover = next(s for s in sample_recordings() if s.surgeon == "plover")
    stored = here.client.add_recording(plover.data)
    part = {name: stored["segments"][0][name] for name in ("start_s", "end_s")}
    plain, same, calm = (here.client.cut_demo(stored["id"], **KESTREL, **part, hysteresis=h) for h in (None, 0, 0.25))
    assert plain == same
    assert here.client.add_demo(plover.data, **KESTREL, **part, hysteresis=0.25) == calm == here.client.demo(calm["id"])
    assert calm["id"] != plain["id"]
    assert (plain["hysteresis"], calm["hysteresis"]) == (0.0, 0.25)
    for demo, states, crossings, lost_mm in ((plain, 44, 19, 2.30), (calm, 18, 0, 2.73)):
        report, path = demo["report"], here.client.demo_path(demo["id"])
        assert (report["path_states"], report["revisits"]) == (states, crossings)
        assert np.linalg.norm(report["discretisation_rmse_mm"]) == pytest.approx(lost_mm, abs=0.01)
        assert (path["hysteresis"], len(path["states"])) == (demo["hysteresis"], states)
    assert here.train(demos=[calm["id"]], release=True)["result"]["released"]
    policy = here.client.policy(**KESTREL)
    assert policy["metrics"]["discretisation_rmse_mm"] == calm["report"]["discretisation_rmse_mm"]
    assert (policy["metrics"]["exact_states"], policy["waypoints"]) == (18, path["states"])


def test_the_schema_tells_of_hysteresis_on_both_doors(service: Service):
    schema = service.http.get("/openapi.json").json()
    in_query = {one["name"]: one for one in schema["paths"]["/demos"]["post"]["parameters"]}["hysteresis"]
    in_body = schema["components"]["schemas"]["DemoIn"]["properties"]["hysteresis"]
    for told in (in_query["schema"], in_body):
        assert (told["minimum"], told["maximum"]) == (0, 0.5)
    assert in_query["schema"]["default"] == 0.0
    assert in_body["description"].endswith("Left out: 0.0.")
    assert "mm" in in_query["description"] and "mm" in in_body["description"]


def test_the_same_bytes_read_in_another_way_are_refused(here: Service):
    here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    with pytest.raises(Problem, match="stored already") as refused:
        here.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL, frame="PSM1_base")
    assert refused.value.status == 409


def large_table() -> bytes:
    """Return a table of slightly more than 3 MiB: four chunks."""
    rows = 40_000
    there = cases.points_mm(samples=rows // 30)
    tip = np.concatenate([there, there[::-1]] * 5)
    return cases.table(tip + np.random.default_rng(0).normal(0, 1e-3, tip.shape), rate_hz=1000)


def test_a_recording_of_several_chunks_comes_back_exactly(here: Service):
    data = large_table()
    demo = here.client.add_demo(data, media_type=CSV, **KESTREL)
    assert here.counts()["recording_chunks"] == -(-len(data) // 2**20) >= 3
    answer = here.http.get(f"/demos/{demo['id']}/recording")
    assert answer.content == data
    assert answer.headers["content-type"].startswith(CSV)
    assert answer.headers["content-length"] == str(len(data))
    assert answer.headers["etag"] == f'"{demo["recording"]}"'


@pytest.mark.parametrize("chunk", ["first", "last"])
def test_a_damaged_multi_chunk_recording_is_refused_before_its_first_byte(here: Service, chunk: str):
    demo = here.client.add_demo(large_table(), media_type=CSV, **KESTREL)
    which = "SELECT min(number)" if chunk == "first" else "SELECT max(number)"
    damaged = "CAST(x'00' || substr(data, 2) AS BLOB)"
    here.tamper(f"UPDATE recording_chunks SET data = {damaged} WHERE number = ({which} FROM recording_chunks)")
    assert_problem(here.http.get(f"/demos/{demo['id']}/recording"), 503, "corrupt")


def test_withdrawing_a_demonstration_withdraws_what_rests_on_it(trained: Service):
    demo = trained.client.demos()[0]
    assert trained.http.delete(f"/demos/{demo['id']}").status_code == 204
    assert trained.client.demo(demo["id"])["state"] == "withdrawn"
    assert trained.client.policies() == []
    assert trained.http.delete(f"/demos/{demo['id']}").status_code == 204
    with pytest.raises(Problem, match="demonstration was withdrawn"):
        trained.client.release(**KESTREL, version=1)
    with pytest.raises(Problem, match="no active demonstration"):
        trained.client.train(**KESTREL, seed=5)
    with pytest.raises(Problem, match="withdrawn"):
        trained.client.train(**KESTREL, demos=[demo["id"]], seed=5)
    with pytest.raises(Problem, match="withdrawn"):
        trained.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)


def test_marking_a_demonstration_as_a_failure_withdraws_what_rests_on_it(trained: Service):
    demo = trained.client.demos()[0]
    where = f"/demos/{demo['id']}/outcome"
    assert demo["outcome"] is None and trained.client.policy(**KESTREL)["outcomes"] is None
    for body in ({"outcome": "failure"}, {"outcome": "unheard"}, {"outcome": "success", "why": "no"}, {}):
        assert_problem(trained.http.put(where, json=body), 422, "invalid-request")
    tag = trained.http.get(f"/demos/{demo['id']}").headers["etag"]
    failed = {"outcome": "failure", "reason": "The needle fell."}
    answer = trained.http.put(where, json=failed, headers={"If-Match": tag})
    assert (answer.status_code, answer.json()["outcome_reason"]) == (200, "The needle fell.")
    assert_problem(trained.http.put(where, json={"outcome": "success"}, headers={"If-Match": tag}), 412)
    assert trained.client.policies() == []
    assert [one["id"] for one in trained.client.demos(outcome="failure")] == [demo["id"]]
    assert trained.client.demos(outcome="unknown") == []
    for demos in (None, [demo["id"]]):
        with pytest.raises(Problem, match="outcomes='any'") as refused:
            trained.client.train(**KESTREL, demos=demos, seed=5)
        assert refused.value.document.remedies == [{"action": "train-any"}]
    with pytest.raises(Problem, match="its demonstration was marked failure"):
        trained.client.release(**KESTREL, version=1)
    job = trained.train(outcomes="any", release=True)
    assert job["result"]["released"]
    assert trained.client.policy(**KESTREL)["outcomes"] == ["failure"]
    assert trained.client.mark_demo(demo["id"], "success")["outcome_reason"] is None
    assert trained.client.release(**KESTREL, version=1)["version"] == 1
    assert_problem(trained.http.put(f"/demos/{'0' * 64}/outcome", json=failed), 404, "not-found")


def test_an_uploader_does_not_change_an_outcome_by_adding_again(here: Service):
    how = {"params": {"outcome": "failure", "outcome_reason": "It fell.", **KESTREL}, "content": cases.hand_off()}
    added = here.http.post("/demos", headers={"Content-Type": CSV}, **how)
    assert (added.status_code, added.json()["outcome"]) == (201, "failure")
    again = f"/recordings/{added.json()['recording']}/demos"
    assert here.http.post(again, json=KESTREL).json()["outcome"] == "failure"
    problem = here.http.post(again, json={**KESTREL, "outcome": "success"})
    assert_problem(problem, 409, "conflict")
    remedy = {"action": "mark-demo", "demo": added.json()["id"], "outcome": "success"}
    assert problem.json()["remedies"] == [remedy]


def test_erasing_a_demonstration_takes_what_was_learnt_from_it(trained: Service):
    trained.client.plan(**KESTREL, suture_points=[{"position_mm": [5, 55, -125]}], handoff="none")
    trained.client.withdraw_demo(trained.client.demos()[0]["id"], erase=True)
    left = {table: rows for table, rows in trained.counts().items() if rows}
    left.pop("history_tiles", None)  # there is one for every 256 leaves
    assert set(left) == {"surgeons", "suture_types", "events", "history", "history_checkpoints", "used_numbers"}
    again = trained.client.add_demo(cases.hand_off(), media_type=CSV, **KESTREL)
    assert again["state"] == "active"


def test_a_recording_whose_demonstration_is_unknown_is_404(service: Service):
    for path in ("", "/recording", "/path", "/reward-map"):
        assert_problem(service.http.get(f"/demos/{'0' * 64}{path}"), 404, "not-found")
    assert_problem(service.http.get(f"/recordings/{'0' * 64}"), 404, "not-found")
    assert_problem(service.http.delete(f"/demos/{'0' * 64}"), 404, "not-found")
