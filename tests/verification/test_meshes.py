"""The arms' outer bodies beside the manufacturer's meshes: they contain them, and are not much larger."""

import numpy as np
import pytest

from skills.kinematics import axes_of, instrument_of, matrix_of
from skills.verification import bodies
from skills.verification.gates import Limits
from skills.verification.hulls import MARGIN_MM, OUTLINE_MM
from tests.by_day import some
from tests.needs import need
from tests.verification import meshes

need("fcl")
pytestmark = pytest.mark.needs("meshes")
NO_MESH = ("setup joint end", "setup joint arm", "cannula", "carriage")  # these are ours; of the Si's carriages alone


@pytest.mark.parametrize("generation", meshes.TOOLS)
def test_the_meshes_follow_the_same_joints(generation):
    for q in np.random.default_rng(0).uniform(-0.6, 0.6, (10, 6)):
        pose = meshes.poses(generation, q)
        column = pose["insertion_link" if generation == "Classic" else "pitch_3_link"][:3, :3]
        flat = meshes.poses(generation, np.zeros(6))["insertion_link" if generation == "Classic" else "pitch_3_link"]
        shaft = axes_of(np.array([q]))[0][0]
        np.testing.assert_allclose(column @ flat[:3, :3].T @ [0, 0, -1], shaft, atol=1e-4)


@pytest.mark.parametrize("generation", meshes.TOOLS)
def test_bodies_contain_the_meshes_with_their_margin_to_spare(generation):
    tool = instrument_of(meshes.TOOLS[generation])
    for q in np.random.default_rng(1).uniform(tool.lower, tool.upper, (5, 6)):
        parts = bodies.parts_of(q[None], meshes.TOOLS[generation])
        for link, pose in meshes.poses(generation, q).items():
            corners = np.unique(meshes.arm(generation)[0][link].reshape(-1, 3).round(2), axis=0)[::5]
            corners = corners @ pose[:3, :3].T + pose[:3, 3]
            off, zero = np.full(len(corners), np.inf), np.zeros(len(corners), np.int64)
            for number in range(len(bodies.names_of(meshes.TOOLS[generation]))):
                hull, radius = parts.corners(zero, zero + number)
                off = np.minimum(off, bodies.hulls_apart(hull, corners[:, None], np.inf) - radius)
            assert off.max() <= -MARGIN_MM + 0.1, link


@pytest.mark.parametrize("tool", meshes.TOOLS.values())
def test_capsules_contain_their_outlines(tool):
    joints, names = np.zeros((1, 6)), bodies.names_of(tool)
    parts, found = bodies.parts_of(joints, tool), bodies.OUTLINES[instrument_of(tool).arm.name]
    assert set(found) < set(names)
    for name in found:
        number = np.array([names.index(name)])
        corners, begin = parts.corners(np.zeros(1, np.int64), number)[0][0], parts.begin_mm[0, number[0]]
        along = parts.end_mm[0, number[0]] - begin
        part = ((corners - begin) @ along / (along @ along)).clip(0, 1)
        off = np.linalg.norm(corners - begin - part[:, None] * along, axis=1) + OUTLINE_MM
        assert off.max() <= bodies.radii_of(tool)[number[0]], name


def near_set_ups(count: int, generation: str) -> list[tuple[float, float, str, str]]:
    """Return random set-ups of two arms that are near each other: mesh distance, ours, and our two parts."""
    rng, tool, found = np.random.default_rng(7), meshes.TOOLS[generation], []
    names = bodies.names_of(tool)
    while len(found) < count:
        turn, lean = rng.uniform(-1.2, 1.2), rng.uniform(-0.2, 0.2, 2)
        base = matrix_of(np.array([[*lean, np.sin(turn / 2), np.cos(turn / 2)]]) / np.sqrt(1 + lean @ lean))[0]
        base_mm = np.array([rng.choice([-1, 1]) * rng.uniform(60, 350), rng.uniform(-80, 80), rng.uniform(-40, 40)])
        joints = np.append(rng.uniform(-0.5, 0.5, (2, 2)), rng.uniform([100, 0, 0, 0], [180, 0, 0, 0], (2, 4)), axis=1)
        a, m = (bodies.parts_of(q[None], tool) for q in joints)
        apart = bodies.between(a, m.seen_from(base, base_mm), np.inf)[0]
        if not -30.0 < apart.min() < 30.0:
            continue
        mesh = meshes.apart_mm(
            meshes.placed(generation, joints[0], np.eye(3), np.zeros(3)),
            meshes.placed(generation, joints[1], base, base_mm),
        )
        i, j = np.unravel_index(apart.argmin(), apart.shape)
        found.append((mesh, float(apart.min()), names[i], names[j]))
    return found


@pytest.mark.parametrize("generation", meshes.TOOLS)
@pytest.mark.parametrize("count", some([60, 600], 2))
def test_no_near_set_up_is_called_freer_than_the_meshes(generation, count):
    for mesh, ours, *_ in near_set_ups(count, generation):
        assert ours <= max(mesh, 0.0)


@pytest.mark.parametrize("count", some([60, 600], 2))
def test_set_ups_whose_meshes_are_13_mm_apart_are_free(count):
    """Where both parts have a mesh; the setup joints, cannulae and their mounts are larger than what is published."""
    found = near_set_ups(count, "Classic")
    free = [one for one in found if one[0] >= 13.0 and not {*one[2:]} & {*NO_MESH[:3], "cannula mount"}]
    refused = [one for one in free if one[1] < Limits().clearance_bodies_mm]
    assert len(free) >= count / 5
    assert len(refused) <= 0.05 * len(free), refused  # one of 23: the bars end in forks, which are hollow
