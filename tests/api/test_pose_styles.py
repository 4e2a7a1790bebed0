"""Pose styles over HTTP: the one of the released policy, the link to it, and the next pose."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from skills.client import Problem
from skills.library.keys import create_key
from skills.library.policies import FORMAT
from tests import backends
from tests.api.posed import of_pose_style
from tests.api.service import KESTREL, POLICY, Service, assert_problem, serving
from tests.library import cases

POSES, NEXT = f"{POLICY}/pose-style", f"{POLICY}/next"


@pytest.fixture(params=backends.BACKENDS)
def posed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Service]:
    """Yield a service in which kestrel's style, with orientation, is released."""
    url = of_pose_style(request.param, tmp_path)
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
