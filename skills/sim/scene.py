"""The scene in PyBullet: PSM_A, the pad, the needle and, where its place is known, PSM_M. Metres on this side.

The only module that imports pybullet, and only when a scene is made. `simulate` is the whole of it from outside:
bytes in, bytes out, in a process of its own (`skills.sim.confined`).

Two passes over the trajectory:

* kinematic: `resetJointState` puts the joints exactly where they shall be; we read back the joints, the frame of the
  link `tool_frame` and the distances between surfaces.
* servo: the motors follow under gravity with the arm's real greatest efforts. The motor's law is
  v = gain (q_target - q) / dt + v_target; with the target at the step's start and the step's own speed it is exact.
"""

import importlib.util
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import as_file, files
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skills.errors import SimulationFailed
from skills.sim import pictures, wire
from skills.style._arrays import Floats, Ints
from skills.style.kinematics import INSERTION, JOINTS, Instrument, instrument_of
from skills.style.playback import CLEARANCE_SEEN_MM
from skills.style.trajectory import A1

MM = 1e-3
POSITION_GAIN, VELOCITY_GAIN = 0.3, 1.0
JAW_OPENING_RAD = 0.06  # of each finger: as if a needle were between them
FINGERS = ("finger_1_hinge", "finger_2_hinge")
FINGER_EFFORT = 0.16  # Nm
PSM_M_COLOUR = (0.35, 0.55, 0.35, 1.0)


def require_pybullet() -> None:
    """Tell early, and without importing it, where PyBullet is missing.

    Raises:
        SimulationFailed: It is not installed; the message says what to install.
    """
    if importlib.util.find_spec("pybullet") is None:
        raise SimulationFailed(
            "PyBullet is not installed, so no playback can be checked. On Python 3.11 and Linux x86-64 install it with "
            "`pip install pybullet==3.2.7`; elsewhere build it from source.",
            cause="not installed",
        )


def simulate(request: bytes) -> bytes:
    """Play what `skills.sim.player` asks for and answer with what was measured."""
    asked = wire.unpack(request)
    with opened(str(asked["instrument"]), float(asked["rate_hz"])) as scene:
        scene.place_pad(asked["tip_mm"], float(asked["pad_top_mm"]))
        if "m_joints" in asked:
            scene.place_psm_m(asked["m_base_mm"], asked["m_base_xyzw"])
        measured = _kinematic_pass(scene, asked)
        tracking, seconds = _servo_pass(scene, asked)
        scene.pose(asked["joints"][_pictured(asked)])
        picture = pictures.draw(scene.photograph, _paths(asked))
        measured |= {
            "tracking_mm": tracking,
            "seconds_per_step": np.array(seconds),
            "picture_png": np.frombuffer(picture, np.uint8),
            "engine": np.array(f"PyBullet {version('pybullet')}"),
        }
        return wire.pack(measured)


@contextmanager
def opened(instrument: str, rate_hz: float) -> Iterator["Scene"]:
    """Open a fresh scene with PSM_A in it, and close it again; a fresh one gives the same numbers each time."""
    require_pybullet()
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setTimeStep(1.0 / rate_hz, physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        yield Scene(pybullet, client, instrument_of(instrument))
    finally:
        pybullet.disconnect(physicsClientId=client)


@dataclass(frozen=True)
class _Body:
    """A loaded arm: its number, and the indices of its joints and links by name."""

    number: int
    joints: tuple[int, ...]
    fingers: tuple[int, ...]
    tool: int


class Scene:
    """One simulation; every length that goes in is in mm."""

    def __init__(self, bullet: ModuleType, client: int, tool: Instrument) -> None:
        self.bullet: Any = bullet
        self.client = client
        self.tool = tool
        self.arm = self._load_arm(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        self.pad: int | None = None
        self.psm_m: _Body | None = None
        self.needle: int | None = None

    # -- what is in it --

    def place_pad(self, tip_mm: Floats, top_mm: float) -> None:
        """Lay the pad under the middle of the path, its wound along the path's longer side."""
        low, high = tip_mm.min(axis=0), tip_mm.max(axis=0)
        middle = (low + high) / 2
        turned = np.pi / 2 if high[1] - low[1] > high[0] - low[0] else 0.0
        quaternion = [0.0, 0.0, float(np.sin(turned / 2)), float(np.cos(turned / 2))]
        self.pad = self._load("suture_pad.urdf", np.array([middle[0], middle[1], top_mm]), quaternion)

    def place_psm_m(self, base_mm: Floats, base_xyzw: Floats) -> None:
        """Set up PSM_M, in green; the arms go through each other, and their distance is measured."""
        self.psm_m = self._load_arm(base_mm, base_xyzw)
        links = range(-1, self.bullet.getNumJoints(self.psm_m.number, physicsClientId=self.client))
        for link in links:
            for own in links:
                self.bullet.setCollisionFilterPair(
                    self.arm.number, self.psm_m.number, own, link, 0, physicsClientId=self.client
                )
            self.bullet.changeVisualShape(self.psm_m.number, link, rgbaColor=PSM_M_COLOUR, physicsClientId=self.client)

    def pose(self, joints: Floats, body: _Body | None = None) -> None:
        """Put an arm's joints (rad, insertion mm) exactly there, at rest."""
        arm = body or self.arm
        reset = self.bullet.resetJointState
        for index, value in zip(arm.joints, _in_metres(joints), strict=True):
            reset(arm.number, index, value, physicsClientId=self.client)

    # -- what is seen --

    def read_joints(self) -> list[float]:
        """Read PSM_A's joints, rad and mm."""
        states = self.bullet.getJointStates(self.arm.number, self.arm.joints, physicsClientId=self.client)
        values = [float(state[0]) for state in states]
        values[INSERTION] /= MM
        return values

    def read_tip(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Read PSM_A's tool frame: position in mm and quaternion."""
        state = self.bullet.getLinkState(
            self.arm.number, self.arm.tool, computeForwardKinematics=1, physicsClientId=self.client
        )
        return np.array(state[4]) / MM, np.array(state[5])  # [0] and [1] would be the centre of mass

    def clearance_mm(self, other: int) -> float:
        """Measure the distance between PSM_A's surfaces and another body's; negative inside."""
        points = self.bullet.getClosestPoints(
            self.arm.number, other, CLEARANCE_SEEN_MM * MM, physicsClientId=self.client
        )
        return min((float(point[8]) / MM for point in points), default=CLEARANCE_SEEN_MM)

    def drive(self, start: Floats, velocity: Floats) -> None:
        """Let the motors move PSM_A through one time step that begins at `start`, rad and mm, and per second."""
        arm = self.arm
        self.bullet.setJointMotorControlArray(
            arm.number,
            [*arm.joints, *arm.fingers],
            self.bullet.POSITION_CONTROL,
            targetPositions=[*_in_metres(start), JAW_OPENING_RAD, JAW_OPENING_RAD],
            targetVelocities=[*_in_metres(velocity), 0.0, 0.0],
            forces=[*self.tool.arm.effort, FINGER_EFFORT, FINGER_EFFORT],
            positionGains=[POSITION_GAIN] * 8,
            velocityGains=[VELOCITY_GAIN] * 8,
            physicsClientId=self.client,
        )
        self.bullet.stepSimulation(physicsClientId=self.client)

    def photograph(self, camera: pictures.Camera) -> pictures.Photograph:
        """Take a picture of the scene as it stands, with the needle between the jaws."""
        tip_mm, quaternion = self.read_tip()
        approach = np.array(self.bullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)[:, 2]
        if self.needle is None:
            self.needle = self._load("needle.urdf", np.zeros(3), [0.0, 0.0, 0.0, 1.0])
        held = (tip_mm + 9.0 * approach) * MM
        self.bullet.resetBasePositionAndOrientation(
            self.needle, held.tolist(), quaternion.tolist(), physicsClientId=self.client
        )
        view = self.bullet.computeViewMatrixFromYawPitchRoll(
            camera.target_m, camera.distance_m, camera.yaw_deg, camera.pitch_deg, 0.0, 2
        )
        projection = self.bullet.computeProjectionMatrixFOV(
            camera.field_deg, camera.width / camera.height, camera.near_m, camera.far_m
        )
        image = self.bullet.getCameraImage(
            camera.width,
            camera.height,
            view,
            projection,
            lightDirection=(0.3, 0.5, 1.0),
            renderer=self.bullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        size = (camera.height, camera.width)
        return pictures.Photograph(
            rgb=np.asarray(image[2], np.uint8).reshape(*size, 4)[:, :, :3].copy(),
            depth=np.asarray(image[3], np.float64).reshape(size),
            view=np.array(view).reshape(4, 4).T,
            projection=np.array(projection).reshape(4, 4).T,
        )

    # -- loading --

    def _load(self, name: str, position_mm: Floats, quaternion: Sequence[float]) -> int:
        with as_file(files("skills") / "urdf" / name) as path:
            return int(
                self.bullet.loadURDF(
                    str(path),
                    basePosition=(np.asarray(position_mm) * MM).tolist(),
                    baseOrientation=list(quaternion),
                    useFixedBase=1,
                    # Otherwise cylinders are hulls, a millimetre too thick.
                    flags=self.bullet.URDF_USE_IMPLICIT_CYLINDER,
                    physicsClientId=self.client,
                )
            )

    def _load_arm(self, position_mm: Floats, quaternion: Floats) -> _Body:
        number = self._load("psm.urdf", position_mm, np.asarray(quaternion).tolist())
        found = [
            self.bullet.getJointInfo(number, index, physicsClientId=self.client)
            for index in range(self.bullet.getNumJoints(number, physicsClientId=self.client))
        ]
        by_joint = {info[1].decode(): int(info[0]) for info in found}
        by_link = {info[12].decode(): int(info[0]) for info in found}
        arm = _Body(
            number=number,
            joints=tuple(by_joint[f"outer_{name}"] for name in JOINTS),
            fingers=tuple(by_joint[name] for name in FINGERS),
            tool=by_link["tool_frame"],
        )
        self.bullet.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=self.client)
        lower, upper = _in_metres(self.tool.lower), _in_metres(self.tool.upper)
        for joint, index in enumerate(arm.joints):
            # The file has the Classic's limits, a Si has others. In a call of its own: with damping it has no effect.
            self.bullet.changeDynamics(
                number,
                index,
                jointLowerLimit=lower[joint],
                jointUpperLimit=upper[joint],
                physicsClientId=self.client,
            )
        for index in arm.fingers:
            self.bullet.resetJointState(number, index, JAW_OPENING_RAD, physicsClientId=self.client)
        return arm


# ---- the two passes --------------------------------------------------------------------------------------------


def _kinematic_pass(scene: Scene, asked: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Put the joints at every sample and look."""
    wanted = asked["joints"]
    count = len(wanted)
    joints, tip, rotation = np.empty((count, 6)), np.empty((count, 3)), np.empty((count, 4))
    pad, other = np.empty(count), np.full(count, CLEARANCE_SEEN_MM)
    for k in range(count):
        scene.pose(wanted[k])
        joints[k] = scene.read_joints()
        tip[k], rotation[k] = scene.read_tip()
        pad[k] = CLEARANCE_SEEN_MM if scene.pad is None else scene.clearance_mm(scene.pad)
        if scene.psm_m is not None and _psm_m_is_there(scene, scene.psm_m, asked, k):
            other[k] = scene.clearance_mm(scene.psm_m.number)
    measured = {"joints": joints, "tip_mm": tip, "rotation_xyzw": rotation, "clearance_pad_mm": pad}
    return measured if scene.psm_m is None else measured | {"clearance_psm_m_mm": other}


def _psm_m_is_there(scene: Scene, psm_m: _Body, asked: dict[str, NDArray[Any]], k: int) -> bool:
    """Bring PSM_M to its pose of this pass where a pass begins; tell whether it has entered."""
    number: Ints = asked["pass_index"]
    if k == 0 or number[k] != number[k - 1]:
        scene.pose(asked["m_joints"][number[k]], psm_m)
    return not (bool(asked["m_enters_after_a1"]) and asked["phase"][k] == A1)


def _servo_pass(scene: Scene, asked: dict[str, NDArray[Any]]) -> tuple[Floats, float]:
    """Let the motors follow; measure the tip's error at each sample, mm, and the seconds of a step."""
    wanted, tips, number = asked["joints"], asked["tip_mm"], asked["pass_index"]
    rate = float(asked["rate_hz"])
    error = np.empty(len(wanted))
    steps, seconds = 0, 0.0
    for k in range(len(wanted)):
        if k == 0 or number[k] != number[k - 1]:
            scene.pose(wanted[k])
        else:
            began = time.perf_counter()
            scene.drive(wanted[k - 1], (wanted[k] - wanted[k - 1]) * rate)
            seconds += time.perf_counter() - began
            steps += 1
        error[k] = np.linalg.norm(scene.read_tip()[0] - tips[k])
    return error, seconds / max(1, steps)


def _in_metres(joints: Floats) -> list[float]:
    """Make a row of joints PyBullet's: the insertion in metres."""
    values = np.asarray(joints, float).tolist()
    values[INSERTION] *= MM
    return list(values)


def _paths(asked: dict[str, NDArray[Any]]) -> list[Floats]:
    """List the way of the tip in A1 of each pass, in metres, each of shape (K, 3)."""
    number, tip, first = asked["pass_index"], asked["tip_mm"] * MM, asked["phase"] == A1
    return [tip[(number == one) & first] for one in range(int(number[-1]) + 1)]


def _pictured(asked: dict[str, NDArray[Any]]) -> int:
    """Choose the sample that is pictured: half-way through A1 of the last pass."""
    last = np.flatnonzero((asked["pass_index"] == asked["pass_index"][-1]) & (asked["phase"] == A1))
    return int(last[len(last) // 2]) if len(last) else len(asked["joints"]) - 1
