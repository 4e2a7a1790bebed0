"""Timelines: motions as columns on one clock, to be played and compared.

    Timeline
    ├── ArmTrack   the motion of one arm: tip, jaws, joints, speed, outer bodies
    ├── Trace      one number over time: a distance, a probability
    └── Stage      a named interval

The clock is even: row i of a column is at `start_s` + i / `rate_hz`. Values between two samples are interpolated, turns
on the shorter way; where an arm was not recorded they are NaN. Nothing is learnt or
judged from a timeline. They are made from the samples of recordings, demonstrations, learnt paths and plans:

    Recording                   --timeline_of_recording--> Timeline
    Recording, Demo             --timeline_of_demo-->      Timeline
    PosePath                    --timeline_of_path-->      Timeline
    Trajectory, Playback, odds  --timeline_of_plan-->      Timeline

The arms' outer bodies are sent at fewer times, because they are large and slow (`Timeline.every`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from skills.arrays import Floats
from skills.demonstration.demonstration import Demo, partner_motion
from skills.demonstration.movement import press_times, same_signs, smoothed_speed
from skills.demonstration.recording import Motion, Recording
from skills.dynamics import Servo, predict
from skills.fields import Column, Count, schema
from skills.kinematics import INSTRUMENTS, JOINTS, forward, matrix_of, quaternion_of
from skills.planning.motion_laws import PHASES
from skills.planning.trajectory import PSM_A, PSM_M, Trajectory
from skills.verification.bodies import Parts, between, names_of, parts_of, radii_of
from skills.verification.clearance import FINGER_MM
from skills.verification.gates import Limits
from skills.verification.playback import Playback

if TYPE_CHECKING:  # it imports scipy, which clients that read a timeline do not need
    from skills.learning.pose_style import PosePath

Kind = Literal["recording", "demonstration", "learnt path", "plan"]


@schema
@dataclass(frozen=True)
class Stage:
    """A named interval: a stage of a session, a gesture, a phase of a pass."""

    name: str
    start_s: float
    end_s: float


@schema
@dataclass(frozen=True, eq=False)
class Trace:
    """One number over time that belongs to no single arm: a distance, a probability.

    Attributes:
        name: Its name.
        unit: Its unit; "" for a share.
        limit: The least value that is permitted; null if there is none.
        values: One for each row.
    """

    name: str
    unit: str
    limit: float | None
    values: Column


@schema
@dataclass(frozen=True, eq=False)
class ArmTrack:
    """The motion of one arm, a row for each time.

    Attributes:
        arm: Its name.
        frame: The frame of its poses.
        instrument: Number of its instrument; null if it is not known.
        tip_mm: Positions of the jaws' hinge: 3 numbers a row.
        rotation_xyzw: Orientations of the jaws, whose third axis is their direction: 4 numbers a row; null if they were
            not recorded.
        jaw_rad: Angle of the jaws; null if it was not recorded.
        joints: Joints in rad, the third in mm: 6 numbers a row; null if they were not recorded.
        speed_mm_s: Speed of the tip, without tremor.
        bodies: Names of the outer bodies and of the shaft; empty if joints, instrument or base are not known.
        radii_mm: Their radii.
        bodies_mm: Both ends of the axis of each: 6 numbers a body, the bodies of every `every`-th row.
        off_mm: The greatest distance at which the tip is predicted to be as the arm executes this motion, which is the
            radius of a tube around it; null if it was not executed.
    """

    arm: str
    frame: str
    instrument: str | None
    tip_mm: Column
    rotation_xyzw: Column | None
    jaw_rad: Column | None
    joints: Column | None
    speed_mm_s: Column
    bodies: tuple[str, ...]
    radii_mm: tuple[float, ...]
    bodies_mm: Column | None
    off_mm: Column | None = None

    def __post_init__(self) -> None:
        for name, row in (
            ("tip_mm", (3,)),
            ("rotation_xyzw", (4,)),
            ("joints", (6,)),
            ("bodies_mm", (len(self.bodies), 6)),
        ):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, getattr(self, name).reshape(-1, *row))


@schema
@dataclass(frozen=True, eq=False)
class Timeline:
    """A motion as columns: base64 of little-endian 32-bit floats, row by row, NaN where nothing is known.

    Attributes:
        kind: The kind of its source.
        rate_hz: Rows in a second.
        rows: Number of rows.
        start_s: Time of the first row: in the recording, or 0.
        arms: The arms; the first is the one that was demonstrated or planned, if one was.
        in_one_frame: Whether all arms are in one frame; if not, each is in its own, as the bases are not known.
        way: For each row the share of the arms' whole way that lies before it, from 0 to 1, to compare two motions.
        clutch_s: The intervals in which the clutch was down: beginning and end.
        stages: The stages, in order.
        traces: Distances and probabilities.
        every: Rows between two rows of bodies.
        finger_mm: Length of a jaw's finger.
    """

    kind: Kind
    rate_hz: float
    rows: Count
    start_s: float
    arms: tuple[ArmTrack, ...]
    in_one_frame: bool
    way: Column
    clutch_s: tuple[tuple[float, float], ...]
    stages: tuple[Stage, ...]
    traces: tuple[Trace, ...]
    every: Count
    finger_mm: float

    def seconds(self) -> Floats:
        """Return the times of the rows, in s."""
        return self.start_s + np.arange(self.rows) / self.rate_hz


RATE_HZ = 200.0  # ours: faster samples of a hand are not visible
MOST_ROWS = 24_000  # ours: two minutes at that rate, 4 MB for two arms with joints; longer motions get a lower rate
BODIES_HZ = 20.0  # ours: interpolated over a twentieth of a second a body is 1 mm off at 200 mm/s

_Samples = tuple[Floats, Floats]  # stamps in s, (N,), and values, (N,) or (N, K)
_Base = tuple[Floats, Floats]  # of an arm in the frame of its poses: rotation (3, 3), position (3,)


@dataclass(frozen=True, eq=False)
class _Clock:
    """The times of the rows in s, shape (T,), and how many rows lie between two rows of bodies."""

    at_s: Floats
    rate_hz: float

    @classmethod
    def of(cls, start_s: float, end_s: float, rate_hz: float) -> "_Clock":
        """Return the rows from one time to another, at a rate or a lower one that `RATE_HZ` and `MOST_ROWS` allow."""
        rate_hz = min(rate_hz, RATE_HZ, (MOST_ROWS - 1) / max(end_s - start_s, 1e-9))
        rows = 1 + int((end_s - start_s) * rate_hz + 1e-6)
        return cls(start_s + np.arange(rows) / rate_hz, rate_hz)

    @property
    def every(self) -> int:
        """Rows between two rows of bodies."""
        return max(1, int(self.rate_hz / BODIES_HZ))

    def column(self, stamps_s: Floats, values: ArrayLike) -> Floats:
        """Return values at the rows, (T,) or (T, K); NaN more than two samples outside of their stamps."""
        numbers = np.asarray(values, np.float64)
        table = numbers.reshape(len(stamps_s), -1)
        found = np.stack([np.interp(self.at_s, stamps_s, one) for one in table.T], axis=1)
        slack = 2 / self.rate_hz
        found[(self.at_s < stamps_s[0] - slack) | (self.at_s > stamps_s[-1] + slack)] = np.nan
        return found.reshape(len(self.at_s), *numbers.shape[1:])

    def turns(self, stamps_s: Floats, rotation_xyzw: Floats) -> Floats:
        """Return orientations at the rows, unit quaternions, (T, 4)."""
        found = self.column(stamps_s, same_signs(rotation_xyzw))
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))

    def track(
        self,
        arm: str,
        frame: str,
        pose: tuple[Floats, Floats, Floats | None],
        jaw: _Samples | None = None,
        joints: _Samples | None = None,
        instrument: str | None = None,
        base: _Base | None = None,
    ) -> tuple[ArmTrack, Parts | None]:
        """Return an arm's columns, and its parts at the rows of bodies.

        Args:
            arm: Its name.
            frame: The frame of its poses.
            pose: Stamps in s, positions, and orientations if they are known.
            jaw: Stamps and angles of the jaw.
            joints: Stamps and joints.
            instrument: Number of its instrument.
            base: The rotation of its base in the frame, (3, 3), and its position, (3,); None if they are not known.
        """
        stamps_s, tip_mm, rotation = pose
        known = instrument in INSTRUMENTS
        found = None if joints is None else self.column(*joints)
        parts, bodies, radii, ends = None, [], [], None
        if found is not None and known and base is not None:
            assert instrument is not None
            parts = parts_of(found[:: self.every], instrument).seen_from(*base)
            bodies, radii = list(names_of(instrument)[:-1]), radii_of(instrument)[:-1].tolist()
            ends = np.concatenate([parts.begin_mm, parts.end_mm], axis=2)[:, :-1]
        where = self.column(stamps_s, tip_mm)
        speed = np.interp(self.at_s, *smoothed_speed(stamps_s, tip_mm))
        speed[np.isnan(where[:, 0])] = np.nan
        track = ArmTrack(
            arm=arm,
            frame=frame,
            instrument=instrument,
            tip_mm=_column(where),
            rotation_xyzw=None if rotation is None else _column(self.turns(stamps_s, rotation)),
            jaw_rad=None if jaw is None else _column(self.column(*jaw)),
            joints=None if found is None else _column(found),
            speed_mm_s=_column(speed),
            bodies=tuple(bodies),
            radii_mm=tuple(radii),
            bodies_mm=None if ends is None else _column(ends),
        )
        return track, parts

    def timeline(self, kind: Kind, arms: Sequence[tuple[ArmTrack, Parts | None]], **more: Any) -> Timeline:
        """Return a timeline of arms, with the distance between the bodies of the first two if both are known."""
        steps = [np.linalg.norm(np.diff(one.tip_mm, axis=0), axis=1) for one, _ in arms]
        way = np.append(0.0, np.cumsum(np.nan_to_num(np.sum(steps, axis=0))))
        traces = list(more.pop("traces", ()))
        posed = [(track, parts) for track, parts in arms[:2] if parts is not None and more["in_one_frame"]]
        if len(posed) == 2:
            (_, parts), (_, others) = posed
            apart = between(parts, others).min(axis=(1, 2))
            values = np.interp(self.at_s, self.at_s[:: self.every], apart)
            traces.insert(0, Trace("Outer bodies apart", "mm", Limits().clearance_bodies_mm, _column(values)))
        return Timeline(
            kind=kind,
            rate_hz=self.rate_hz,
            rows=len(self.at_s),
            start_s=float(self.at_s[0]),
            arms=tuple(track for track, _ in arms),
            way=_column(way / way[-1] if way[-1] > 0 else way),
            traces=tuple(traces),
            every=self.every,
            finger_mm=FINGER_MM,
            **more,
        )


def _column(values: Floats) -> Any:
    """Return values as a read-only column of 32-bit floats."""
    column = np.array(values, np.float32)
    column.setflags(write=False)
    return column


# ---- recordings ----------------------------------------------------------------------------------------------------


def timeline_of_recording(recording: Recording) -> Timeline:
    """Return a recording as a timeline.

    Arms are shown in one frame if each was recorded in it. Outer bodies are shown where joints were recorded and the
    place of the base in that frame is known and stood still.

    Args:
        recording: The recording.
    """
    motions, together = _motions(recording)
    clock = _Clock.of(0.0, recording.duration_s, _rate_hz(motions))
    arms = []
    for one in motions:
        pose = recording.seconds(one.stamps_ns), one.tip_mm, one.rotation_xyzw
        known = _signals(recording, one.arm)
        arms.append(
            clock.track(one.arm, one.frame, pose, *known, recording.instrument_on(one.arm), _base(recording, one))
        )
    return clock.timeline("recording", arms, in_one_frame=together, **_session(recording, 0.0, recording.duration_s))


def timeline_of_demo(recording: Recording, demo: Demo) -> Timeline:
    """Return a demonstration in its frame, with the other arm if that was recorded all along it.

    Args:
        recording: The recording from which it was cut.
        demo: The demonstration, as `cut_demo` returned it.
    """
    seconds, m = demo.start_s + demo.stamps_s, demo.partner
    motion = recording.motion_of(arm=demo.arm, topic=demo.topic)
    clock = _Clock.of(demo.start_s, demo.end_s, _rate_hz([motion]))
    still = (np.eye(3), np.zeros(3)) if motion.states_base or recording.base_under(motion) is not None else None
    known = _signals(recording, demo.arm)
    pose = seconds, demo.tip_mm, demo.rotation_xyzw
    arms = [clock.track(demo.arm, demo.frame, pose, *known, demo.instrument, still)]
    other = partner_motion(recording, demo)
    if m is not None and other is not None:
        base = None
        if m.base_mm is not None and m.base_xyzw is not None:
            base = matrix_of(np.array([m.base_xyzw]))[0], np.asarray(m.base_mm)
        pose = seconds, other.tip_mm, other.rotation_xyzw
        arms.append(clock.track(m.arm, demo.frame, pose, *_signals(recording, m.arm), m.instrument, base))
    return clock.timeline("demonstration", arms, in_one_frame=True, **_session(recording, demo.start_s, demo.end_s))


def _rate_hz(motions: Sequence[Motion]) -> float:
    """Return the highest rate of the motions, from the median steps of their stamps; 1 if none has two samples."""
    return max((1e9 / float(np.median(np.diff(m.stamps_ns))) for m in motions if len(m.stamps_ns) > 1), default=1.0)


def _motions(recording: Recording) -> tuple[list[Motion], bool]:
    """Return a motion for each arm, and whether they are in one frame, as they are if there is one for all."""
    arms = recording.arms
    if len(arms) > 1:
        for frame in sorted({one.frame for one in recording.motions if not one.states_base}):
            there = [one for one in recording.motions if one.frame == frame and not one.states_base]
            found = [next(one for one in there if one.arm == arm) for arm in arms if arm in {one.arm for one in there}]
            if len(found) == len(arms):
                return found, True
    return [recording.motion_of(arm=arm) for arm in arms], len(arms) == 1


def _signals(recording: Recording, arm: str) -> tuple[_Samples | None, _Samples | None]:
    """Return the jaw and the joints of an arm, each with its stamps in s."""
    jaw = recording.jaw_of(arm)
    joints = next((one for one in recording.joints if one.arm == arm and one.positions.shape[1] >= 6), None)
    return (
        None if jaw is None or not len(jaw.values) else (recording.seconds(jaw.stamps_ns), jaw.values),
        None if joints is None else (recording.seconds(joints.stamps_ns), joints.positions[:, :6]),
    )


def _base(recording: Recording, motion: Motion) -> _Base | None:
    """Return the base of a motion's arm in the motion's frame; None if its place is not known or it moved."""
    if motion.states_base:
        return np.eye(3), np.zeros(3)
    for base in recording.bases:
        if base.is_of(motion) and base.is_steady:
            return matrix_of(np.array([base.rotation_xyzw]))[0], np.asarray(base.position_mm)
    return None


def _session(recording: Recording, start_s: float, end_s: float) -> dict[str, Any]:
    """Return the clutch and the stages in a part of a recording."""
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    presses = [] if recording.clutch is None else press_times(recording.clutch)
    down = [(first, last_ns if last is None else last) for first, last in presses]

    def within(spans_ns: Sequence[tuple[int, int]]) -> list[tuple[float, float] | None]:
        """Return intervals in s since the recording's origin; None for those outside of the part."""
        spans = recording.seconds(np.array(spans_ns, np.int64).reshape(-1, 2)).tolist()
        return [(first, last) if last > start_s and first < end_s else None for first, last in spans]

    stages = within([(one.start_ns, one.end_ns) for one in recording.labels])
    return {
        "clutch_s": tuple(span for span in within(down) if span),
        "stages": tuple(Stage(one.name, *at) for one, at in zip(recording.labels, stages, strict=True) if at),
    }


# ---- learnt paths and plans ----------------------------------------------------------------------------------------


def timeline_of_path(path: "PosePath", *, arm: str, frame: str) -> Timeline:
    """Return the motion that a pose style gives at its own place, in the tempo of its demonstrations.

    Args:
        path: The motion, and that of the other arm if the style has one.
        arm: Name of the arm that was demonstrated.
        frame: Name of the frame of all poses.
    """
    clock = _Clock.of(0.0, float(path.elapsed_s[-1]), RATE_HZ)
    jaw = None if path.jaw_rad is None else (path.elapsed_s, path.jaw_rad)
    arms = [clock.track(arm, frame, (path.elapsed_s, path.tip_mm, path.rotation_xyzw), jaw)]
    if path.partner is not None:
        other = path.partner
        jaw = None if other.jaw_rad is None else (path.elapsed_s, other.jaw_rad)
        arms.append(clock.track(other.arm, frame, (path.elapsed_s, other.tip_mm, other.rotation_xyzw), jaw))
    return clock.timeline("learnt path", arms, in_one_frame=True, clutch_s=(), stages=())


def timeline_of_plan(
    trajectory: Trajectory,
    *,
    arm: str,
    frame: str,
    played: Playback | None = None,
    odds: Mapping[int, float] | None = None,
    event: str = "",
    servo: Servo | None = None,
) -> Timeline:
    """Return a plan's motion in the base frame of PSM_A.

    Args:
        trajectory: The motion.
        arm: Name of PSM_A.
        frame: Name of its base frame.
        played: The newest playback, of which the distances are shown; None if there is none.
        odds: For each pass the probability of an event; None: none is shown.
        event: That event in words.
        servo: How PSM_A is driven, whose predicted motion is shown as one more arm; None: it is not shown.
    """
    t, at_s = trajectory, trajectory.stamps_s
    clock = _Clock.of(float(at_s[0]), float(at_s[-1]), t.rate_hz)
    arms = []
    for one in t.arms:
        poses, base = one.poses(), (one.base, one.base_mm)
        name, jaw = (f"{PSM_A} ({arm})", one.jaw_rad) if one.name == PSM_A else (PSM_M, None)
        pose = at_s, poses.tip_mm, quaternion_of(poses.rotation)
        shown = None if jaw is None else (at_s, jaw)
        arms.append(clock.track(name, frame, pose, shown, (at_s, one.joints), one.instrument, base))
    efforts = []
    if servo is not None:
        found = predict(t.joints, at_s, servo, t.instrument)
        tip_mm, turned = forward(found.executed.joints, t.instrument)
        joints = at_s, found.executed.joints
        executed = clock.track(f"{PSM_A} as executed", frame, (at_s, tip_mm, quaternion_of(turned)), None, joints)
        arms = [(replace(arms[0][0], off_mm=_column(clock.column(at_s, found.off_mm[2]))), arms[0][1]), *arms[1:]]
        arms.append(executed)
        for joint, values in zip(JOINTS, 100 * found.effort.T, strict=True):
            efforts.append(Trace(f"Effort of {joint}", "% of its limit", None, _column(clock.column(at_s, values))))
    return clock.timeline(
        "plan",
        arms,
        in_one_frame=True,
        clutch_s=(),
        stages=_stages(t),
        traces=(*_distances(clock, t, played), *_odds(clock, t, odds or {}, event), *efforts),
    )


def _stages(t: Trajectory) -> tuple[Stage, ...]:
    """Return the phases of all passes; between two passes is the pause."""
    key = t.pass_index * len(PHASES) + t.phase
    edges = np.concatenate([[0], np.flatnonzero(np.diff(key)) + 1, [len(t)]])
    stages = []
    for first, after in pairwise(edges.tolist()):
        last = after if after < len(t) and t.pass_index[after] == t.pass_index[first] else after - 1
        name = f"pass {t.pass_index[first]}: {PHASES[t.phase[first]]}"
        stages.append(Stage(name, float(t.stamps_s[first]), float(t.stamps_s[last])))
    return tuple(stages)


def _distances(clock: _Clock, t: Trajectory, played: Playback | None) -> list[Trace]:
    """Return the least distances that the simulator measured, from the pad and between the tools."""
    if played is None or len(played) != len(t):
        return []
    limits, pairs, stamps_s = Limits(), played.link_pairs, t.stamps_s[played.looked_at]
    found = []
    for name, other, limit in (
        ("Tools above the pad", "pad", limits.clearance_pad_mm),
        ("Tools apart", PSM_M, limits.clearance_psm_m_mm),
    ):
        columns = [k for k, pair in enumerate(pairs) if pair.other == other and not pair.may_touch]
        if columns:
            least = played.clearances_mm[:, columns].min(axis=1)
            found.append(Trace(name, "mm", limit, _column(clock.column(stamps_s, least))))
    return found


def _odds(clock: _Clock, t: Trajectory, odds: Mapping[int, float], event: str) -> list[Trace]:
    """Return the probability of each pass while it lasts."""
    if not odds:
        return []
    begins = np.searchsorted(t.stamps_s, clock.at_s + 1e-9, side="right").clip(1) - 1
    ends = t.stamps_s[t.last_samples]
    number = t.pass_index[begins]
    values = np.array([odds.get(one, np.nan) for one in range(t.passes)])[number]
    values[clock.at_s > ends[number] + 1e-6] = np.nan
    return [Trace(event, "", None, _column(values))]
