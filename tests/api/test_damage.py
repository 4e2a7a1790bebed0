"""Rows changed by hand are not served, and erasure leaves nothing of a person in the files."""

from pathlib import Path

import pytest

from skills.db.weighted_cache import WeightedCache
from skills.library.operation import integrity
from tests.api.service import CSV, KESTREL, POLICY, Service, assert_problem
from tests.library import cases

CANARY = "canary-7f3a91"
ASKS = (
    ("GET", POLICY, None, {}),
    ("GET", POLICY, None, {"Accept": "application/x-npz"}),
    ("GET", f"{POLICY}/versions/1", None, {}),
    ("POST", f"{POLICY}/rollouts", {"start_mm": [0.0, 55.0, -125.0]}, {}),
    ("POST", f"{POLICY}/next", {"position_mm": [0.0, 55.0, -125.0]}, {}),
    ("POST", "/plans", KESTREL | {"suture_points": [{"position_mm": [5.0, 55.0, -125.0]}], "handoff": "none"}, {}),
)


@pytest.fixture(autouse=True)
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clear the caches that other tests filled, as in a process that has just started."""
    monkeypatch.setattr(integrity, "_policies", WeightedCache(32))


def test_a_manifest_changed_after_it_was_served_is_not_served_again(trained: Service):
    trained.http.post(f"{POLICY}/rollouts", json={"start_mm": [0.0, 55.0, -125.0]})
    trained.tamper("UPDATE policy_versions SET manifest = replace(manifest, '\"seed\": 0', '\"seed\": 1')")
    assert_refused(trained)


def assert_refused(service: Service) -> None:
    """Assert that every request for the policy gets 503, without any numbers of the policy."""
    before = service.counts()
    for method, path, body, headers in ASKS:
        problem = assert_problem(service.http.request(method, path, json=body, headers=headers), 503, "corrupt")
        assert "numbers" not in problem
    assert service.counts() == before


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ('"goal_mm": [5.0', '"goal_mm": [6.0'),
        ('"seed": 0', '"seed": 1'),
        ('"cell_mm": 5.0', '"cell_mm": 5.1'),
        ('"instrument": "400006"', '"instrument": "400007"'),
        ('"surgeon": "kestrel"', '"surgeon": "heron"'),
        ('"dtw_total_mm": 0.0', '"dtw_total_mm": 0.1'),
    ],
)
def test_a_manifest_changed_by_hand_is_never_served(trained: Service, was: str, now: str):
    trained.tamper("UPDATE policy_versions SET manifest = replace(manifest, :was, :now)", was=was, now=now)
    assert_refused(trained)


def other_policy(service: Service) -> None:
    """Learn another style, whose rows can be swapped in."""
    service.client.add_demo(cases.hand_off((5.0, 5.0, 0.0)), media_type=CSV, **KESTREL)
    assert service.train(seed=4)["state"] == "succeeded"


def test_the_numbers_of_another_style_are_never_served(trained: Service):
    other_policy(trained)
    trained.tamper("UPDATE policy_versions SET learnt = (SELECT learnt FROM policy_versions WHERE version = 2)")
    assert_refused(trained)


def test_the_coverage_of_another_style_is_never_served(trained: Service):
    trained.client.add_demo(cases.hand_off((5.0, 5.0, 0.0)), media_type=CSV, **KESTREL)
    trained.train(learner={"kind": "cell-q-learning", "episodes": 20})
    trained.tamper("UPDATE policy_versions SET covered = (SELECT covered FROM policy_versions WHERE version = 2)")
    assert_problem(trained.http.get(POLICY, headers={"Accept": "application/x-npz"}), 503, "corrupt")


def test_an_overwritten_byte_in_a_policy_is_never_served(trained: Service):
    trained.tamper(
        "UPDATE policy_versions SET learnt = CAST(substr(learnt, 1, 900) || x'00' || substr(learnt, 902) AS BLOB)"
    )
    assert_refused(trained)


def test_a_damaged_newest_policy_does_not_bring_an_older_one_back(trained: Service):
    trained.train(seed=2, release=True)
    trained.tamper("UPDATE policy_versions SET manifest = replace(manifest, 'seed', 'sead') WHERE version = 2")
    assert_problem(trained.http.get(POLICY), 503, "corrupt")
    assert trained.client.policy(**KESTREL, version=1)["version"] == 1


def test_a_motion_of_another_plan_is_never_served(trained: Service):
    first, second = (
        trained.client.plan(**KESTREL, suture_points=[{"position_mm": [x, 55, -125]}], handoff="none") for x in (5, 9)
    )
    trained.tamper(
        "UPDATE plans SET plan = (SELECT plan FROM plans WHERE sha256 = :other) WHERE sha256 = :one",
        one=first["id"], other=second["id"],
    )  # fmt: skip
    assert_problem(trained.http.get(f"/plans/{first['id']}/trajectory"), 503, "corrupt")
    assert trained.http.get(f"/plans/{second['id']}/trajectory").status_code == 200


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE recording_chunks SET data = CAST(substr(data, 1, 900) || x'00' || substr(data, 902) AS BLOB)",
        "UPDATE recording_chunks SET data = CAST(substr(data, 1, 900) AS BLOB)",
        "DELETE FROM recording_chunks",
        "UPDATE recording_chunks SET number = 1",
        "UPDATE recording_chunks SET data = 'text'",
    ],
)
def test_a_damaged_recording_is_refused_before_its_first_byte(trained: Service, damage: str):
    (demo,) = trained.client.demos()
    path = f"/demos/{demo['id']}/recording"
    whole = trained.http.get(path)
    assert (whole.status_code, len(whole.content)) == (200, int(whole.headers["content-length"]))
    trained.tamper(damage)
    problem = assert_problem(trained.http.get(path), 503, "corrupt")
    assert "backup" in problem["detail"]


def test_an_erased_surgeon_is_nowhere_in_the_files(service: Service):
    """The service keeps running: neither the pseudonym nor the recording's bytes remain, write-ahead log included."""
    service.client.put_surgeon(CANARY)
    service.client.put_surgeon("heron")
    data = cases.bag() + b""
    table = cases.hand_off((1.25, 0.0, 0.0))
    for one, kind in ((table, CSV), (data, None)):
        service.client.add_demo(one, media_type=kind, surgeon=CANARY, suture=cases.SUTURE)
    service.client.add_demo(data, surgeon="heron", suture=cases.SUTURE)
    job = service.client.train(CANARY, cases.SUTURE, release=True)
    service.work()
    service.client.plan(CANARY, cases.SUTURE, [{"position_mm": [5, 55, -125]}], handoff="none")
    service.client.train(CANARY, cases.SUTURE, seed=1)
    assert CANARY.encode() in everything(service)
    assert table[1000:1064] in everything(service)
    service.client.erase_surgeon(CANARY)
    left = everything(service)
    assert CANARY.encode() not in left
    assert table[1000:1064] not in left
    assert_problem(service.http.get(f"/jobs/{job['id']}"), 404)
    rows = {name: count for name, count in service.counts().items() if count}
    assert rows.pop("events") > 0
    assert rows.pop("suture_types") == 11
    assert rows.pop("history") > 0
    assert rows.pop("history_checkpoints") > 0
    rows.pop("history_tiles", None)  # there is one for every 256 leaves
    # heron uploaded the same bytes
    shared = dict.fromkeys(["recordings", "recording_chunks", "recording_uploads", "parsed_recordings"], 1)
    shared |= {"parsed_chunks": 1, "erased_intervals": 1}
    assert rows == {"surgeons": 1, "erasures": 1, "demonstrations": 1, "reward_maps": 1} | shared
    (demo,) = service.client.demos("heron")
    assert service.client.get_json(f"/demos/{demo['id']}/path")["recorded_mm"]
    assert "who was erased" in assert_problem(service.http.get(f"/demos/{demo['id']}/recording"), 409)["detail"]


def everything(service: Service) -> bytes:
    """Read the database's files as bytes: the tables and the write-ahead log."""
    folder = Path(service.url.removeprefix("sqlite:///")).parent
    return b"".join(file.read_bytes() for file in folder.iterdir() if ".jobs" not in file.name)
