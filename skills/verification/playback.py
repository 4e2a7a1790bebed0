"""Playbacks: the simulator's measurements at the samples of a trajectory, and the pictures of a playback.

`skills.simulation.player.play` returns a `Playback` of two passes over a trajectory: a kinematic pass, which sets the
joints to those of the trajectory and measures tips and surfaces, and, where a servo is stated, a torque pass: the
executed motion (`skills.dynamics`), among things that it can touch. `skills.verification.verdict.judge` compares it
with the trajectory. All of this is ours; the paper played its plans on the robot.

Distances take most of the simulator's time, so it does not measure them at every sample; between two measurements they
are bounded by the distance that the arms can have moved (`skills.verification.clearance`).

The pictures are a value like any other, so that they can be stored completely.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.arrays import Floats, Ints
from skills.errors import BadInput
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory

CLEARANCE_SEEN_MM = 50.0  # surfaces further apart than this are reported as this far
PAD = "pad"
LINKS = ("roll_link", "wrist_pitch_link", "finger_1", "finger_2")  # the links of `urdf/psm.urdf` that have a surface
FINGERS = ("finger_1", "finger_2")
PAD_SIZE_MM = (120.0, 120.0, 12.0)  # of `urdf/suture_pad.urdf`, whose frame is the middle of its top
PAD_AROUND_MM = 20.0  # ours: least reach of the pad beyond a path, because an arm next to the pad would touch nothing

# The checks of a verdict, and by which means each is decided.
MEANS = {
    "joints, speeds, accelerations": "PSM_A's joints as the simulator was set to them and read back, PSM_M's as "
    "commanded, against published limits",
    "tip and rotation": "PyBullet's forward kinematics against the closed form",
    "shaft, wrist, fingers and pad": "PyBullet's distances between capsules, which are exact to 0.0001 mm as no convex "
    "hull is among them (hulls are up to 2 mm off); between two measurements a bound in closed form",
    "force of contact": "PyBullet's rigid contacts of the executed motion, where a servo is stated",
    "outer bodies": "closed form: capsules around published joint origins",
    "scene, tissue and needle": "closed form: capsules and the needle's arc",
    "what was asked": "closed form, computed anew from the request",
    "probability and catch": "closed form in seeded worlds; friction plays no part in it, and the contact referee "
    "(MuJoCo) in no verdict",
}


@dataclass(frozen=True)
class LinkPair:
    """Two links whose distance is measured; the pad is a body of one link."""

    body: str
    link: str
    other: str
    other_link: str

    def __str__(self) -> str:
        """Return the names of both."""
        other = "the pad" if self.other == PAD else f"{self.other} {self.other_link}"
        return f"{self.body} {self.link} to {other}"

    @property
    def may_touch(self) -> bool:
        """True for fingers of both arms, which meet where the needle is handed over."""
        return self.other == PSM_M and self.link in FINGERS and self.other_link in FINGERS


_PSM_A_PAIRS = tuple(LinkPair(PSM_A, link, PAD, PAD) for link in LINKS)
_PSM_M_PAIRS = tuple(LinkPair(PSM_A, link, PSM_M, other) for link in LINKS for other in LINKS)
_PSM_M_PAIRS += tuple(LinkPair(PSM_M, link, PAD, PAD) for link in LINKS)


def link_pairs(with_psm_m: bool) -> tuple[LinkPair, ...]:
    """Return the pairs of links whose distances are measured: the columns of `Playback.clearances_mm`.

    Args:
        with_psm_m: Whether PSM_M is in the scene.
    """
    return _PSM_A_PAIRS + _PSM_M_PAIRS if with_psm_m else _PSM_A_PAIRS


def pad_scale(tip_mm: Floats) -> float:
    """Return the factor, at least 1, that enlarges the pad so that it lies under a complete path.

    Args:
        tip_mm: The path in the PSM base frame, shape (T, 3).
    """
    extent = float(np.ptp(tip_mm[:, :2], axis=0).max())
    return max(1.0, (extent + 2 * PAD_AROUND_MM) / PAD_SIZE_MM[0])


@dataclass(frozen=True, eq=False)
class Playback:
    """A motion and the simulator's measurements of it, stored as they came, NaN included.

    Attributes:
        trajectory: The motion that was played, T samples: what is exported is what was judged.
        tip_mm: Tip in the kinematic pass, PSM base frame, shape (T, 3).
        rotation_xyzw: The jaw's rotation there, shape (T, 4).
        joints: Joints of the kinematic pass, rad and mm, shape (T, 6).
        looked_at: The samples at which distances were measured, ascending, shape (C,); they contain the first and the
            last of each phase, and every sample of a stretch in which surfaces come close.
        clearances_mm: Distances of `link_pairs` there, negative inside, shape (C, 4), or (C, 24) with PSM_M.
        shaft_off_mm: Distance of PSM_A's shaft from its remote centre there, shape (C,).
        psm_m_tip_mm: PSM_M's tip there in the PSM_A base frame, shape (C, 3); None if it is not in the scene.
        pad_mm: The middle of the pad's top, PSM base frame, shape (3,).
        picture_png: A still picture of the scene.
        engine: The simulator and its version.
        files: SHA-256 of each file from which the scene was made.
        tracking_mm: Distance of the executed tip from the trajectory's, shape (T,); None: no servo was stated.
        efforts: Efforts of the motors then, Nm and N, shape (T, 6), or None.
        contact_n: Force of pad and PSM_M on PSM_A then, N, shape (T,), or None.
        windows: First and last sample of each stretch whose motion is PyBullet's, shape (W, 2), or None; elsewhere
            PSM_A can touch nothing, and the compiled motion stands.
    """

    trajectory: Trajectory
    tip_mm: Floats
    rotation_xyzw: Floats
    joints: Floats
    looked_at: Ints
    clearances_mm: Floats
    shaft_off_mm: Floats
    psm_m_tip_mm: Floats | None
    pad_mm: Floats
    picture_png: bytes
    engine: str
    files: Mapping[str, str]
    tracking_mm: Floats | None = None
    efforts: Floats | None = None
    contact_n: Floats | None = None
    windows: Ints | None = None

    def __post_init__(self) -> None:
        count, looks, pairs = len(self.trajectory), len(self.looked_at), len(self.link_pairs)
        for name, shape in {
            "tip_mm": (count, 3),
            "rotation_xyzw": (count, 4),
            "joints": (count, 6),
            "tracking_mm": (count,),
            "efforts": (count, 6),
            "contact_n": (count,),
            "windows": (0 if self.windows is None else len(self.windows), 2),
            "looked_at": (looks,),
            "clearances_mm": (looks, pairs),
            "shaft_off_mm": (looks,),
            "psm_m_tip_mm": (looks, 3),
            "pad_mm": (3,),
        }.items():
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _kept(getattr(self, name), name, shape))
        whole = looks and self.looked_at[0] == 0 and self.looked_at[-1] == count - 1
        if not (whole and (np.diff(self.looked_at) > 0).all()):
            raise BadInput(
                "Distances are measured at the first sample, at the last, and at some in between, in increasing order."
            )

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.trajectory)

    @property
    def link_pairs(self) -> tuple[LinkPair, ...]:
        """The pairs of links whose distances were measured."""
        return link_pairs(self.psm_m_tip_mm is not None)


def _kept(values: ArrayLike, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a read-only copy of an array; unlike `frozen` it permits NaN, which the gates then refuse."""
    array = np.array(values, dtype=np.int64 if name in ("looked_at", "windows") else np.float64, order="C", copy=True)
    if array.shape != shape:
        raise BadInput(f"{name} has shape {array.shape}; give {shape}.", shape=array.shape)
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Pictures:
    """The pictures of a playback, each the bytes of a file.

    Attributes:
        animation_mp4: The film of the complete trajectory, H.264.
        animation_gif: The same film as a GIF.
        joints_png: The joints of both arms with their limits, over time.
        clearance_png: Distances between surfaces over time, with their limits.
    """

    animation_mp4: bytes
    animation_gif: bytes
    joints_png: bytes
    clearance_png: bytes
