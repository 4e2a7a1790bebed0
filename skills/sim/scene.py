"""The scene in PyBullet: PSM_A, the pad, the needle and, where its place is known, PSM_M. Metres on this side.

The only module that imports pybullet, and only when a scene is made. What is done in it is in `skills.sim.passes`.
"""

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import as_file, files
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skills.errors import SimulationFailed
from skills.sim import pictures
from skills.style._arrays import Floats
from skills.style.handoff import HELD_MM, HOLDING_RAD, OPEN_RAD
from skills.style.kinematics import INSERTION, JOINTS, Instrument, instrument_of
from skills.style.playback import CLEARANCE_SEEN_MM, FINGERS, LINKS, pad_scale

MM = 1e-3
PLACE, TURN = 4, 5  # of a link's state: its frame; 0 and 1 would be its centre of mass
EFFORT = 3  # of a joint's state
POSITION_GAIN, VELOCITY_GAIN = 0.3, 1.0
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
class Body:
    """A loaded arm: its number, and the indices of its joints and links; `surfaces` are those of `playback.LINKS`."""

    number: int
    joints: tuple[int, ...]
    fingers: tuple[int, ...]
    tool: int
    shaft: int
    surfaces: tuple[int, ...]


class Scene:
    """One simulation; every length that goes in is in mm."""

    def __init__(self, bullet: ModuleType, client: int, tool: Instrument) -> None:
        self.bullet: Any = bullet
        self.client = client
        self.tool = tool
        self.files: dict[str, str] = {}
        self.arm = self._load_arm(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), tool, HOLDING_RAD)
        self.pad: int | None = None
        self.pad_mm = np.zeros(3)
        self.psm_m: Body | None = None
        self.needle: int | None = None
        self._driven = [*self.arm.joints, *self.arm.fingers]
        self._efforts = [*tool.arm.effort, FINGER_EFFORT, FINGER_EFFORT]
        self._position_gains, self._velocity_gains = [POSITION_GAIN] * 8, [VELOCITY_GAIN] * 8

    # -- what is in it --

    def place_pad(self, tip_mm: Floats, top_mm: float) -> None:
        """Lay the pad under the middle of the path, its wound along the path's longer side, as large as that asks."""
        low, high = tip_mm.min(axis=0), tip_mm.max(axis=0)
        middle = (low + high) / 2
        turned = np.pi / 2 if high[1] - low[1] > high[0] - low[0] else 0.0
        quaternion = [0.0, 0.0, float(np.sin(turned / 2)), float(np.cos(turned / 2))]
        self.pad_mm = np.array([middle[0], middle[1], top_mm])
        self.pad = self._load("suture_pad.urdf", self.pad_mm, quaternion, scale=pad_scale(tip_mm))

    def place_psm_m(self, base_mm: Floats, base_xyzw: Floats, instrument: str | None = None) -> None:
        """Set up PSM_M, in green and with its jaws open, by default with PSM_A's instrument.

        The arms go through each other, and their distance is measured.
        """
        tool = instrument_of(instrument) if instrument else self.tool
        self.psm_m = self._load_arm(base_mm, base_xyzw, tool, OPEN_RAD)
        links = range(-1, self.bullet.getNumJoints(self.psm_m.number, physicsClientId=self.client))
        for link in links:
            for own in links:
                self.bullet.setCollisionFilterPair(
                    self.arm.number, self.psm_m.number, own, link, 0, physicsClientId=self.client
                )
            self.bullet.changeVisualShape(self.psm_m.number, link, rgbaColor=PSM_M_COLOUR, physicsClientId=self.client)

    def pose(self, joints: Floats, body: Body | None = None) -> None:
        """Put an arm's joints (rad, insertion mm) exactly there, at rest."""
        arm = body or self.arm
        # One call for all joints takes a fifth of the time of one for each.
        self.bullet.resetJointStatesMultiDof(
            arm.number, arm.joints, in_metres(joints)[:, None].tolist(), physicsClientId=self.client
        )

    # -- what is seen --

    def read_joints(self) -> list[float]:
        """Read PSM_A's joints, rad and mm."""
        values = [float(state[0]) for state in self.joint_states()]
        values[INSERTION] /= MM
        return values

    def joint_states(self) -> Any:
        """Read PSM_A's joints as PyBullet has them: position, speed, reaction, effort of each."""
        return self.bullet.getJointStates(self.arm.number, self.arm.joints, physicsClientId=self.client)

    def read_tip(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Read PSM_A's tool frame: position in mm and quaternion."""
        place, quaternion = self.frame_of(self.arm, self.arm.tool)
        return np.array(place) / MM, np.array(quaternion)

    def frame_of(self, body: Body, link: int) -> Any:
        """Read the frame of a link as PyBullet has it: position and quaternion."""
        state = self.bullet.getLinkState(body.number, link, 0, 1, self.client)
        return state[PLACE], state[TURN]

    def closest(self, body: int, other: int) -> Any:
        """Read the nearest points of all links of two bodies that are near each other, as PyBullet has them."""
        return self.bullet.getClosestPoints(body, other, CLEARANCE_SEEN_MM * MM, physicsClientId=self.client)

    def pressed_n(self) -> float:
        """Read with what force the pad pushes PSM_A back."""
        points = self.bullet.getContactPoints(self.arm.number, self.pad, physicsClientId=self.client)
        return float(sum(point[9] for point in points))

    def drive(self, start: list[float], velocity: list[float]) -> None:
        """Let the motors move PSM_A through one time step that begins at `start`.

        Args:
            start: Joints and fingers as PyBullet has them (`in_metres`), 8 numbers.
            velocity: Their speeds in this step.
        """
        self.bullet.setJointMotorControlArray(
            self.arm.number,
            self._driven,
            self.bullet.POSITION_CONTROL,
            targetPositions=start,
            targetVelocities=velocity,
            forces=self._efforts,
            positionGains=self._position_gains,
            velocityGains=self._velocity_gains,
            physicsClientId=self.client,
        )
        self.bullet.stepSimulation(physicsClientId=self.client)

    def photograph(self, camera: pictures.Camera, needle: tuple[Floats, Floats] | None = None) -> pictures.Photograph:
        """Take a picture of the scene as it stands, the needle in a pose (mm, quaternion) or between PSM_A's jaws."""
        self._place_needle(*(needle or self._in_jaws()))
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

    def _in_jaws(self) -> tuple[Floats, Floats]:
        tip_mm, quaternion = self.read_tip()
        approach = np.array(self.bullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)[:, 2]
        return tip_mm + HELD_MM * approach, quaternion

    def _place_needle(self, place_mm: Floats, quaternion: Floats) -> None:
        if self.needle is None:
            self.needle = self._load("needle.urdf", np.zeros(3), [0.0, 0.0, 0.0, 1.0])
        self.bullet.resetBasePositionAndOrientation(
            self.needle, (place_mm * MM).tolist(), quaternion.tolist(), physicsClientId=self.client
        )

    # -- loading --

    def _load(self, name: str, position_mm: Floats, quaternion: Sequence[float], scale: float = 1.0) -> int:
        with as_file(files("skills") / "urdf" / name) as path:
            self.files[name] = sha256(path.read_bytes()).hexdigest()
            return int(
                self.bullet.loadURDF(
                    str(path),
                    basePosition=(np.asarray(position_mm) * MM).tolist(),
                    baseOrientation=list(quaternion),
                    useFixedBase=1,
                    globalScaling=scale,
                    # Otherwise cylinders are hulls, a millimetre too thick.
                    flags=self.bullet.URDF_USE_IMPLICIT_CYLINDER,
                    physicsClientId=self.client,
                )
            )

    def _load_arm(self, position_mm: Floats, quaternion: Floats, tool: Instrument, opening_rad: float) -> Body:
        number = self._load("psm.urdf", position_mm, np.asarray(quaternion).tolist())
        found = [
            self.bullet.getJointInfo(number, index, physicsClientId=self.client)
            for index in range(self.bullet.getNumJoints(number, physicsClientId=self.client))
        ]
        by_joint = {info[1].decode(): int(info[0]) for info in found}
        by_link = {info[12].decode(): int(info[0]) for info in found}
        arm = Body(
            number=number,
            joints=tuple(by_joint[f"outer_{name}"] for name in JOINTS),
            fingers=tuple(by_joint[f"{name}_hinge"] for name in FINGERS),
            tool=by_link["tool_frame"],
            shaft=by_link["roll_link"],
            surfaces=tuple(by_link[name] for name in LINKS),
        )
        self.bullet.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=self.client)
        lower, upper = in_metres(tool.lower).tolist(), in_metres(tool.upper).tolist()
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
            self.bullet.resetJointState(number, index, opening_rad, physicsClientId=self.client)
        return arm


def in_metres(joints: Floats) -> Floats:
    """Make joints, shape (..., 6), PyBullet's: the insertion in metres."""
    values = np.array(joints, float)
    values[..., INSERTION] *= MM
    return values
