"""What two engines that share nothing with the verdict measure along a motion: MuJoCo, and python-fcl on meshes.

MuJoCo has both tools as it reads `urdf/psm.urdf`, and a needle of round pieces that is made here; python-fcl has the
manufacturer's meshes of the Classic's arms (`tests.verification.meshes`).
"""

from collections.abc import Callable
from importlib.resources import files
from itertools import pairwise

import mujoco
import numpy as np

from skills.gridworld.scene import Scene
from skills.kinematics import forward, matrix_of, quaternion_of
from skills.planning.handoff import OtherArm
from skills.planning.trajectory import A1, A2, Trajectory
from skills.verification.clearance import LINKS
from tests.verification import meshes

PSM = str(files("skills") / "urdf" / "psm.urdf")
JOINTS = tuple(f"outer_{name}" for name in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"))
RADIUS_MM, THICK_MM, HELD_MM, PIECES = 26.0 / np.pi, 0.66, 9.0, 24
FAR_MM = 200.0  # distances beyond it are not measured
STEP_MM = 0.5  # by which a distance may be less between two samples that are measured
BODY_MM, TOOL_MM = 600.0, 260.0  # from the remote centre to the end of an arm's body, and of a tool or needle
REACH_MM = 30.0  # from the wrist to the end of needle and fingers
MEET_MM = 30.0  # between the hinges of two tools of which one has just taken the needle from the other


class Engine:
    """Two tools, a needle and a scene in MuJoCo."""

    def __init__(self, other: OtherArm, scene: Scene) -> None:
        spec = mujoco.MjSpec.from_file(PSM)
        spec.compiler.fusestatic = False
        x, y, z, w = other.base_xyzw
        frame = spec.worldbody.add_frame(pos=(other.base_mm / 1e3).tolist(), quat=[w, x, y, z])
        spec.attach(mujoco.MjSpec.from_file(PSM), prefix="m_", frame=frame)
        needle = spec.worldbody.add_body(name="needle", mocap=True)
        ends = needle_mm() / 1e3
        for begin, end in pairwise(ends):
            needle.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*begin, *end], size=[THICK_MM / 2e3, 0, 0], contype=1
            )
        around = spec.worldbody.add_body(name="scene")
        for box in scene.boxes:
            low, high = np.array(box.low_mm) / 1e3, np.array(box.high_mm) / 1e3
            around.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=(low + high) / 2, size=(high - low) / 2, contype=1)
        if scene.tissue is not None:  # level
            size, pos = [1.0, 1.0, 0.1], [0.0, 0.0, scene.tissue.at_mm[2] / 1e3 - 0.1]
            around.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size, contype=1)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.shapes = {name: self._of(name) for name in ("needle", "scene", *LINKS, *(f"m_{one}" for one in LINKS))}

    def _of(self, body: str) -> list[int]:
        found = self.model.body(body)
        numbers = range(found.geomadr[0], found.geomadr[0] + found.geomnum[0])
        return [k for k in numbers if self.model.geom_contype[k]]

    def place(self, prefix: str, joints: np.ndarray, finger_rad: float) -> None:
        values = dict(zip(JOINTS, (joints * [1, 1, 1e-3, 1, 1, 1]).tolist(), strict=True))
        for name, value in (values | {f"finger_{k}_hinge": finger_rad for k in (1, 2)}).items():
            self.data.qpos[self.model.joint(prefix + name).qposadr] = value

    def place_needle(self, place_mm: np.ndarray, rotation: np.ndarray) -> None:
        x, y, z, w = quaternion_of(rotation[None])[0]
        self.data.mocap_pos[0], self.data.mocap_quat[0] = place_mm / 1e3, [w, x, y, z]

    def apart_mm(self, some: list[str], others: list[str]) -> float:
        pairs = ((a, b) for one in some for a in self.shapes[one] for other in others for b in self.shapes[other])
        far_m = FAR_MM / 1e3
        return min(
            (1e3 * mujoco.mj_geomDistance(self.model, self.data, a, b, far_m, None) for a, b in pairs), default=FAR_MM
        )


def needle_mm() -> np.ndarray:
    """Return the ends of the needle's pieces, mm, in its frame: x along it where it is held, y to the arc's middle."""
    along = np.linspace(-np.pi / 3, 2 * np.pi / 3, PIECES + 1)
    return RADIUS_MM * np.stack([np.sin(along), 1 - np.cos(along), np.zeros_like(along)], axis=1)


def ways_mm(trajectory: Trajectory, pivot_mm: float) -> np.ndarray:
    """Return how far any part within a distance of its remote centre has moved at most, of both arms together, mm."""
    levers_mm = [pivot_mm, pivot_mm, 1.0, *3 * [REACH_MM]]
    both = np.append(trajectory.joints, trajectory.psm_m.joints, axis=1)
    return np.append(0.0, (np.abs(np.diff(both, axis=0)) @ np.tile(levers_mm, 2)).cumsum())


def keeps_apart(ways: np.ndarray, apart_mm: Callable[[int], float], least_mm: float) -> bool:
    """Return whether a distance stays above a limit, to `STEP_MM`: it changes by no more than the ways."""
    at = 0
    while at < len(ways):
        if not (apart := apart_mm(at)) >= least_mm:
            return False
        at = max(at + 1, int(np.searchsorted(ways, ways[at] + max(apart - least_mm, STEP_MM))))
    return True


def meshes_keep_apart(trajectory: Trajectory, least_mm: float) -> bool:
    """Return whether the meshes of both arms stay a distance apart."""
    other = trajectory.psm_m
    base = matrix_of(other.base_xyzw[None])[0]

    def apart_mm(at: int) -> float:
        ours = meshes.placed("Classic", trajectory.joints[at], np.eye(3), np.zeros(3))
        return meshes.apart_mm(ours, meshes.placed("Classic", other.joints[at], base, other.base_mm))

    return keeps_apart(ways_mm(trajectory, BODY_MM), apart_mm, least_mm)


def tools_keep_apart(trajectory: Trajectory, scene: Scene, waits: bool, least_mm: float) -> bool:
    """Return whether tools, needle and scene stay a distance apart.

    Where the arms meet, fingers are not measured from fingers, nor fingers and wrist of the arm without the needle from
    it: from A2 on until PSM_M has gone back, and before where PSM_M waits at the hand-off.

    Args:
        trajectory: The motion of both arms.
        scene: Level tissue and boxes.
        waits: Whether PSM_M waits at the hand-off from the start.
        least_mm: The distance.
    """
    other = trajectory.psm_m
    engine, turned = Engine(other, scene), matrix_of(trajectory.rotation_xyzw)
    base = matrix_of(other.base_xyzw[None])[0]
    m_tip, m_turned = forward(other.joints)
    m_tip, m_turned = m_tip @ base.T + other.base_mm, base @ m_turned
    ours, theirs = [*LINKS], [f"m_{one}" for one in LINKS]

    def needle_of_a(at: int) -> tuple[np.ndarray, np.ndarray]:
        last = trajectory.last_samples[trajectory.pass_index[at]]
        side = -1.0 if turned[last][:, 0] @ m_turned[last][:, 2] > 0 else 1.0  # its free end is where PSM_M comes from
        return trajectory.tip_mm[at] + HELD_MM * turned[at][:, 2], turned[at] * [side, side, 1.0]

    def apart_mm(at: int) -> float:
        engine.place("", trajectory.joints[at], float(trajectory.jaw_rad[at]) / 2)
        engine.place("m_", other.joints[at], float(other.jaw_rad[at]) / 2)
        of_a, meet = trajectory.phase[at] in (A1, A2), waits or trajectory.phase[at] == A2
        place, pose = needle_of_a(at)
        if not of_a:  # PSM_M has had it since the pass before
            took = int(trajectory.last_samples[trajectory.pass_index[at] - 1])
            place, pose = needle_of_a(took)
            turn = m_turned[at] @ m_turned[took].T
            place, pose = m_tip[at] + turn @ (place - m_tip[took]), turn @ pose
            meet = meet or float(np.linalg.norm(m_tip[at] - trajectory.tip_mm[at])) < MEET_MM
        engine.place_needle(place, pose)
        mujoco.mj_kinematics(engine.model, engine.data)
        others = theirs if of_a else ours
        return min(
            engine.apart_mm(ours, theirs[:-2]),
            engine.apart_mm(ours[:-2] if meet else ours, theirs),
            engine.apart_mm([*ours, *theirs, "needle"], ["scene"]),
            engine.apart_mm(["needle"], others[:1] if meet else others),
        )

    return keeps_apart(ways_mm(trajectory, TOOL_MM), apart_mm, least_mm)
