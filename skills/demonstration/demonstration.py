"""Demonstrations: one hand-off of one arm, cut out of a recording.

    Recording --cut_demo--> Demo

The paper (Sec. III-A) learns from one segment: the hand-off of the needle, from the moment the arm moves off with it
(A1) to the moment the other arm takes it (A2). `propose_segments` finds such segments; the surgeon decides. The times
of a segment count from the recording's `origin_ns`; a demonstration's own `stamps_s` count from its first sample.

Samples in which the arm was not driven, because the clutch was down or teleoperation did not follow, were not
demonstrated and are left out. The gaps in time stay open: the stamps remain those of the recording, and `pauses` lists
the intervals without samples, so that rates are computed correctly and a lost sample is not mistaken for a pause. The
thresholds are ours: the paper cut by hand.
"""

from dataclasses import dataclass

import numpy as np

from skills.arrays import Floats, freeze
from skills.demonstration.movement import Pause, clutched, is_driven, undriven
from skills.demonstration.partner import Partner, PartnerMotion, in_base, partner_along, partner_at
from skills.demonstration.plausible import check_steps
from skills.demonstration.recording import BaseFrame, Motion, Recording, base_frames
from skills.errors import BadSegment, JointsDisagree, NotMetres
from skills.kinematics import DEFAULT_INSTRUMENT
from skills.notebook import card

EXTENT_LIMITS_MM = (1.0, 300.0)  # less: metres declared as millimetres; more: beyond a PSM's reach
PAUSES_LIMIT = 200  # ours: no hand-off has so many, and the motion between two of them is measured separately
EDGE_NS = 1000  # tolerance at the recording's ends, for times in seconds that were rounded


@dataclass(frozen=True, eq=False)
class Demo:
    """One demonstrated hand-off of one arm.

    Attributes:
        arm: The arm's name, such as "PSM2".
        topic: The topic that the motion was recorded on.
        frame: The frame of `tip_mm` and `rotation_xyzw`.
        start_s: Time of the first sample, in seconds since the recording's `origin_ns`.
        end_s: Time of the last sample, in seconds since the recording's `origin_ns`.
        stamps_s: Time of each sample from the first, shape (T,), strictly increasing from 0.
        tip_mm: Positions of the tip in `frame`, shape (T, 3).
        rotation_xyzw: Unit quaternions in `frame`, shape (T, 4); None if not recorded.
        jaw_rad: Angle of the jaw at each stamp, shape (T,): interpolated, and constant beyond the first and last jaw
            sample. None if not recorded.
        clutch_presses: Number of presses of the clutch pedal within the segment; quick taps do not count.
        instrument: The tool's number in the dVRK's files, as joints and poses show it, or as the recording states it;
            "400006-Si" on an arm of the other generation. `DEFAULT_INSTRUMENT` if it is neither shown nor stated.
        pauses: The intervals between the first and the last sample in which the arm was not driven.
        partner: Pose of the other arm as it takes the needle, in `frame`; None if no other arm is near or its pose
            cannot be expressed in `frame`.
    """

    arm: str
    topic: str
    frame: str
    start_s: float
    end_s: float
    stamps_s: Floats
    tip_mm: Floats
    rotation_xyzw: Floats | None = None
    jaw_rad: Floats | None = None
    clutch_presses: int = 0
    instrument: str = DEFAULT_INSTRUMENT
    pauses: tuple[Pause, ...] = ()
    partner: Partner | None = None

    def __post_init__(self) -> None:
        count = len(self.stamps_s)
        if count < 2:
            raise BadSegment(f"A demonstration needs at least 2 samples, this one has {count}.", samples=count)
        freeze(self, stamps_s=(count,), tip_mm=(count, 3), rotation_xyzw=(count, 4), jaw_rad=(count,))
        if self.stamps_s[0] != 0 or (np.diff(self.stamps_s) <= 0).any():
            raise BadSegment("The stamps of a demonstration start at 0 and increase strictly.")
        _check_extent(self.topic, self.tip_mm)

    def _repr_html_(self) -> str:
        also = {"orientation": self.rotation_xyzw is not None, "jaw": self.jaw_rad is not None}
        extent = " x ".join(f"{side:.0f}" for side in np.ptp(self.tip_mm, axis=0))
        facts = {
            "arm": f"{self.arm}, in {self.frame}",
            "in the recording": f"{self.start_s:.2f} to {self.end_s:.2f} s, {len(self.stamps_s)} samples",
            "extent": f"{extent} mm",
            "recorded": ", ".join(["position", *(name for name, there in also.items() if there)]),
            "instrument": self.instrument,
            "not driven": f"{sum(one.end_s - one.start_s for one in self.pauses):.2f} s, {len(self.pauses)} times",
            "takes the needle": None if self.partner is None else self.partner.arm,
        }
        return card("Demonstration", facts, {"recorded": [self.tip_mm]})


def cut_demo(
    recording: Recording,
    *,
    arm: str | None = None,
    topic: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Demo:
    """Cut one arm's motion between two moments out of a recording, both ends included, where the arm was driven.

    Args:
        recording: A recording, as `read_recording` returns it.
        arm: The arm; may be omitted if the recording has one arm.
        topic: The pose topic; by default the arm's `local/measured_cp`, then `measured_cp`, then any other.
        start_s: Seconds since the recording's `origin_ns`; by default the motion's first sample.
        end_s: Seconds since the recording's `origin_ns`; by default the motion's last sample.

    Returns:
        The demonstration: positions in mm, at least 2 samples. They are in the frame of the motion; if the joints show
        where the arm's base stands in that frame, they are in the base.

    Raises:
        NoUsableTopic: There is no such arm or topic, or there are several arms and none is named.
        BadSegment: The segment is not finite, ends before it starts, lies outside the recording, holds fewer than 2
            samples of a driven arm, or has more than 200 pauses in which the arm was not driven.
        NotMetres: The path's extent is below 1 mm or above 300 mm.
        ImplausibleMotion: Between two samples the tip moves further than a PSM can.
        JointsDisagree: The joints recorded beside the poses contradict them, or the stated instrument.
    """
    motion = recording.motion_of(arm=arm, topic=topic)
    _check_joints(recording, motion)
    first_ns, last_ns = _segment_ns(recording, motion, start_s, end_s)
    within = (motion.stamps_ns >= first_ns) & (motion.stamps_ns <= last_ns)
    # before the count: a segment in which only the clutch was down has no demonstrated sample
    inside = within & is_driven(motion.stamps_ns, undriven(recording, motion.arm))
    if inside.sum() < 2:
        left_out = int(within.sum() - inside.sum())
        idle = f", and in {left_out} more the arm was not driven" if left_out else ""
        raise BadSegment(
            f"The segment has {inside.sum()} samples of {motion.topic}{idle}; at least 2 are needed. Widen it.",
            samples=int(inside.sum()),
        )
    stamps_ns = motion.stamps_ns[inside]
    seconds = recording.seconds(stamps_ns)
    bases, base = base_frames(recording), recording.base_under(motion)
    tip_mm = motion.tip_mm[inside]
    rotation_xyzw = None if motion.rotation_xyzw is None else motion.rotation_xyzw[inside]
    check_steps(motion.topic, seconds, tip_mm)
    partner = partner_at(recording, motion, float(seconds[-1]), bases)
    if base is not None:
        tip_mm, rotation_xyzw = _in_base(base, tip_mm, rotation_xyzw)
        partner = None if partner is None else in_base(partner, base, bases)
    return Demo(
        arm=motion.arm,
        topic=motion.topic,
        frame=motion.frame if base is None else base.local_frame,
        start_s=float(seconds[0]),
        end_s=float(seconds[-1]),
        stamps_s=(stamps_ns - stamps_ns[0]) / 1e9,  # integers are subtracted first, so that no nanosecond is lost
        tip_mm=tip_mm,
        rotation_xyzw=rotation_xyzw,
        jaw_rad=_jaw_at(recording, motion.arm, seconds),
        clutch_presses=sum(first_ns <= down_ns <= last_ns for down_ns, _ in clutched(recording)),
        instrument=recording.instrument_on(motion.arm) or DEFAULT_INSTRUMENT,
        pauses=_pauses(recording, motion.arm, int(stamps_ns[0]), int(stamps_ns[-1])),
        partner=partner,
    )


def partner_motion(recording: Recording, demo: Demo) -> PartnerMotion | None:
    """Return the motion of the other arm at each stamp of a demonstration, in the demonstration's frame.

    Args:
        recording: The recording of which the demonstration is a part.
        demo: The demonstration, as `cut_demo` returned it.

    Returns:
        The motion of the arm that takes the needle; None if the demonstration has no `partner`, if the other arm was
        not recorded all along it, or if the demonstration was cut in another frame than it would be today.
    """
    if demo.partner is None:
        return None
    motion = recording.motion_of(arm=demo.arm, topic=demo.topic)
    base = recording.base_under(motion)
    if demo.frame != (motion.frame if base is None else base.local_frame):
        return None
    seconds, bases = demo.start_s + demo.stamps_s, base_frames(recording)
    found = partner_along(recording, motion, seconds, bases, demo.partner.arm)
    if found is None:
        return None
    tip_mm, rotation_xyzw = found.tip_mm, found.rotation_xyzw
    if base is not None:
        tip_mm, rotation_xyzw = base.seen_from(tip_mm, rotation_xyzw)
    return PartnerMotion(found.arm, tip_mm, rotation_xyzw, _jaw_at(recording, found.arm, seconds))


def _check_joints(recording: Recording, motion: Motion) -> None:
    """Refuse poses that the measured joints contradict, or an instrument that they do.

    Poses that are not stated to be in the arm's base are not refused for their place: a camera may have moved.
    """
    found = recording.identification_of(motion)
    if found is None or found.verdict not in ("wrong instrument", "wrong frame", "contradiction"):
        return
    if found.verdict != "wrong instrument" and not motion.states_base:
        return
    remedy = {
        "wrong instrument": "Correct the name of the tool in the recording, or remove it.",
        "wrong frame": "State the frame in which the poses are, or use the arm's local/measured_cp.",
        "contradiction": "Record them again, or remove the joints if they are wrong.",
    }[found.verdict]
    raise JointsDisagree(
        f"{motion.topic}: {found.reason}.",
        remedy,
        topic=motion.topic,
        verdict=found.verdict,
        stated=found.stated,
        candidates=list(found.candidates),
        residual_mm=found.residual_mm,
    )


def _in_base(base: BaseFrame, tip_mm: Floats, rotation_xyzw: Floats | None) -> tuple[Floats, Floats | None]:
    """Transform a motion into its arm's base; its orientation only if it was recorded."""
    known = np.tile([0.0, 0.0, 0.0, 1.0], (len(tip_mm), 1)) if rotation_xyzw is None else rotation_xyzw
    tip, rotation = base.seen_from(tip_mm, known)
    return tip, None if rotation_xyzw is None else rotation


def _pauses(recording: Recording, arm: str, first_ns: int, last_ns: int) -> tuple[Pause, ...]:
    """Return the pauses between two samples, in seconds from the first of them."""
    pauses = tuple(
        Pause((start - first_ns) / 1e9, (end - first_ns) / 1e9, cause)
        for start, end, cause in undriven(recording, arm)
        if first_ns < start and end < last_ns
    )
    if len(pauses) > PAUSES_LIMIT:
        raise BadSegment(
            f"The arm was not driven in {len(pauses)} stretches of the segment, by clutch or because "
            f"teleoperation did not follow; at most {PAUSES_LIMIT} are read. Cut a single hand-off.",
            pauses=len(pauses),
        )
    return pauses


def _segment_ns(recording: Recording, motion: Motion, start_s: float | None, end_s: float | None) -> tuple[int, int]:
    """Return the first and the last moment of a segment, in the recording's own nanoseconds.

    Raises:
        BadSegment: It is not finite, ends before it starts or lies outside the recording, or the motion has one sample.
    """
    for name, value in (("start_s", start_s), ("end_s", end_s)):
        if value is not None and not np.isfinite(value):
            raise BadSegment(f"{name} is {value}; give seconds from the recording's start.")
    if len(motion.stamps_ns) < 2:
        raise BadSegment(f"{motion.topic} has one sample; a demonstration needs two at least.", samples=1)
    whole = recording.seconds(motion.stamps_ns[[0, -1]])
    begin = float(whole[0]) if start_s is None else start_s
    end = float(whole[1]) if end_s is None else end_s
    numbers = {"start_s": begin, "end_s": end, "duration_s": recording.duration_s}
    if end <= begin:
        raise BadSegment(
            f"The segment ends at {end:g} s, before it starts at {begin:g} s.",
            "Give its start before its end.",
            **numbers,
        )
    if begin < -EDGE_NS / 1e9 or end > recording.duration_s + EDGE_NS / 1e9:
        # a thousandth of the largest time would lie in the recording: the caller probably gave milliseconds
        given = [value for value in (start_s, end_s) if value]
        milli = (
            [] if max(given) / 1000 > recording.duration_s else ["Give seconds; these values look like milliseconds."]
        )
        raise BadSegment(
            f"The segment {begin:g} s to {end:g} s is outside the recording, which lasts from 0 s to "
            f"{recording.duration_s:g} s.",
            *milli,
            **numbers,
        )
    return recording.origin_ns + round(begin * 1e9), recording.origin_ns + round(end * 1e9)


def _check_extent(topic: str, tip_mm: Floats) -> None:
    """Refuse positions, (T, 3), whose extent along every axis is below, or along one above, `EXTENT_LIMITS_MM`.

    Raises:
        NotMetres: It is.
    """
    extent_mm = float(np.ptp(tip_mm, axis=0).max())
    least, most = EXTENT_LIMITS_MM
    if least <= extent_mm <= most:
        return
    hint = (
        "the arm stood still, or the unit is not metres"
        if extent_mm < least
        else "no hand-off is so wide, so the unit is not metres or the segment contains more than one"
    )
    raise NotMetres(
        f"{topic}: the path is {extent_mm:g} mm wide; a hand-off is between {least:g} and {most:g} mm: {hint}.",
        extent_mm=extent_mm,
    )


def _jaw_at(recording: Recording, arm: str, seconds: Floats) -> Floats | None:
    """Return the angle of an arm's jaw at some times, shape (T,), in rad; None if none was recorded."""
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0:
        return None
    return np.interp(seconds, recording.seconds(jaw.stamps_ns), jaw.values)
