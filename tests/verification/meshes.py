"""The manufacturer's meshes of both arms, placed by their own URDF: jhu-dvrk/dvrk_model, which is not in this project.

Nothing here is shared with `skills`: the chains are followed joint by joint, and python-fcl measures. Meshes of the
Classic are in its tree, those of the Si in Git LFS. The instrument's shaft is left out: tools are compared elsewhere.
"""

import os
import re
import struct
import xml.etree.ElementTree as ET
from functools import cache
from math import pi
from pathlib import Path

import fcl
import numpy as np

TOOLS = {"Classic": "400006", "Si": "420006"}
AT_ZERO = {"Classic": 0.0, "Si": -0.162975}  # of the URDF's pitch, where that of the controller is 0
HOUSING = "meshes/instruments/housing/Classic/housing_Classic_body.dae"
ANGLES = {"PI": pi, "PI_2": pi / 2, "-PI": -pi, "-PI_2": -pi / 2}


def folder() -> Path:
    return Path(os.environ["SKILLS_TEST_MESHES"])


def numbers(text: str) -> list[float]:
    return [float(one) for one in re.sub(r"\$\{([^}]*)\}", lambda found: str(ANGLES[found[1]]), text).split()]


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def origin(of: ET.Element) -> np.ndarray:
    found, pose = of.find("origin"), np.eye(4)
    if found is not None:
        roll, pitch, yaw = numbers(found.get("rpy", "0 0 0"))
        x, y, z = np.eye(3)
        pose[:3, :3] = turned(z, yaw) @ turned(y, pitch) @ turned(x, roll)
        pose[:3, 3] = 1000 * np.array(numbers(found.get("xyz", "0 0 0")))
    return pose


def triangles(path: Path) -> np.ndarray:
    """Return the triangles of a file, in mm, (N, 3, 3)."""
    data = path.read_bytes()
    if path.suffix == ".stl":
        rows = np.frombuffer(data, "<f4,<f4,<f4,(9,)<f4,<u2", struct.unpack("<I", data[80:84])[0], 84)
        return 1000 * rows["f3"].reshape(-1, 3, 3).astype(float)
    space = "{http://www.collada.org/2005/11/COLLADASchema}"
    found, root = [], ET.fromstring(data)
    for mesh in root.iter(f"{space}mesh"):
        sources = {one.get("id"): one for one in mesh.iter(f"{space}source")}
        positions = mesh.find(f"{space}vertices/{space}input[@semantic='POSITION']").get("source")[1:]
        places = np.array(sources[positions].find(f"{space}float_array").text.split(), float).reshape(-1, 3)
        for part in mesh.iter(f"{space}triangles"):
            inputs = part.findall(f"{space}input")
            stride = 1 + max(int(one.get("offset")) for one in inputs)
            at = next(int(one.get("offset")) for one in inputs if one.get("semantic") == "VERTEX")
            rows = (np.array(one.text.split(), int).reshape(-1, stride)[:, at] for one in part.findall(f"{space}p"))
            found += [places[one].reshape(-1, 3, 3) for one in rows]
    return 1000 * np.concatenate(found)


@cache
def arm(generation: str) -> tuple[dict[str, np.ndarray], dict[str, tuple]]:
    """Return the triangles of each link in its own frame, and the joint before each link."""
    text = (folder() / "urdf" / generation / "PSM_base.urdf.xacro").read_text()
    for name, value in (("prefix", ""), ("parent_link", "world"), ("xyz", "0 0 0"), ("rpy", "0 0 0")):
        text = text.replace(f"${{{name}}}", value)
    root, links, joints = ET.fromstring(text), {}, {}
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            if (mesh := visual.find("geometry/mesh")) is not None:
                pose = origin(visual)
                file = folder() / mesh.get("filename").split("dvrk_model/")[1]
                links[link.get("name")] = triangles(file) @ pose[:3, :3].T + pose[:3, 3]
    if generation == "Classic":
        housing = triangles(folder() / HOUSING) @ turned(np.eye(3)[2], pi / 2).T + [0, 0, 90.4]
        links["adaptor_link"] = housing[housing[:, :, 2].max(axis=1) < 110.0]
    for joint in root.iter("joint"):
        axis, same = joint.find("axis"), joint.find("mimic")
        joints[joint.find("child").get("link")] = (
            joint.find("parent").get("link"),
            joint.get("type"),
            origin(joint),
            None if axis is None else np.array(numbers(axis.get("xyz"))),
            joint.get("name") if same is None else same.get("joint"),
            1.0 if same is None else float(same.get("multiplier")),
        )
    return links, joints


def poses(generation: str, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return the pose of each link with a mesh in the arm's base frame, mm, (4, 4)."""
    links, joints = arm(generation)
    moved = {"yaw": q[0], "pitch": q[1] + AT_ZERO[generation], "insertion": q[2]}
    found = {}
    for link in links:
        pose, at = np.eye(4), link
        while at in joints and joints[at][0] != "world":
            before, kind, place, axis, name, times = joints[at]
            move = np.eye(4)
            if kind == "prismatic":
                move[:3, 3] = times * moved[name] * axis
            elif axis is not None:
                move[:3, :3] = turned(axis, times * moved[name])
            pose, at = place @ move @ pose, before
        found[link] = pose
    return found


@cache
def model(generation: str, link: str) -> fcl.BVHModel:
    mesh, found = arm(generation)[0][link], fcl.BVHModel()
    found.beginModel(3 * len(mesh), len(mesh))
    found.addSubModel(mesh.reshape(-1, 3), np.arange(3 * len(mesh)).reshape(-1, 3))
    found.endModel()
    return found


def placed(generation: str, q: np.ndarray, base: np.ndarray, base_mm: np.ndarray) -> list[fcl.CollisionObject]:
    return [
        fcl.CollisionObject(
            model(generation, link), fcl.Transform(base @ pose[:3, :3], base @ pose[:3, 3] + np.asarray(base_mm))
        )
        for link, pose in poses(generation, q).items()
    ]


def apart_mm(first: list[fcl.CollisionObject], second: list[fcl.CollisionObject]) -> float:
    """Return the least distance of two arms; -1 if they collide."""
    least = np.inf
    for a in first:
        for b in second:
            if fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()):
                return -1.0
            least = min(least, fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult()))
    return least
