"""The simulator's verdict on a trajectory: what was measured, what is allowed, and the first sample that is not.

A `Playback` is what `skills.sim.play` measured: a kinematic pass, which puts the joints where the trajectory has them
and looks where the tip and the surfaces are, and a servo pass, in which the joints' motors follow with real forces.
`judge` compares it with the trajectory. All of this is ours; the paper played its plans on the robot.

What the verdict says: the geometry is right and free. In free space the servo's error shows the simulator's gains, not
the robot, so it guards against mistakes of ours and of contact; it is no evidence of the hardware's accuracy.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from skills.errors import BadInput
from skills.style._arrays import Floats, frozen
from skills.style.kinematics import (
    CANNULA_MM,
    INSERTION,
    JOINTS,
    UNITS,
    angle_between,
    instrument_of,
    joint_margins,
    matrix_of,
)
from skills.style.trajectory import A2, Trajectory, joint_ratios

CLEARANCE_SEEN_MM = 50.0  # surfaces further apart than this are reported as this far


@dataclass(frozen=True, eq=False)
class WaitingArm:
    """PSM_M, standing still at its hand-off pose of each pass while PSM_A comes.

    Attributes:
        base_mm: Its remote centre in the PSM_A base frame, shape (3,).
        base_xyzw: Its base's rotation there, unit quaternion, shape (4,).
        joints: Its joints in each pass, rad and mm, shape (passes, 6).
        enters_after_a1: It comes only when A1 is over, as a surgeon would do it; otherwise it waits there all along.
    """

    base_mm: Floats
    base_xyzw: Floats
    joints: Floats
    enters_after_a1: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_mm", frozen(self.base_mm, np.float64, (3,), "base_mm"))
        object.__setattr__(self, "base_xyzw", frozen(self.base_xyzw, np.float64, (4,), "base_xyzw"))
        object.__setattr__(self, "joints", frozen(self.joints, np.float64, (None, 6), "joints"))
        matrix_of(self.base_xyzw[None])


@dataclass(frozen=True, eq=False)
class Playback:
    """What the simulator measured, one row per sample of the trajectory. Measurements are kept as they came, even NaN.

    Attributes:
        tip_mm: Tip of the kinematic pass in the PSM base frame, shape (T, 3).
        rotation_xyzw: The jaw's rotation there, shape (T, 4).
        joints: Joints of the kinematic pass, rad and mm, shape (T, 6).
        tracking_mm: Distance of the servo pass's tip from the trajectory's, shape (T,).
        clearance_pad_mm: Smallest distance between arm and pad, negative inside, shape (T,).
        clearance_psm_m_mm: The same between arm and PSM_M, shape (T,), or None where there is none.
        pad_top_mm: Height of the pad's top in the PSM base frame.
        picture_png: A still picture of the scene.
        engine: The simulator and its version.
        seconds_per_step: Wall time of one servo step: a timing, so no part of any report or digest.
    """

    tip_mm: Floats
    rotation_xyzw: Floats
    joints: Floats
    tracking_mm: Floats
    clearance_pad_mm: Floats
    clearance_psm_m_mm: Floats | None
    pad_top_mm: float
    picture_png: bytes
    engine: str
    seconds_per_step: float

    def __post_init__(self) -> None:
        count = len(self.tip_mm)
        shapes: list[tuple[str, tuple[int, ...]]] = [
            ("tip_mm", (count, 3)),
            ("rotation_xyzw", (count, 4)),
            ("joints", (count, 6)),
            ("tracking_mm", (count,)),
            ("clearance_pad_mm", (count,)),
        ]
        if self.clearance_psm_m_mm is not None:
            shapes.append(("clearance_psm_m_mm", (count,)))
        for name, shape in shapes:
            array = np.array(getattr(self, name), dtype=np.float64, order="C", copy=True)
            if array.shape != shape:
                raise BadInput(f"{name} has shape {array.shape}; give {shape}.", shape=array.shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.tip_mm)


@dataclass(frozen=True)
class JudgeSettings:
    """What is allowed. All of it is ours; the reasons are beside each.

    Attributes:
        fk_mm: Simulator against closed form, position; they agree to 1e-4 mm when the URDF is right.
        fk_deg: The same, rotation.
        joint_margin: Least distance of every joint from its limits, as a part of its range.
        insertion_mm: Least insertion: with less the wrist is inside the cannula.
        speed_ratio: Greatest joint speed as a part of its limit; a millionth is left for round-off.
        acceleration_ratio: Greatest joint acceleration as a part of its limit; the same.
        tracking_mm: Servo error on the way; the simulator's own is under 0.001 mm, and in contact it is millimetres.
        goal_mm: Servo error at the end of each pass.
        alignment_deg: Error of the jaw's rotation at the end of each pass.
        clearance_pad_mm: Least distance from the pad; the simulator's distances are good to 0.2 mm.
        clearance_psm_m_mm: Least distance from PSM_M during A1. In A2 the jaws are meant to meet.
    """

    fk_mm: float = 0.01
    fk_deg: float = 0.01
    joint_margin: float = 0.0
    insertion_mm: float = CANNULA_MM
    speed_ratio: float = 1.000001
    acceleration_ratio: float = 1.000001
    tracking_mm: float = 0.1
    goal_mm: float = 0.05
    alignment_deg: float = 0.1
    clearance_pad_mm: float = 1.0
    clearance_psm_m_mm: float = 0.5


@dataclass(frozen=True)
class Failure:
    """The first sample that is not allowed."""

    sample: int
    pass_index: int
    phase: int
    stamp_s: float
    quantity: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        """Say it in a sentence."""
        return (
            f"Pass {self.pass_index}, A{self.phase}, sample {self.sample} ({self.stamp_s:.3f} s): {self.quantity} is "
            f"{self.value:.4g} {self.unit}, the limit is {self.limit:.4g}."
        )


@dataclass(frozen=True)
class PlaybackReport:
    """The verdict and its figures: plain numbers, the same for the same trajectory wherever it was played.

    `least_margin` is the part of its range that the joint `least_margin_joint` was from its limit. Angles are per
    pass: `turns_deg` what A2 turned, `alignment_errors_deg` how far its end is from the target. `engine` is the
    simulator's version.
    """

    feasible: bool
    failure: Failure | None
    samples: int
    passes: int
    duration_s: float
    unreachable_samples: int
    least_margin: float
    least_margin_joint: str
    least_insertion_mm: float
    peak_speed_ratio: float
    peak_acceleration_ratio: float
    fk_error_mm: float
    fk_error_deg: float
    tracking_max_mm: float
    tracking_rms_mm: float
    goal_error_mm: float
    alignment_errors_deg: tuple[float, ...]
    turns_deg: tuple[float, ...]
    deviation_mm: float
    clearance_pad_mm: float
    clearance_psm_m_mm: float | None
    pad_top_mm: float
    engine: str
    settings: JudgeSettings = field(default_factory=JudgeSettings)


@dataclass(frozen=True, eq=False)
class _Gate:
    """One quantity along the trajectory and what it must be: at most, or at least, the limit."""

    quantity: str
    unit: str
    values: Floats
    limit: float
    at_least: bool = False

    def broken(self) -> int | None:
        """Find the first sample that does not pass; NaN does not."""
        passes = self.values >= self.limit if self.at_least else self.values <= self.limit
        return None if passes.all() else int(np.argmin(passes))


def judge(playback: Playback, trajectory: Trajectory, settings: JudgeSettings | None = None) -> PlaybackReport:
    """Compare what was measured with what was meant and allowed.

    Raises:
        BadInput: The playback has another number of samples than the trajectory.
    """
    if len(playback) != len(trajectory):
        raise BadInput(
            f"The playback has {len(playback)} samples, the trajectory {len(trajectory)}; play this trajectory.",
            playback=len(playback),
            trajectory=len(trajectory),
        )
    limits = settings or JudgeSettings()
    seen = _figures(playback, trajectory)
    failure = _first_failure(trajectory, _gates(seen, playback, trajectory, limits))
    ends = trajectory.last_samples
    joint = int(np.argmin(_lowest(seen.margins)))
    psm_m = playback.clearance_psm_m_mm
    return PlaybackReport(
        feasible=failure is None,
        failure=failure,
        samples=len(trajectory),
        passes=trajectory.passes,
        duration_s=trajectory.duration_s,
        # Counted so that a NaN margin is unreachable.
        unreachable_samples=int(np.count_nonzero(~(seen.margins >= -1e-9).all(axis=1))),
        least_margin=float(seen.margins.min()),
        least_margin_joint=JOINTS[joint],
        least_insertion_mm=float(playback.joints[:, INSERTION].min()),
        peak_speed_ratio=float(seen.speed.max()),
        peak_acceleration_ratio=float(seen.acceleration.max()),
        fk_error_mm=float(seen.fk_mm.max()),
        fk_error_deg=float(seen.fk_deg.max()),
        tracking_max_mm=float(playback.tracking_mm.max()),
        tracking_rms_mm=float(np.sqrt(np.mean(playback.tracking_mm**2))),
        goal_error_mm=float(playback.tracking_mm[ends].max()),
        alignment_errors_deg=tuple(seen.fk_deg[ends].tolist()),
        turns_deg=_turns(trajectory),
        deviation_mm=trajectory.deviation_mm,
        clearance_pad_mm=float(playback.clearance_pad_mm.min()),
        clearance_psm_m_mm=None if psm_m is None else float(psm_m.min()),
        pad_top_mm=playback.pad_top_mm,
        engine=playback.engine,
        settings=limits,
    )


@dataclass(frozen=True, eq=False)
class _Figures:
    margins: Floats  # (T, 6), parts of the joints' ranges
    speed: Floats  # (T, 6), parts of the limits
    acceleration: Floats
    fk_mm: Floats  # (T,)
    fk_deg: Floats


def _figures(playback: Playback, trajectory: Trajectory) -> _Figures:
    tool = instrument_of(trajectory.instrument)
    speed, acceleration = joint_ratios(
        playback.joints, trajectory.pass_index, trajectory.rate_hz, trajectory.instrument
    )
    return _Figures(
        margins=joint_margins(playback.joints, trajectory.instrument) / (tool.upper - tool.lower),
        speed=speed,
        acceleration=acceleration,
        fk_mm=np.linalg.norm(playback.tip_mm - trajectory.tip_mm, axis=1),
        fk_deg=_rotation_error_deg(playback.rotation_xyzw, trajectory.rotation_xyzw),
    )


def _rotation_error_deg(measured: Floats, meant: Floats) -> Floats:
    """Measure the angle between quaternions, shape (T,); NaN where the measured one is none."""
    length = np.linalg.norm(measured, axis=1)
    sound = np.abs(length - 1.0) < 1e-6
    safe = np.where(sound[:, None], measured, meant)
    angle = np.degrees(angle_between(matrix_of(safe), matrix_of(meant)))
    return np.where(sound, angle, np.nan)


def _gates(seen: _Figures, playback: Playback, trajectory: Trajectory, limits: JudgeSettings) -> Iterator[_Gate]:
    """List what must hold; of several that break at one sample the first listed is reported."""
    yield from _joint_gates(seen, playback, trajectory, limits)
    yield _Gate("tip off the closed form", "mm", seen.fk_mm, limits.fk_mm)
    yield _Gate("rotation off the closed form", "deg", seen.fk_deg, limits.fk_deg)
    yield _Gate("clearance to the pad", "mm", playback.clearance_pad_mm, limits.clearance_pad_mm, at_least=True)
    if playback.clearance_psm_m_mm is not None:
        # In A2 the jaws are meant to meet; np.maximum lets no NaN pass.
        meant = np.where(trajectory.phase == A2, limits.clearance_psm_m_mm, -np.inf)
        apart = np.maximum(playback.clearance_psm_m_mm, meant)
        yield _Gate("clearance to PSM_M", "mm", apart, limits.clearance_psm_m_mm, at_least=True)
    yield _Gate("servo error", "mm", playback.tracking_mm, limits.tracking_mm)
    at_end = np.isin(np.arange(len(trajectory)), trajectory.last_samples)
    yield _Gate("servo error at the goal", "mm", np.where(at_end, playback.tracking_mm, 0.0), limits.goal_mm)
    yield _Gate("alignment error", "deg", np.where(at_end, seen.fk_deg, 0.0), limits.alignment_deg)


def _joint_gates(seen: _Figures, playback: Playback, trajectory: Trajectory, limits: JudgeSettings) -> Iterator[_Gate]:
    tool = instrument_of(trajectory.instrument)
    spare = limits.joint_margin * (tool.upper - tool.lower)
    for joint, name in enumerate(JOINTS):
        values = playback.joints[:, joint]
        yield _Gate(name, UNITS[joint], values, float(tool.upper[joint] - spare[joint]) + 1e-9)
        yield _Gate(name, UNITS[joint], values, float(tool.lower[joint] + spare[joint]) - 1e-9, at_least=True)
    insertion = playback.joints[:, INSERTION]
    yield _Gate("insertion out of the cannula", "mm", insertion, limits.insertion_mm, at_least=True)
    for joint, name in enumerate(JOINTS):
        yield _Gate(f"speed of {name}", "of its limit", seen.speed[:, joint], limits.speed_ratio)
        yield _Gate(f"acceleration of {name}", "of its limit", seen.acceleration[:, joint], limits.acceleration_ratio)


def _first_failure(trajectory: Trajectory, gates: Iterator[_Gate]) -> Failure | None:
    """Name the earliest sample at which a gate is broken."""
    broken = [(sample, gate) for gate in gates if (sample := gate.broken()) is not None]
    if not broken:
        return None
    sample, gate = min(broken, key=lambda one: one[0])
    return Failure(
        sample=sample,
        pass_index=int(trajectory.pass_index[sample]),
        phase=int(trajectory.phase[sample]),
        stamp_s=float(trajectory.stamps_s[sample]),
        quantity=gate.quantity,
        value=float(gate.values[sample]),
        limit=gate.limit,
        unit=gate.unit,
    )


def _turns(trajectory: Trajectory) -> tuple[float, ...]:
    """Measure what each pass's A2 turns, degrees."""
    last = trajectory.last_samples
    first = np.append(0, last[:-1] + 1)
    matrices = matrix_of(trajectory.rotation_xyzw[np.concatenate([first, last])])
    angles = np.degrees(angle_between(matrices[: len(first)], matrices[len(first) :]))
    return tuple(np.where(trajectory.phase[last] == A2, angles, 0.0).tolist())


def _lowest(margins: Floats) -> Floats:
    """Take each joint's least margin, NaN as the least of all."""
    return np.asarray(np.where(np.isnan(margins), -np.inf, margins).min(axis=0))
