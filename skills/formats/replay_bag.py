"""The replay bag for a robot or a simulator: for each automatic segment of a plan a bag folder of each arm that moves.

    Trajectory --arms_of--> ArmMotion --segment_motions, folder_of--> 000-A1/PSM1/PSM1.mcap ...
                                      --segment_index--> what comes when, who moves, and what must be true before
    files --seal--> one zip

Each arm has three topics, with one message on each of them for every sample, stamped with the sample's time:

    /PSMn/setpoint_js        six joint positions and velocities: rad, the insertion in m; independent of frames
    /PSMn/setpoint_cp        the tip in the base frame of the arm itself, m
    /PSMn/jaw/setpoint_js    the jaw's angle, rad

So `dvrk_bag_replay.py` of dvrk_python replays each folder unchanged. It reads a topic in the order of the bag, drops a
message whose stamp is not later than the one before it (for the first message, than 0), and pairs the messages of the
arm and the jaw; it cannot wait, so where somebody may wait a folder ends. Here stamps equal the log times, begin at
`EPOCH_NS`, strictly increase, are on one clock in all folders, and both topics have equally many.

Lengths in the folders are metres, as in every bag. The same trajectory gives the same bytes.
"""

import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skills.arrays import Floats, Ints
from skills.formats import bag_writer
from skills.formats.archive import pack
from skills.formats.bag_writer import Message, bag_folder
from skills.formats.checksums import SUMS, write_sums
from skills.formats.columns import in_metres
from skills.kinematics import JAW_TIP_MM, JOINTS, forward, instrument_of, quaternion_of
from skills.planning.automatic_segments import AutomaticSegment, segments_of
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD
from skills.planning.trajectory import Trajectory
from skills.schemas.plans import ArmStart, PlanSegment, Role, SegmentIndex
from skills.verification.gates import Limits

CRTK_ARMS = ("PSM1", "PSM2", "PSM3")  # the names that `dvrk_bag_replay.py -a` accepts
EPOCH_NS = 1_000_000_000  # ours: a stamp of 0 is "invalid" to CRTK, and a plan has no date
# An arm that begins so far off touches nothing that the verdict found clear; both angles move a jaw's tip so far.
START_MM = Limits().clearance_psm_m_mm
START_RAD = START_MM / JAW_TIP_MM


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """The setpoints of one arm, in metres.

    Attributes:
        name: Its name on the robot, one of `CRTK_ARMS`.
        role: PSM_A hands the needle over, PSM_M takes it.
        instrument: Number of its instrument.
        frame: The name of its base frame, in which `tip_m` is.
        rate_hz: Samples per second.
        stamps_ns: Shape (T,), strictly increasing, above 0.
        joints: Columns of `kinematics.JOINTS`, rad and m, shape (T, 6).
        tip_m: Position of the tip, shape (T, 3).
        rotation_xyzw: Rotation of the jaw, shape (T, 4).
        jaw_rad: Angle of the jaw, shape (T,).
        segment: The name of the segment that this is; "" for the whole motion.
    """

    name: str
    role: Role
    instrument: str
    frame: str
    rate_hz: float
    stamps_ns: Ints
    joints: Floats
    tip_m: Floats
    rotation_xyzw: Floats
    jaw_rad: Floats
    segment: str = ""

    @property
    def topics(self) -> tuple[str, str, str]:
        """The topics of its joints, its tip and its jaw."""
        return f"/{self.name}/setpoint_js", f"/{self.name}/setpoint_cp", f"/{self.name}/jaw/setpoint_js"

    @property
    def place(self) -> str:
        """Its folder in the bag, or its name for the whole motion."""
        return f"{self.segment}/{self.name}" if self.segment else self.name

    @property
    def moves(self) -> bool:
        """Whether a joint or the jaw moves."""
        return bool((self.joints != self.joints[0]).any() or (self.jaw_rad != self.jaw_rad[0]).any())

    def part(self, samples: slice, segment: str) -> "ArmMotion":
        """Return some of its samples, as a segment."""
        return replace(
            self,
            segment=segment,
            stamps_ns=self.stamps_ns[samples],
            joints=self.joints[samples],
            tip_m=self.tip_m[samples],
            rotation_xyzw=self.rotation_xyzw[samples],
            jaw_rad=self.jaw_rad[samples],
        )

    def start(self, sample: int, *, moves: bool) -> ArmStart:
        """Return where it stands in a sample, before a segment in which it moves or not."""
        return ArmStart(
            arm=self.name,
            role=self.role,
            moves=moves,
            frame=self.frame,
            position_mm=(1000.0 * self.tip_m[sample]).tolist(),
            rotation_xyzw=self.rotation_xyzw[sample].tolist(),
            jaw_rad=float(self.jaw_rad[sample]),
        )

    @property
    def box(self) -> list[tuple[str, float, float]]:
        """The lowest and the highest coordinate of its tip along each axis, in mm, as the robot's own script has it."""
        low, high = (1000.0 * ends for ends in (self.tip_m.min(axis=0), self.tip_m.max(axis=0)))
        return list(zip("XYZ", low.tolist(), high.tolist(), strict=True))


def joined(parts: Sequence[ArmMotion]) -> ArmMotion:
    """Return parts of an arm's motion as one."""
    return replace(
        parts[0],
        segment="",
        stamps_ns=np.concatenate([part.stamps_ns for part in parts]),
        joints=np.concatenate([part.joints for part in parts]),
        tip_m=np.concatenate([part.tip_m for part in parts]),
        rotation_xyzw=np.concatenate([part.rotation_xyzw for part in parts]),
        jaw_rad=np.concatenate([part.jaw_rad for part in parts]),
    )


def arm_names(arm: str, other: str | None = None) -> tuple[str, str]:
    """Return the names of PSM_A and PSM_M on the robot.

    Args:
        arm: The plan's arm, such as "PSM2"; for another name, such as "PSM" from a recording that does not name its
            arm, PSM1 is used.
        other: The arm that took the needle in the demonstration; None, or not a possible one: the first other arm is
            used.
    """
    mine = arm.upper() if arm.upper() in CRTK_ARMS else CRTK_ARMS[0]
    others = [name for name in CRTK_ARMS if name != mine]
    return mine, other.upper() if other is not None and other.upper() in others else others[0]


def held_jaw_rad(demonstrated: Floats | None, instrument: str) -> float:
    """Return the jaw angle at which PSM_A holds the needle: the median of the demonstrated angles, or closed.

    A median outside the range of the instrument's jaw (JIGSAWS has another zero) is not used.

    Args:
        demonstrated: Angles in rad, shape (T,); None where there are none.
        instrument: Number of the instrument.
    """
    if demonstrated is None:
        return JAW_CLOSED_RAD
    low, high = instrument_of(instrument).jaw_rad
    angle = float(np.median(demonstrated))
    return angle if low <= angle <= high else JAW_CLOSED_RAD


def arms_of(
    trajectory: Trajectory,
    *,
    arm: str,
    frame: str,
    other: str | None = None,
    jaw_rad: float = JAW_CLOSED_RAD,
) -> tuple[ArmMotion, ...]:
    """Return the setpoints of each arm of a trajectory: PSM_A, and PSM_M if its pose is known.

    Args:
        trajectory: The one that was played in the simulator.
        arm: The plan's arm, see `arm_names`.
        frame: The plan's frame.
        other: The arm that took the needle in the demonstration.
        jaw_rad: The angle of PSM_A's jaw, if the trajectory has none.
    """
    stamps_ns = EPOCH_NS + np.rint(trajectory.stamps_s * 1e9).astype(np.int64)
    names = arm_names(arm, other)
    psm_a = ArmMotion(
        name=names[0],
        role="PSM_A",
        instrument=trajectory.instrument,
        frame=frame,
        rate_hz=trajectory.rate_hz,
        stamps_ns=stamps_ns,
        joints=in_metres(trajectory.joints),
        tip_m=trajectory.tip_mm / 1000.0,
        rotation_xyzw=trajectory.rotation_xyzw,
        jaw_rad=np.full(len(trajectory), jaw_rad) if trajectory.jaw_rad is None else trajectory.jaw_rad,
    )
    psm_m = trajectory.psm_m
    if psm_m is None:
        return (psm_a,)
    tip_mm, rotation = forward(psm_m.joints, psm_m.instrument)
    return psm_a, ArmMotion(
        name=names[1],
        role="PSM_M",
        instrument=psm_m.instrument,
        frame=f"{names[1]}_base",
        rate_hz=trajectory.rate_hz,
        stamps_ns=stamps_ns,
        joints=in_metres(psm_m.joints),
        tip_m=tip_mm / 1000.0,
        rotation_xyzw=quaternion_of(rotation),
        jaw_rad=np.full(len(trajectory), JAW_OPEN_RAD) if psm_m.jaw_rad is None else psm_m.jaw_rad,
    )


def velocities_of(stamps_ns: Ints, joints: Floats) -> Floats:
    """Return joint velocities, shape (T, N): central differences, and 0 at both ends of a segment.

    There the arm is at rest, and a controller may continue with the last commanded velocity until it receives the next
    setpoint.

    Args:
        stamps_ns: Of one segment, shape (T,).
        joints: Shape (T, N).
    """
    velocities = np.zeros_like(joints)
    velocities[1:-1] = (joints[2:] - joints[:-2]) / ((stamps_ns[2:] - stamps_ns[:-2])[:, None] / 1e9)
    return velocities


def messages_of(motion: ArmMotion) -> Iterator[Message]:
    """Yield an arm's messages: for each sample the joints, the tip and the jaw."""
    on_joints, on_tip, on_jaw = motion.topics
    velocities = velocities_of(motion.stamps_ns, motion.joints)
    jaws = motion.jaw_rad[:, None]
    turning = velocities_of(motion.stamps_ns, jaws)
    columns = (motion.stamps_ns, motion.joints, velocities, motion.tip_m, motion.rotation_xyzw, jaws, turning)
    for stamp_ns, joints, speeds, tip_m, turn, jaw, rate in zip(*(one.tolist() for one in columns), strict=True):
        yield bag_writer.joint_state(on_joints, stamp_ns, joints, JOINTS, velocities=speeds)
        yield bag_writer.pose(on_tip, stamp_ns, motion.frame, tip_m, turn)
        yield bag_writer.joint_state(on_jaw, stamp_ns, jaw, ["jaw"], velocities=rate)


def folder_of(motion: ArmMotion, plan_sha256: str) -> dict[str, bytes]:
    """Return the files of an arm's bag folder in a segment; the MCAP file has `notes_of` as metadata."""
    made = bag_folder(messages_of(motion), motion.name, notes_of(motion, plan_sha256))
    return {f"{motion.segment}/{name}": data for name, data in made.items()}


def segment_motions(
    trajectory: Trajectory, arms: Sequence[ArmMotion]
) -> list[tuple[AutomaticSegment, list[ArmMotion]]]:
    """Return each segment with what each arm does in it."""
    return [
        (one, [arm.part(one.samples, f"{number:03d}-{one.kind}") for arm in arms])
        for number, one in enumerate(segments_of(trajectory))
    ]


def segment_index(segments: Sequence[tuple[AutomaticSegment, list[ArmMotion]]], plan_sha256: str) -> SegmentIndex:
    """Return what comes when, who moves, and what must be true before each segment.

    Args:
        segments: The result of `segment_motions`.
        plan_sha256: The digest of the plan.
    """
    return SegmentIndex(
        plan=plan_sha256,
        position_tolerance_mm=START_MM,
        rotation_tolerance_rad=START_RAD,
        jaw_tolerance_rad=START_RAD,
        segments=[
            PlanSegment(
                name=parts[0].segment,
                kind=one.kind,
                pass_index=one.pass_index,
                from_ns=int(parts[0].stamps_ns[0]),
                to_ns=int(parts[0].stamps_ns[-1]),
                by_hand=list(one.by_hand),
                teleoperated=[part.name for part in parts] if one.by_hand else [],
                needle_held_by=held_by(one.kind, len(parts)),
                arms=[part.start(0, moves=part.moves) for part in parts],
            )
            for one, parts in segments
        ],
    )


def held_by(kind: str, arms: int) -> Role | None:
    """Return the arm that holds the needle before a segment; None if it is not planned."""
    return "PSM_A" if kind != "transfer" else "PSM_M" if arms > 1 else None


def notes_of(motion: ArmMotion, plan_sha256: str) -> dict[str, str]:
    """Return the notes in an arm's file: its plan, and the parameters that are needed to verify it."""
    return {
        "plan": plan_sha256,
        "segment": motion.segment,
        "role": motion.role,
        "instrument": motion.instrument,
        "rate_hz": repr(motion.rate_hz),
        "use": "research use only",
    }


def seal(members: Mapping[str, bytes]) -> bytes:
    """Return a zip archive of files by name, with their checksums."""
    sums = write_sums({name: hashlib.sha256(data).hexdigest() for name, data in members.items()})
    out = io.BytesIO()
    pack({name: io.BytesIO(data) for name, data in sorted({**members, SUMS: sums}.items())}, out)
    return out.getvalue()
