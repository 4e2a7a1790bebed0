"""Long recordings whose hand-offs are known by construction: a surgeon sutures with both hands of a dVRK.

Each pass: PSM_M pushes the needle through (M1) while PSM_A waits, drifting, or steadies the tissue; PSM_A reaches for
the needle in dabs, sometimes grasping next to it (M2); it grips, and sometimes tugs; it pulls and carries in one stroke
or two, with a hesitation or a clutched pause between them (A1); it rests, and turns the needle in place (A2); PSM_M's
jaw closes on it, PSM_A's opens, and it goes back, rotating back on the way. Before, between and after, both idle.

The truth of a pass: A1 starts where the first stroke starts, changes to A2 where the last one ends, and A2 ends with
the turn. The script shares no thresholds with the code under test.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from skills.demonstration.recording import Motion, Recording, Signal
from skills.kinematics import matrix_of, quaternion_of

A, M = "PSM2", "PSM1"
OPEN, SHUT = 0.9, 0.05
EPOCH_NS = 1_760_000_000 * 10**9
M_BESIDE_MM = np.array([-14.0, 6.0, 4.0])  # from PSM_A's tip to PSM_M's at the hand-off
DOWN = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])


@dataclass(frozen=True)
class Kind:
    """Properties of a session; by default everything is recorded and the hand is calm."""

    seed: int
    rate_hz: float = 100.0
    passes: int = 12
    jaw: bool = True
    clutch: bool = True
    both_arms: bool = True
    wrist: bool = True
    noisy: bool = False

    @property
    def tremor_mm(self) -> float:
        return 0.6 if self.noisy else 0.2

    @property
    def noise_mm(self) -> float:
        return 0.1 if self.noisy else 0.02

    @property
    def drift_mm_s(self) -> float:
        return 0.6 if self.noisy else 0.3


@dataclass(frozen=True)
class Truth:
    start_s: float
    handover_s: float
    end_s: float


@dataclass
class Arm:
    """One arm's script: times and the values from each time on, connected by minimum-jerk movements."""

    at_s: list[float] = field(default_factory=lambda: [0.0])
    place_mm: list[np.ndarray] = field(default_factory=list)
    turn_rad: list[np.ndarray] = field(default_factory=lambda: [np.zeros(3)])
    jaw_rad: list[float] = field(default_factory=lambda: [OPEN])
    curves: dict[int, np.ndarray] = field(default_factory=dict)

    def go(self, until_s: float, place=None, turn=None, jaw=None, curve=None) -> None:
        if curve is not None:
            self.curves[len(self.at_s)] = curve
            place = curve[-1]
        self.at_s.append(until_s)
        self.place_mm.append(self.place_mm[-1] if place is None else np.asarray(place, float))
        self.turn_rad.append(self.turn_rad[-1] if turn is None else np.asarray(turn, float))
        self.jaw_rad.append(self.jaw_rad[-1] if jaw is None else jaw)

    def wait(self, until_s: float) -> None:
        self.go(until_s)

    def play(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ends = np.array(self.at_s)
        which = np.clip(np.searchsorted(ends, seconds, side="right"), 1, len(ends) - 1)
        share = np.clip((seconds - ends[which - 1]) / (ends[which] - ends[which - 1]), 0, 1)
        done = share**3 * (10 - 15 * share + 6 * share**2)
        mix = [np.array(v, float) for v in (self.place_mm, self.turn_rad, self.jaw_rad)]
        tip, turn, jaw = (v[which - 1] + (v[which] - v[which - 1]) * _column(done, v) for v in mix)
        for number, curve in self.curves.items():
            here = which == number
            along = done[here] * (len(curve) - 1)
            tip[here] = np.stack([np.interp(along, np.arange(len(curve)), axis) for axis in curve.T], axis=1)
        return tip, turn, jaw


def _mm(*xyz: float) -> np.ndarray:
    return np.array(xyz, float)


def _column(done: np.ndarray, values: np.ndarray) -> np.ndarray:
    return done if values.ndim == 1 else done[:, None]


def session(kind: Kind) -> tuple[Recording, list[Truth]]:
    """Return a recording, and the true times of its hand-offs."""
    rng = np.random.default_rng(kind.seed)
    a, m, truths, presses = _script(kind, rng)
    seconds = stamps_of(a.at_s[-1], kind.rate_hz, rng)
    stamps_ns = EPOCH_NS + np.rint(seconds * 1e9).astype(np.int64)
    motions, jaws = [], []
    for arm, script in ((A, a), (M, m)):
        tip, turn, jaw = script.play(seconds)
        tip = tip + unsteady(seconds, kind, rng)
        rotation = turned(turn + rng.normal(0, 0.003 if kind.noisy else 0.001, turn.shape)) if kind.wrist else None
        if arm == A or kind.both_arms:
            motions += [local(arm, stamps_ns, tip, rotation), in_camera(arm, stamps_ns, tip, rotation)]
            jaws.append((arm, Signal(stamps_ns, jaw + rng.normal(0, 0.01, len(jaw)))))
    truths = [Truth(*(t - seconds[0] for t in (one.start_s, one.handover_s, one.end_s))) for one in truths]
    events = [(0.0, 0.0), *((t, v) for down, up in presses for t, v in ((down, 1.0), (up, 0.0)))]
    clutch = Signal(EPOCH_NS + np.array([round(t * 1e9) for t, _ in events]), np.array([v for _, v in events]))
    value = Recording("mcap", "full", tuple(motions), clutch=clutch if kind.clutch else None)
    return replace(value, jaws=tuple(jaws) if kind.jaw else ()), truths


def _script(kind: Kind, rng: np.random.Generator) -> tuple[Arm, Arm, list[Truth], list[tuple[float, float]]]:
    a, m = Arm(), Arm()
    exit_mm = np.array([-15.0, 45.0, -125.0])
    a.place_mm.append(exit_mm + _mm(0, 0, 25.0))
    m.place_mm.append(exit_mm + _mm(-30.0, 0, 10))
    truths, presses = [], []
    now = rng.uniform(3, 10)
    a.wait(now), m.wait(now)
    for number in range(kind.passes):
        exit_mm = np.array([-15.0, 35.0 + 2.0 * number, -125.0]) + rng.normal(0, 1, 3)
        now = _hand_work(a, m, exit_mm, now, presses, rng)
        now, truth = _pass(a, m, exit_mm, now, presses, kind, rng)
        truths.append(truth)
        now = _back(a, m, exit_mm, now, rng)
        if rng.random() < 0.15:
            now += rng.uniform(5, 15)  # the surgeon looks at something else
    end = now + rng.uniform(3, 8)
    a.wait(end), m.wait(end)
    return a, m, truths, presses


def _hand_work(a: Arm, m: Arm, exit_mm, now: float, presses: list, rng: np.random.Generator) -> float:
    """Perform M1 and M2: the needle comes through, PSM_A reaches for it."""
    pushed = now + rng.uniform(2.5, 6)
    m.go(m.at_s[-1] + 0.1, jaw=SHUT)
    m.go(now + 1.0, place=exit_mm + _mm(-25.0, -3, 3))
    m.go(pushed, place=exit_mm + _mm(-12.0, 0, 1), turn=m.turn_rad[-1] + np.array([0, 0.9, 0]))
    if rng.random() < 0.4:  # steadies the tissue
        here = a.place_mm[-1]
        a.wait(now + 0.3)
        a.go(now + 0.5, jaw=SHUT)
        a.go(now + 1.0, place=here + rng.normal(0, 1.5, 3))
        a.wait(now + 1.6)
        a.go(now + 2.0, place=here)
        a.go(now + 2.2, jaw=OPEN)
    elif rng.random() < 0.5:  # puts the other hand elsewhere
        presses.append((now + 0.5, now + 1.6))
    now = pushed + rng.uniform(0.2, 0.6)
    a.wait(now)
    turn = a.turn_rad[-1]
    for short_mm in [*rng.uniform(3, 9, rng.integers(0, 3)), 0.0]:
        now += rng.uniform(0.5, 0.9)
        a.go(now, place=exit_mm + _mm(0, 0, short_mm), turn=turn + rng.normal(0, 0.08, 3))
        now += rng.uniform(0.2, 0.5)
        a.wait(now)
    if rng.random() < 0.3:  # grasps next to the needle
        a.go(now + 0.25, jaw=SHUT)
        a.go(now + 0.6, place=exit_mm + _mm(0, 0, 2.0))
        a.go(now + 0.85, jaw=OPEN)
        a.go(now + 1.3, place=exit_mm)
        now += 1.3
        a.wait(now := now + 0.3)
    return now


def _pass(
    a: Arm, m: Arm, exit_mm, now: float, presses: list, kind: Kind, rng: np.random.Generator
) -> tuple[float, Truth]:
    now += 0.3
    a.go(now, jaw=SHUT)
    a.wait(now := now + rng.uniform(0.6, 1.2))
    if rng.random() < 0.3:  # tests the grip
        a.go(now + 0.25, place=exit_mm + _mm(0, 0, 1.2))
        a.go(now + 0.5, place=exit_mm)
        a.wait(now := now + 1.0)
    m.wait(now - 0.2)
    m.go(now, jaw=OPEN)
    start = now
    curve = _curve(np.vstack([exit_mm, exit_mm + _corners(rng)]))
    strokes = np.sort(np.append(rng.uniform(0.3, 0.7, rng.integers(0, 2)), [0.0, 1.0]))
    speed = rng.uniform(9, 30)
    length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    for number, (done, until) in enumerate(pairwise(strokes)):
        if number > 0:
            clutched = kind.clutch and rng.random() < 0.5
            rest = rng.uniform(0.8, 2.5) if clutched else rng.uniform(0.15, 0.5)
            if clutched:
                presses.append((now + 0.05, now + rest - 0.05))
            a.wait(now := now + rest)
        now += max(0.8, (until - done) * length / speed)
        a.go(now, curve=curve[round(done * 1000) : round(until * 1000) + 1])
    handover = now
    goal = curve[-1]
    m.go(max(m.at_s[-1] + 0.3, handover - rng.uniform(-0.2, 1.0)), place=goal + M_BESIDE_MM + _mm(-8, 0, 0))
    a.wait(now := now + rng.uniform(0.1, 0.5))
    axis = rng.normal(0, 1, 3)
    angle = np.radians(rng.uniform(35, 90))
    turned = a.turn_rad[-1] + angle * axis / np.linalg.norm(axis)
    a.go(now + rng.uniform(0.8, 1.8), place=goal + rng.normal(0, 0.5, 3), turn=turned)
    end = now = a.at_s[-1]
    taken = max(now, m.at_s[-1]) + rng.uniform(0.3, 0.6)
    m.go(taken, place=goal + M_BESIDE_MM)
    m.go(taken + 0.25, jaw=SHUT)
    a.wait(now := taken + 0.25 + rng.uniform(0.2, 0.5))
    a.go(now := now + 0.3, jaw=OPEN)
    return now, Truth(start, handover, end)


def _back(a: Arm, m: Arm, exit_mm, now: float, rng: np.random.Generator) -> float:
    """Go back to wait next to the wound, rotating back on the way."""
    a.wait(now := now + rng.uniform(0.75, 1.5))
    m.wait(now)
    now += rng.uniform(1.2, 2.5)
    a.go(now, place=exit_mm + _mm(0, 0, 25.0) + rng.normal(0, 2, 3), turn=np.zeros(3))
    m.go(now, place=exit_mm + _mm(-30.0, 0, 10), turn=np.zeros(3))
    return now


def _corners(rng: np.random.Generator) -> np.ndarray:
    """Choose the path from the wound to the hand-off: up, across, and there; each corner from the wound, in mm."""
    far = rng.uniform(30, 55)
    goal = np.array([far, rng.uniform(-8, 12), rng.uniform(5, 25)])
    return np.array([goal * 0.3 + _mm(0, 5, 12), goal * 0.7 + rng.normal(0, 4, 3), goal])


def _curve(points: np.ndarray) -> np.ndarray:
    """Draw a smooth curve through points, as 1001 points at equal steps."""
    t = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    fit = [np.polynomial.Polynomial.fit(t, axis, len(points) - 1) for axis in points.T]
    dense = np.stack([one(np.linspace(0, t[-1], 4001)) for one in fit], axis=1)
    length = np.append(0, np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1)))
    even = np.linspace(0, length[-1], 1001)
    return np.stack([np.interp(even, length, axis) for axis in dense.T], axis=1)


def stamps_of(duration_s: float, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    """Return timestamps with jitter of a twentieth of a step and a few samples lost."""
    count = int(duration_s * rate_hz)
    kept = np.ones(count, bool)
    for lost in rng.integers(0, count, 5):
        kept[lost : lost + round(0.05 * rate_hz)] = False
    return ((np.arange(count) + rng.uniform(0, 0.05, count)) / rate_hz)[kept]


def unsteady(seconds: np.ndarray, kind: Kind, rng: np.random.Generator) -> np.ndarray:
    """Return tremor of 8 to 12 Hz, slow drift and the encoders' noise, (T, 3) mm."""
    rates, phases = rng.uniform(8, 12, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    shaking = kind.tremor_mm * np.sin(2 * np.pi * rates * seconds[:, None, None] + phases).mean(axis=1)
    slow = 2 * np.pi / rng.uniform(3, 9, 3)
    drifting = kind.drift_mm_s / slow * np.sin(slow * seconds[:, None] + phases[0])
    return shaking + drifting + rng.normal(0, kind.noise_mm, shaking.shape)


def turned(vector: np.ndarray) -> np.ndarray:
    """Rotate the tool-down orientation by rotation vectors, (T, 3), to quaternions, (T, 4)."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    axis = vector / np.maximum(angle, 1e-12)
    turn = np.concatenate((axis * np.sin(angle / 2), np.cos(angle / 2)), axis=1)
    return quaternion_of(matrix_of(turn) @ matrix_of(DOWN[None]))


def local(arm: str, stamps_ns: np.ndarray, tip_mm: np.ndarray, rotation) -> Motion:
    """Return the pose relative to the arm's own base; PSM_A's base is the frame of the script."""
    turn, shift = BASES[arm]
    place = (tip_mm - shift) @ turn
    seen = None if rotation is None else quaternion_of(turn.T @ matrix_of(rotation))
    return Motion(arm, f"/{arm}/local/measured_cp", f"{arm}_base", stamps_ns, place, seen)


def in_camera(arm: str, stamps_ns: np.ndarray, tip_mm: np.ndarray, rotation) -> Motion:
    seen = None if rotation is None else quaternion_of(CAMERA[0] @ matrix_of(rotation))
    return Motion(arm, f"/{arm}/measured_cp", "ECM", stamps_ns, tip_mm @ CAMERA[0].T + CAMERA[1], seen)


def _about(axis: int, angle: float) -> np.ndarray:
    turn = np.zeros((1, 4))
    turn[0, axis], turn[0, 3] = np.sin(angle / 2), np.cos(angle / 2)
    return matrix_of(turn)[0]


# Each arm's base in PSM_A's base frame, and PSM_A's in the camera's frame.
BASES = {A: (np.eye(3), np.zeros(3)), M: (_about(2, np.radians(-45)), np.array([-160.0, 20.0, 20.0]))}
CAMERA = (_about(0, 2.0) @ _about(2, 0.7), np.array([30.0, -40.0, 180.0]))


def kinds(seeds: range) -> Iterator[Kind]:
    """Yield a session of every seed in every combination of recorded signals."""
    for plain in map(Kind, seeds):
        yield plain
        yield replace(plain, rate_hz=200.0)
        yield replace(plain, jaw=False)
        yield replace(plain, clutch=False)
        yield replace(plain, both_arms=False)
        yield replace(plain, noisy=True)
        yield replace(plain, jaw=False, clutch=False, both_arms=False)
        yield replace(plain, jaw=False, noisy=True)
