"""The replay bag for a robot or a simulator: a folder for each arm, with every sample of a plan's trajectory.

    Trajectory --arms_of--> ArmMotion --folder_of--> PSM1/metadata.yaml, PSM1/PSM1.mcap --seal--> one zip

Each arm has three topics, with one message on each of them for every sample, stamped with the sample's time:

    /PSMn/setpoint_js        six joint positions and velocities: rad, the insertion in m; independent of frames
    /PSMn/setpoint_cp        the tip in the base frame of the arm itself, m
    /PSMn/jaw/setpoint_js    the jaw's angle, rad

So `dvrk_bag_replay.py` of dvrk_python replays them unchanged. It reads a topic in the order of the bag, drops a message
whose stamp is not later than the one before it (for the first message, than 0), and pairs the messages of the arm and
the jaw. Here stamps equal the log times, begin at `EPOCH_NS` and strictly increase, and both topics have equally many.

Lengths here are metres, as in every bag. The same trajectory gives the same bytes.
"""

import hashlib
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel

from skills.arrays import Floats, Ints
from skills.errors import BadPlan
from skills.formats import bag_writer
from skills.formats.archive import pack
from skills.formats.bag_writer import Message, bag_folder
from skills.formats.checksums import SUMS, write_sums
from skills.formats.columns import in_metres
from skills.kinematics import JOINTS, forward, instrument_of, quaternion_of
from skills.planning.handoff import JAW_CLOSED_RAD, JAW_OPEN_RAD
from skills.planning.motion_laws import A2, PHASES, TRANSFER
from skills.planning.trajectory import Trajectory

CRTK_ARMS = ("PSM1", "PSM2", "PSM3")  # the names that `dvrk_bag_replay.py -a` accepts
EPOCH_NS = 1_000_000_000  # ours: a stamp of 0 is "invalid" to CRTK, and a plan has no date
PAUSE_TICKS = 1.5  # stamps further apart than this many sample periods are a pause between passes

Role = Literal["PSM_A", "PSM_M"]


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """The setpoints of one arm, in metres.

    Attributes:
        name: Its name on the robot, one of `CRTK_ARMS`.
        role: PSM_A hands the needle over, PSM_M takes it.
        instrument: Number of its instrument.
        frame: The name of its base frame, in which `tip_m` is.
        rate_hz: Samples per second within a pass.
        stamps_ns: Shape (T,), strictly increasing, above 0.
        joints: Columns of `kinematics.JOINTS`, rad and m, shape (T, 6).
        tip_m: Position of the tip, shape (T, 3).
        rotation_xyzw: Rotation of the jaw, shape (T, 4).
        jaw_rad: Angle of the jaw, shape (T,).
        pass_index: Index of the plan's pass that this is, from 0; None: all passes.
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
    pass_index: int | None

    @property
    def topics(self) -> tuple[str, str, str]:
        """The topics of its joints, its tip and its jaw."""
        return f"/{self.name}/setpoint_js", f"/{self.name}/setpoint_cp", f"/{self.name}/jaw/setpoint_js"

    @property
    def extent_mm(self) -> Floats:
        """The bounding box of its tip, lowest and highest corner, shape (2, 3), as the robot's own script prints it."""
        return 1000.0 * np.stack([self.tip_m.min(axis=0), self.tip_m.max(axis=0)])


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
    pass_index: int | None = None,
) -> tuple[ArmMotion, ...]:
    """Return the setpoints of each arm of a trajectory: PSM_A, and PSM_M if its pose is known.

    Args:
        trajectory: The one that was played in the simulator.
        arm: The plan's arm, see `arm_names`.
        frame: The plan's frame.
        other: The arm that took the needle in the demonstration.
        jaw_rad: The angle of PSM_A's jaw, if the trajectory has none.
        pass_index: A single pass, counted from 0 as in reports; its samples keep their stamps. None: all passes.

    Raises:
        BadPlan: There is no such pass.
    """
    rows = rows_of_pass(trajectory, pass_index)
    stamps_ns = EPOCH_NS + np.rint(trajectory.stamps_s[rows] * 1e9).astype(np.int64)
    names = arm_names(arm, other)
    psm_a = ArmMotion(
        name=names[0],
        role="PSM_A",
        instrument=trajectory.instrument,
        frame=frame,
        rate_hz=trajectory.rate_hz,
        stamps_ns=stamps_ns,
        joints=in_metres(trajectory.joints[rows]),
        tip_m=trajectory.tip_mm[rows] / 1000.0,
        rotation_xyzw=trajectory.rotation_xyzw[rows],
        jaw_rad=np.full(len(rows), jaw_rad) if trajectory.jaw_rad is None else trajectory.jaw_rad[rows],
        pass_index=pass_index,
    )
    psm_m = trajectory.psm_m
    if psm_m is None:
        return (psm_a,)
    tip_mm, rotation = forward(psm_m.joints[rows], psm_m.instrument)
    return psm_a, ArmMotion(
        name=names[1],
        role="PSM_M",
        instrument=psm_m.instrument,
        frame=f"{names[1]}_base",
        rate_hz=trajectory.rate_hz,
        stamps_ns=stamps_ns,
        joints=in_metres(psm_m.joints[rows]),
        tip_m=tip_mm / 1000.0,
        rotation_xyzw=quaternion_of(rotation),
        jaw_rad=np.full(len(rows), JAW_OPEN_RAD) if psm_m.jaw_rad is None else psm_m.jaw_rad[rows],
        pass_index=pass_index,
    )


def rows_of_pass(trajectory: Trajectory, pass_index: int | None) -> Ints:
    """Return the indices of the samples of one pass, or of all samples.

    Raises:
        BadPlan: There is no such pass.
    """
    if pass_index is None:
        return np.arange(len(trajectory))
    if not 0 <= pass_index < trajectory.passes:
        raise BadPlan(f"The plan's passes are 0 to {trajectory.passes - 1}.", **{"pass": pass_index})
    return np.flatnonzero(trajectory.pass_index == pass_index)


def velocities_of(stamps_ns: Ints, joints: Floats, rate_hz: float) -> Floats:
    """Return joint velocities, shape (T, N): central differences, and 0 at both ends of every stretch without a pause.

    At those ends the arm is at rest, and a controller may continue with the last commanded velocity until it receives
    the next setpoint.

    Args:
        stamps_ns: Shape (T,).
        joints: Shape (T, N).
        rate_hz: Samples per second without pauses; steps longer than `PAUSE_TICKS` samples are pauses.
    """
    velocities = np.zeros_like(joints)
    goes_on = np.diff(stamps_ns) <= PAUSE_TICKS * 1e9 / rate_hz
    within = (goes_on[:-1] & goes_on[1:])[:, None]
    seconds = (stamps_ns[2:] - stamps_ns[:-2])[:, None] / 1e9
    velocities[1:-1] = np.where(within, (joints[2:] - joints[:-2]) / seconds, 0.0)
    return velocities


def messages_of(motion: ArmMotion) -> Iterator[Message]:
    """Yield an arm's messages: for each sample the joints, the tip and the jaw."""
    on_joints, on_tip, on_jaw = motion.topics
    velocities = velocities_of(motion.stamps_ns, motion.joints, motion.rate_hz)
    jaws = motion.jaw_rad[:, None]
    turning = velocities_of(motion.stamps_ns, jaws, motion.rate_hz)
    columns = (motion.stamps_ns, motion.joints, velocities, motion.tip_m, motion.rotation_xyzw, jaws, turning)
    for stamp_ns, joints, speeds, tip_m, turn, jaw, rate in zip(*(one.tolist() for one in columns), strict=True):
        yield bag_writer.joint_state(on_joints, stamp_ns, joints, JOINTS, velocities=speeds)
        yield bag_writer.pose(on_tip, stamp_ns, motion.frame, tip_m, turn)
        yield bag_writer.joint_state(on_jaw, stamp_ns, jaw, ["jaw"], velocities=rate)


def folder_of(motion: ArmMotion, plan_sha256: str) -> dict[str, bytes]:
    """Return the files of an arm's bag folder; the MCAP file has `notes_of` as metadata."""
    return bag_folder(messages_of(motion), motion.name, notes_of(motion, plan_sha256))


def notes_of(motion: ArmMotion, plan_sha256: str) -> dict[str, str]:
    """Return the notes in an arm's file: its plan, and the parameters that are needed to verify it."""
    return {
        "plan": plan_sha256,
        "pass": "all" if motion.pass_index is None else str(motion.pass_index),
        "role": motion.role,
        "instrument": motion.instrument,
        "rate_hz": repr(motion.rate_hz),
        "use": "research use only",
    }


class PhaseTimes(BaseModel):
    """A phase of a pass: its first and its last stamp."""

    phase: str
    from_ns: int
    to_ns: int


class JawMove(BaseModel):
    """The motion of one arm's jaw: its last angle, and the stamps between which it moves."""

    arm: str
    jaw_rad: float
    from_ns: int
    to_ns: int


class HandOver(BaseModel):
    """The needle's change from one arm to the other: the stamp at which the arms stand, and the jaws in their order."""

    at_ns: int
    jaws_in_order: list[JawMove]


class PassTimes(BaseModel):
    """A pass on the clock of the setpoints.

    PSM_M takes the needle in `hand_over`, at the end of A2. PSM_A has it again after `take_back`, at the end of a
    transfer; before its `at_ns` the surgeon inserts the needle and takes it (M1, M2). None where the jaws do not move.
    """

    index: int
    phases: list[PhaseTimes]
    hand_over: HandOver | None
    take_back: HandOver | None = None


class ExecutorTimetable(BaseModel):
    """The passes of a bag on the one clock of its setpoints, for a program or a person that executes it.

    Attributes:
        plan: The SHA-256 of the plan.
        use: The limits of its use.
        before_each_pass: Instructions to the person.
        passes: The passes.
    """

    plan: str
    use: str = ""
    before_each_pass: str = ""
    passes: list[PassTimes]


def pass_times(trajectory: Trajectory, arms: tuple[ArmMotion, ...]) -> list[PassTimes]:
    """Return the times of each pass of a bag.

    Args:
        trajectory: The one that the bag is made of.
        arms: The result of `arms_of` for it.
    """
    rows = rows_of_pass(trajectory, arms[0].pass_index)
    stamps_ns, number, phase = arms[0].stamps_ns, trajectory.pass_index[rows], trajectory.phase[rows]
    found = []
    for one in np.unique(number).tolist():
        parts = [(name, stamps_ns[(number == one) & (phase == k)].tolist()) for k, name in enumerate(PHASES)]
        transfer = np.flatnonzero((number == one) & (phase == TRANSFER))
        found.append(
            PassTimes(
                index=one,
                phases=[PhaseTimes(phase=name, from_ns=ns[0], to_ns=ns[-1]) for name, ns in parts if ns],
                hand_over=_hand_over(arms, np.flatnonzero((number == one) & (phase == A2))),
                # with the sample after them, where the jaws' motion ends
                take_back=_hand_over(arms, np.append(transfer, transfer[-1:] + 1)),
            )
        )
    return found


def _hand_over(arms: tuple[ArmMotion, ...], rows: Ints) -> HandOver | None:
    """Return when each jaw moves in some samples of a bag; None unless both do."""
    moves = []
    for arm in arms:
        steps = np.flatnonzero(np.diff(arm.jaw_rad[rows]) != 0)
        if len(steps):
            first, last = rows[steps[0]], rows[steps[-1] + 1]
            from_ns, to_ns = arm.stamps_ns[[first, last]].tolist()
            moves.append(JawMove(arm=arm.name, jaw_rad=float(arm.jaw_rad[last]), from_ns=from_ns, to_ns=to_ns))
    if len(moves) < 2:
        return None
    moves.sort(key=lambda move: (move.from_ns, move.to_ns, move.arm))
    return HandOver(at_ns=moves[0].from_ns, jaws_in_order=moves)


def seal(members: Mapping[str, bytes]) -> bytes:
    """Return a zip archive of files by name, with their checksums."""
    sums = write_sums({name: hashlib.sha256(data).hexdigest() for name, data in members.items()})
    out = io.BytesIO()
    pack({name: io.BytesIO(data) for name, data in sorted({**members, SUMS: sums}.items())}, out)
    return out.getvalue()
