"""The simulator: a scene in PyBullet, and the two passes over a trajectory in it. PyBullet's side is in metres.

The scene has PSM_A, the pad, the needle and, if its place is known, PSM_M. This is the only module that imports
pybullet, and only when a scene is opened; `skills.simulation.film` uses the scene too. `simulate` makes both passes and
their measurements, file to file:

* kinematic: the joints are set exactly to their commanded values; we read back the joints, the frame of the link
  `tool_frame` and, at every few samples, the distances between links. Where distances are small or the arms may have
  come near between two measurements, every sample is measured.
* servo: the motors follow under gravity with the arm's real greatest efforts, PSM_A alone with the pad. The motor's law
  is v = gain (q_target - q) / dt + v_target; with the position at the start of the step as target, and the speed of
  that step, it is exact.

The inner loops use lists and PyBullet's units: its calls take microseconds, and so would the creation of each small
array.
"""

import importlib.util
import time
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from skills import packing
from skills.arrays import Floats, Ints
from skills.errors import SimulationFailed
from skills.kinematics import INSERTION, JOINTS, InstrumentConstants, instrument_of, matrix_of
from skills.planning.handoff import HELD_MM, HOLDING_RAD, OPEN_RAD, OtherArm
from skills.planning.motion_laws import A1, Poses
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory
from skills.simulation import pictures
from skills.verification.clearance import Bounds
from skills.verification.playback import CLEARANCE_SEEN_MM, FINGERS, LINKS, PAD, Playback, link_pairs, pad_scale

MM = 1e-3
PLACE, TURN = 4, 5  # indices of the frame in a link's state; 0 and 1 would be its centre of mass
EFFORT = 3  # index of the effort in a joint's state
POSITION_GAIN, VELOCITY_GAIN = 0.3, 1.0
FINGER_EFFORT = 0.16  # Nm
URDF_CENTRE_MM, URDF_WRIST_MM = 431.8, 15.6  # remote centre and wrist offset of `urdf/psm.urdf`
PSM_M_COLOUR = (0.35, 0.55, 0.35, 1.0)
LOOK_CLOSER_MM = 2.0  # ours: twice the gates' distances; nearer than this, every sample is measured


@dataclass(frozen=True, eq=False)
class PlayRequest:
    """A trajectory, the height of the pad in mm, and the samples at which distances are measured first."""

    trajectory: Trajectory
    pad_top_mm: float
    looks: Ints


class KinematicPass(NamedTuple):
    """The measurements of the kinematic pass, with the names that they have in a `Playback`."""

    tip_mm: Floats
    rotation_xyzw: Floats
    joints: Floats
    looked_at: Ints
    clearances_mm: Floats
    shaft_off_mm: Floats
    psm_m_tip_mm: Floats | None


class ServoPass(NamedTuple):
    """The measurements of the servo pass, likewise."""

    tracking_mm: Floats
    efforts: Floats
    contact_n: Floats
    seconds_per_step: float


CLASSES = packing.known(PlayRequest, Trajectory, OtherArm, Poses, Playback)


def require_pybullet() -> None:
    """Raise an error early, and without the import, if PyBullet is missing.

    Raises:
        SimulationFailed: It is not installed; the message states how to install it.
    """
    if importlib.util.find_spec("pybullet") is None:
        raise SimulationFailed(
            "PyBullet is not installed, so no plan can be played. On Python 3.11 and Linux x86-64 install it "
            "with `pip install pybullet==3.2.7`; elsewhere build it from source.",
            cause="not installed",
        )


@contextmanager
def opened(instrument: str, rate_hz: float) -> Iterator["Simulator"]:
    """Open a fresh scene with PSM_A, and close it at the end; a fresh one gives the same numbers each time."""
    require_pybullet()
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    bullet = BulletClient(pybullet.DIRECT)
    try:
        bullet.setTimeStep(1.0 / rate_hz)
        bullet.setGravity(0, 0, -9.81)
        bullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        yield Simulator(bullet, instrument_of(instrument))
    finally:
        bullet.disconnect()


@dataclass(frozen=True)
class SceneBody:
    """A loaded arm: its number, and the indices of its joints and links; `surfaces` are those of `playback.LINKS`."""

    number: int
    joints: tuple[int, ...]
    fingers: tuple[int, ...]
    tool: int
    shaft: int
    surfaces: tuple[int, ...]


class Simulator:
    """One simulation. Lengths in arguments are in mm, except in `drive` and in cameras, which use PyBullet's metres."""

    def __init__(self, bullet: Any, tool: InstrumentConstants) -> None:
        self.bullet = bullet
        self.files: dict[str, str] = {}
        self.arm = self._load_arm(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), tool, HOLDING_RAD)
        self.pad: int | None = None
        self.pad_mm = np.zeros(3)
        self.psm_m: SceneBody | None = None
        self.needle: int | None = None
        self._driven = [*self.arm.joints, *self.arm.fingers]
        self._efforts = [*tool.arm.effort, FINGER_EFFORT, FINGER_EFFORT]
        self._position_gains, self._velocity_gains = [POSITION_GAIN] * 8, [VELOCITY_GAIN] * 8

    # -- contents --

    def set_up(self, trajectory: Trajectory, pad_top_mm: float) -> None:
        """Place the pad under a trajectory, and PSM_M if it has one."""
        self.place_pad(trajectory.tip_mm, pad_top_mm)
        if (m := trajectory.psm_m) is not None:
            self.place_psm_m(m.base_mm, m.base_xyzw, instrument_of(m.instrument))

    def place_pad(self, tip_mm: Floats, top_mm: float) -> None:
        """Lay the pad, large enough, under the middle of the path, with its wound along the path's longer side."""
        low, high = tip_mm.min(axis=0), tip_mm.max(axis=0)
        middle = (low + high) / 2
        turned = np.pi / 2 if high[1] - low[1] > high[0] - low[0] else 0.0
        quaternion = [0.0, 0.0, float(np.sin(turned / 2)), float(np.cos(turned / 2))]
        self.pad_mm = np.array([middle[0], middle[1], top_mm])
        self.pad = self._load("suture_pad.urdf", self.pad_mm, quaternion, scale=pad_scale(tip_mm))

    def place_psm_m(self, base_mm: Floats, base_xyzw: Floats, tool: InstrumentConstants) -> None:
        """Load PSM_M, in green and with its jaws open.

        Collisions between the arms are off, because their distance is measured instead.
        """
        self.psm_m = self._load_arm(base_mm, base_xyzw, tool, OPEN_RAD)
        links = range(-1, self.bullet.getNumJoints(self.psm_m.number))
        for link in links:
            for own in links:
                self.bullet.setCollisionFilterPair(self.arm.number, self.psm_m.number, own, link, 0)
            self.bullet.changeVisualShape(self.psm_m.number, link, rgbaColor=PSM_M_COLOUR)

    def pose(self, joints: Floats, body: SceneBody | None = None) -> None:
        """Set an arm's joints (rad, insertion mm) exactly, at rest."""
        arm = body or self.arm
        # One call for all joints takes a fifth of the time of one call for each.
        self.bullet.resetJointStatesMultiDof(arm.number, arm.joints, in_metres(joints)[:, None].tolist())

    def show(self, trajectory: Trajectory, sample: int) -> None:
        """Set the joints of the arms in the scene to those of a sample."""
        self.pose(trajectory.joints[sample])
        if self.psm_m is not None and trajectory.psm_m is not None:
            self.pose(trajectory.psm_m.joints[sample], self.psm_m)

    # -- measurements and motion --

    def joint_states(self) -> Any:
        """Return PSM_A's joint states in PyBullet's form: position, speed, reaction, effort of each."""
        return self.bullet.getJointStates(self.arm.number, self.arm.joints)

    def read_tip(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return PSM_A's tool frame: position in mm and quaternion."""
        place, quaternion = self.frame_of(self.arm, self.arm.tool)
        return np.array(place) / MM, np.array(quaternion)

    def frame_of(self, body: SceneBody, link: int) -> Any:
        """Return the frame of a link in PyBullet's form: position in m and quaternion."""
        state = self.bullet.getLinkState(body.number, link, 0, 1)
        return state[PLACE], state[TURN]

    def closest(self, body: int, other: int) -> Any:
        """Return the nearest points of all links of two bodies that are near each other, in PyBullet's form."""
        return self.bullet.getClosestPoints(body, other, CLEARANCE_SEEN_MM * MM)

    def pressed_n(self) -> float:
        """Return the force of the pad on PSM_A, N."""
        points = self.bullet.getContactPoints(self.arm.number, self.pad)
        return float(sum(point[9] for point in points))

    def drive(self, start: list[float], velocity: list[float]) -> None:
        """Let the motors move PSM_A through one time step that begins at `start`.

        Args:
            start: Joints and fingers in PyBullet's units (`in_metres`), 8 numbers.
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
        )
        self.bullet.stepSimulation()

    def photograph(self, camera: pictures.Camera, needle: tuple[Floats, Floats] | None = None) -> pictures.Photograph:
        """Return an image of the present scene, the needle in a given pose (mm, quaternion) or between PSM_A's jaws."""
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
        )
        size = (camera.height, camera.width)
        return pictures.Photograph(
            rgb=np.asarray(image[2], np.uint8).reshape(*size, 4)[:, :, :3].copy(),
            depth=np.asarray(image[3], np.float64).reshape(size),
            view=np.array(view).reshape(4, 4).T,
            projection=np.array(projection).reshape(4, 4).T,
        )

    def _in_jaws(self) -> tuple[Floats, Floats]:
        """Return the needle's pose between PSM_A's jaws, mm and quaternion."""
        tip_mm, quaternion = self.read_tip()
        approach = np.array(self.bullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)[:, 2]
        return tip_mm + HELD_MM * approach, quaternion

    def _place_needle(self, place_mm: Floats, quaternion: Floats) -> None:
        if self.needle is None:
            self.needle = self._load("needle.urdf", np.zeros(3), [0.0, 0.0, 0.0, 1.0])
        self.bullet.resetBasePositionAndOrientation(self.needle, (place_mm * MM).tolist(), quaternion.tolist())

    # -- loading --

    def _load(
        self,
        name: str,
        position_mm: Floats,
        quaternion: Sequence[float],
        scale: float = 1.0,
        wrist_mm: float | None = None,
    ) -> int:
        """Load a file of the scene, note its digest, and return the number of its body."""
        text = (files("skills") / "urdf" / name).read_text()
        self.files[name] = sha256(text.encode()).hexdigest()
        with TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_text(text if wrist_mm is None else arm_in_capsules(text, wrist_mm))
            return int(
                self.bullet.loadURDF(
                    str(path),
                    basePosition=(np.asarray(position_mm) * MM).tolist(),
                    baseOrientation=list(quaternion),
                    useFixedBase=1,
                    globalScaling=scale,
                    # Without it PyBullet makes cylinders into hulls, a millimetre too thick.
                    flags=self.bullet.URDF_USE_IMPLICIT_CYLINDER,
                )
            )

    def _load_arm(
        self, position_mm: Floats, quaternion: Floats, tool: InstrumentConstants, opening_rad: float
    ) -> SceneBody:
        """Load an arm with the wrist offset of its tool, its joint limits, and the opening of each of its fingers."""
        number = self._load("psm.urdf", position_mm, np.asarray(quaternion).tolist(), wrist_mm=tool.wrist_offset_mm)
        found = [self.bullet.getJointInfo(number, index) for index in range(self.bullet.getNumJoints(number))]
        by_joint = {info[1].decode(): int(info[0]) for info in found}
        by_link = {info[12].decode(): int(info[0]) for info in found}
        arm = SceneBody(
            number=number,
            joints=tuple(by_joint[f"outer_{name}"] for name in JOINTS),
            fingers=tuple(by_joint[f"{name}_hinge"] for name in FINGERS),
            tool=by_link["tool_frame"],
            shaft=by_link["roll_link"],
            surfaces=tuple(by_link[name] for name in LINKS),
        )
        self.bullet.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.0)
        limits = in_metres(np.stack([tool.lower, tool.upper])).T.tolist()
        for index, (lower, upper) in zip(arm.joints, limits, strict=True):
            # The file has the Classic's limits, a Si has others. A separate call, because with damping in the same call
            # the limits have no effect.
            self.bullet.changeDynamics(number, index, jointLowerLimit=lower, jointUpperLimit=upper)
        for index in arm.fingers:
            self.bullet.resetJointState(number, index, opening_rad)
        return arm


def arm_in_capsules(text: str, wrist_mm: float) -> str:
    """Return the file of an arm with its remote centre where the wrist's offset is this one, and with capsules.

    A capsule is PyBullet's own word for a cylinder with a sphere at either end, twice as fast and exact.
    """
    before, after = (f'"0 {(URDF_CENTRE_MM + more_mm) * MM:.4f} 0"' for more_mm in (0.0, wrist_mm - URDF_WRIST_MM))
    assert text.count(before) == 1
    root = ElementTree.fromstring(text.replace(before, after))  # noqa: S314 - a file of the package
    for link in root.iter("link"):
        for end in link.findall("collision")[1:]:
            link.remove(end)
        for cylinder in link.findall("collision/geometry/cylinder"):
            cylinder.tag = "capsule"
    return ElementTree.tostring(root, "unicode")


def in_metres(joints: Floats) -> Floats:
    """Return joints, shape (..., 6), in PyBullet's units: the insertion in metres."""
    values = np.array(joints, float)
    values[..., INSERTION] *= MM
    return values


# ---- the two passes ------------------------------------------------------------------------------------------------


def simulate(given: BinaryIO, answer: BinaryIO) -> None:
    """Play the request of `skills.simulation.player` and write the measurements."""
    asked = packing.read(given, CLASSES)
    assert isinstance(asked, PlayRequest)
    motion = asked.trajectory
    with opened(motion.instrument, motion.rate_hz) as scene:
        scene.set_up(motion, asked.pad_top_mm)
        kinematic = kinematic_pass(scene, asked)
        scene.show(motion, _pictured(motion))
        picture = pictures.draw(scene.photograph, _paths(motion))
        files, pad_mm = dict(sorted(scene.files.items())), scene.pad_mm
    # In a fresh scene: PSM_M would take two thirds of each step, and earlier contacts influence later steps.
    with opened(motion.instrument, motion.rate_hz) as scene:
        scene.place_pad(motion.tip_mm, asked.pad_top_mm)
        servo = servo_pass(scene, motion)
    playback = Playback(
        trajectory=motion,
        **kinematic._asdict(),
        **servo._asdict(),
        pad_mm=pad_mm,
        picture_png=picture,
        engine=f"PyBullet {version('pybullet')}",
        files=files,
    )
    packing.write(answer, playback, CLASSES)


# ---- the kinematic pass ----------------------------------------------------------------------------------------


def kinematic_pass(scene: Simulator, asked: PlayRequest) -> KinematicPass:
    """Set the joints at every sample and read them back, and measure distances.

    Distances are measured at the requested samples, and then at all others where links may be near each other.
    """
    motion = asked.trajectory
    distances = _Distances(scene, motion)
    values, places, turns = array("d"), array("d"), array("d")
    due = set(asked.looks.tolist())
    bullet, arm = scene.bullet, scene.arm
    put, read_joints, read_link = bullet.resetJointStatesMultiDof, bullet.getJointStates, bullet.getLinkState
    number, joints, tool = arm.number, arm.joints, arm.tool
    for k, row in enumerate(_rows(in_metres(motion.joints)[:, :, None])):
        put(number, joints, row)
        a, b, c, d, e, f = read_joints(number, joints)
        values.extend((a[0], b[0], c[0], d[0], e[0], f[0]))
        frame = read_link(number, tool, 0, 1)
        places.extend(frame[PLACE])
        turns.extend(frame[TURN])
        if k in due:
            distances.at(k)
    for k in _closer(distances.seen_mm(), asked).tolist():
        scene.pose(motion.joints[k])
        distances.at(k)
    read = _table(values, 6)
    read[:, INSERTION] /= MM
    return KinematicPass(_table(places, 3) / MM, _table(turns, 4), read, *distances.in_order())


def _rows(values: Floats) -> Iterator[Any]:
    """Yield rows as lists, some thousands at a time: a long plan as Python numbers would not fit into memory."""
    for first in range(0, len(values), 4096):
        yield from values[first : first + 4096].tolist()


def _table(values: "array[float]", columns: int) -> Floats:
    return np.array(values).reshape(-1, columns)


def _closer(seen_mm: Floats, asked: PlayRequest) -> Ints:
    """Return the samples without a measurement at which links may be near each other."""
    motion = asked.trajectory
    moving = {PSM_A: (motion.joints, motion.instrument)}
    if (m := motion.psm_m) is not None:
        moving[PSM_M] = (m.joints, m.instrument)
    bounds = Bounds.of(moving, link_pairs(m is not None), asked.looks, seen_mm)
    near = np.zeros(len(motion), dtype=bool)
    for column in range(len(bounds.pairs)):
        near |= bounds.at_least_mm(column) < LOOK_CLOSER_MM
    return np.setdiff1d(np.flatnonzero(near), asked.looks)


class _Distances:
    """The measurements at some samples, with PSM_A already posed there; PSM_M, if it is in the scene, is posed here."""

    def __init__(self, scene: Simulator, motion: Trajectory) -> None:
        self._scene = scene
        self._m_joints = None if motion.psm_m is None else motion.psm_m.joints
        self._pairs = _pairs_of_bodies(scene)
        self._nothing = [CLEARANCE_SEEN_MM * MM] * len(link_pairs(scene.psm_m is not None))
        self._samples: list[int] = []
        self._seen, self._m_places = array("d"), array("d")
        self._shaft_places, self._shaft_turns = array("d"), array("d")

    def at(self, sample: int) -> None:
        """Measure at one sample."""
        scene, seen = self._scene, self._nothing.copy()
        if scene.psm_m is not None and self._m_joints is not None:
            scene.pose(self._m_joints[sample], scene.psm_m)
            self._m_places.extend(scene.frame_of(scene.psm_m, scene.psm_m.tool)[0])
        for bodies, columns in self._pairs.items():
            for point in scene.closest(*bodies):  # a pair of capsules has one nearest point
                seen[columns[point[3], point[4]]] = point[8]
        self._samples.append(sample)
        self._seen.extend(seen)
        place, turn = scene.frame_of(scene.arm, scene.arm.shaft)
        self._shaft_places.extend(place)
        self._shaft_turns.extend(turn)

    def seen_mm(self) -> Floats:
        """Return the distances in the order of measurement, shape (C, P)."""
        return _table(self._seen, len(self._nothing)) / MM

    def in_order(self) -> tuple[Ints, Floats, Floats, Floats | None]:
        """Return the samples in ascending order, and what a `KinematicPass` has at them."""
        order = np.argsort(self._samples)
        place, along = _table(self._shaft_places, 3) / MM, matrix_of(_table(self._shaft_turns, 4))[:, :, 2]
        shaft_off_mm = np.linalg.norm(np.cross(place, along), axis=1)
        m_mm = None if self._scene.psm_m is None else _table(self._m_places, 3)[order] / MM
        return np.array(self._samples)[order], self.seen_mm()[order], shaft_off_mm[order], m_mm


def _pairs_of_bodies(scene: Simulator) -> dict[tuple[int, int], dict[tuple[int, int], int]]:
    """Return for each pair of bodies in the scene the column of `link_pairs` for each pair of their links' indices."""
    assert scene.pad is not None
    places = {(PAD, PAD): (scene.pad, -1)}
    for name, arm in ((PSM_A, scene.arm), (PSM_M, scene.psm_m)):
        if arm is not None:
            places |= {(name, link): (arm.number, index) for link, index in zip(LINKS, arm.surfaces, strict=True)}
    found: dict[tuple[int, int], dict[tuple[int, int], int]] = {}
    for column, pair in enumerate(link_pairs(scene.psm_m is not None)):
        (body, link), (other, other_link) = places[pair.body, pair.link], places[pair.other, pair.other_link]
        found.setdefault((body, other), {})[link, other_link] = column
    return found


# ---- the servo pass --------------------------------------------------------------------------------------------


def servo_pass(scene: Simulator, motion: Trajectory) -> ServoPass:
    """Let the motors follow, and measure the tip's error, the motors' efforts and the pad's force."""
    wanted = np.pad(in_metres(motion.joints), ((0, 0), (0, 2)), constant_values=HOLDING_RAD)
    velocities = np.diff(wanted, axis=0) * motion.rate_hz
    scene.pose(motion.joints[0])
    places, efforts, pressed = array("d"), array("d", [0.0] * 6), array("d", [0.0])
    places.extend(scene.frame_of(scene.arm, scene.arm.tool)[0])
    began = time.perf_counter()
    for start, velocity in zip(_rows(wanted[:-1]), _rows(velocities), strict=True):
        scene.drive(start, velocity)
        a, b, c, d, e, f = scene.joint_states()
        efforts.extend((a[EFFORT], b[EFFORT], c[EFFORT], d[EFFORT], e[EFFORT], f[EFFORT]))
        places.extend(scene.frame_of(scene.arm, scene.arm.tool)[0])
        pressed.append(scene.pressed_n())
    seconds = time.perf_counter() - began
    return ServoPass(
        tracking_mm=np.linalg.norm(_table(places, 3) / MM - motion.tip_mm, axis=1),
        efforts=_table(efforts, 6),
        contact_n=np.array(pressed),
        seconds_per_step=seconds / max(1, len(velocities)),
    )


# ---- the picture -----------------------------------------------------------------------------------------------


def _paths(motion: Trajectory) -> list[Floats]:
    """Return the path of the tip in A1 of each pass, in metres, each of shape (K, 3)."""
    first = motion.phase == A1
    return [motion.tip_mm[(motion.pass_index == one) & first] * MM for one in range(motion.passes)]


def _pictured(motion: Trajectory) -> int:
    """Choose the sample of the picture: half-way through A1 of the last pass."""
    last = np.flatnonzero((motion.pass_index == motion.pass_index[-1]) & (motion.phase == A1))
    return int(last[len(last) // 2]) if len(last) else len(motion) - 1
