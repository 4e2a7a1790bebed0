"""Synthesis of the sample recordings: four surgeons with styles that can be distinguished by eye.

    kestrel   direct and smooth                     heron    a wide high arc
    wren      a loop that crosses its own path      plover   hesitant, with clutching pauses and tremor

One more recording of kestrel has five hand-offs. A hand moves along a smooth curve through a few points with the speed
of a minimum-jerk movement; tremor of 8 to 12 Hz is added; it rests before and after; the jaw closes on the needle
before a hand-off and opens after it. Everything lies inside the paper's grid. Numbers are rounded to a nanometre before
they are written, so that every machine produces the same bytes.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats, Ints
from skills.demonstration.recording import Motion, Recording, Signal
from skills.formats.bag_writer import write_mcap
from skills.formats.topics import CLUTCH_TOPICS, PRESSED, RELEASED

ARM = "PSM2"
FRAME = "PSM2_base"
EPOCH_NS = 1_750_000_000 * 1_000_000_000
TOOL_DOWN_XYZW = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # R = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
DRIFT_RAD = np.radians(0.8)  # about each axis, so any two orientations are less than 3 degrees apart
OPEN_RAD, CLOSED_RAD = 0.9, 0.05
REST_S, GRIP_S, SETTLE_S, BETWEEN_S, RETURN_S = 1.2, 0.3, 0.2, 0.5, 1.4


@dataclass(frozen=True)
class Sample:
    """A sample recording.

    Attributes:
        name: A slug, unique among the samples.
        surgeon: The slug of a surgeon of surgeons.toml.
        suture: The slug of a suture type of suture_types.toml.
        data: The MCAP file.
        segments: The true start and end of each hand-off, in seconds from the first pose.
    """

    name: str
    surgeon: str
    suture: str
    data: bytes
    segments: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class _Hand:
    """The motion characteristics of a hand.

    Attributes:
        moves: For each move its share of the path, its duration in s, the rest after it in s, and whether the clutch is
            pressed during that rest.
        tremor_mm: Amplitude of the tremor along each axis.
        rate_hz: Sample rate of the recording.
    """

    moves: tuple[tuple[float, float, float, bool], ...]
    tremor_mm: float
    rate_hz: float


@dataclass(frozen=True)
class _Phase:
    """A time span in which the hand follows a part of a curve while the jaw turns."""

    duration_s: float
    curve_mm: Floats
    along: tuple[float, float] = (1.0, 1.0)
    jaw_rad: tuple[float, float] = (OPEN_RAD, OPEN_RAD)
    clutched: bool = False
    hands_off: bool = False


_KESTREL = _Hand(moves=((1.0, 4.0, 0.0, False),), tremor_mm=0.05, rate_hz=200.0)
_HERON = _Hand(moves=((1.0, 6.0, 0.0, False),), tremor_mm=0.08, rate_hz=100.0)
_WREN = _Hand(moves=((0.55, 4.5, 0.3, False), (0.45, 3.5, 0.0, False)), tremor_mm=0.12, rate_hz=125.0)
_PLOVER = _Hand(
    moves=(
        (0.2, 2.6, 0.6, False),
        (0.2, 2.4, 1.4, True),
        (0.2, 2.8, 0.5, False),
        (0.2, 2.2, 1.2, True),
        (0.2, 3.0, 0.0, False),
    ),
    tremor_mm=0.3,
    rate_hz=100.0,
)

_DIRECT_MM = ((-28, 29, -136), (-4, 50, -125), (17, 67, -108))
_HIGH_MM = ((-24, 40, -134), (-20, 44, -112), (-6, 50, -95), (8, 58, -97), (15, 64, -112), (14, 66, -124))
_LOOP_MM = (
    (-22, 62, -131),
    (-6, 52, -125),
    (8, 42, -125),
    (12, 33, -124),
    (3, 28, -123),
    (-6, 34, -124),
    (-2, 46, -125),
    (6, 58, -121),
    (14, 68, -114),
)
_HESITANT_MM = (
    (-19, 35, -129),
    (-11, 43, -131),
    (-7, 39, -123),
    (1, 49, -125),
    (5, 45, -117),
    (-1, 53, -115),
    (9, 57, -119),
    (15, 59, -111),
)
_ALONG_THE_WOUND_MM = (1.5, 2.5, 0.0)  # from one of the five passes to the next


@cache
def sample_recordings() -> tuple[Sample, ...]:
    """Return all samples; every call and every machine produces the same bytes."""
    five = [np.add(_DIRECT_MM, np.multiply(number - 2, _ALONG_THE_WOUND_MM)) for number in range(5)]
    return (
        _sample("kestrel-simple-running", "simple-running", _KESTREL, [_DIRECT_MM]),
        _sample("heron-simple-running", "simple-running", _HERON, [_HIGH_MM]),
        _sample("wren-simple-running", "simple-running", _WREN, [_LOOP_MM]),
        _sample("plover-simple-running", "simple-running", _PLOVER, [_HESITANT_MM]),
        _sample("kestrel-five-hand-offs", "simple-interrupted", replace(_KESTREL, rate_hz=100.0), five),
    )


def _sample(name: str, suture: str, hand: _Hand, passes: Sequence[ArrayLike]) -> Sample:
    rng = np.random.default_rng(zlib.crc32(name.encode()))  # unlike hash(), the same in every process
    phases = list(_session(hand, [_smooth(np.asarray(points, dtype=np.float64)) for points in passes]))
    seconds, stamps_ns = _stamps(sum(phase.duration_s for phase in phases), hand.rate_hz, rng)
    tip_mm, jaw_rad = _play(phases, seconds)
    tip_mm = tip_mm + _tremor(seconds, hand.tremor_mm, rng)
    rotation = _drifting(seconds, rng)
    motion = Motion(ARM, f"/{ARM}/local/measured_cp", FRAME, stamps_ns, tip_mm.round(6), rotation.round(9))
    recording = Recording(
        format="mcap",
        integrity="full",
        motions=(motion,),
        jaws=((ARM, Signal(stamps_ns, jaw_rad.round(6))),),
        clutch=_pedal(phases),
    )
    return Sample(name, name.split("-")[0], suture, write_mcap(recording), _truth(phases))


def _session(hand: _Hand, curves: list[Floats]) -> Iterator[_Phase]:
    """Yield the phases of a recording: a rest, a hand-off for each curve with a return in between, and a rest."""
    yield _Phase(REST_S, curves[0], along=(0.0, 0.0))
    for number, curve in enumerate(curves):
        if number > 0:
            back = _smooth(np.array([curves[number - 1][-1], [-5.0, 45.0, -112.0], curve[0]]))
            yield _Phase(BETWEEN_S, back, along=(0.0, 0.0))
            yield _Phase(RETURN_S, back, along=(0.0, 1.0))
            yield _Phase(BETWEEN_S, back)
        yield from _hand_off(hand, curve)
    yield _Phase(REST_S, curves[-1])


def _hand_off(hand: _Hand, curve: Floats) -> Iterator[_Phase]:
    shut = (CLOSED_RAD, CLOSED_RAD)
    yield _Phase(GRIP_S, curve, along=(0.0, 0.0), jaw_rad=(OPEN_RAD, CLOSED_RAD))
    yield _Phase(SETTLE_S, curve, along=(0.0, 0.0), jaw_rad=shut)
    done = 0.0
    for share, duration_s, rest_s, clutched in hand.moves:
        yield _Phase(duration_s, curve, along=(done, done + share), jaw_rad=shut, hands_off=True)
        done += share
        if rest_s > 0:
            yield _Phase(rest_s, curve, along=(done, done), jaw_rad=shut, clutched=clutched, hands_off=True)
    yield _Phase(SETTLE_S, curve, jaw_rad=shut)
    yield _Phase(GRIP_S, curve, jaw_rad=(CLOSED_RAD, OPEN_RAD))


def _smooth(points_mm: Floats) -> Floats:
    """Return a Catmull-Rom curve through points: 1001 points at equal steps of arc length, shape (1001, 3) in mm."""
    # reflected end points, so that the curve includes the first and the last point
    ends = np.vstack([2 * points_mm[0] - points_mm[1], points_mm, 2 * points_mm[-1] - points_mm[-2]])
    u = np.linspace(0.0, 1.0, 200)[:, None]
    pieces = []
    for a, b, c, d in zip(ends, ends[1:], ends[2:], ends[3:], strict=False):
        pieces.append(b + u * (c - a) / 2 + u**2 * (a - 2.5 * b + 2 * c - d / 2) + u**3 * (1.5 * (b - c) + (d - a) / 2))
    dense = np.vstack(pieces)
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))))
    even = np.linspace(0.0, length[-1], 1001)
    return np.stack([np.interp(even, length, axis) for axis in dense.T], axis=1)


def _stamps(duration_s: float, rate_hz: float, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return time stamps with the jitter of a real recorder, up to 5 % of a step: seconds from the first, and ns."""
    steps = np.arange(int(duration_s * rate_hz)) + rng.uniform(0.0, 0.05, int(duration_s * rate_hz))
    offsets_ns = np.rint((steps - steps[0]) * (1e9 / rate_hz)).astype(np.int64)
    return offsets_ns / 1e9, EPOCH_NS + offsets_ns


def _play(phases: list[_Phase], seconds: Floats) -> tuple[Floats, Floats]:
    """Return the tip position, shape (T, 3) in mm, and the jaw angle, shape (T,) in rad, at given times."""
    ends = np.cumsum([phase.duration_s for phase in phases])
    which = np.minimum(np.searchsorted(ends, seconds, side="right"), len(phases) - 1)
    tip_mm, jaw_rad = np.empty((len(seconds), 3)), np.empty(len(seconds))
    for number, phase in enumerate(phases):
        here = which == number
        done = _minimum_jerk((seconds[here] - (ends[number] - phase.duration_s)) / phase.duration_s)
        along = (phase.along[0] + (phase.along[1] - phase.along[0]) * done) * (len(phase.curve_mm) - 1)
        nodes = np.arange(len(phase.curve_mm))
        tip_mm[here] = np.stack([np.interp(along, nodes, axis) for axis in phase.curve_mm.T], axis=1)
        jaw_rad[here] = phase.jaw_rad[0] + (phase.jaw_rad[1] - phase.jaw_rad[0]) * done
    return tip_mm, jaw_rad


def _minimum_jerk(share: Floats) -> Floats:
    """Return the share of the path at a share of the time, for a minimum-jerk movement (Flash and Hogan, 1985)."""
    s = np.clip(share, 0.0, 1.0)
    way: Floats = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return way


def _tremor(seconds: Floats, amplitude_mm: float, rng: np.random.Generator) -> Floats:
    """Return the mean of two oscillations of 8 to 12 Hz on each axis, shape (T, 3), never above the amplitude."""
    rates_hz, phases = rng.uniform(8.0, 12.0, (2, 3)), rng.uniform(0.0, 2 * np.pi, (2, 3))
    waves = np.sin(2 * np.pi * rates_hz * seconds[:, None, None] + phases)
    shaking: Floats = amplitude_mm * waves.mean(axis=1)
    return shaking


def _drifting(seconds: Floats, rng: np.random.Generator) -> Floats:
    """Return orientations that drift slowly around tool-down, as quaternions x, y, z, w, shape (T, 4)."""
    phases = rng.uniform(0.0, 2 * np.pi, 3)
    half = DRIFT_RAD * np.sin(2 * np.pi * seconds[:, None] / np.array([7.0, 9.0, 11.0]) + phases) / 2
    x, y, z = half.T
    w = np.sqrt(1.0 - (half**2).sum(axis=1))
    a, b = TOOL_DOWN_XYZW[:2]
    return np.stack([w * a - z * b, w * b + z * a, x * b - y * a, -x * a - y * b], axis=1)


def _pedal(phases: list[_Phase]) -> Signal:
    """Return the clutch events: released at the start, pressed and released around every clutched rest."""
    events, now_s = [(0.0, RELEASED)], 0.0
    for phase in phases:
        if phase.clutched:
            events += [(now_s + 0.05, PRESSED), (now_s + phase.duration_s - 0.05, RELEASED)]
        now_s += phase.duration_s
    stamps = [EPOCH_NS + round(second * 1e9) for second, _ in events]
    return Signal(np.array(stamps), np.array([float(value) for _, value in events]), CLUTCH_TOPICS[0])


def _truth(phases: list[_Phase]) -> tuple[tuple[float, float], ...]:
    """Return the start and end of each hand-off, in seconds from the first pose."""
    spans: list[tuple[float, float]] = []
    now_s, before = 0.0, False
    for phase in phases:
        # successive phases of one hand-off make one span
        start_s = spans.pop()[0] if before and phase.hands_off else now_s
        now_s += phase.duration_s
        if phase.hands_off:
            spans.append((round(start_s, 6), round(now_s, 6)))
        before = phase.hands_off
    return tuple(spans)
