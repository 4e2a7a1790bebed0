"""An independent Monte Carlo of a pass in inexact worlds: other kinematics, distances and catch than the package's.

It shares with `skills.verification.monte_carlo` the definition of the event and the numbers of the manuals, which are
written here anew. The chain of joints is multiplied out as 4 x 4 matrices; the joints of a shifted pass follow from
geometry (the wrist lies on a line through the remote centre); distances of segments are found by alternating
projections; the needle is an arc of points. The noise is drawn at other moments too: those of all samples given.
"""

from math import cos, pi, radians, sin

import numpy as np

RADIUS_MM = 26 / pi  # of the needle
WIRE_MM, HELD_MM, WIDTH_MM = 0.66, 9.0, 1.1
SHAFT_MM, WRIST_MM, REACH_MM, DEPTH_OFFSET_MM = 416.2, 9.1, 10.2, 15.6
THICK_MM = np.array([4.0, 3.6, 1.1, 1.1])
FREE_RAD, OPEN_RAD, HOLDING_RAD, STATED_RAD = 2 * pi / 3, radians(30), 0.06, radians(15)
PAD_MM, ARMS_MM = 1.0, 0.5  # least distances of the playback


def chain(joints) -> tuple[np.ndarray, np.ndarray]:
    """Multiply the published Denavit-Hartenberg matrices of an arm, joint by joint: tips and rotations [n o a]."""
    tips, turns = [], []
    for q1, q2, q3, q4, q5, q6 in joints:
        pose = np.eye(4)
        for alpha, a, theta, d in (
            (pi / 2, 0.0, q1 + pi / 2, 0.0),
            (-pi / 2, 0.0, q2 - pi / 2, 0.0),
            (pi / 2, 0.0, 0.0, q3 - 431.8),
            (0.0, 0.0, q4, SHAFT_MM),
            (-pi / 2, 0.0, q5 - pi / 2, 0.0),
            (-pi / 2, WRIST_MM, q6 - pi / 2, 0.0),
        ):
            rx = np.array(
                [[1, 0, 0, 0], [0, cos(alpha), -sin(alpha), 0], [0, sin(alpha), cos(alpha), 0], [0, 0, 0, 1.0]]
            )
            tx, rz, tz = np.eye(4), np.eye(4), np.eye(4)
            tx[0, 3], tz[2, 3] = a, d
            rz[:2, :2] = [[cos(theta), -sin(theta)], [sin(theta), cos(theta)]]
            pose = pose @ rx @ tx @ rz @ tz
        tips.append(pose[:3, 3])
        turns.append(pose[:3, :3] @ np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]))
    return np.array(tips), np.array(turns)


def rodrigues(vector) -> np.ndarray:
    """Return the rotation about an axis, by its length in rad."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + sin(angle) * cross + (1 - cos(angle)) * cross @ cross


def segments(tip, turn, opening, jaw_turn) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of shaft, wrist and fingers, (T, 4, 3), of an arm whose remote centre is the origin."""
    n, o, a = (turn[:, :, k] for k in range(3))
    # The wrist is 9.1 mm from the hinge, across the hinge axis, and the shaft through it passes the remote centre.
    across = tip - (tip * n).sum(axis=1, keepdims=True) * n
    wrist = tip - WRIST_MM * across / np.linalg.norm(across, axis=1, keepdims=True)
    shaft = wrist / np.linalg.norm(wrist, axis=1, keepdims=True)
    begins, ends = [wrist - SHAFT_MM * shaft, wrist], [wrist, tip]
    cosine, sine = (np.reshape(one(opening), (-1, 1)) for one in (np.cos, np.sin))
    for side in (1.0, -1.0):
        along, aside = cosine * a + side * sine * o, side * cosine * o - sine * a
        begins.append(tip + 0.6 * aside @ jaw_turn.T)
        ends.append(begins[-1] + (REACH_MM - WIDTH_MM) * along @ jaw_turn.T)
    return np.stack(begins, axis=1), np.stack(ends, axis=1)


def apart(one, other) -> np.ndarray:
    """Return the distances of all links of one arm from all of the other, (T, 4, 4), by alternating projections."""
    p, q = one[0][:, :, None], other[0][:, None]
    u, v = one[1][:, :, None] - p, other[1][:, None] - q
    t = np.full(np.broadcast_shapes(u.shape, v.shape)[:3], 0.5)
    for _ in range(25):
        s = np.clip(((q + t[..., None] * v - p) * u).sum(axis=-1) / (u * u).sum(axis=-1), 0, 1)
        t = np.clip(((p + s[..., None] * u - q) * v).sum(axis=-1) / (v * v).sum(axis=-1), 0, 1)
    between = p + s[..., None] * u - q - t[..., None] * v
    return np.linalg.norm(between, axis=-1) - THICK_MM[:, None] - THICK_MM


def caught(tip_a, jaw_a, free, needle_turn, tip_m, jaw_m) -> bool:
    """Follow the needle's arc point by point through the plane in which PSM_M's fingers close."""
    phi = np.linspace(0, FREE_RAD, 1201)
    u = needle_turn @ (jaw_a @ free)
    t = needle_turn @ np.cross(jaw_a[:, 2], jaw_a @ free)
    grip = tip_a + HELD_MM * jaw_a[:, 2]
    arc = grip + RADIUS_MM * ((1 - np.cos(phi))[:, None] * t + np.sin(phi)[:, None] * u)
    x, y, z = ((arc - tip_m) @ jaw_m).T
    if t @ jaw_m[:, 0] < 0:  # the jaws are the same from behind
        x, y = -x, -y
    crossing = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    if not len(crossing):
        return False
    k = crossing[-1]
    part = -x[k] / (x[k + 1] - x[k])
    y, z = y[k] + part * (y[k + 1] - y[k]), z[k] + part * (z[k + 1] - z[k])
    spare = RADIUS_MM * np.array([phi[k], FREE_RAD - phi[k]]) >= WIDTH_MM
    depth, half = np.hypot(y, z), WIRE_MM / 2
    swept = 3.6 + half <= depth <= REACH_MM - half and abs(y) * cos(OPEN_RAD) + half <= z * sin(OPEN_RAD)
    along = arc[k + 1] - arc[k]
    return bool(spare.all() and swept and abs(along @ jaw_m[:, 0]) / np.linalg.norm(along) >= cos(STATED_RAD))


def successes(trajectory, errors, pad_top_mm: float, pad_normal, worlds: int, seed: int, step: int = 8) -> int:
    """Count the worlds in which a trajectory of one pass with PSM_M stays clear and the needle is caught."""
    rng = np.random.default_rng(seed)
    at = np.unique(np.append(np.arange(0, len(trajectory), step), len(trajectory) - 1))
    stamps = trajectory.stamps_s[at]
    x, y, z, w = trajectory.psm_m.base_xyzw
    base = rodrigues(2 * np.arctan2(np.linalg.norm([x, y, z]), w) * np.array([x, y, z]) / np.linalg.norm([x, y, z]))
    base_mm = trajectory.psm_m.base_mm
    moving = np.concatenate([trajectory.joints, trajectory.psm_m.joints], axis=1)
    stands = np.array([np.ptp(moving[k:], axis=0).max() < 1e-6 for k in at])
    openings = [np.maximum(jaw_rad[at] / 2, HOLDING_RAD) for jaw_rad in (trajectory.jaw_rad, trajectory.psm_m.jaw_rad)]
    planned = [chain(joints[at]) for joints in (trajectory.joints, trajectory.psm_m.joints)]
    seen = planned[0], (planned[1][0] @ base.T + base_mm, base @ planned[1][1])  # in PSM_A's base frame
    jaw_a, jaw_m = seen[0][1][-1], seen[1][1][-1]
    free = np.array([1.0, 0, 0]) * (1.0 if jaw_a[:, 0] @ jaw_m[:, 2] < 0 else -1.0)
    count = 0
    for _ in range(worlds):
        shift = rng.uniform(-5, 5, 3)
        axis = rng.standard_normal(3)
        needle = rodrigues(rng.uniform(-1, 1) * radians(10) * axis / np.linalg.norm(axis))
        base_off = errors.registration_mm * rng.standard_normal(3)
        base_turn = rodrigues(radians(errors.registration_deg) * rng.standard_normal(3))
        turns = [rodrigues(radians(errors.wrist_deg) * rng.standard_normal(3)) for _ in range(2)]
        noise = [_noise(rng, stamps, errors) + errors.tip_bias_mm * rng.standard_normal(3) for _ in range(2)]
        links = [segments(seen[0][0] + shift, seen[0][1], openings[0], turns[0])]
        own = (seen[1][0] + shift - base_mm) @ base, np.swapaxes(base, 0, 1) @ seen[1][1]
        links.append(segments(*own, openings[1], base.T @ turns[1] @ base))
        placed = [tuple(ends + noise[0][:, None] for ends in links[0])]
        placed.append(tuple(ends @ (base_turn @ base).T + base_mm + base_off + noise[1][:, None] for ends in links[1]))
        low = min((np.minimum(b @ pad_normal, e @ pad_normal) - THICK_MM).min() for b, e in placed)
        near = apart(*placed)
        near[stands, 2:, 2:] = np.inf  # at the hand-off itself
        if not (low - pad_top_mm - shift @ pad_normal >= PAD_MM and near.min() >= ARMS_MM):
            continue
        tip_a, tip_m = placed[0][1][-1, 1], placed[1][1][-1, 1]
        count += caught(tip_a, turns[0] @ jaw_a, free, _in_jaws(turns[0], needle), tip_m, base_turn @ turns[1] @ jaw_m)
    return count


def _in_jaws(turn, needle) -> np.ndarray:
    """Return the needle's rotation, which is drawn in PSM_A's base frame, where the jaws are turned."""
    return turn @ needle @ turn.T


def _noise(rng, stamps, errors) -> np.ndarray:
    rows = [rng.standard_normal(3)]
    for gap in np.diff(stamps):
        keep = np.exp(-gap / errors.tip_correlation_s) if errors.tip_correlation_s else 0.0
        rows.append(keep * rows[-1] + np.sqrt(1 - keep**2) * rng.standard_normal(3))
    return errors.tip_noise_mm * np.array(rows)
