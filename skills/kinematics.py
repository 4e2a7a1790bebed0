"""The patient-side manipulator (PSM) as numbers: its constants, forward kinematics and closed-form inverse kinematics.

Joints are rows of six in the order of `JOINTS`: yaw, pitch, insertion, roll, wrist pitch, wrist yaw. All are radians
but the insertion, which is in **millimetres** like every length of the domain; `skills.simulation` converts it to
metres for the simulator. Positions are in the PSM base frame: origin at the remote centre, the tool along -z at zero
joints.

The tip is that of the dVRK's `local/measured_cp`: on the hinge of the jaws, `JAW_TIP_MM` before the finger tips.
A rotation's columns are [n o a]: n the hinge axis, o from finger to finger, a the approach.

Source: jhu-dvrk/sawIntuitiveResearchKit @9e535e68, share/kinematic/PSM.json and PSM_Si.json, share/tool/
LARGE_NEEDLE_DRIVER_400006.json and _420006.json, in modified (Craig) Denavit-Hartenberg convention,
T_i = Rx(alpha) Tx(a) Rz(theta) Tz(d). The inverse is ours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import copysign, isnan, nan, pi, radians, sqrt
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.arithmetic import ARC, COSINE, QUARTER, SINE, arctan2, cos, product, sin
from skills.arrays import Flags, Floats, Ints, frozen
from skills.compiled import compiled, inner
from skills.errors import BadInput, ImproperRotation, UnknownInstrument, Unreachable
from skills.fields import Point, Six, schema
from skills.remedies import did_you_mean

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
Unit = Literal["rad", "mm"]
UNITS: tuple[Unit, ...] = ("rad", "rad", "mm", "rad", "rad", "rad")
INSERTION = 2
ROLL = 3

WRIST_MM = 9.1  # from the wrist's pitch axis to the hinge of the jaws
JAW_TIP_MM = 10.2  # from the hinge to the finger tips, along the approach (dvrk_model @70998aa)
CANNULA_MM = 35.0  # with a smaller insertion the wrist is still inside the cannula (saw engages at 25 mm)
_USUAL_OFFSET_MM = 15.6  # `wrist_offset_mm` of every tool on an arm of its own generation
# Only the roll, with limits of 260 degrees either way, has room for a full turn more or less.
_TURNS = (0.0, 2 * pi, -2 * pi)
_ROUND_OFF = 1e-9  # rad and mm: a joint exactly at its limit is within it


@schema
@dataclass(frozen=True)
class ArmConstants:
    """A PSM without its instrument: the position of its remote centre and the limits of its joints.

    Attributes:
        name: Name for messages.
        remote_centre_mm: Position of the remote centre in the insertion's row of the DH table, where d is the insertion
            minus this.
        lower: Lower joint limits, rad, insertion mm.
        upper: Upper joint limits, rad, insertion mm.
        speed: Speed limits with which saw plans, not those of the motors, rad/s, insertion mm/s.
        acceleration: Acceleration limits with which saw plans, not those of the motors, rad/s2, insertion mm/s2.
        effort: ftmax in Nm, insertion N, used by the servo check.
    """

    name: str
    remote_centre_mm: float
    lower: Six
    upper: Six
    speed: Six
    acceleration: Six
    effort: Six


@schema
@dataclass(frozen=True)
class InstrumentConstants:
    """A tool on an arm.

    Attributes:
        name: The tool's number in the dVRK's files; "420006-Classic" on an arm of the other generation than its own.
        arm: The arm that it is on.
        shaft_mm: Length of its shaft up to the wrist.
        jaw_rad: Range of the opening of its jaws.
    """

    name: str
    arm: ArmConstants
    shaft_mm: float
    jaw_rad: tuple[float, float]

    @property
    def wrist_offset_mm(self) -> float:
        """Distance by which the wrist lags behind the insertion: at this insertion it is in the remote centre."""
        return self.arm.remote_centre_mm - self.shaft_mm

    @property
    def cannula_mm(self) -> float:
        """The insertion with which the wrist is out of the cannula: `CANNULA_MM` where tool and arm belong together."""
        return CANNULA_MM + round(self.wrist_offset_mm - _USUAL_OFFSET_MM, 6)

    @property
    def lower(self) -> Floats:
        """The joints' lower limits, rad and mm, shape (6,)."""
        return np.array(self.arm.lower)

    @property
    def upper(self) -> Floats:
        """The joints' upper limits, rad and mm, shape (6,)."""
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

CLASSIC = ArmConstants(
    name="PSM Classic",
    remote_centre_mm=431.8,
    lower=(radians(-91), radians(-53), 0.0, radians(-260), radians(-80), radians(-80)),
    upper=(radians(91), radians(53), 240.0, radians(260), radians(80), radians(80)),
    speed=_SPEED,
    acceleration=_ACCELERATION,
    effort=_EFFORT,
)
# For the Si the limits and efforts of the first three joints are published; roll and wrist are the tool's, whose two
# generations have the same. The speeds and accelerations are assumed to be the Classic's.
SI = ArmConstants(
    name="PSM Si",
    remote_centre_mm=482.6,
    lower=(-2.964, -1.265, 0.0, radians(-260), radians(-80), radians(-80)),
    upper=(2.964, 1.301, 290.0, radians(260), radians(80), radians(80)),
    speed=_SPEED,
    acceleration=_ACCELERATION,
    effort=(17.0845, 17.0845, 40.9063, *_EFFORT[3:]),
)

DEFAULT_INSTRUMENT = "400006"
INSTRUMENTS: Mapping[str, InstrumentConstants] = MappingProxyType(
    {
        "400006": InstrumentConstants("400006", CLASSIC, 416.2, (radians(-40), radians(80))),
        "420006": InstrumentConstants("420006", SI, 467.0, (radians(-20), radians(80))),
        # Each on an arm of the other generation: laboratories do it, and the tip is 50.8 mm further in or out.
        "400006-Si": InstrumentConstants("400006-Si", SI, 416.2, (radians(-40), radians(80))),
        "420006-Classic": InstrumentConstants("420006-Classic", CLASSIC, 467.0, (radians(-20), radians(80))),
    }
)

# The paper's orientation at zero joints: the tool points down, its hinge axis along +y.
POINTING_DOWN: Floats = frozen([[0, 1, 0], [1, 0, 0], [0, 0, -1]], np.float64, (3, 3), "POINTING_DOWN")


def instrument_of(name: str) -> InstrumentConstants:
    """Return an instrument by its number.

    Args:
        name: The tool's number in the dVRK's files, such as "400006"; or "400006-Si" on an arm of the other generation.

    Returns:
        The instrument, with its arm.

    Raises:
        UnknownInstrument: No constants are known for it; the message lists those that are.
    """
    if name not in INSTRUMENTS:
        known = ", ".join(INSTRUMENTS)
        near = did_you_mean(name, INSTRUMENTS)
        raise UnknownInstrument(f"The instrument {name!r} is unknown; use one of {known}.", *near, instrument=name)
    return INSTRUMENTS[name]


# ---- forward ---------------------------------------------------------------------------------------------------


def forward(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> tuple[Floats, Floats]:
    """Compute the pose of the tip from the joints.

    Args:
        joints: Rows of `JOINTS`, rad and mm, shape (T, 6). Limits are not checked.
        instrument: Number of the instrument.

    Returns:
        The tip in the PSM base frame in mm, shape (T, 3), and its rotation [n o a], shape (T, 3, 3).
    """
    q = frozen(joints, np.float64, (None, 6), "joints")
    shaft, wrist, rotation = axes_of(q)
    depth_mm = q[:, INSERTION, None] - instrument_of(instrument).wrist_offset_mm
    return depth_mm * shaft + WRIST_MM * wrist, rotation


def axes_of(joints: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute the directions of shaft and wrist, of which the tip of every instrument is made.

    The tip is (insertion - wrist offset) * shaft + (length of the wrist) * wrist. Instruments differ in these lengths
    only, so that one call is enough to try all of them.

    Args:
        joints: Rows of `JOINTS`, rad and mm, shape (T, 6).

    Returns:
        The direction of the shaft and that from the wrist's pitch axis to the hinge of the jaws, in the PSM base frame,
        each of shape (T, 3); and the rotation of the tip [n o a], shape (T, 3, 3).
    """
    (s1, s2, s4, s5, s6), (c1, c2, c4, c5, c6) = (f(joints[:, (0, 1, 3, 4, 5)]).T[:, :, None] for f in (sin, cos))
    shaft = np.concatenate([c2 * s1, -s2, -c2 * c1], axis=1)
    x3 = np.concatenate([-s1 * s2, -c2, c1 * s2], axis=1)
    y3 = _cross(shaft, x3)
    x4, z5 = c4 * x3 + s4 * y3, c4 * y3 - s4 * x3
    wrist = s5 * x4 + c5 * shaft
    hinge = _cross(wrist, z5)
    between = -s6 * wrist - c6 * z5
    return shaft, wrist, np.stack([hinge, between, _cross(hinge, between)], axis=-1)


# ---- inverse ---------------------------------------------------------------------------------------------------


def inverse(
    tip_mm: ArrayLike, rotation: ArrayLike, instrument: str = DEFAULT_INSTRUMENT, near: ArrayLike | None = None
) -> Floats:
    """Compute the joints of given poses of the tip, in closed form.

    Of the solutions within the limits each sample takes the one nearest to that of the sample before: the least time at
    full joint speed, summed over the joints. Only solutions with the wrist beyond the remote centre are considered,
    where it is outside the cannula.

    Args:
        tip_mm: Tip in the PSM base frame, mm, shape (T, 3).
        rotation: Its rotation [n o a], shape (T, 3, 3), or (3, 3) if it is constant.
        instrument: Number of the instrument.
        near: Joints before the first sample, shape (6,), rad and mm; by default all 0, with roll and wrist straight.

    Returns:
        Rows of `JOINTS`, rad and mm, shape (T, 6).

    Raises:
        BadInput: A number is NaN or infinite, or the shapes do not agree.
        ImproperRotation: A rotation is not orthonormal with determinant 1.
        Unreachable: A pose is out of reach; its attributes name the first such sample, its joint, value and limit.
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


def reachable(tip_mm: ArrayLike, rotation: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> Flags:
    """Return which poses the arm can take within its joint limits.

    Args:
        tip_mm: Tip in the PSM base frame, mm, shape (T, 3).
        rotation: Its rotation [n o a], shape (T, 3, 3), or (3, 3) if it is constant.
        instrument: Number of the instrument.

    Returns:
        Flags of shape (T,).

    Raises:
        BadInput, ImproperRotation: As for `inverse`.
    """
    tool = instrument_of(instrument)
    tip, turned = _poses(tip_mm, rotation)
    return _left(tip, turned, tool)[1]


@schema
@dataclass(frozen=True)
class NearestLimit:
    """The place on a path at which a joint comes nearest to its limit, or goes furthest beyond it.

    Joints are compared relative to their range, and at each place in the solution that stays furthest from the limits.

    Attributes:
        tip_mm: The place, in the PSM base frame.
        joint: Name of the joint.
        unit: Unit of the following numbers.
        limit: The limit nearest to the joint's value.
        value: Value of the joint; null if no joints put the tip there.
        margin: Distance from the limit, negative beyond it; null if no joints put the tip there.
    """

    tip_mm: Point
    joint: str
    unit: Unit
    limit: float
    value: float | None
    margin: float | None


def nearest_limit(
    tip_mm: ArrayLike, rotation: ArrayLike, instrument: str = DEFAULT_INSTRUMENT
) -> tuple[NearestLimit, int]:
    """Find the pose that comes nearest to a joint limit, and count the poses beyond the limits.

    Args:
        tip_mm: Tip in the PSM base frame, mm, shape (T, 3), T at least 1.
        rotation: Its rotation [n o a], shape (T, 3, 3), or (3, 3) if it is constant.
        instrument: Number of the instrument.

    Returns:
        The nearest pose, with its joint and margin; and the number of poses that no joints within the limits reach.

    Raises:
        BadInput, ImproperRotation: As for `inverse`.
    """
    tool = instrument_of(instrument)
    tip, turned = _poses(tip_mm, rotation)
    left, within = _left(tip, turned, tool)
    one = slice(int(left.argmin()), int(left.argmin()) + 1)
    return _nearest_limit(tip[one], solutions_of(tip[one], turned[one], tool), tool), int(np.count_nonzero(~within))


def joint_margins(joints: ArrayLike, instrument: str = DEFAULT_INSTRUMENT) -> Floats:
    """Return the distance of each joint from its nearer limit; negative beyond the limit.

    Args:
        joints: Rows of `JOINTS`, rad and mm, shape (T, 6).
        instrument: Number of the instrument.

    Returns:
        Distances in rad and mm, shape (T, 6).
    """
    tool = instrument_of(instrument)
    q = np.asarray(joints, dtype=np.float64)
    return np.minimum(q - tool.lower, tool.upper - q)


def _poses(tip_mm: ArrayLike, rotation: ArrayLike) -> tuple[Floats, Floats]:
    """Check the poses of a caller (finite, of one length, the rotations proper), and repeat a constant rotation."""
    tip = frozen(tip_mm, np.float64, (None, 3), "tip_mm")
    turned = np.asarray(rotation, dtype=np.float64)
    held = turned.shape == (3, 3)
    turned = frozen(turned[None] if held else turned, np.float64, (None, 3, 3), "rotation")
    if not held and len(turned) != len(tip):
        raise BadInput(f"{len(tip)} positions need {len(tip)} rotations or one, not {len(turned)}.")
    check_rotation(turned)
    return tip, np.broadcast_to(turned, (len(tip), 3, 3))


def solutions_of(tip: Floats, rotation: Floats, tool: InstrumentConstants) -> Floats:
    """List all solutions of all poses regardless of limits: two wrists times three turns of the roll.

    The wrist's pitch axis z5 is normal to both the tip's position and the wrist's yaw axis z6, because shaft, wrist
    and hinge lie in one plane; its two signs are the two branches.

    Args:
        tip: Tip in the PSM base frame, mm, shape (T, 3).
        rotation: Its rotation [n o a], shape (T, 3, 3), checked.
        tool: The instrument.

    Returns:
        Joints, rad and mm, shape (T, 6, 6): solutions, then joints; NaN where the wrist is in the remote centre.
    """
    turns = np.zeros((len(_TURNS), 6))
    turns[:, ROLL] = _TURNS
    wrists = _wrists(tip, rotation, tool).transpose(2, 0, 1)
    return (wrists[:, :, None] + turns).reshape(len(tip), 6, 6)


def _left(tip: Floats, rotation: Floats, tool: InstrumentConstants) -> tuple[Floats, Flags]:
    """Return for each pose the part of its range left to a joint where that is most, and whether it is reached."""
    wrists = _wrists(tip, rotation, tool)
    values = np.concatenate((wrists, wrists[:, ROLL, None] + np.array(_TURNS[1:])[:, None]), axis=1)
    lower, upper = (limits[[*range(6), ROLL, ROLL], None] for limits in (tool.lower, tool.upper))
    parts = np.nan_to_num(np.minimum(values - lower, upper - values) / (upper - lower), nan=-np.inf)
    inside = (values >= lower - _ROUND_OFF) & (values <= upper + _ROUND_OFF)
    for of in (parts, inside):
        of[:, ROLL] = of[:, [ROLL, 6, 7]].max(axis=1)
    return parts[:, :6].min(axis=1).max(axis=0), np.asarray(inside[:, :6].all(axis=1).any(axis=0))


def _wrists(tip: Floats, rotation: Floats, tool: InstrumentConstants) -> Floats:
    """Return the joints of all poses, (2, 6, T), for the two signs of the wrist's pitch axis."""
    wrists, poses = np.empty((2, 6, len(tip))), np.concatenate((tip.T, rotation.reshape(-1, 9).T))
    for z5_sign, joints in zip((1.0, -1.0), wrists, strict=True):
        _solve(poses, z5_sign, joints)
    wrists[:, INSERTION] += tool.wrist_offset_mm
    return wrists


@compiled
def _solve(poses: Floats, z5_sign: float, joints: Floats) -> None:
    """Fill in the joints, (6, T), of poses, (12, T): position and rotation; straight on, so that it is vectorised."""
    for at in range(poses.shape[1]):
        tip = (poses[0, at], poses[1, at], poses[2, at])
        # From the last DH frame to the tip is a rotation only, because the tip is on the hinge.
        x6 = (0.0 - poses[4, at], 0.0 - poses[7, at], 0.0 - poses[10, at])
        z6 = (0.0 - poses[3, at], 0.0 - poses[6, at], 0.0 - poses[9, at])
        normal = _across(tip, z6)
        length = _length(normal)
        # If the tip lies on z6, every perpendicular is a solution; x6 is one of them.
        over = length if length > 1e-9 else 1.0
        z5 = (normal[0] / over, normal[1] / over, normal[2] / over) if length > 1e-9 else x6
        z5 = (z5_sign * z5[0], z5_sign * z5[1], z5_sign * z5[2])
        x5 = _across(z6, z5)
        wrist = (tip[0] - WRIST_MM * x5[0], tip[1] - WRIST_MM * x5[1], tip[2] - WRIST_MM * x5[2])
        depth = _length(wrist)
        # With the wrist in the remote centre the shaft's direction is undetermined; the wrist is inside the cannula
        # there.
        over = depth if depth > 1e-6 else nan
        shaft = (wrist[0] / over, wrist[1] / over, wrist[2] / over)
        sine = min(max(shaft[1], -1.0), 1.0)
        yaw, pitch = _angle(shaft[0], -shaft[2]), -_angle(sine, sqrt((1 - sine) * (1 + sine)))
        s1, c1, s2, c2 = _wave(yaw, 0), _wave(yaw, 1), _wave(pitch, 0), _wave(pitch, 1)
        x3 = (-s1 * s2, -c2, c1 * s2)
        y3 = _across(shaft, x3)
        roll = _angle(-_dot(z5, x3), _dot(z5, y3))
        s4, c4 = _wave(roll, 0), _wave(roll, 1)
        x4 = (c4 * x3[0] + s4 * y3[0], c4 * x3[1] + s4 * y3[1], c4 * x3[2] + s4 * y3[2])
        joints[0, at], joints[1, at], joints[2, at], joints[3, at] = yaw, pitch, depth, roll
        joints[4, at] = _wrapped(_angle(-_dot(x5, shaft), _dot(x5, x4)) + pi / 2)
        joints[5, at] = _wrapped(_angle(-_in_order(x6, z5), _in_order(x6, x5)) + pi / 2)


@inner
def _angle(y: float, x: float) -> float:
    """Return `arctan2` of `skills.arithmetic`, with the same bits."""
    high, wide = abs(y), abs(x)
    longer = max(high, wide)
    tangent = min(high, wide) / (1.0 if longer == 0 else longer)
    for _ in range(2):
        tangent = tangent / (1 + sqrt(1 + tangent * tangent))
    angle = 4 * tangent * _series(ARC, tangent * tangent)
    angle = pi / 2 - angle if high > wide else angle
    return copysign(pi - angle if copysign(1.0, x) < 0 else angle, y)


@inner
def _wave(angle: float, ahead: int) -> float:
    """Return `sin`, or a quarter turn ahead `cos`, of `skills.arithmetic`, with the same bits."""
    turns = float(np.rint(angle * (2 / pi)))
    rest = angle - turns * QUARTER[0] - turns * QUARTER[1] - turns * QUARTER[2]
    quarter = (turns + ahead) - 4 * float(np.floor((turns + ahead) / 4))
    upright = quarter == 1 or quarter == 3
    value: float = _series(COSINE, rest * rest) if upright else rest * _series(SINE, rest * rest)
    return -value if quarter >= 2 else value


@inner
def _series(coefficients: Sequence[float], x: float) -> float:
    total = coefficients[-1]
    for k in range(len(coefficients) - 2, -1, -1):
        total = total * x + coefficients[k]
    return total


@inner
def _across(u: Point, v: Point) -> Point:
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


@inner
def _length(u: Point) -> float:
    return sqrt(_in_order(u, u))


@inner
def _dot(u: Point, v: Point) -> float:
    """Add in the order of SSE2, with which numpy made the digests that are stored."""
    return (0.0 + u[0] * v[0] + u[2] * v[2]) + u[1] * v[1]


@inner
def _in_order(u: Point, v: Point) -> float:
    return 0.0 + u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inner
def _wrapped(angle: float) -> float:
    """Wrap an angle, of more than -pi and at most 2 pi, into (-pi, pi]."""
    below = pi - angle
    return pi - (below + 2 * pi if below < 0 else below)


def _within_limits(solutions: Floats, tool: InstrumentConstants) -> Flags:
    """Return which solutions are within the limits of all joints, shape (T, solutions); false for NaN."""
    inside = (solutions >= tool.lower - _ROUND_OFF) & (solutions <= tool.upper + _ROUND_OFF)
    return np.asarray(inside.all(axis=2))


def _nearest_branch(solutions: Floats, allowed: Flags, before: Floats, tool: InstrumentConstants) -> Ints:
    """Choose for each sample the allowed solution nearest to the one chosen for the sample before, shape (T,)."""
    width = int(allowed.sum(axis=1).max())
    # The allowed ones come first; they are rarely more than two, so the arrays below stay small.
    order = np.argsort(~allowed, axis=1, kind="stable")[:, :width]
    best = np.take_along_axis(solutions, order[:, :, None], axis=1)
    barred = ~np.take_along_axis(allowed, order, axis=1)
    first = np.where(barred[0], np.inf, (np.abs(best[0] - before) / tool.speed).sum(axis=1))
    seconds = (np.abs(best[1:, None, :, :] - best[:-1, :, None, :]) / tool.speed).sum(axis=3)
    following = np.where(barred[1:, None, :], np.inf, seconds).argmin(axis=2).tolist()
    branch = [int(first.argmin())]
    for options in following:
        branch.append(options[branch[-1]])
    return np.asarray(order[np.arange(len(order)), branch], dtype=np.int64)


def _nearest_limit(tip: Floats, solutions: Floats, tool: InstrumentConstants) -> NearestLimit:
    """Find the pose whose best solution, of shape (T, solutions, 6), is nearest a limit; NaN is furthest beyond."""
    margins = np.minimum(solutions - tool.lower, tool.upper - solutions)
    parts = np.where(np.isnan(margins), -np.inf, margins / (tool.upper - tool.lower))
    worst = parts.min(axis=2)
    best = worst.argmax(axis=1)
    sample = int(worst[np.arange(len(worst)), best].argmin())
    joint = int(parts[sample, best[sample]].argmin())
    value, margin = (float(of[sample, best[sample], joint]) for of in (solutions, margins))
    x, y, z = tip[sample].tolist()
    nearer_upper = tool.upper[joint] - value < value - tool.lower[joint]
    return NearestLimit(
        tip_mm=(x, y, z),
        joint=JOINTS[joint],
        unit=UNITS[joint],
        limit=float(tool.upper[joint] if nearer_upper else tool.lower[joint]),
        value=None if isnan(value) else value,
        margin=None if isnan(margin) else margin,
    )


def _out_of_reach(sample: int, tip: Floats, solutions: Floats, tool: InstrumentConstants) -> Unreachable:
    """Return the error that names the joint furthest over its limit, in the solution that exceeds the limits least."""
    nearest = _nearest_limit(tip[sample : sample + 1], solutions[sample : sample + 1], tool)
    value = nan if nearest.value is None else nearest.value
    where = ", ".join(f"{x:.1f}" for x in tip[sample])
    return Unreachable(
        f"Sample {sample} at ({where}) mm needs {nearest.joint} {value:.5g} {nearest.unit}, beyond the limit "
        f"{nearest.limit:.4g} of the {tool.arm.name} with {tool.name}; move the point or turn the tool.",
        sample=sample,
        joint=nearest.joint,
        value=value,
        limit=nearest.limit,
        tip_mm=tip[sample].tolist(),
    )


def _cross(u: Floats, v: Floats) -> Floats:
    """Return the cross product; numpy's own, for vectors of any length, takes four times as long for a short path."""
    a, b, c = u[..., 0], u[..., 1], u[..., 2]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


# ---- rotations -------------------------------------------------------------------------------------------------


def check_rotation(rotation: Floats) -> None:
    """Refuse matrices that are not proper rotations to within 1e-6.

    Args:
        rotation: Matrices, shape (T, 3, 3).

    Raises:
        ImproperRotation: A matrix is not orthonormal with determinant 1; `sample` is the index of the first.
    """
    skew = np.abs(product(np.swapaxes(rotation, -1, -2), rotation) - np.eye(3)).max(axis=(-1, -2), initial=0.0)
    good = (skew < 1e-6) & (np.linalg.det(rotation) > 0)
    if not good.all():
        sample = int(np.argmin(good))
        raise ImproperRotation(f"Rotation {sample} is not orthonormal with determinant 1; normalise it.", sample=sample)


def matrix_of(rotation_xyzw: ArrayLike) -> Floats:
    """Convert quaternions to rotation matrices.

    Args:
        rotation_xyzw: Quaternions x, y, z, w of any length but 0, shape (T, 4).

    Returns:
        Rotations, shape (T, 3, 3).

    Raises:
        BadInput: A number is NaN or infinite.
        ImproperRotation: A quaternion has length 0.
    """
    q = frozen(rotation_xyzw, np.float64, (None, 4), "rotation_xyzw")
    length = np.linalg.norm(q, axis=1, keepdims=True)
    if not (length > 1e-9).all():
        raise ImproperRotation("A quaternion has length 0; give a unit quaternion.", sample=int(np.argmin(length)))
    x, y, z, w = (q / length).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternion_of(rotation: ArrayLike) -> Floats:
    """Convert rotation matrices to unit quaternions.

    Of the two quaternions of a rotation, the first sample has its largest component positive, and each following sample
    has the one nearer to its predecessor, so that a smooth turn has smooth quaternions.

    Args:
        rotation: Rotations, shape (T, 3, 3).

    Returns:
        Unit quaternions x, y, z, w, shape (T, 4).

    Raises:
        BadInput, ImproperRotation: A number is not finite, or a matrix is not a proper rotation.
    """
    m = frozen(rotation, np.float64, (None, 3, 3), "rotation")
    check_rotation(m)
    return nearest_quaternions(m)


def nearest_quaternions(rotation: Floats) -> Floats:
    """Convert matrices that are nearly rotations to unit quaternions, with signs as by `quaternion_of`.

    Args:
        rotation: Matrices, shape (T, 3, 3); they are not checked.

    Returns:
        Unit quaternions x, y, z, w, shape (T, 4).
    """
    m = rotation
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
    """Return the angle of the turn from one rotation to another.

    Args:
        rotation: Rotations, shape (T, 3, 3).
        other: Rotations, shape (T, 3, 3).

    Returns:
        Angles in rad, 0 to pi, shape (T,).
    """
    q = quaternion_of(product(np.swapaxes(rotation, -1, -2), other))
    return np.asarray(2 * arctan2(np.linalg.norm(q[:, :3], axis=1), np.abs(q[:, 3])))
