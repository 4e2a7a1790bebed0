"""The two passes over a trajectory in the simulator and their measurements; `simulate` does both, file to file.

* kinematic: the joints are set exactly to their commanded values; we read back the joints, the frame of the link
  `tool_frame` and, at every few samples, the distances between links. Where distances are small or the arms may have
  come near between two measurements, every sample is measured.
* servo: the motors follow under gravity with the arm's real greatest efforts, PSM_A alone with the pad. The motor's law
  is v = gain (q_target - q) / dt + v_target; with the position at the start of the step as target, and the speed of
  that step, it is exact.

The inner loops use lists and PyBullet's units: its calls take microseconds, and so would the creation of each small
array.
"""

import time
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, BinaryIO

import numpy as np

from skills import packing
from skills.arrays import Floats, Ints
from skills.kinematics import INSERTION, matrix_of
from skills.planning.handoff import HOLDING_RAD
from skills.planning.trajectory import A1
from skills.simulation import pictures
from skills.simulation.scene import EFFORT, MM, PLACE, TURN, Scene, in_metres, opened
from skills.verification.clearance import Bounds
from skills.verification.playback import CLEARANCE_SEEN_MM, LINKS, PSM_A, PSM_M, link_pairs

LOOK_CLOSER_MM = 2.0  # ours: twice the gates' distances; nearer than this, every sample is measured
Asked = dict[str, Any]  # named arrays, numbers and texts


def simulate(given: BinaryIO, answer: BinaryIO) -> None:
    """Play the request of `skills.simulation.player` and write the measurements."""
    asked: Asked = packing.read(given, {})
    instrument, rate_hz = asked["instrument"], asked["rate_hz"]
    with opened(instrument, rate_hz) as scene:
        _set_up(scene, asked)
        measured = kinematic_pass(scene, asked)
        shown = _pictured(asked)
        scene.pose(asked["joints"][shown])
        if scene.psm_m is not None:
            scene.pose(asked["m_joints"][shown], scene.psm_m)
        picture = pictures.draw(scene.photograph, _paths(asked))
        files = dict(sorted(scene.files.items()))
    # In a fresh scene: PSM_M would take two thirds of each step, and earlier contacts influence later steps.
    with opened(instrument, rate_hz) as scene:
        scene.place_pad(asked["tip_mm"], asked["pad_top_mm"])
        measured |= servo_pass(scene, asked)
    measured |= {"picture_png": picture, "engine": f"PyBullet {version('pybullet')}", "files": files}
    packing.write(answer, measured, {})


def _set_up(scene: Scene, asked: Asked) -> None:
    scene.place_pad(asked["tip_mm"], asked["pad_top_mm"])
    if "m_joints" in asked:
        scene.place_psm_m(asked["m_base_mm"], asked["m_base_xyzw"], asked["m_instrument"])


# ---- the kinematic pass ----------------------------------------------------------------------------------------


def kinematic_pass(scene: Scene, asked: Asked) -> Asked:
    """Set the joints at every sample and read them back, and measure distances.

    Distances are measured at the requested samples, and then at all others where links may be near each other.
    """
    look = _Look(scene, asked)
    values, places, turns = array("d"), array("d"), array("d")
    due = set(asked["looks"].tolist())
    bullet, client, arm = scene.bullet, scene.client, scene.arm
    put, read_joints, read_link = bullet.resetJointStatesMultiDof, bullet.getJointStates, bullet.getLinkState
    number, joints, tool = arm.number, arm.joints, arm.tool
    for k, row in enumerate(_rows(in_metres(asked["joints"])[:, :, None])):
        put(number, joints, row, physicsClientId=client)
        a, b, c, d, e, f = read_joints(number, joints, client)
        values.extend((a[0], b[0], c[0], d[0], e[0], f[0]))
        frame = read_link(number, tool, 0, 1, client)
        places.extend(frame[PLACE])
        turns.extend(frame[TURN])
        if k in due:
            look.at(k)
    for k in _closer(look.seen_mm(), asked).tolist():
        scene.pose(asked["joints"][k])
        look.at(k)
    read = _table(values, 6)
    read[:, INSERTION] /= MM
    return {"joints": read, "tip_mm": _table(places, 3) / MM, "rotation_xyzw": _table(turns, 4), **look.measured()}


def _rows(values: Floats) -> Iterator[Any]:
    """Yield rows as lists, some thousands at a time: a long plan as Python numbers would not fit into memory."""
    for first in range(0, len(values), 4096):
        yield from values[first : first + 4096].tolist()


def _table(values: "array[float]", columns: int) -> Floats:
    return np.array(values).reshape(-1, columns)


def _closer(seen_mm: Floats, asked: Asked) -> Ints:
    """Return the samples without a measurement at which links may be near each other."""
    moving = {PSM_A: (asked["joints"], asked["instrument"])}
    if "m_joints" in asked:
        moving[PSM_M] = (asked["m_joints"], asked["m_instrument"])
    bounds = Bounds.of(moving, link_pairs("m_joints" in asked), asked["looks"], seen_mm)
    near = np.zeros(len(asked["joints"]), dtype=bool)
    for column in range(len(bounds.pairs)):
        near |= bounds.at_least_mm(column) < LOOK_CLOSER_MM
    return np.setdiff1d(np.flatnonzero(near), asked["looks"])


class _Look:
    """The measurements at some samples, with PSM_A already posed there; PSM_M, if it is in the scene, is posed here."""

    def __init__(self, scene: Scene, asked: Asked) -> None:
        self._scene = scene
        self._m_joints = asked.get("m_joints")
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
        for pair in self._pairs:
            columns = pair.columns
            for point in scene.closest(pair.body, pair.other):  # a pair of capsules has one nearest point
                seen[columns[point[3], point[4]]] = point[8]
        self._samples.append(sample)
        self._seen.extend(seen)
        place, turn = scene.frame_of(scene.arm, scene.arm.shaft)
        self._shaft_places.extend(place)
        self._shaft_turns.extend(turn)

    def seen_mm(self) -> Floats:
        """Return the distances in the order of measurement, shape (C, P)."""
        return _table(self._seen, len(self._nothing)) / MM

    def measured(self) -> Asked:
        """Return all measurements in the order of samples."""
        order = np.argsort(self._samples)
        place, along = _table(self._shaft_places, 3) / MM, matrix_of(_table(self._shaft_turns, 4))[:, :, 2]
        found: Asked = {
            "looked_at": np.array(self._samples)[order],
            "clearances_mm": self.seen_mm()[order],
            "shaft_off_mm": np.linalg.norm(np.cross(place, along), axis=1)[order],
        }
        if self._m_places:
            found["psm_m_tip_mm"] = _table(self._m_places, 3)[order] / MM
        return found


@dataclass(frozen=True)
class _BodyPair:
    """Two bodies, and the column of `link_pairs` for each pair of their links' indices."""

    body: int
    other: int
    columns: dict[tuple[int, int], int]


def _pairs_of_bodies(scene: Scene) -> list[_BodyPair]:
    """Return the pairs of bodies in the scene, with columns numbered as in `link_pairs`."""
    assert scene.pad is not None
    on_pad = range(len(LINKS))
    found = [_BodyPair(scene.arm.number, scene.pad, {(a, -1): k for k, a in enumerate(scene.arm.surfaces)})]
    if scene.psm_m is not None:
        both = [(a, m) for a in scene.arm.surfaces for m in scene.psm_m.surfaces]
        columns = {pair: len(on_pad) + k for k, pair in enumerate(both)}
        found.append(_BodyPair(scene.arm.number, scene.psm_m.number, columns))
        first = len(on_pad) + len(both)
        under_m = {(m, -1): first + k for k, m in enumerate(scene.psm_m.surfaces)}
        found.append(_BodyPair(scene.psm_m.number, scene.pad, under_m))
    return found


# ---- the servo pass --------------------------------------------------------------------------------------------


def servo_pass(scene: Scene, asked: Asked) -> Asked:
    """Let the motors follow, and return the tip's error, the motors' efforts, the pad's force, and seconds per step."""
    wanted = np.pad(in_metres(asked["joints"]), ((0, 0), (0, 2)), constant_values=HOLDING_RAD)
    velocities = np.diff(wanted, axis=0) * asked["rate_hz"]
    scene.pose(asked["joints"][0])
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
    return {
        "tracking_mm": np.linalg.norm(_table(places, 3) / MM - asked["tip_mm"], axis=1),
        "efforts": _table(efforts, 6),
        "contact_n": np.array(pressed),
        "seconds_per_step": seconds / max(1, len(velocities)),
    }


# ---- the picture -----------------------------------------------------------------------------------------------


def _paths(asked: Asked) -> list[Floats]:
    """Return the path of the tip in A1 of each pass, in metres, each of shape (K, 3)."""
    number, tip, first = asked["pass_index"], asked["tip_mm"] * MM, asked["phase"] == A1
    return [tip[(number == one) & first] for one in range(int(number[-1]) + 1)]


def _pictured(asked: Asked) -> int:
    """Choose the sample of the picture: half-way through A1 of the last pass."""
    last = np.flatnonzero((asked["pass_index"] == asked["pass_index"][-1]) & (asked["phase"] == A1))
    return int(last[len(last) // 2]) if len(last) else len(asked["joints"]) - 1
