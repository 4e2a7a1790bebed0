"""The patient-side manipulator (PSM) as numbers: its constants, forward kinematics and closed-form inverse kinematics.

Joints are rows of six in the order of `JOINTS`: yaw, pitch, insertion, roll, wrist pitch, wrist yaw. All are radians
but the insertion, which is **millimetres** like every length of the domain; `skills.sim` turns it into metres at the
simulator's door. Positions are in the PSM base frame: origin at the remote centre, the tool along -z at zero joints.

The tip is where the dVRK's `local/measured_cp` has it: on the hinge of the jaws, `JAW_TIP_MM` before the finger tips.
A rotation's columns are [n o a]: n the hinge axis, o from finger to finger, a the approach.

Source: jhu-dvrk/sawIntuitiveResearchKit @9e535e68, share/kinematic/PSM.json and PSM_Si.json, share/tool/
LARGE_NEEDLE_DRIVER_400006.json and _420006.json, in modified (Craig) Denavit-Hartenberg convention,
T_i = Rx(alpha) Tx(a) Rz(theta) Tz(d). The inverse is ours.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, radians
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import BadInput, ImproperRotation, UnknownInstrument, Unreachable
from skills.style._arrays import Floats, Ints, frozen

Bools = NDArray[np.bool_]
Six = tuple[float, float, float, float, float, float]

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
UNITS = ("rad", "rad", "mm", "rad", "rad", "rad")
INSERTION = 2
ROLL = 3

WRIST_MM = 9.1  # from the wrist's pitch axis to the hinge of the jaws
JAW_TIP_MM = 10.2  # from the hinge to the finger tips, along the approach (dvrk_model @70998aa)
CANNULA_MM = 35.0  # with less insertion the wrist is still inside the cannula (saw engages at 25 mm)
_ROUND_OFF = 1e-9  # rad and mm: a joint that stands on its limit is within it


@dataclass(frozen=True)
class Arm:
    """The part of a PSM that stays: where its remote centre is and what its joints can do (rad and s, insertion mm).

    `speed` and `acceleration` are the limits that saw plans with, not those of the motors; `effort` is ftmax in Nm
    (insertion: N), which the servo check uses.
    """

    name: str
    remote_centre_mm: float
    lower: Six
    upper: Six
    speed: Six
    acceleration: Six
    effort: Six


@dataclass(frozen=True)
class Instrument:
    """A tool on an arm; `shaft_mm` is its shaft's length up to the wrist, `jaw_rad` the opening of its jaws."""

    name: str
    arm: Arm
    shaft_mm: float
    jaw_rad: tuple[float, float]

    @property
    def wrist_offset_mm(self) -> float:
        """How far the wrist lags behind the insertion: at this insertion it is in the remote centre."""
        return self.arm.remote_centre_mm - self.shaft_mm

    @property
    def lower(self) -> Floats:
        """The joints' lower limits, shape (6,)."""
        return np.array(self.arm.lower)

    @property
    def upper(self) -> Floats:
        """The joints' upper limits, shape (6,)."""
        return np.array(self.arm.upper)

    @property
    def speed(self) -> Floats:
        """The joints' speed limits, rad/s and mm/s, shape (6,)."""
        return np.array(self.arm.speed)

    @property
    def acceleration(self) -> Floats:
        """The joints' acceleration limits, rad/s2 and mm/s2, shape (6,)."""
        return np.array(self.arm.acceleration)


_SPEED: Six = (radians(90), radians(90), 200.0, radians(1080), radians(1080), radians(1080))
_ACCELERATION: Six = (radians(90), radians(90), 200.0, radians(720), radians(720), radians(720))
_EFFORT: Six = (3.316, 3.316, 9.878, 0.33, 0.25, 0.20)

CLASSIC = Arm(
    name="PSM Classic",
    remote_centre_mm=431.8,
    lower=(radians(-91), radians(-53), 0.0, radians(-260), radians(-80), radians(-80)),
    upper=(radians(91), radians(53), 240.0, radians(260), radians(80), radians(80)),
    speed=_SPEED,
    acceleration=_ACCELERATION,
    effort=_EFFORT,
)
# Only the first three joints' limits are published apart for the Si; the others are taken to be the Classic's.
SI = Arm(
    name="PSM Si",
    remote_centre_mm=482.6,
    lower=(-2.964, -1.265, 0.0, radians(-260), radians(-80), radians(-80)),
    upper=(2.964, 1.301, 290.0, radians(260), radians(80), radians(80)),
    speed=_SPEED,
    acceleration=_ACCELERATION,
    effort=_EFFORT,
)

DEFAULT_INSTRUMENT = "400006"
INSTRUMENTS: Mapping[str, Instrument] = MappingProxyType(
    {
        "400006": Instrument("400006", CLASSIC, 416.2, (radians(-40), radians(80))),
        "420006": Instrument("420006", SI, 467.0, (radians(-20), radians(80))),
    }
)

# The paper's orientation at zero joints: the tool points down, its hinge axis along +y.
POINTING_DOWN: Floats = frozen([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float64, (3, 3), "POINTING_DOWN")
# From the last DH frame to the tip: a rotation only, for the tip is on the hinge.
_TIP_IN_HINGE: Floats = frozen([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], np.float64, (3, 3), "_TIP_IN_HINGE")


def instrument_of(name: str) -> Instrument:
    """Look up an instrument by its number.

    Raises:
        UnknownInstrument: No constants are known for it; the message lists those that are.
    """
    if name not in INSTRUMENTS:
        known = ", ".join(INSTRUMENTS)
        raise UnknownInstrument(f"No instrument {name!r} is known; use one of {known}.", instrument=name)
    return INSTRUMENTS[name]


# ---- forward ---------------------------------------------------------------------------------------------------


def forward(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> tuple[Floats, Floats]:
    """Compute where the joints put the tip.

    Args:
        joints: Rows of `JOINTS`, rad and mm, shape (T, 6). Limits are not checked.
        instrument: Number of the instrument.

    Returns:
        The tip in the PSM base frame in mm, shape (T, 3), and its rotation [n o a], shape (T, 3, 3).
    """
    q = frozen(joints, np.float64, (None, 6), "joints")
    tool = instrument_of(instrument)
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for alpha, a, theta, d in (
        (+pi / 2, 0.0, q[:, 0] + pi / 2, 0.0),
        (-pi / 2, 0.0, q[:, 1] - pi / 2, 0.0),
        (+pi / 2, 0.0, 0.0, q[:, 2] - tool.arm.remote_centre_mm),
        (0.0, 0.0, q[:, 3], tool.shaft_mm),
        (-pi / 2, 0.0, q[:, 4] - pi / 2, 0.0),
        (-pi / 2, WRIST_MM, q[:, 5] - pi / 2, 0.0),
    ):
        pose = pose @ _link(alpha, a, theta, d, len(q))
    return pose[:, :3, 3].copy(), pose[:, :3, :3] @ _TIP_IN_HINGE


def _link(alpha: float, a: float, theta: Floats | float, d: Floats | float, count: int) -> Floats:
    """Make one row of the modified DH table a homogeneous transform per sample, shape (T, 4, 4)."""
    # Exact for the table's multiples of a right angle, where np.cos(pi / 2) would leave 6e-17.
    ca, sa = float(np.round(np.cos(alpha), 12)), float(np.round(np.sin(alpha), 12))
    ct, st = np.cos(theta), np.sin(theta)
    link = np.zeros((count, 4, 4))
    link[:, 0, 0], link[:, 0, 1], link[:, 0, 3] = ct, -st, a
    link[:, 1, 0], link[:, 1, 1], link[:, 1, 2], link[:, 1, 3] = st * ca, ct * ca, -sa, -sa * d
    link[:, 2, 0], link[:, 2, 1], link[:, 2, 2], link[:, 2, 3] = st * sa, ct * sa, ca, ca * d
    link[:, 3, 3] = 1.0
    return link


# ---- inverse ---------------------------------------------------------------------------------------------------


def inverse(
    tip_mm: ArrayLike, rotation: ArrayLike, instrument: str = DEFAULT_INSTRUMENT, near: ArrayLike | None = None
) -> Floats:
    """Compute the joints that put the tip there, in closed form.

    Of the solutions within the limits each sample takes the one nearest the sample before: least seconds at full
    joint speed, summed over the joints. The wrist is sought beyond the remote centre, as it is outside the cannula.

    Args:
        tip_mm: Tip in the PSM base frame, mm, shape (T, 3).
        rotation: Its rotation [n o a], shape (T, 3, 3), or (3, 3) where it is held.
        instrument: Number of the instrument.
        near: Joints before the first sample, shape (6,); by default roll and wrist are straight.

    Returns:
        Rows of `JOINTS`, rad and mm, shape (T, 6).

    Raises:
        BadInput: A number is NaN or infinite, or a rotation is none.
        Unreachable: A pose is out of reach; `numbers` names the first such sample, its joint, value and limit.
    """
    tool = instrument_of(instrument)
    tip, turned = _poses(tip_mm, rotation)
    if not len(tip):
        return np.empty((0, 6))
    solutions = solutions_of(tip, turned, tool)
    allowed = _within_limits(solutions, tool)
    reached = allowed.any(axis=1)
    if not reached.all():
        raise _out_of_reach(int(np.argmin(reached)), tip, solutions, tool)
    before = np.zeros(6) if near is None else frozen(near, np.float64, (6,), "near")
    chosen = _nearest_branch(solutions, allowed, before, tool)
    return solutions[np.arange(len(tip)), chosen]


def reachable(tip_mm: ArrayLike, rotation: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> Bools:
    """Tell which poses the arm can take within its joint limits, shape (T,); arguments as for `inverse`."""
    tool = instrument_of(instrument)
    tip, turned = _poses(tip_mm, rotation)
    return np.asarray(_within_limits(solutions_of(tip, turned, tool), tool).any(axis=1))


def joint_margins(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> Floats:
    """Measure how far each joint is from its nearer limit, rad and mm, shape (T, 6); negative is beyond it."""
    tool = instrument_of(instrument)
    q = np.asarray(joints, dtype=np.float64)
    return np.minimum(q - tool.lower, tool.upper - q)


def _poses(tip_mm: ArrayLike, rotation: ArrayLike) -> tuple[Floats, Floats]:
    """Check poses given by a caller: finite, of one length, the rotations proper."""
    tip = frozen(tip_mm, np.float64, (None, 3), "tip_mm")
    turned = np.asarray(rotation, dtype=np.float64)
    held = turned.shape == (3, 3)
    turned = frozen(turned[None] if held else turned, np.float64, (None, 3, 3), "rotation")
    if not held and len(turned) != len(tip):
        raise BadInput(f"{len(tip)} positions came with {len(turned)} rotations; give as many, or one for all.")
    check_rotation(turned)
    return tip, np.broadcast_to(turned, (len(tip), 3, 3))


def solutions_of(tip: Floats, rotation: Floats, tool: Instrument) -> Floats:
    """List every solution of every pose regardless of limits, shape (T, 6, 6): two wrists, three turns of roll.

    The wrist's pitch axis z5 is normal to both the tip's position and the wrist's yaw axis z6, because shaft, wrist
    and hinge lie in one plane; its two signs are the two branches.
    """
    hinge = rotation @ _TIP_IN_HINGE.T
    x6, z6 = hinge[:, :, 0], hinge[:, :, 2]
    normal = _cross(tip, z6)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # The tip lies on z6: every perpendicular is a solution, x6 is one of them.
    z5 = np.where(length > 1e-9, normal / np.where(length > 1e-9, length, 1.0), x6)
    wrists = _wrists(tip, x6, z6, np.stack([z5, -z5]), tool)
    turns = np.zeros((3, 6))
    turns[:, ROLL] = 0.0, 2 * pi, -2 * pi
    return (wrists.swapaxes(0, 1)[:, :, None, :] + turns).reshape(len(tip), 6, 6)


def _wrists(tip: Floats, x6: Floats, z6: Floats, z5: Floats, tool: Instrument) -> Floats:
    """Solve all joints for two choices of the wrist's pitch axis z5, (2, T, 6); NaN where the shaft has no way."""
    x5 = _cross(z6, z5)
    wrist = tip - WRIST_MM * x5
    depth = np.linalg.norm(wrist, axis=-1)
    # With the wrist in the remote centre the shaft's direction is anybody's guess; it is inside the cannula there.
    shaft = wrist / np.where(depth > 1e-6, depth, np.nan)[..., None]
    yaw = np.arctan2(shaft[..., 0], -shaft[..., 2])
    pitch = -np.arcsin(np.clip(shaft[..., 1], -1.0, 1.0))
    s1, c1, s2, c2 = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
    x3 = np.stack([-s1 * s2, -c2, c1 * s2], axis=-1)
    y3 = _cross(shaft, x3)
    roll = np.arctan2(-_dot(z5, x3), _dot(z5, y3))
    x4 = np.cos(roll)[..., None] * x3 + np.sin(roll)[..., None] * y3
    wrist_pitch = _wrapped(np.arctan2(-_dot(x5, shaft), _dot(x5, x4)) + pi / 2)
    wrist_yaw = _wrapped(np.arctan2(-_dot(x6, z5), _dot(x6, x5)) + pi / 2)
    return np.stack([yaw, pitch, depth + tool.wrist_offset_mm, roll, wrist_pitch, wrist_yaw], axis=-1)


def _within_limits(solutions: Floats, tool: Instrument) -> Bools:
    """Tell which solutions keep every joint within its limits, shape (T, solutions); NaN does not."""
    inside = (solutions >= tool.lower - _ROUND_OFF) & (solutions <= tool.upper + _ROUND_OFF)
    return np.asarray(inside.all(axis=2))


def _nearest_branch(solutions: Floats, allowed: Bools, before: Floats, tool: Instrument) -> Ints:
    """Choose for each sample the allowed solution nearest the one chosen before it, shape (T,)."""
    width = int(allowed.sum(axis=1).max())
    order = np.argsort(~allowed, axis=1, kind="stable")[:, :width]  # the allowed ones first: rarely more than two
    best = np.take_along_axis(solutions, order[:, :, None], axis=1)
    barred = ~np.take_along_axis(allowed, order, axis=1)
    first = np.where(barred[0], np.inf, (np.abs(best[0] - before) / tool.speed).sum(axis=1))
    seconds = (np.abs(best[1:, None, :, :] - best[:-1, :, None, :]) / tool.speed).sum(axis=3)
    following = np.where(barred[1:, None, :], np.inf, seconds).argmin(axis=2).tolist()
    branch = [int(first.argmin())]
    for options in following:
        branch.append(options[branch[-1]])
    return np.asarray(order[np.arange(len(order)), branch], dtype=np.int64)


def _out_of_reach(sample: int, tip: Floats, solutions: Floats, tool: Instrument) -> Unreachable:
    """Name the joint that is furthest over its limit in the solution that is least over its limits."""
    over = np.maximum(tool.lower - solutions[sample], solutions[sample] - tool.upper) / (tool.upper - tool.lower)
    over = np.where(np.isnan(over), np.inf, over)
    solution = int(over.max(axis=1).argmin())
    joint = int(over[solution].argmax())
    value = float(solutions[sample, solution, joint])
    limit = float(tool.upper[joint] if value > tool.upper[joint] else tool.lower[joint])
    where = ", ".join(f"{x:.1f}" for x in tip[sample])
    return Unreachable(
        f"Sample {sample} at ({where}) mm needs {JOINTS[joint]} {value:.5g} {UNITS[joint]}, beyond the limit "
        f"{limit:.4g} of the {tool.arm.name} with {tool.name}; move the point or turn the tool.",
        sample=sample,
        joint=JOINTS[joint],
        value=value,
        limit=limit,
        tip_mm=tip[sample].tolist(),
    )


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", u, v))


def _cross(u: Floats, v: Floats) -> Floats:
    """The cross product; numpy's own, which takes any length of vectors, takes four times as long for a short path."""
    a, b, c = u[..., 0], u[..., 1], u[..., 2]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def _wrapped(angle: Floats) -> Floats:
    """Bring angles into (-pi, pi]."""
    return np.asarray(pi - (pi - angle) % (2 * pi))


# ---- rotations -------------------------------------------------------------------------------------------------


def check_rotation(rotation: Floats) -> None:
    """Refuse matrices, shape (T, 3, 3), that are not proper rotations to 1e-6.

    Raises:
        ImproperRotation: The first that is none, by its index.
    """
    skew = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2), initial=0.0)
    good = (skew < 1e-6) & (np.linalg.det(rotation) > 0)
    if not good.all():
        sample = int(np.argmin(good))
        raise ImproperRotation(f"Rotation {sample} is not orthonormal with determinant 1; normalise it.", sample=sample)


def matrix_of(rotation_xyzw: ArrayLike) -> Floats:
    """Turn quaternions x, y, z, w of any length, shape (T, 4), into rotations, shape (T, 3, 3)."""
    q = frozen(rotation_xyzw, np.float64, (None, 4), "rotation_xyzw")
    length = np.linalg.norm(q, axis=1, keepdims=True)
    if not (length > 1e-9).all():
        raise ImproperRotation("A quaternion has no length; give a unit one.", sample=int(np.argmin(length)))
    x, y, z, w = (q / length).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternion_of(rotation: ArrayLike) -> Floats:
    """Turn rotations, shape (T, 3, 3), into unit quaternions x, y, z, w, shape (T, 4).

    Of the two that mean the same, the first has its largest number positive and each next is the one nearer its
    predecessor, so that a smooth turn has smooth quaternions.
    """
    m = frozen(rotation, np.float64, (None, 3, 3), "rotation")
    check_rotation(m)
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    xw, yw, zw = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    # Four times the quaternion's outer product with itself: its row of the largest diagonal is the best conditioned.
    outer = np.array(
        [
            [1 + xx - yy - zz, xy, xz, xw],
            [xy, 1 - xx + yy - zz, yz, yw],
            [xz, yz, 1 - xx - yy + zz, zw],
            [xw, yw, zw, 1 + xx + yy + zz],
        ]
    )
    largest = np.argmax(np.einsum("iit->it", outer), axis=0)
    q = outer[largest, :, np.arange(len(m))]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    flips = np.where(np.einsum("ti,ti->t", q[1:], q[:-1]) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(flips)[:, None]
    return np.asarray(q)


def angle_between(rotation: Floats, other: Floats) -> Floats:
    """Measure the angle of the turn from one rotation to another, rad, shape (T,), both of shape (T, 3, 3)."""
    q = quaternion_of(np.swapaxes(rotation, -1, -2) @ other)
    return np.asarray(2 * np.arctan2(np.linalg.norm(q[:, :3], axis=1), np.abs(q[:, 3])))
