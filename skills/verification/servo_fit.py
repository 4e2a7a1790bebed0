"""The servo of a laboratory's own arm: gains, friction and load, fitted to setpoints, joints and efforts.

    states --fit_servo--> FittedQuantity of each joint, the Servo to state, and notes

The efforts e of each joint are fitted by least squares, while it moves, to both laws of `skills.dynamics`, with the
load of this arm as a factor l of the published one; in the second law e is the commanded effort where it was recorded:

    e = I a + Fv v + Fc sign(v) + l load(q)        e = P (q_s - q) + D (v_s - v) + c l load(q) + terms in v and a

c is the part that is compensated. The terms in v and a stand for an effort that is measured a part of a ms before or
after its joint; without v_s the one in v is omitted, as it is D's. All is smoothed by one window, which keeps linear
laws true. Without efforts P is taken as published and l as 1: q_s - q = (1 - c) load(q) / P + terms in v, sign(v), a.

An interval is a jackknife over contiguous blocks, because neighbours are not independent. It does not see that a law is
wrong; but a law with an I, Fv, P or D below 0 is not written. Nor does it see that efforts were recorded in step with
setpoints, between two of which they fall; but then Fv is far below 0, and no joint's first law is written. Lengths are
metres, as within `skills.dynamics`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, Ints
from skills.dynamics import Servo, loads
from skills.errors import BadInput
from skills.fields import parse_json
from skills.kinematics import JOINTS
from skills.verification.arm_calibration import BLOCKS

RECORD = "Record `ros2 bag record /PSM1/measured_js /PSM1/setpoint_js` with efforts, all joints moving for a minute."
WINDOW_S = 0.1  # ours: surgeons' motions are slower, and over less time counts of the encoders are accelerations
MOVING = 0.2  # ours: below this part of its rms speed a joint may stick, and its friction has no sign
_STUDENT = 2.015  # quantile 0.95 of Student's t with BLOCKS - 1 degrees of freedom
_M_TO_MM = np.array([1.0, 1.0, 1000.0, 1.0, 1.0, 1.0])
_MOTION, _GAINS = ("inertia", "viscous", "coulomb", "load"), ("stiffness", "damping", "compensation")


@dataclass(frozen=True)
class FittedQuantity:
    """A number of a joint's servo.

    Errors are root mean squares on each half of the samples by a fit to the other half, of the effort, Nm or N, and
    without efforts of the joint, rad or m.

    Attributes:
        joint: The joint.
        quantity: The field of the servo.
        fitted: The number, in the unit of that field.
        low: Lower end of the interval that has the number with a probability of 90 %.
        high: Its upper end.
        published: The published number; of a compensation 0 or 1, whichever is nearer.
        left_out: Error of the fit.
        as_published: Error with this number as published and the others fitted.
        no_error: Error if no effort, or no error of the joint, is predicted.
        constant: Error if the mean is predicted.
        written: Whether the servo has the number: the law is possible, the error of the fit the least, of the
            controller's law even half of the last two, and the interval above 0, or for friction and load cut at 0.
    """

    joint: str
    quantity: str
    fitted: float
    low: float
    high: float
    published: float
    left_out: float
    as_published: float
    no_error: float
    constant: float
    written: bool


def fit_servo(stamps_s: Floats, measured: Floats, setpoints: Floats) -> tuple[list[FittedQuantity], Servo, list[str]]:
    """Fit the servo of an arm to its recorded states.

    Args:
        stamps_s: Times, shape (T,).
        measured: Joints, velocities and efforts of a PSM, rad and m, Nm and N, shape (T, 3, 6); velocities and efforts
            are NaN where they were not recorded.
        setpoints: The same as the controller holds and commands them; of velocities that were not recorded there are
            none, as in the dVRK's `setpoint_js`.

    Returns:
        The fitted numbers, joint by joint; the servo, where all that is not written has its default; and what the fit
        rests on, and what to record for the rest.

    Raises:
        BadInput: There are too few samples, times that do not increase, or joints that are not finite.
        BadSettings: The fitted numbers together are no servo.
    """
    gaps_s = np.diff(stamps_s, prepend=-np.inf)
    width = max(1, round(WINDOW_S / float(np.median(gaps_s)))) if (gaps_s > 0).all() and len(gaps_s) else len(gaps_s)
    if not (len(gaps_s) >= 4 * BLOCKS + width and np.isfinite([measured[:, 0], setpoints[:, 0]]).all()):
        raise BadInput(f"A servo is fitted to {4 * BLOCKS} samples or more of six joints, in order of time. {RECORD}")
    (joints, speeds, felt), (wanted, sent, given) = measured.swapaxes(0, 1), setpoints.swapaxes(0, 1)
    efforts = bool(np.isfinite(felt).all())
    speeds = np.where(np.isfinite(speeds), speeds, np.gradient(joints, stamps_s, axis=0))
    held, given = loads(joints * _M_TO_MM), np.where(np.isfinite(given), given, felt)
    if not efforts:
        held, felt = held / np.array(Servo().stiffness), wanted - joints
    terms = [wanted - joints, np.nan_to_num(sent), speeds, np.gradient(speeds, stamps_s, axis=0), held, felt, given]
    window = np.hanning(width + 2)[1:-1]
    smooth = np.apply_along_axis(np.convolve, 1, np.array(terms), window / window.sum(), "valid")
    found = [one for j in range(6) for one in _of_joint(j, smooth[:, :, j], efforts)]
    notes = [f"All is smoothed over {WINDOW_S} s; measured velocities that were not recorded are central differences."]
    if not efforts:
        notes.append(f"There are no efforts: only the compensated part of the published load is fitted. {RECORD}")
    if any(one.quantity == "viscous" and one.high < 0 for one in found):
        notes.append("Friction is below 0, as if efforts were read in step with setpoints: record at another rate.")
        found = [replace(one, written=one.written and one.quantity in _GAINS) for one in found]
    refused = ", ".join(f"{one.joint} {one.quantity}" for one in found if not one.written)
    notes.append(f"Not known or no better than as published, so left as by default: {refused or 'nothing'}.")
    return found, _servo(found, np.nan_to_num(sent).any() if efforts else True), notes


def _of_joint(j: int, terms: Floats, efforts: bool) -> Iterator[FittedQuantity]:
    """Yield the numbers of a joint from q_s - q, v_s, v, a, load and both efforts, shape (7, T)."""
    moving = np.abs(terms[2]) >= efforts * MOVING * np.sqrt(np.mean(terms[2] ** 2))
    off, sent, v, a, held, effort, given = terms[:, moving]
    if efforts:
        motion = np.array([a, v, np.sign(v), held]).T
        yield from _quantities(j, _MOTION, motion, effort, effort)
        held = held * _solved(motion, effort, [])[3]
        yield from _quantities(j, _GAINS, np.array([off, sent - v, held, v * sent.any(), a]).T, given, given)
    else:
        yield from _quantities(j, _GAINS[2:], np.array([held, v, np.sign(v), a]).T, held - effort, effort)


def _quantities(j: int, names: Sequence[str], terms: Floats, target: Floats, real: Floats) -> Iterator[FittedQuantity]:
    """Yield the numbers that are the first factors of a law: terms, (N, K), times factors add up to the target."""
    parts = [_solved(terms, target, block) for block in np.array_split(np.arange(len(target)), BLOCKS)]
    factors, half = _solved(terms, target, []), _STUDENT * np.sqrt(BLOCKS - 1) * np.std(parts, axis=0)  # jackknife
    possible = bool((factors + half)[:2].min() >= 0) or names[0] == "compensation"
    error, none, mean = map(_left_out, (terms, terms[:, :0], np.ones((len(real), 1))), (target, real, real))
    scale = 0.5 if names[0] == "stiffness" else 1.0  # ours: of a controller's effort its law leaves little
    for k, name in enumerate(names):
        if j < 3 or name not in ("load", "compensation"):
            middle = np.mean(np.atleast_2d(getattr(Servo(), name)), axis=0)[j]
            published = float(factors[k] > 0.5 if name == "compensation" else middle)
            fitted, low, high = (float(f"{factors[k] + side * half[k]:.4g}") for side in (0, -1, 1))
            without = _left_out(terms, target, k, published)
            sure = possible and (low > 0 or name in _MOTION[1:])
            written = sure and error < min(without, scale * none, scale * mean)
            yield FittedQuantity(JOINTS[j], name, fitted, low, high, published, error, without, none, mean, written)


def _solved(terms: Floats, target: Floats, left: Ints | list[int], fixed: int = -1, at: float = 0.0) -> Floats:
    """Return a law's factors, shape (K,), by all samples but those left out, with one of them fixed if it is named."""
    terms, target = np.delete(terms, left, axis=0), np.delete(target, left)
    free = np.arange(terms.shape[1]) != fixed
    found = np.where(free, 0.0, at)
    found[free] = np.linalg.lstsq(terms[:, free], target - terms @ found, rcond=None)[0]
    return found


def _left_out(terms: Floats, target: Floats, fixed: int = -1, at: float = 0.0) -> float:
    """Return the root mean square error of each half by the factors of the other."""
    halves = np.array_split(np.arange(len(target)), 2)
    off = [target[one] - terms[one] @ _solved(terms, target, one, fixed, at) for one in halves]
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _servo(found: Sequence[FittedQuantity], velocities: bool) -> Servo:
    """Return the servo with the numbers that are written, as far as they are from 0 up."""
    ends = {name: np.array(getattr(Servo(), name)) for name in (*_MOTION, *_GAINS)}
    for one in found:
        values, j = ends[one.quantity], JOINTS.index(one.joint)
        if one.written:
            values[..., j] = np.maximum((one.low, one.high), 0.0) if values.ndim == 2 else one.fitted
        elif one.quantity == "compensation":
            values[:, j] *= one.published
    compensated = bool(ends["compensation"][:, :3].any())
    numbers = {name: values.tolist() for name, values in ends.items() if compensated or name != "compensation"}
    return parse_json(Servo, numbers | {"velocities": bool(velocities), "gravity_compensated": compensated})
