"""Plans, their motion, and the simulator's verdict."""

import json
from dataclasses import asdict
from html import escape
from pathlib import Path

import numpy as np
import pytest

from skills.verification.arm_errors import UNCALIBRATED, ArmErrors
from tests.api.service import GOAL_MM, KESTREL, Service, assert_problem, copy_of_trained, serving
from tests.arms import ARMS
from tests.db.test_packed import forged

POINTS = [[5.0, 55.0, -125.0], [11.0, 55.0, -125.0], [17.0, 55.0, -125.0]]
QUARTER = [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]  # a quarter turn about z


def plan(service: Service, *points: list[float], **asked: object) -> dict:
    """Plan passes; unless PSM_M is given they have no hand-off."""
    if "psm_m" not in asked:
        asked = {"handoff": "none"} | asked
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


def test_the_form_names_what_it_cannot_keep_of_a_scene(still: Service):
    plane = {"at_mm": [0.0, 0.0, -175.0], "normal": [0.0, 0.0, 1.0], "along": [1.0, 0.0, 0.0]}
    box = {"low_mm": [58.0, 58.0, -122.0], "high_mm": [62.0, 62.0, -118.0]}
    for scene, named in (({"tissue": plane}, None), ({"tissue": plane, "boxes": [box]}, "1 boxes."), (None, None)):
        made = plan(still, POINTS[0], **({} if scene is None else {"scene": {"frame": "PSM_base"} | scene}))
        page = still.http.get(f"/pages/plans/new?like={made['id']}", headers={"Accept": "text/html"}).text
        assert ("a scene that this form cannot show" in page) == (named is not None)
        assert named is None or named in page
        assert ('name="tissue_mm" step="any" placeholder="not given" value="-175.0"' in page) == (scene is not None)


def test_plans_are_listed_the_newest_first_with_their_newest_playback(trained: Service):
    made = [plan(trained, point, rate_hz=100) for point in POINTS[:2]]
    listed = trained.client.plans()
    assert [one["id"] for one in listed] == [one["id"] for one in reversed(made)]
    assert all((one["playback"], one["feasible"], one["passes"]) == (None, None, 1) for one in listed)
    first = trained.http.get("/plans?limit=1").json()
    assert [one["id"] for one in first["items"]] == [made[1]["id"]]
    assert trained.http.get(f"/plans?cursor={first['next']}").json()["items"] == listed[1:]
    trained.client.play(made[0]["id"])
    trained.work()
    playback = next(job["result"]["playback"] for job in trained.client.jobs(kind="playback"))
    assert (trained.client.plans()[1]["playback"], trained.client.plans()[0]["playback"]) == (playback, None)


def test_a_turned_suture_point_turns_the_pass_about_it(still: Service):
    straight = plan(still, POINTS[0])["passes"][0]
    points = [{"position_mm": POINTS[0], "rotation_xyzw": QUARTER}]
    turned = still.client.plan(**KESTREL, suture_points=points, handoff="none")["passes"][0]
    x, y, z = np.subtract(straight["path_mm"], POINTS[0]).T
    np.testing.assert_allclose(np.subtract(turned["path_mm"], POINTS[0]), np.stack([-y, x, z], axis=1), atol=1e-9)


def test_the_same_plan_is_stored_once(still: Service):
    body = KESTREL | {"suture_points": [{"position_mm": GOAL_MM}], "speed_mm_s": 12.5, "handoff": "none"}
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
    plainly = {} if "psm_m" in asked else {"handoff": "none"}
    body = KESTREL | {"suture_points": [{"position_mm": GOAL_MM}]} | plainly | asked
    problem = assert_problem(still.http.post("/plans", json=body), status)
    assert words.lower() in problem["detail"].lower(), problem["detail"]
    assert still.counts() == before


# ---- the hand-off, and its probability of success ---------------------------------------------------------------


def test_a_plan_that_hands_nothing_over_is_made_on_request_alone(still: Service):
    body = KESTREL | {"suture_points": [{"position_mm": [3.0, 55.0, -125.0]}]}
    before = still.counts()
    problem = assert_problem(still.http.post("/plans", json=body), 422, "no-hand-off")
    assert "would have no hand-off" in problem["detail"]
    assert "handoff 'none'" in problem["detail"]
    both = body | {"handoff": "none", "psm_m": {"approach": APPROACH, "base": BASE}}
    assert_problem(still.http.post("/plans", json=both), 422, "bad-plan")
    assert_problem(still.http.post("/plans", json=body | {"handoff": "some"}), 422)
    assert still.counts() == before
    made = still.http.post("/plans", json=body | {"handoff": "none"})
    assert made.status_code == 201
    alone = made.json()
    assert (alone["hands_over"], alone["psm_m"]) == (False, None)
    assert "along 1 pass; no hand-off: no PSM_M, no A2." in alone["description"]
    assert alone["a2"] is None
    assert 0 < alone["trajectory"]["tempo"] <= 1
    whole = plan(still, [3.0, 55.0, -125.0], psm_m={"approach": APPROACH, "base": BASE})
    assert whole["hands_over"]
    assert "hands the needle to PSM_M" in whole["description"]


@pytest.mark.parametrize("arms", [[UNCALIBRATED], pytest.param([ARMS, UNCALIBRATED], marks=pytest.mark.nightly)])
def test_a_headline_is_good_only_if_the_stated_arm_error_allows_it(tmp_path: Path, arms: list[ArmErrors]):
    levels = {}
    for errors in arms:
        folder = tmp_path / errors.name
        folder.mkdir()
        with serving(copy_of_trained(folder), arm_errors=json.dumps(asdict(errors))) as service:
            made = plan(service, GOAL_MM, psm_m={"approach": APPROACH, "base": BASE})
            service.client.play(made["id"])
            playback = service.client.playback(service.work()[-1]["result"]["playback"])
            headline = playback["headline"]
            assert playback["feasible"]
            [whole] = [
                under["plan"] for under in playback["report"]["estimate"]["under"] if under["errors"] == asdict(errors)
            ]
            assert (headline["probability"], headline["errors"]) == (whole, errors.name)
            assert headline["costs_most"] in headline["text"]
            assert f"succeeds in {whole['count']} of {whole['of']} worlds" in headline["text"]
            levels[errors.name] = headline["level"], headline["word"]
            page = service.http.get(f"/pages/plans/{made['id']}", headers={"Accept": "text/html"}).text
            assert f'class="verdict {headline["level"]}"' in page
            assert f"{headline['word']}: feasible in an exact simulation" in page
            bag = service.http.get(f"/plans/{made['id']}/trajectory", headers={"Accept": "application/zip"})
            assert (bag.status_code == 200) == ("Replay bag" in page) == ('id="no-bag"' not in page)
            assert bag.status_code == 200 or escape(bag.json()["detail"]) in page
    expected = {"bench": ("good", "Likely to succeed"), "uncalibrated": ("bad", "Likely to fail")}
    assert levels == {one.name: expected[one.name] for one in arms}


def test_a_playback_states_its_own_errors_or_takes_the_installations(still: Service):
    asked = {"plan": plan(still, [5.0, 56.0, -125.0])["id"]}
    own, calibrated, installed = asked | {"errors": asdict(ARMS)}, asked | {"errors": "calibrated"}, asked
    jobs = [still.http.post("/playbacks", json=body).json()["id"] for body in (own, calibrated, installed, own)]
    assert len(set(jobs)) == 3 and jobs[0] == jobs[3]
    for wrong in ("exact", asdict(ARMS) | {"tip_bias_mm": -1}, asdict(ARMS) | {"sources": {}}):
        assert_problem(still.http.post("/playbacks", json=asked | {"errors": wrong}), 422)
    renamed = asdict(ARMS) | {"name": "calibrated"}
    problem = assert_problem(still.http.post("/playbacks", json=asked | {"errors": renamed}), range(400, 423))
    assert "give your own another name" in problem["detail"]


# ---- PSM_M, starts and time -------------------------------------------------------------------------------------

APPROACH = [-0.94, 0.10, -0.33]
BASE = {"position_mm": [160.0, 20.0, 20.0], "rotation_xyzw": [0.0, 0.0, 0.3826834324, 0.9238795325]}  # 45 degrees


def test_psm_m_moves_if_its_base_is_given_and_the_plan_names_its_sources(still: Service):
    asked = {"approach": APPROACH, "base": BASE, "source": "invented for a test"}
    made = plan(still, *POINTS, psm_m=asked)
    assert made["psm_m"] == {
        "approach": APPROACH,
        "base_mm": BASE["position_mm"],
        "base_xyzw": BASE["rotation_xyzw"],
        "instrument": "400006",
        "enters": "after_A1",
        "from": {"approach": "the request: invented for a test", "base": "the request: invented for a test"},
    }
    assert made["trajectory"]["psm_m_moves"]
    alone = plan(still, *POINTS, psm_m={"approach": APPROACH})
    assert alone["psm_m"]["from"] == {"approach": "the request", "base": None}
    assert not alone["trajectory"]["psm_m_moves"]
    assert alone["trajectory"]["duration_s"] < made["trajectory"]["duration_s"]


@pytest.mark.parametrize(
    "other",
    [
        {"psm_m": {"approach": APPROACH, "base": BASE, "enters": "start"}},
        {"psm_m": {"approach": APPROACH, "base": BASE, "instrument": "420006"}},
        {"psm_m": {"approach": APPROACH, "base": BASE | {"position_mm": [161.0, 20.0, 20.0]}}},
        {"psm_m": {"approach": APPROACH, "base": BASE, "source": "measured"}},
        {"psm_m": {"approach": APPROACH, "base": BASE}, "rate_hz": 100.0},
        {"psm_m": {"approach": APPROACH, "base": BASE}, "tip_offset_mm": 10.2},
    ],
)
def test_another_psm_m_rate_or_tip_is_another_plan(still: Service, other: dict):
    known = plan(still, GOAL_MM, psm_m={"approach": APPROACH, "base": BASE})
    assert plan(still, GOAL_MM, **other)["id"] != known["id"]


def test_a_plan_tells_its_transfers_its_seams_and_its_seconds(still: Service):
    made = plan(still, *POINTS, psm_m={"approach": APPROACH, "base": BASE}, rate_hz=100.0)
    first, *others = [one["transfer"] for one in made["passes"]]
    assert first is None
    start, end = np.array(made["passes"][1]["start_mm"]), np.array(POINTS[0])
    for one in others:
        assert one["length_mm"] == pytest.approx(np.linalg.norm(start - end), abs=1e-6)
        assert one["duration_s"] > 1.875 * one["length_mm"] / 20.0
    motion = made["trajectory"]
    assert motion["rate_hz"] == 100.0
    assert sum(motion["seconds_by_phase"].values()) == pytest.approx(motion["samples"] / 100.0)
    assert [seam["after_pass"] for seam in motion["seams"]] == [0, 1]
    for seam in motion["seams"]:
        assert seam["pause_s"] == pytest.approx(1.0)
        assert seam["leap_mm"] == 0.0
        assert seam["joint_leap"] < 1e-9


def test_a_start_outside_the_grid_is_reached_by_a_transfer(still: Service):
    inside = plan(still, GOAL_MM, starts_mm=[[-30.0, 25.0, -120.0]])
    outside = plan(still, GOAL_MM, starts_mm=[[-60.0, 25.0, -120.0]])
    (one,) = outside["passes"]
    assert one["start_mm"] == [-60.0, 25.0, -120.0]
    assert one["states"] == inside["passes"][0]["states"]
    assert one["path_mm"] == inside["passes"][0]["path_mm"]
    assert one["transfer"]["length_mm"] == pytest.approx(30.0)
    refused = still.http.post(
        "/plans",
        json=KESTREL
        | {"suture_points": [{"position_mm": GOAL_MM}], "starts_mm": [[-81.0, 25.0, -120.0]], "handoff": "none"},
    )
    problem = assert_problem(refused, 422, "outside-grid")
    assert problem["numbers"] == {"pass": 0, "outside_mm": 51.0, "limit_mm": 50.0}


def test_a_suture_point_may_be_where_the_finger_tips_go(still: Service):
    made = plan(still, GOAL_MM, tip_offset_mm=10.2)
    x, y, z = GOAL_MM
    assert made["passes"][0]["path_mm"][-1] == pytest.approx([x, y, z + 10.2])  # the jaw points down
    assert (made["passes"][0]["position_mm"], made["tip_offset_mm"]) == (GOAL_MM, 10.2)


@pytest.mark.parametrize(
    ("asked", "kind", "words"),
    [
        ({"psm_m": {}}, "no-approach", "has no approach direction of psm_m"),
        ({"psm_m": {"base": BASE}}, "no-approach", "has no approach direction of psm_m"),
        ({"psm_m": {"approach": APPROACH, "base": BASE, "instrument": "470006"}}, "invalid-request", ""),
        (
            {"psm_m": {"approach": APPROACH, "base": BASE | {"position_mm": [500.0, 0.0, 0.0]}}},
            "unreachable",
            "Pass 0, A1, PSM_M: Sample 0",
        ),
        ({"psm_m": {"approach": APPROACH, "base": BASE | {"rotation_xyzw": [0, 0, 0, 0]}}}, "improper-rotation", ""),
        ({"psm_m": {"approach": APPROACH, "base": {"position_mm": [1, 2, 3]}}}, "invalid-request", ""),
        ({"psm_m": {"approach": APPROACH, "enters": "never"}}, "invalid-request", ""),
        ({"rate_hz": 99.0}, "invalid-request", ""),
        ({"rate_hz": 240.0}, "invalid-request", ""),
        ({"tip_offset_mm": 51.0}, "invalid-request", ""),
    ],
)
def test_a_psm_m_that_cannot_come_and_a_rate_that_no_plan_has_are_refused(
    still: Service, asked: dict, kind: str, words: str
):
    before = still.counts()
    plainly = {} if "psm_m" in asked else {"handoff": "none"}
    body = KESTREL | {"suture_points": [{"position_mm": GOAL_MM}]} | plainly | asked
    problem = assert_problem(still.http.post("/plans", json=body), 422, kind)
    assert words.lower() in problem["detail"].lower(), problem["detail"]
    assert still.counts() == before


def test_a_plan_stored_before_psm_m_moved_is_refused_without_a_crash(trained: Service):
    made = plan(trained, GOAL_MM)
    before = {"arm": "PSM", "frame": "PSM_base", "instrument": "400006", "speed_mm_s": 20.0, "approach_m": None}
    before |= {"orientation": "assumed tool-down", "path": "fitted", "passes": {"tuple": []}}
    trained.tamper("UPDATE plans SET plan = :old", old=forged({"value": "SuturePlan", "of": before}))
    assert trained.client.plan_of(made["id"]) == made  # its stored response can still be read
    assert_problem(trained.http.get(f"/plans/{made['id']}/trajectory"), 503, "corrupt")
    trained.client.play(made["id"])
    [job] = trained.work()
    assert (job["state"], job["result"]) == ("failed", None)
    assert plan(trained, POINTS[1])["id"] != made["id"]
    trained.client.erase_surgeon("kestrel")
    assert_problem(trained.http.get(f"/plans/{made['id']}"), 404)


def test_a_plan_is_executed_as_the_request_or_the_installation_states(trained: Service):
    made = plan(trained, GOAL_MM)
    weak = {"stiffness": [20.0, 20.0, 1000.0, 1.0, 1.0, 1.0], "velocities": False}
    played = {}
    for name, servo in (("none", None), ("sound", {"gravity_compensated": True}), ("weak", weak)):
        asked = trained.client.play(made["id"], servo=servo)
        [job] = [one for one in trained.work() if one["id"] == asked["id"]]
        assert job["state"] == "succeeded", job["error"]
        played[name] = trained.client.playback(job["result"]["playback"])
    assert played["none"]["report"]["executed"] is None and "Not executed" in played["none"]["headline"]["text"]
    sound, refused = played["sound"]["report"]["executed"], played["weak"]["report"]
    assert sound["failure"] is None and sound["servo"]["gravity_compensated"] and sound["worst_mm"][0] < 1.0
    assert "Not validated on hardware" in played["sound"]["headline"]["text"]
    assert played["sound"]["feasible"] and not played["weak"]["feasible"]
    assert refused["failure"] == refused["executed"]["failure"] and refused["executed"]["surely"]
    assert "As executed." in played["weak"]["headline"]["text"]
    for wrong in ({"velocitys": False}, {"delay_s": -1.0}, {"stiffness": [1.0]}):
        assert_problem(trained.http.post("/playbacks", json={"plan": made["id"], "servo": wrong}), 422)


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
    headline = playback["headline"]
    assert (headline["level"], headline["word"]) == ("caution", "No hand-off"), (
        "feasible, but it leaves out the hand-off"
    )
    assert "no hand-off: no PSM_M, no A2" in headline["text"]
    assert playback["plan"] == made["id"]
    assert playback["report"]["failure"] is None
    assert trained.client.picture(playback["id"]).startswith(b"\x89PNG\r\n\x1a\n")
    assert_problem(trained.http.post("/playbacks", json={"plan": "0" * 64}), 404)
    assert_problem(trained.http.get(f"/playbacks/{'0' * 64}/picture.png"), 404)
