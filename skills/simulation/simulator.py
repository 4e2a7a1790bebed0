"""The simulator: a scene in PyBullet, and the two passes over a trajectory in it. PyBullet's side is in metres.

The scene has PSM_A, the pad, the needle and, if its place is known, PSM_M. This is the only module that imports
pybullet, and only when a scene is opened; `skills.simulation.film` uses the scene too. `simulate` makes both passes and
their measurements, file to file:

* kinematic: the joints are set exactly to their commanded values; we read back the joints, the frame of the link
  `tool_frame` and, at every few samples, the distances between links. Where distances are small or the arms may have
  come near between two measurements, every sample is measured.
* torque, where a servo is stated: PSM_A moves by the torques of `skills.dynamics`, at 1 kHz or more, in windows in
  which it may touch the pad or PSM_M, both rigid, which goes on as planned. Elsewhere the compiled motion stands. The
  fitted load stands for gravity and cables, so gravity is off; links have the inertias of their motors, for which the
  servo's step is short enough; jaws do not give way; and the play is added after, so the motors' places are those that
  touch. Forces are those of the last step before a sample.

The inner loops use lists and PyBullet's units: its calls take microseconds, and so would the creation of each small
array.
"""

import importlib.util
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib.metadata import version
from importlib.resources import files
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from skills import packing
from skills.arrays import Flags, Floats, Ints
from skills.compiled import cache_folders, check_cache_folder, make_ready
from skills.dynamics import Drive, Executed, Prediction, Servo, drive_of, predict, torques
from skills.errors import SimulationFailed
from skills.kinematics import (
    DEFAULT_INSTRUMENT,
    INSERTION,
    JOINTS,
    InstrumentConstants,
    axes_of,
    forward,
    instrument_of,
    matrix_of,
)
from skills.planning.handoff import HELD_MM, HOLDING_RAD, OPEN_RAD, OtherArm
from skills.planning.motion_laws import A1, A2, Poses
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory
from skills.simulation import pictures
from skills.verification.clearance import Bounds, travel_mm
from skills.verification.playback import CLEARANCE_SEEN_MM, FINGERS, LINKS, PAD, Playback, link_pairs, pad_scale

MM = 1e-3
PLACE, TURN = 4, 5  # indices of the frame in a link's state; 0 and 1 would be its centre of mass
FORCE = 9  # index of the force in a contact
LIGHT_KG, LIGHT_KG_M2 = 1e-4, 1e-7  # ours: of a link beside its motor, a thousandth of it and less
HEAVY_KG = 1e3  # ours: what touches PSM_M does not move it
BALANCED_MM = 120.0  # insertion at which the insertion's mass is at the remote centre in `urdf/psm.urdf`
WINDOW_S = 0.3  # ours: five times 2 I / D of yaw; so long after a contact less than a hundredth of its push is left
URDF_CENTRE_MM, URDF_WRIST_MM = 431.8, 15.6  # remote centre and wrist offset of `urdf/psm.urdf`
PSM_M_COLOUR = (0.35, 0.55, 0.35, 1.0)
LOOK_CLOSER_MM = 2.0  # ours: twice the gates' distances; nearer than this, every sample is measured


@dataclass(frozen=True, eq=False)
class PlayRequest:
    """A trajectory, the height of the pad in mm, the samples at which distances are measured first, and the servo."""

    trajectory: Trajectory
    pad_top_mm: float
    looks: Ints
    servo: Servo | None = None


class KinematicPass(NamedTuple):
    """The measurements of the kinematic pass, with the names that they have in a `Playback`."""

    tip_mm: Floats
    rotation_xyzw: Floats
    joints: Floats
    looked_at: Ints
    clearances_mm: Floats
    shaft_off_mm: Floats
    psm_m_tip_mm: Floats | None


CLASSES = packing.known(PlayRequest, Trajectory, OtherArm, Poses, Servo, Playback)


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
def opened(instrument: str) -> Iterator["Simulator"]:
    """Open a fresh scene with PSM_A, and close it at the end; a fresh one gives the same numbers each time."""
    require_pybullet()
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    bullet = BulletClient(pybullet.DIRECT)
    try:
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
    """One simulation. Lengths in arguments are in mm, except in cameras, which use PyBullet's metres."""

    def __init__(self, bullet: Any, tool: InstrumentConstants) -> None:
        self.bullet = bullet
        self.files: dict[str, str] = {}
        self.arm = self._load_arm(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), tool, HOLDING_RAD)
        self.pad: int | None = None
        self.pad_mm = np.zeros(3)
        self.psm_m: SceneBody | None = None
        self.needle: int | None = None
        self._balanced_mm = BALANCED_MM + tool.wrist_offset_mm - URDF_WRIST_MM

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
        """Load PSM_M, in green and with its jaws open, and so heavy that it goes on as it is moved."""
        self.psm_m = m = self._load_arm(base_mm, base_xyzw, tool, OPEN_RAD)
        for link in range(self.bullet.getNumJoints(m.number)):
            self.bullet.changeDynamics(m.number, link, mass=HEAVY_KG, localInertiaDiagonal=[HEAVY_KG] * 3)
            self.bullet.changeVisualShape(m.number, link, rgbaColor=PSM_M_COLOUR)
        self.bullet.setJointMotorControlArray(m.number, m.joints, self.bullet.VELOCITY_CONTROL, forces=[0.0] * 6)

    def pose(self, joints: Floats, body: SceneBody | None = None, speeds: Floats | None = None) -> None:
        """Set an arm's joints (rad, insertion mm) exactly, at rest or with speeds."""
        arm, moving = body or self.arm, np.zeros(6) if speeds is None else in_metres(speeds)
        # One call for all joints takes a fifth of the time of one call for each.
        self.bullet.resetJointStatesMultiDof(
            arm.number, arm.joints, in_metres(joints)[:, None].tolist(), moving[:, None].tolist()
        )

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
        """Return the force of all that touches PSM_A, N."""
        return float(sum(point[FORCE] for point in self.bullet.getContactPoints(self.arm.number)))

    def weigh(self, inertia: Floats, joints: Floats) -> Floats:
        """Turn PSM_A's motors off, and give each link the inertia of its motor about its own joint's axis.

        PyBullet knows no rotors beside the links. So a link also resists the joints before its own, and the insertion's
        mass swings where it is not at the remote centre: for that, which the mass matrices have, torques must allow.

        Args:
            inertia: That of each joint, kg m2 and kg, shape (6,).
            joints: The places between which it then moves, rad and mm, shape (K, 6).

        Returns:
            The resulting mass matrices there, shape (K, 6, 6).
        """
        bullet, arm = self.bullet, self.arm
        away_m = (joints[:, INSERTION] - self._balanced_mm) * MM
        own = inertia.copy()
        own[:2] -= inertia[INSERTION] * away_m.mean() ** 2
        for link in range(bullet.getNumJoints(arm.number)):
            bullet.changeDynamics(arm.number, link, mass=LIGHT_KG, localInertiaDiagonal=[LIGHT_KG_M2] * 3)
        for joint, link in enumerate(arm.joints):
            mass = own[joint] if joint == INSERTION else LIGHT_KG
            turning = LIGHT_KG_M2 if joint == INSERTION else own[joint]
            bullet.changeDynamics(arm.number, link, mass=mass, localInertiaDiagonal=[LIGHT_KG_M2, LIGHT_KG_M2, turning])
        bullet.setJointMotorControlArray(arm.number, arm.joints, bullet.VELOCITY_CONTROL, forces=[0.0] * 6)
        axes = _axes(joints)
        along = np.tril(axes @ np.swapaxes(axes, 1, 2))
        along[:, INSERTION, INSERTION] = 1.0  # it slides
        found = np.swapaxes(along, 1, 2) @ (own[:, None] * along)
        for joint in range(2):
            found[:, joint, joint] += inertia[INSERTION] * away_m**2 * (1 - along[:, INSERTION + 1, joint] ** 2)
        return np.asarray(found)

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


def _axes(joints: Floats) -> Floats:
    """Return the directions of PSM_A's joints in its base frame, (K, 6, 3); 0 of the insertion, which slides."""
    (s1, s6), (c1, c6) = (f(joints[:, (0, 5)]).T for f in (np.sin, np.cos))
    shaft, _, rotation = axes_of(joints)
    n, o, a = np.moveaxis(rotation, 2, 0)
    still, one = np.zeros_like(s1), np.ones_like(s1)
    yaw, pitch = np.stack([still, -one, still], axis=1), np.stack([-c1, still, -s1], axis=1)
    return np.stack([yaw, pitch, 0 * shaft, shaft, -c6[:, None] * o - s6[:, None] * a, -n], axis=1)


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
    with opened(motion.instrument) as scene:
        scene.set_up(motion, asked.pad_top_mm)
        kinematic = kinematic_pass(scene, asked)
        scene.show(motion, _pictured(motion))
        picture = pictures.draw(scene.photograph, _paths(motion))
        files, pad_mm = dict(sorted(scene.files.items())), scene.pad_mm
    playback = Playback(
        trajectory=motion,
        **kinematic._asdict(),
        pad_mm=pad_mm,
        picture_png=picture,
        engine=f"PyBullet {version('pybullet')}",
        files=files,
    )
    if asked.servo is not None:
        playback = _executed(asked, asked.servo, playback)
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
    bounds, near = _bounds(asked.trajectory, asked.looks, seen_mm), np.zeros(len(asked.trajectory), dtype=bool)
    for column in range(len(bounds.pairs)):
        near |= bounds.at_least_mm(column) < LOOK_CLOSER_MM
    return np.setdiff1d(np.flatnonzero(near), asked.looks)


def _bounds(motion: Trajectory, looked_at: Ints, seen_mm: Floats) -> Bounds:
    """Return the bounds on distances at every sample, from those seen at some."""
    moving = {arm.name: (arm.joints, arm.instrument) for arm in motion.arms}
    return Bounds.of(moving, link_pairs(motion.psm_m is not None), looked_at, seen_mm)


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


# ---- the torque pass -------------------------------------------------------------------------------------------


def windows_of(motion: Trajectory, predicted: Prediction, looked_at: Ints, seen_mm: Floats) -> Ints:
    """Choose the windows that are stepped: wherever an arm of all ranges may touch something, and some more.

    These are the hand-overs and the worst predicted error of each pass. Each window is longer by `WINDOW_S` either way.

    Args:
        motion: The planned motion.
        predicted: The executed one, with its ranges.
        looked_at: The samples at which distances were measured, shape (C,).
        seen_mm: The distances there, shape (C, P).

    Returns:
        The first and the last sample of each window, in order and apart, shape (W, 2).
    """
    bounds, off_mm = _bounds(motion, looked_at, seen_mm), np.zeros((len(motion), len(LINKS)))
    for arm in (predicted.executed, *predicted.others):
        beside = np.stack([motion.joints, arm.joints], axis=1).reshape(-1, 6)
        off_mm = np.maximum(off_mm, travel_mm(beside, motion.instrument)[::2])
    marked = np.zeros(len(motion), dtype=bool)
    for column, pair in enumerate(bounds.pairs):
        if pair.body == PSM_A:
            marked |= ~(bounds.at_least_mm(column) > off_mm[:, LINKS.index(pair.link)])
    for number in range(motion.passes):
        of_pass = np.flatnonzero(motion.pass_index == number)
        marked[of_pass[predicted.off_mm[0, of_pass].argmax()]] = True
    if motion.psm_m is not None:
        marked[motion.last_samples[motion.phase[motion.last_samples] == A2]] = True
    stamps, ends = motion.stamps_s, _stretches(marked)
    first, last = np.searchsorted(stamps, [stamps[ends[:, 0]] - WINDOW_S, stamps[ends[:, 1]] + WINDOW_S])
    covered = np.zeros(len(motion), dtype=bool)
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):
        covered[begin : end + 1] = True
    return _stretches(covered)


def _stretches(marked: Flags) -> Ints:
    """Return the first and the last sample of each stretch that is marked, shape (W, 2)."""
    edges = np.diff(marked.astype(np.int8), prepend=0, append=0)
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1], axis=1)


def _executed(asked: PlayRequest, servo: Servo, played: Playback) -> Playback:
    """Return a playback with the executed motion."""
    motion = asked.trajectory
    predicted = predict(motion.joints, motion.stamps_s, servo, motion.instrument)
    windows = windows_of(motion, predicted, played.looked_at, played.clearances_mm)
    with opened(motion.instrument) as scene:
        scene.set_up(motion, asked.pad_top_mm)
        joints, efforts, contact_n = torque_pass(scene, motion, servo, predicted.executed, windows)
    tracking_mm = np.linalg.norm(forward(joints, motion.instrument)[0] - motion.tip_mm, axis=1)
    return replace(played, tracking_mm=tracking_mm, efforts=efforts, contact_n=contact_n, windows=windows)


def get_ready() -> None:
    """Load the loops of executed motions: a contained process would compile them anew, which takes two seconds."""
    for folder in cache_folders():
        check_cache_folder(folder)
    make_ready(_shortest)


def _shortest() -> None:
    """Execute the shortest motion, and make one step of it."""
    joints, stamps_s, servo = np.tile([0.0, 0.0, 100.0, 0.0, 0.0, 0.0], (2, 1)), np.array([0.0, 0.01]), Servo()
    predict(joints, stamps_s, servo, ranged=False)
    drive = drive_of(joints, stamps_s, servo, servo.arm(0.5, 0.5), DEFAULT_INSTRUMENT)
    torques(1, 0.0, servo.step_s, np.eye(6), np.zeros((2, 6)), np.zeros((4, 6)), *drive)


def torque_pass(
    scene: Simulator, motion: Trajectory, servo: Servo, executed: Executed, windows: Ints
) -> tuple[Floats, Floats, Floats]:
    """Move PSM_A by torques through windows of its executed motion, among things that it can touch.

    Args:
        scene: A fresh scene with these things.
        motion: The planned motion.
        servo: How the arm is driven.
        executed: What the arm in the middle of all ranges does where it touches nothing.
        windows: The first and the last sample of each window, shape (W, 2).

    Returns:
        The executed joints, rad and mm, shape (T, 6), PyBullet's inside of windows; efforts and forces of contact.
    """
    drive = drive_of(motion.joints, motion.stamps_s, servo, servo.arm(0.5, 0.5), motion.instrument)
    joints, efforts, contact_n = executed.joints.copy(), executed.efforts.copy(), np.zeros(len(motion))
    play = drive.parts[5] / in_metres(np.ones(6))
    for first, last in windows.tolist():
        inside = slice(first + 1, last + 1)
        motors, efforts[inside], contact_n[inside] = _stepped(scene, motion, drive, executed.motors[first], first, last)
        for k, motor in enumerate(motors, first + 1):
            joints[k] = np.minimum(np.maximum(joints[k - 1], motor - play), motor + play)
    return joints, efforts, contact_n


def _stepped(
    scene: Simulator, motion: Trajectory, drive: Drive, begin: Floats, first: int, last: int
) -> tuple[Floats, Floats, Floats]:
    """Step through a window that begins with these places and speeds of the motors, rad and m, shape (2, 6).

    Returns:
        Places of the motors, rad and mm, efforts, and the force of contact, of the samples after the first.
    """
    bullet, arm, m = scene.bullet, scene.arm, motion.psm_m
    masses = scene.weigh(drive.parts[2], motion.joints[first : last + 1])
    state, put, h = begin.copy(), np.tile(begin[1], (4, 1)), 0.0
    motors, efforts, pressed = array("d"), array("d"), array("d")
    act, step, read = bullet.setJointMotorControlArray, bullet.stepSimulation, bullet.getJointStates
    number, joints, by_torque = arm.number, arm.joints, bullet.TORQUE_CONTROL
    for k in range(first + 1, last + 1):
        begun, mass = float(drive.stamps[k - 1]), masses[k - first]
        gap = float(drive.stamps[k]) - begun
        steps = ceil(gap / drive.stream[0] - 1e-6)
        if abs(gap / steps - h) > 1e-9:
            # PyBullet changes places after speeds, so what it calls places are those half a step later.
            place, h = state[0] - h / 2 * state[1], gap / steps
            bullet.setTimeStep(h)
            state[0] = place + h / 2 * state[1]
            bullet.resetJointStatesMultiDof(number, joints, state[0][:, None].tolist(), state[1][:, None].tolist())
        if m is not None and scene.psm_m is not None:
            scene.pose(m.joints[k - 1], scene.psm_m, (m.joints[k] - m.joints[k - 1]) / gap)
        for i in range(steps):
            torques(k, begun + (i + 0.5) * h, h, mass, state, put, *drive)
            act(number, joints, by_torque, forces=put[0].tolist())
            step()
            a, b, c, d, e, f = read(number, joints)
            state[0] = (a[0], b[0], c[0], d[0], e[0], f[0])
            state[1] = (a[1], b[1], c[1], d[1], e[1], f[1])
        motors.extend(state[0] - h / 2 * state[1])
        efforts.extend(put[1])
        pressed.append(scene.pressed_n())
    places = _table(motors, 6)
    places[:, INSERTION] /= MM
    return places, _table(efforts, 6), np.array(pressed)


# ---- the picture -----------------------------------------------------------------------------------------------


def _paths(motion: Trajectory) -> list[Floats]:
    """Return the path of the tip in A1 of each pass, in metres, each of shape (K, 3)."""
    first = motion.phase == A1
    return [motion.tip_mm[(motion.pass_index == one) & first] * MM for one in range(motion.passes)]


def _pictured(motion: Trajectory) -> int:
    """Choose the sample of the picture: half-way through A1 of the last pass."""
    last = np.flatnonzero((motion.pass_index == motion.pass_index[-1]) & (motion.phase == A1))
    return int(last[len(last) // 2]) if len(last) else len(motion) - 1
