"""Pose styles over HTTP: the one of the released policy, the link to it, and the next pose."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from skills.client import Problem
from skills.learning.pose_style import PHASES
from skills.library.people.keys import create_key
from skills.library.policies.pose_styles import FORMAT
from skills.schemas.pose_styles import NextPose, PoseStyle
from tests import backends
from tests.api.posed import of_both_arms, of_pose_style
from tests.api.service import KESTREL, POLICY, Service, assert_problem, serving
from tests.library import cases
from tests.library.test_pose_styles import AWAY_MM, BESIDE_MM, OPEN_RAD

POSES, NEXT = f"{POLICY}/pose-style", f"{POLICY}/next"


@pytest.fixture(params=backends.BACKENDS)
def posed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Service]:
    """Yield a service in which kestrel's style, with orientation, is released."""
    url = of_pose_style(request.param, tmp_path)
    with serving(url) as service:
        yield service
    backends.drop(url)


@pytest.fixture(params=backends.BACKENDS)
def both(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Service]:
    """Yield a service that serves a pose style with the other arm's motion."""
    url = of_both_arms(request.param, tmp_path)
    with serving(url) as service:
        yield service
    backends.drop(url)


def test_the_pose_style_of_the_released_policy_is_linked_and_served(posed: Service):
    policy = posed.http.get(POLICY)
    assert policy.headers["link"] == f'<{cases.SUTURE}/pose-style>; rel="related"; title="pose style"'
    assert posed.http.get(POLICY, headers={"If-None-Match": policy.headers["etag"]}).headers["link"]
    answer = posed.http.get(POSES)
    style = answer.json()
    assert (style["format"], style["sha256"], style["frame"]) == (FORMAT, policy.json()["sha256"], "PSM2_base")
    assert len({len(style[name]) for name in ("position_mm", "rotation_xyzw", "elapsed_s", "spread_mm")}) == 1
    tube = style["tube"]
    assert (tube["faults"], tube["radius_mm"], tube["limits"]["ahead"]) == ([], 20.0, 1)
    assert tube["radius_deg"] == pytest.approx(np.degrees(tube["radius_rad"]))
    assert posed.http.get(POSES, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert posed.client.pose_style(**KESTREL) == style


def test_next_follows_the_poses_to_the_end(posed: Service):
    style = posed.http.get(POSES).json()
    position, rotation, phase, ticks = np.add(style["position_mm"][0], (0.0, 12.0, 0.0)), [0.0, 1.0, 0.0, 0.0], None, 0
    rotation = style["rotation_xyzw"][0]
    while True:
        step = posed.client.next_pose(**KESTREL, position_mm=position, rotation_xyzw=rotation, phase=phase)
        assert step["inside"] and step["tick_s"] == style["tick_s"]
        if step["finished"]:
            break
        position, rotation, phase, ticks = step["position_mm"], step["rotation_xyzw"], step["phase"], ticks + 1
    assert ticks <= style["tube"]["ticks"]
    assert (position, step["elapsed_s"]) == (style["position_mm"][-1], style["elapsed_s"][-1])


def test_a_pose_outside_the_tube_is_named(posed: Service):
    style = posed.http.get(POSES).json()
    far = np.add(style["position_mm"][0], (0.0, 0.0, -21.0)).tolist()
    body = {"position_mm": far, "rotation_xyzw": style["rotation_xyzw"][0], "phase": 0}
    step = posed.http.post(NEXT, json=body).json()
    assert (step["inside"], step["phase"], step["off_mm"]) == (False, 0, pytest.approx(21.0))
    assert_problem(posed.http.post(NEXT, json=body | {"rotation_xyzw": [0, 0, 0, 2]}), 422)
    assert_problem(posed.http.post(NEXT, json=body | {"phase": 101}), 422)
    assert posed.http.post(NEXT, json={"position_mm": far}).json().keys() >= {"action", "correction_mm"}


def test_the_other_arm_is_served_at_the_same_phases(both: Service):
    style = both.client.pose_style(**KESTREL)
    other = style["partner_motion"]
    assert (other["arm"], style["partner"]["arm"], style["frame"], other["scene"]) == (*2 * ["PSM1"], "PSM2_base", None)
    assert len(other["position_mm"]) == len(other["rotation_xyzw"]) == len(style["position_mm"])
    assert np.abs(other["position_mm"] - np.linspace(AWAY_MM, BESIDE_MM, PHASES)).max() < 1e-6  # by hand
    assert np.abs(other["jaw_rad"] - np.linspace(OPEN_RAD, 0.0, PHASES)).max() < 1e-6
    assert other["position_mm"][-1] == pytest.approx(style["partner"]["position_mm"], abs=1e-6)
    played = both.http.get(f"/timelines/policy-versions/{style['sha256']}").json()["timeline"]
    assert [arm["arm"] for arm in played["arms"]] == ["PSM2", "PSM1"]


def test_next_has_the_other_arm_at_the_phase_that_it_answers(both: Service):
    style = both.client.pose_style(**KESTREL)
    other = style["partner_motion"]
    pose, phase = {name: style[name][30] for name in ("position_mm", "rotation_xyzw")}, None
    for _ in range(3):
        step = both.client.next_pose(**KESTREL, **pose, phase=phase)
        phase = step["phase"]
        at = {name: other[name][phase] for name in ("position_mm", "rotation_xyzw", "jaw_rad")}
        assert step["partner_pose"] == {"arm": "PSM1", **at}
        pose = {name: step[name] for name in pose}
    assert phase == 33
    far = np.add(pose["position_mm"], (0.0, 0.0, -21.0)).tolist()  # outside the tube the phase waits, and it with it
    step = both.client.next_pose(**KESTREL, **pose | {"position_mm": far}, phase=phase)
    assert (step["inside"], step["phase"]) == (False, 33)
    assert step["partner_pose"]["position_mm"] == other["position_mm"][33]


def test_where_one_arm_was_recorded_the_answers_have_no_other(posed: Service):
    style = posed.client.pose_style(**KESTREL)
    assert style["partner_motion"] is None and style["partner"] is None
    pose = {name: style[name][0] for name in ("position_mm", "rotation_xyzw")}
    assert posed.client.next_pose(**KESTREL, **pose)["partner_pose"] is None
    older = {name: value for name, value in posed.client.next_pose(**KESTREL, **pose).items() if name != "partner_pose"}
    assert NextPose.model_validate(older).partner_pose is None  # of an older service
    assert PoseStyle.model_validate(style).partner_motion is None


def test_beside_a_scene_the_distance_of_the_other_arm_is_stated(both: Service):
    """By hand: the box is 13 to 18 mm along x, 8 mm from PSM_A's path, and the other arm enters it after phase 96."""
    in_a_scene(both, 8.0)
    style = both.client.pose_style(**KESTREL)
    assert style["scene"]["least_mm"] == pytest.approx(8.0) and style["tube"]["faults"] == []
    assert style["partner_motion"]["scene"] == {"least_mm": 0.0, "part": "box 0", "phase": 96}
    assert both.client.next_pose(
        **KESTREL, position_mm=style["position_mm"][0], rotation_xyzw=style["rotation_xyzw"][0]
    )["partner_pose"]


def test_a_withdrawn_policy_has_no_pose_style(posed: Service):
    assert posed.http.get(POSES).status_code == 200
    posed.client.withdraw(**KESTREL)
    assert_problem(posed.http.get(POSES), 404, "not-found")
    body = {"position_mm": [0, 0, 0], "rotation_xyzw": [0, 0, 0, 1]}
    assert_problem(posed.http.post(NEXT, json=body), 404, "not-found")


def test_a_key_for_others_sees_no_pose_style(posed: Service):
    posed.client.put_surgeon("heron")
    with posed.database.writing() as session:
        _, theirs = create_key(session, "lab", "reader", "test", surgeons=["heron"])
        _, ours = create_key(session, "ours", "reader", "test", surgeons=["kestrel"])
    headers = {"Authorization": f"Bearer {theirs}"}
    assert_problem(posed.http.get(POSES, headers=headers), 404, "not-found")
    assert posed.http.get(POSES, headers={"Authorization": f"Bearer {ours}"}).status_code == 200


def test_positions_alone_have_no_pose_style_and_no_link(trained: Service):
    assert "link" not in trained.http.get(POLICY).headers
    assert "has no orientation" in assert_problem(trained.http.get(POSES), 404, "not-found")["detail"]
    with pytest.raises(Problem, match="has no orientation"):
        trained.client.next_pose(**KESTREL, position_mm=[0, 0, 0], rotation_xyzw=[0, 0, 0, 1])


def in_a_scene(service: Service, side_mm: float) -> None:
    """Release a version that is learnt beside a box, with its face so far from the demonstrated path."""
    x, y, z = np.array(service.http.get(POSES).json()["position_mm"]).T
    low, high = (x.max() + side_mm, y.min(), z.min()), (x.max() + side_mm + 5, y.max(), z.max())
    scene = {"frame": "PSM2_base", "boxes": [{"low_mm": low, "high_mm": high}]}
    learner = {"kind": "value-iteration", "gamma": 0.95, "slip": 0.0}
    job = service.train(scene=scene, learner=learner, release=True)
    assert job["result"]["released"], job["result"]


def test_a_pose_style_beside_a_scene_has_a_narrower_tube(posed: Service):
    in_a_scene(posed, 8.0)
    style = posed.client.pose_style(**KESTREL)
    assert style["scene"]["part"] == "box 0" and style["scene"]["least_mm"] == pytest.approx(8.0)
    assert style["tube"]["radius_mm"] == pytest.approx(8.0) and style["tube"]["faults"] == []
    nearest = style["scene"]["phase"]
    at = np.add(style["position_mm"][nearest], (9.0, 0.0, 0.0)).tolist()
    rotation = style["rotation_xyzw"][nearest]
    said = posed.client.next_pose(**KESTREL, position_mm=at, rotation_xyzw=rotation, phase=nearest)
    assert not said["inside"]


def test_a_pose_style_too_near_to_a_scene_is_not_served(posed: Service):
    in_a_scene(posed, 0.8)
    assert posed.http.get(POLICY).status_code == 200  # the policy of the grid is
    detail = assert_problem(posed.http.get(POSES), 404, "not-found")["detail"]
    assert "The path comes within 0.8 mm of box 0 of the scene" in detail
    with pytest.raises(Problem, match="further from the scene"):
        posed.client.next_pose(**KESTREL, position_mm=[0, 55, -125], rotation_xyzw=[0, 0, 0, 1])
    signed = posed.http.get(f"{POLICY}/signature")
    assert signed.status_code == 200
    names = [one["name"] for one in json.loads(base64.b64decode(signed.json()["payload"]))["subject"]]
    assert "policy.json" in names and "pose-style.json" not in names
