"""The files of the scene in other readers of URDF: equal kinematics, and equal distances.

MuJoCo is there by day. At night yourdfpy and Pinocchio read them too, where whoever runs it has installed them
(`pip install yourdfpy pin`, for tests alone).
"""

import io
from importlib.resources import files
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from skills.kinematics import forward
from skills.verification.clearance import LINKS, clearance_between, links_of
from tests.verification.test_clearance import BASE, BASE_MM, joints_anywhere, two_arms

FOLDER = files("skills") / "urdf"
NAMES = ("psm.urdf", "needle.urdf", "suture_pad.urdf")
STANDARD = {"box", "cylinder", "sphere"}  # of the URDF specification, without meshes
JOINTS = tuple(f"outer_{name}" for name in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"))
BASE_XYZW = (0.0, np.sin(np.radians(35) / 2), 0.0, np.cos(np.radians(35) / 2))
FINGER_RAD = np.radians(30.0)


def in_metres(joints: np.ndarray) -> list[float]:
    return (joints * [1, 1, 1e-3, 1, 1, 1]).tolist()


@pytest.mark.parametrize("name", NAMES)
def test_shapes_are_those_of_the_standard_and_something_collides(name: str):
    root = ElementTree.fromstring((FOLDER / name).read_text())
    shapes = [one.tag for one in root.iterfind("link/collision/geometry/*")]
    assert shapes and set(shapes) <= STANDARD


def two_in_mujoco() -> mujoco.MjModel:
    """Return a model with PSM_A at the origin and PSM_M at `BASE`, whose names begin with m_."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "psm.urdf"))
    x, y, z, w = BASE_XYZW
    frame = spec.worldbody.add_frame(pos=(np.array(BASE_MM) / 1e3).tolist(), quat=[w, x, y, z])
    spec.attach(mujoco.MjSpec.from_file(str(FOLDER / "psm.urdf")), prefix="m_", frame=frame)
    return spec.compile()


def pose(model: mujoco.MjModel, data: mujoco.MjData, prefix: str, joints: np.ndarray, finger_rad: float) -> None:
    named = dict(zip(JOINTS, in_metres(joints), strict=True)) | {f"finger_{k}_hinge": finger_rad for k in (1, 2)}
    for name, value in named.items():
        data.qpos[model.joint(prefix + name).qposadr] = value


def test_mujoco_puts_the_tip_where_the_closed_form_has_it():
    model = mujoco.MjModel.from_xml_path(str(FOLDER / "psm.urdf"))
    data = mujoco.MjData(model)
    joints = joints_anywhere(200, seed=3)
    tips_mm, rotations = forward(joints)
    for q, tip_mm, rotation in zip(joints, tips_mm, rotations, strict=True):
        pose(model, data, "", q, 0.0)
        mujoco.mj_kinematics(model, data)
        finger = data.body("finger_1")  # at an angle of 0 its frame is the tool's
        np.testing.assert_allclose(finger.xpos * 1e3, tip_mm, atol=1e-6)
        np.testing.assert_allclose(finger.xmat.reshape(3, 3), rotation, atol=1e-9)


def test_mujoco_has_the_arms_as_far_apart_as_the_closed_form():
    model = two_in_mujoco()
    data = mujoco.MjData(model)
    joints, joints_m = two_arms(100)
    opening = 2 * FINGER_RAD
    ours = clearance_between(
        links_of(joints, opening_rad=FINGER_RAD), links_of(joints_m, opening_rad=FINGER_RAD).seen_from(BASE, BASE_MM)
    )
    assert opening > 0 and 10 < np.count_nonzero(ours.min(axis=(1, 2)) < 0) < 90
    shapes = {prefix: [solid(model, prefix + link) for link in LINKS] for prefix in ("", "m_")}
    for k in range(100):
        pose(model, data, "", joints[k], FINGER_RAD)
        pose(model, data, "m_", joints_m[k], FINGER_RAD)
        mujoco.mj_kinematics(model, data)
        theirs = np.array([[apart_mm(model, data, a, b) for b in shapes["m_"]] for a in shapes[""]])
        apart = ours[k] > 0.01
        np.testing.assert_allclose(theirs[apart], ours[k][apart], atol=0.01)  # mm
        assert (theirs[~apart] < 0.02).all()


def solid(model: mujoco.MjModel, link: str) -> list[int]:
    """Return the shapes of a link that collide."""
    body = model.body(link)
    first, count = body.geomadr[0], body.geomnum[0]
    return [k for k in range(first, first + count) if model.geom_contype[k]]


def apart_mm(model: mujoco.MjModel, data: mujoco.MjData, some: list[int], others: list[int]) -> float:
    return min(1e3 * mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in some for b in others)


@pytest.mark.nightly
def test_yourdfpy_puts_the_tip_where_the_closed_form_has_it():
    yourdfpy = pytest.importorskip("yourdfpy", reason="pip install yourdfpy")
    for name in NAMES:
        yourdfpy.URDF.load(io.StringIO((FOLDER / name).read_text()), build_collision_scene_graph=True)
    arm = yourdfpy.URDF.load(io.StringIO((FOLDER / "psm.urdf").read_text()), build_collision_scene_graph=True)
    joints = joints_anywhere(50, seed=4)
    for q, tip_mm, rotation in zip(joints, *forward(joints), strict=True):
        arm.update_cfg(dict(zip(JOINTS, in_metres(q), strict=True)))
        found = arm.get_transform("tool_frame", "base")
        np.testing.assert_allclose(found[:3, 3] * 1e3, tip_mm, atol=1e-6)
        np.testing.assert_allclose(found[:3, :3], rotation, atol=1e-9)


@pytest.mark.nightly
def test_pinocchio_has_the_tip_and_the_distances_of_the_closed_form():
    pin = pytest.importorskip("pinocchio", reason="pip install pin")
    coal = pytest.importorskip("coal")
    path = str(FOLDER / "psm.urdf")
    model = pin.buildModelFromUrdf(path)
    shapes = pin.buildGeomFromUrdf(model, path, pin.COLLISION)
    assert len(shapes.geometryObjects) == 3 * len(LINKS)
    tool, data = model.getFrameId("tool_frame"), model.createData()
    x, y, z, w = BASE_XYZW
    base = pin.SE3(pin.Quaternion(w, x, y, z), np.array(BASE_MM) / 1e3)

    def placed(q: np.ndarray, tip_mm: np.ndarray, rotation: np.ndarray) -> dict[str, list]:
        """Return the shapes of each link with their places, after a look at the tip."""
        values = dict(zip(JOINTS, in_metres(q), strict=True)) | {f"finger_{k}_hinge": FINGER_RAD for k in (1, 2)}
        configuration = np.array([values[name] for name in model.names[1:]])
        pin.framesForwardKinematics(model, data, configuration)
        np.testing.assert_allclose(data.oMf[tool].translation * 1e3, tip_mm, atol=1e-6)
        np.testing.assert_allclose(data.oMf[tool].rotation, rotation, atol=1e-9)
        at = shapes.createData()
        pin.updateGeometryPlacements(model, data, shapes, at)
        named = list(zip((one.name for one in shapes.geometryObjects), shapes.geometryObjects, at.oMg, strict=True))
        return {link: [(one.geometry, place) for name, one, place in named if name.startswith(link)] for link in LINKS}

    def apart(a: tuple, b: tuple) -> float:
        found = coal.DistanceResult()
        (one, here), (other, there) = a, (b[0], base * b[1])
        ends = [coal.Transform3s(place.rotation, place.translation) for place in (here, there)]
        return 1e3 * coal.distance(one, ends[0], other, ends[1], coal.DistanceRequest(), found)

    joints, joints_m = two_arms(50)
    ours = clearance_between(
        links_of(joints, opening_rad=FINGER_RAD), links_of(joints_m, opening_rad=FINGER_RAD).seen_from(BASE, BASE_MM)
    )
    arms = (zip(q, *forward(q), strict=True) for q in (joints, joints_m))
    for k, (one, other) in enumerate(zip(*arms, strict=True)):
        a, m = placed(*one), placed(*other)
        theirs = [[min(apart(i, j) for i in a[link] for j in m[beside]) for beside in LINKS] for link in LINKS]
        free = ours[k] > 0.01
        np.testing.assert_allclose(np.array(theirs)[free], ours[k][free], atol=0.01)  # mm
