"""Recordings as values: the motion of the arms, its time stamps and its frames.

    Recording
    ├── Motion      the tip of one arm, one per pose topic
    ├── Joints      the measured joints of one arm
    ├── Signal      one number over time, a jaw's angle or a pedal
    ├── Column      a column of a table, and what it was read as
    ├── Label       a named interval: a stage of the session, a gesture
    └── Topic       a topic of the file, used or not
    --base_frames--> BaseFrame   the pose of an arm's base in the frame of another of its topics (`paired_bases`)
    --identifications--> ArmIdentification   arm, instrument and base that joints and poses of an arm show together

Motions, joints and signals are checked in their constructors (`skills.demonstration.motion`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Literal

import numpy as np

from skills.arithmetic import product
from skills.arrays import Floats, Ints, nearest, xyz, xyzw
from skills.demonstration.hypotheses import stated_instrument
from skills.demonstration.identification import MOST_SAMPLES, ArmIdentification, Identification, identify
from skills.demonstration.motion import Joints as Joints
from skills.demonstration.motion import Motion as Motion
from skills.demonstration.motion import Signal as Signal
from skills.demonstration.motion import equal_samples as equal_samples
from skills.demonstration.motion import recorded_events as recorded_events
from skills.demonstration.motion import recorded_joints as recorded_joints
from skills.demonstration.motion import recorded_motion as recorded_motion
from skills.demonstration.motion import recorded_signal as recorded_signal
from skills.errors import NoUsableTopic, UnreadableRecording
from skills.fields import Count, Point, Quaternion, schema
from skills.kinematics import matrix_of, quaternion_of
from skills.quaternions import INVERSE, angle_of, best_turn, multiplied, turned, unit
from skills.remedies import did_you_mean

NS_PER_S = 1_000_000_000
BASES_LIMIT = 64  # ours: pairs of motions of one arm in two frames; a dVRK's recording has one or two per arm
PAIR_NS = 2_000_000  # ours: between two poses so near in time a tip at 100 mm/s moves by 0.2 mm
PAIRS_LEAST = 10  # ours: from fewer pairs it cannot be concluded that a base stood still
IDENTIFIED_LIMIT = 16  # ours: pairs of joints and poses that are compared, 0.1 s each; a dVRK has two per arm
JOINT_GAP_NS = 50_000_000  # ours: joints further apart in time are not interpolated
STEADY_MM, STEADY_RAD = 3.0, 0.05  # ours: a base that moved more in the other frame has no single pose
WIDE_MM = 2.0  # ours: a rotation cannot be fitted to tips that move less than this in a second direction


@schema
@dataclass(frozen=True)
class BaseFrame:
    """The pose of an arm's base: a point p of `local_frame` is at `position_mm` + R p in `frame`.

    Attributes:
        arm: The arm's name.
        frame: Frame of the arm's other pose, such as "ECM".
        local_frame: The arm's base, the frame of its `local/measured_cp`.
        position_mm: Position of the base in `frame`.
        rotation_xyzw: Its rotation R as a unit quaternion.
        spread_mm: Greatest distance from `position_mm` among the positions that single pairs of poses give. A large
            value means that the base moved, because the camera or the set-up joints did.
        spread_rad: Greatest angle from R among the rotations that single pairs give.
    """

    arm: str
    frame: str
    local_frame: str
    position_mm: Point
    rotation_xyzw: Quaternion
    spread_mm: float
    spread_rad: float

    @property
    def is_steady(self) -> bool:
        """Whether the base stood still in `frame`."""
        return self.spread_mm <= STEADY_MM and self.spread_rad <= STEADY_RAD

    def is_of(self, motion: Motion) -> bool:
        """Return whether it is the base of a motion's arm in the frame of that motion."""
        return (self.arm, self.frame) == (motion.arm, motion.frame)

    def seen_from(self, position_mm: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
        """Transform poses from `frame` into the base's own frame.

        Args:
            position_mm: Positions in `frame`, shape (T, 3).
            rotation_xyzw: Unit quaternions in `frame`, shape (T, 4).

        Returns:
            The same in `local_frame`.
        """
        turn = matrix_of(np.array([self.rotation_xyzw]))[0]
        rotation = quaternion_of(product(turn.T, matrix_of(rotation_xyzw)))
        return product(position_mm - np.asarray(self.position_mm), turn), rotation


def identified_arms(
    motions: Sequence[Motion], joints: Sequence[Joints], tools: Mapping[str, str], *, timed: bool
) -> Iterator[ArmIdentification]:
    """Yield the arms and instruments that joints and poses show together.

    Args:
        motions: Poses; those that were computed from joints are left out.
        joints: Measured joints. Of more than `IDENTIFIED_LIMIT` pairs, of all arms together, the first are compared.
        tools: Arm and its stated instrument.
        timed: Whether the stamps are times that were recorded, so that speeds can be computed from them.
    """
    measured = [motion for motion in motions if not motion.from_joints]
    pairs = ((one, motion) for one in joints for motion in measured if one.arm == motion.arm)
    # Limited, because each pair costs some hypotheses for some thousand samples.
    for one, motion in islice(pairs, IDENTIFIED_LIMIT):
        at, values, speeds = _joints_at(one, motion.stamps_ns)
        if len(at) == 0:
            continue
        rotation = None if motion.rotation_xyzw is None else matrix_of(motion.rotation_xyzw[at])
        found = identify(
            values,
            motion.tip_mm[at],
            rotation,
            speeds=speeds if timed else None,
            in_base=motion.states_base,
            stated=tools.get(motion.arm),
        )
        if found is not None:
            yield ArmIdentification(motion.arm, one.topic, motion.topic, motion.frame, found)


def _joints_at(joints: Joints, stamps_ns: Ints) -> tuple[Ints, Floats, Floats]:
    """Return indices of stamps, at most `MOST_SAMPLES`, between two samples of the joints; joints and speeds there."""
    at = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), MOST_SAMPLES)).round().astype(np.int64)
    if len(joints.stamps_ns) < 2:
        return at[:0], joints.positions[:0], joints.positions[:0]
    wanted_ns, known_ns = stamps_ns[at], joints.stamps_ns
    after = np.clip(np.searchsorted(known_ns, wanted_ns), 1, len(known_ns) - 1)
    before = after - 1
    gap_ns = known_ns[after] - known_ns[before]
    same = (wanted_ns == known_ns[before]) | (wanted_ns == known_ns[after])  # nothing is interpolated
    near = (wanted_ns >= known_ns[before]) & (wanted_ns <= known_ns[after]) & (same | (gap_ns <= JOINT_GAP_NS))
    at, after, before, wanted_ns, gap_ns = at[near], after[near], before[near], wanted_ns[near], gap_ns[near]
    share = ((wanted_ns - known_ns[before]) / np.maximum(1, gap_ns))[:, None]
    # Speeds over some samples, because the difference of two is mostly the noise of the encoders.
    first, last = np.maximum(before - 2, 0), np.minimum(after + 2, len(known_ns) - 1)
    seconds = np.maximum(1, known_ns[last] - known_ns[first])[:, None] / 1e9
    speeds = (joints.positions[last] - joints.positions[first]) / seconds
    return at, (1.0 - share) * joints.positions[before] + share * joints.positions[after], speeds


def shown_bases(identifications: Sequence[ArmIdentification], motions: Sequence[Motion]) -> Iterator[BaseFrame]:
    """Yield the bases that joints show in the frame of poses which are not stated to be in the base.

    Args:
        identifications: Arms that joints and poses show together; those that are not "identified" are left out.
        motions: The recorded poses, for which of them are stated to be in the base.
    """
    stated = {(motion.arm, motion.topic) for motion in motions if motion.states_base}
    for one in identifications:
        if one.found.verdict == "identified" and (one.arm, one.topic) not in stated:
            yield BaseFrame(
                arm=one.arm,
                frame=one.frame,
                local_frame=f"{one.arm}_base",
                position_mm=one.found.position_mm,
                rotation_xyzw=one.found.rotation_xyzw,
                spread_mm=one.found.greatest_mm,
                spread_rad=one.found.residual_rad or 0.0,
            )


def paired_bases(motions: Sequence[Motion]) -> tuple[BaseFrame, ...]:
    """Find the poses of the bases of arms whose pose was recorded both in the base's frame and in another.

    A base is the pose in the other frame times the inverse of the pose in its own, from samples of equal stamps or the
    nearest within `PAIR_NS`. The result is the median over all pairs of samples, component by component. If the
    orientations do not agree with the tips, the rotation is fitted to the tips, and `spread_rad` is the deviation of
    the orientations from it. Of more than `BASES_LIMIT` pairs of motions only the first are compared.

    Args:
        motions: The recorded poses; those without orientation are left out.

    Returns:
        One frame for each pair of motions of an arm, in mm; none for pairs with fewer than `PAIRS_LEAST` common
        samples.
    """
    whole = [motion for motion in motions if motion.rotation_xyzw is not None]
    pairs = (
        (local, other)
        for local in whole
        if local.is_local
        for other in whole
        if not other.is_local and local.arm == other.arm and local.frame != other.frame
    )
    # Limited, because each pair of motions costs a pass over its samples.
    found = [_base_frame(local, other) for local, other in islice(pairs, BASES_LIMIT)]
    return tuple(base for base in found if base is not None)


def _base_frame(local: Motion, other: Motion) -> BaseFrame | None:
    """Compute the pose of a base; None if too few samples of the two motions have a counterpart in time."""
    here, there = _pairs(local.stamps_ns, other.stamps_ns)
    if len(here) < PAIRS_LEAST:
        return None
    assert local.rotation_xyzw is not None and other.rotation_xyzw is not None
    turns = unit(multiplied(other.rotation_xyzw[there], local.rotation_xyzw[here] * INVERSE))
    turns *= np.where(product(turns, turns[0]) < 0, -1.0, 1.0)[:, None]  # q and -q are the same turn
    # The smaller misfit of the tips decides, because recorded orientations may disagree with the tips.
    turn = min(_candidates(turns, local.tip_mm[here], other.tip_mm[there]), key=lambda one: one[0])[1]
    places = other.tip_mm[there] - turned(turn, local.tip_mm[here])
    place = np.median(places, axis=0)
    spread_rad = float(angle_of(multiplied(turns, turn * INVERSE)).max())
    return BaseFrame(
        arm=local.arm,
        frame=other.frame,
        local_frame=local.frame,
        position_mm=xyz(place),
        rotation_xyzw=xyzw(turn),
        spread_mm=float(np.linalg.norm(places - place, axis=1).max()),
        spread_rad=spread_rad,
    )


def _candidates(turns: Floats, here_mm: Floats, there_mm: Floats) -> Iterator[tuple[float, Floats]]:
    """Yield candidates for the rotation, each with its misfit in mm: the median of the turns, and a fit to the tips.

    The fit (Kabsch) is determined only if the tips move in more than one direction.
    """
    found = [unit(np.median(turns, axis=0))]
    one, other = here_mm - here_mm.mean(axis=0), there_mm - there_mm.mean(axis=0)
    spread = np.einsum("ni,nj->ij", one, one)
    size = np.trace(spread)
    # The sum of products of two principal spreads, over that of the spreads: nearly the second one.
    if size * size - (spread * spread).sum() > 2 * size * len(one) * WIDE_MM**2:
        found.append(best_turn(np.einsum("ni,nj->ij", other, one)))
    for turn in found:
        places = there_mm - turned(turn, here_mm)
        yield float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))), turn


def _pairs(stamps_ns: Ints, others_ns: Ints) -> tuple[Ints, Ints]:
    """Return the indices of samples that belong together: each with the nearest of the others, if near enough."""
    if np.array_equal(stamps_ns, others_ns):  # columns of one table
        every = np.arange(len(stamps_ns))
        return every, every
    nearer = nearest(others_ns, stamps_ns)
    near = np.flatnonzero(np.abs(others_ns[nearer] - stamps_ns) <= PAIR_NS)
    return near, nearer[near]


ARMS_LIMIT, MOTIONS_LIMIT = 16, 200  # ours: a da Vinci has three PSMs; every pair of arms and of motions is compared

Format = Literal["mcap", "csv", "jigsaws", "rosbag2", "rosbag1", "lerobot"]
Integrity = Literal["full", "partial", "none"]


@dataclass(frozen=True)
class Label:
    """A named interval, both ends included, in the recording's own nanoseconds.

    `kind` is "stage" (of a session, from a recorder's tags), "gesture" (of JIGSAWS, such as "G6") or "primitive" (a
    motion primitive of COMPASS, such as "Grasp(L, Needle)").
    """

    name: str
    kind: Literal["stage", "gesture", "primitive"]
    start_ns: int
    end_ns: int


@schema
@dataclass(frozen=True)
class Topic:
    """One topic of a file: its name, its message type and its number of messages."""

    name: str
    type: str
    messages: Count


@schema
@dataclass(frozen=True)
class Column:
    """A column of a table, and what it was read as.

    Attributes:
        name: Its name in the header.
        quantity: Such as "x", "q3" or "PSM1 qw"; "" for a column that is not used.
        unit: Its unit; "" where it has none.
    """

    name: str
    quantity: str
    unit: str


@dataclass(frozen=True, eq=False)
class Recording:
    """The content of one file, as far as this package uses it.

    Attributes:
        format: The format of the file.
        integrity: Whether checksums cover every pose ("full"), some ("partial") or none ("none").
        motions: One per pose topic of a PSM, at least one.
        jaws: Arm and its jaw's angle in rad.
        clutch: The console's clutch pedal.
        topics: All topics of the file, used or not.
        joints: Measured joints of PSMs and MTMs.
        masters: Motions of the tips of MTMs; nothing is learnt from them.
        grippers: MTM and its gripper's angle in rad.
        pedals: Topic and state of every pedal, the clutch included: 0 released, 1 pressed, 2 a quick tap.
        following: Teleoperation, such as "MTMR_PSM1", and whether it drove its PSM: 0 or 1.
        scales: Teleoperation and its motion scale.
        tools: Arm and its instrument as the console names it, such as "LARGE_NEEDLE_DRIVER:400006".
        labels: Named intervals, in order of time.
        notes: Metadata of the file, name and value, such as the digest of the file that it was made from.
        left_out: Topics that were not usable, and the fault of each; no demonstration depends on any of them.
        columns: The columns of a table.
        setpoints: Commanded poses of the tips of PSMs; nothing is learnt from them, and none is a motion.
        jaw_setpoints: Arm and the commanded angle of its jaw in rad.
    """

    format: Format
    integrity: Integrity
    motions: tuple[Motion, ...]
    jaws: tuple[tuple[str, Signal], ...] = ()
    clutch: Signal | None = None
    topics: tuple[Topic, ...] = ()
    joints: tuple[Joints, ...] = ()
    masters: tuple[Motion, ...] = ()
    grippers: tuple[tuple[str, Signal], ...] = ()
    pedals: tuple[tuple[str, Signal], ...] = ()
    following: tuple[tuple[str, Signal], ...] = ()
    scales: tuple[tuple[str, Signal], ...] = ()
    tools: tuple[tuple[str, str], ...] = ()
    labels: tuple[Label, ...] = ()
    notes: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    columns: tuple[Column, ...] = ()
    setpoints: tuple[Motion, ...] = ()
    jaw_setpoints: tuple[tuple[str, Signal], ...] = ()

    def __post_init__(self) -> None:
        if not self.motions:
            raise NoUsableTopic(f"No topic has the pose of a PSM.{_listed(self.topics)}")
        if len(self.motions) > MOTIONS_LIMIT or len(self.arms) > ARMS_LIMIT:
            raise UnreadableRecording(
                f"The recording has {len(self.motions)} motions of {len(self.arms)} arms; at most {MOTIONS_LIMIT} of "
                f"{ARMS_LIMIT} are read. Keep the topics of the arms that hand the needle over.",
                motions=len(self.motions),
                arms=len(self.arms),
            )

    @property
    def is_timed(self) -> bool:
        """Whether the file itself has times: a table may have none."""
        return not self.columns or any(column.quantity == "t" for column in self.columns)

    @property
    def origin_ns(self) -> int:
        """The earliest stamp of the motions: second 0 of every segment."""
        return min(int(motion.stamps_ns[0]) for motion in self.motions)

    @property
    def duration_s(self) -> float:
        """Time from the earliest stamp of the motions to the latest."""
        return (max(int(motion.stamps_ns[-1]) for motion in self.motions) - self.origin_ns) / 1e9

    @cached_property
    def bases(self) -> tuple[BaseFrame, ...]:
        """The poses of the arms' bases, see `base_frames`; computed once."""
        paired = paired_bases(self.motions)
        known = {(base.arm, base.frame) for base in paired}
        shown = shown_bases(self.identifications, self.motions)
        return *paired, *(base for base in shown if (base.arm, base.frame) not in known)

    @cached_property
    def identifications(self) -> tuple[ArmIdentification, ...]:
        """The arms and instruments that joints and poses show together; computed once."""
        return tuple(identified_arms(self.motions, self.joints, dict(self.tools), timed=self.is_timed))

    def identification_of(self, motion: Motion) -> Identification | None:
        """Return what the joints show of a motion; None if they were not recorded beside it."""
        return next((one.found for one in self.identifications if one.is_of(motion.arm, motion.topic)), None)

    def base_under(self, motion: Motion) -> BaseFrame | None:
        """Return the base of a motion's arm in the frame of the motion, if joints show it and it is another frame."""
        found = self.identification_of(motion)
        if motion.states_base or found is None or found.verdict != "identified":
            return None
        shown = shown_bases(self.identifications, self.motions)
        return next((base for base in shown if base.is_of(motion)), None)

    def instrument_on(self, arm: str) -> str | None:
        """Return the instrument of an arm: the one that its joints show, or else the one that the recording states.

        Returns:
            Its number in the dVRK's files, such as "400006", of which constants may not be known; None if it is neither
            shown nor stated.
        """
        shown = [one.found for one in self.identifications if one.arm == arm and one.found.verdict == "identified"]
        if shown:
            return min(shown, key=lambda found: found.residual_mm).instrument
        return stated_instrument(dict(self.tools).get(arm, ""))

    @property
    def arms(self) -> tuple[str, ...]:
        """The names of the arms that have a motion, sorted."""
        return tuple(sorted({motion.arm for motion in self.motions}))

    def jaw_of(self, arm: str) -> Signal | None:
        """Return the jaw signal of an arm, or None if it was not recorded."""
        return dict(self.jaws).get(arm)

    def setpoint_of(self, motion: Motion) -> Motion | None:
        """Return the setpoints of a motion: of the same arm in the same frame; None if there are none.

        Poses of one arm in its base and in another frame may name the same frame, so what their topics say of it must
        be the same too.
        """
        place = motion.arm, motion.frame, motion.states_base
        return next((one for one in self.setpoints if (one.arm, one.frame, one.states_base) == place), None)

    def jaw_setpoint_of(self, arm: str) -> Signal | None:
        """Return the setpoints of an arm's jaw, or None if they were not recorded."""
        return dict(self.jaw_setpoints).get(arm)

    def motion_of(self, *, arm: str | None = None, topic: str | None = None) -> Motion:
        """Choose a motion by its topic, or else the arm's `local/measured_cp`, then `measured_cp`, then any other.

        Raises:
            NoUsableTopic: There is no such arm or topic, or there are several arms and none is named.
        """
        fitting = [m for m in self.motions if arm in (None, m.arm) and topic in (None, m.topic)]
        if not fitting:
            here = ", ".join(f"{m.topic} of {m.arm}" for m in self.motions)
            asked = " and ".join(x for x in (arm and f"arm {arm}", topic and f"topic {topic}") if x)
            near = did_you_mean(arm, self.arms) if arm is not None and arm not in self.arms else []
            near = near or did_you_mean(topic or "", [m.topic for m in self.motions])
            raise NoUsableTopic(
                f"The recording has no pose for {asked}. It has poses for {here}.", *near, arm=arm, topic=topic
            )
        arms = sorted({m.arm for m in fitting})
        if len(arms) > 1:
            raise NoUsableTopic(f"The recording has several arms: {', '.join(arms)}. Name one.", arms=arms)
        return min(fitting, key=preference)

    def seconds(self, stamps_ns: Ints) -> Floats:
        """Convert stamps to seconds since `origin_ns`; integers are subtracted first, so that no nanosecond is lost."""
        return (stamps_ns - self.origin_ns) / 1e9


def base_frames(recording: Recording) -> tuple[BaseFrame, ...]:
    """Return the poses of the bases of arms in other frames, in mm.

    They are found from poses of an arm in both frames (`paired_bases`), and otherwise from its joints (`shown_bases`).

    Args:
        recording: The recording; they are computed once for each.
    """
    return recording.bases


def preference(motion: Motion) -> tuple[int, str]:
    """Prefer the pose relative to the arm's own remote centre: camera and set-up joints do not move it.

    Args:
        motion: The poses of one topic.

    Returns:
        A key to sort by, the preferred one first: rank of the topic, and its name.
    """
    known = [f"/{motion.arm}/local/measured_cp", f"/{motion.arm}/measured_cp"]
    rank = known.index(motion.topic) if motion.topic in known else len(known)
    return (0 if motion.topic.endswith("/position_cartesian_local_current") else rank, motion.topic)


def _listed(topics: tuple[Topic, ...]) -> str:
    """Return a sentence with the first 20 topics; nothing if there are none."""
    if not topics:
        return ""
    return " It has " + ", ".join(f"{topic.name} ({topic.type})" for topic in topics[:20]) + "."
