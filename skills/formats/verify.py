"""Offline verification of a replay bag, from its bytes alone: `skills verify FILE.zip --key KEY`.

    zip --verify_bag--> the checks that passed, one line each; the first failed check raises `BadBag`

The checksums must be complete and correct, the JSON papers must refer to one plan, and each arm's setpoints must be the
ones that `replay_bag` writes: they are read by the walker, which verifies every checksum of an MCAP file, then compared
with the closed-form kinematics and the limits of the instrument, and written again and compared byte for byte. Ranges,
speeds and accelerations of the joints must be those of the verdict.

So a verified bag has the form that this project writes, and the arm can follow it. Whether the robot's frames, tool
and surroundings are those of the plan is not verified: `docs/replay.md`. The checksums detect damage, and not somebody
who computes them again; the signature of the service does, for whoever has its public key (`--key`).
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Any, BinaryIO, TypeVar

import numpy as np
from pydantic import AliasPath, BaseModel, Field, StrictBool, StrictStr, ValidationError

from skills.arrays import Flags, Floats, Ints
from skills.errors import BadBag, Corrupt, UnknownInstrument
from skills.formats import replay_bag
from skills.formats.archive import Archive, shown
from skills.formats.bag_folder import METADATA
from skills.formats.bag_writer import DEFINITIONS, Written, metadata_of
from skills.formats.checksums import SUMS, digest_of, read_sums
from skills.formats.columns import in_mm
from skills.formats.mcap.cdr import WANTED_POSE, Columns, Decoder, Wanted, fields_of
from skills.formats.mcap.reader import Channel, MessageSchema, Walker
from skills.formats.topics import JOINT_STATE, POSE
from skills.kinematics import JOINTS, angle_between, forward, instrument_of, joint_margins, matrix_of
from skills.packing import canonical, sha256
from skills.planning.trajectory import joint_ratios
from skills.schemas.plans import ArmStart, Role, SegmentIndex
from skills.transparency.notes import read_notes
from skills.transparency.signing_keys import PublicKey
from skills.transparency.statements import Statement, read_envelope

PLAN, VERDICT, POLICY, README = "plan.json", "verdict.json", "policy.json", "README.txt"
SEGMENTS = "segments.json"  # what comes when, and what must be true before
PAPERS = (PLAN, VERDICT, POLICY, README, SEGMENTS)
SIGNATURE = "signature.dsse"
SAMPLES_LIMIT = 2_000_000  # per arm: 200 passes of 50 s at 200 Hz
FORM_MM, FORM_RAD = 1e-6, 1e-6  # round-off is 1e-13; a joint that is off by a millionth of its range is found
GOAL_MM = 1e-3  # an exported pass ends within 1e-9 of its path's end
JUDGED_OFF = 1e-6  # rad, mm, or a part of a limit; metres in the bag leave 1e-9
SPEED_RATIO = 1.000001  # a tolerance of 1e-6 for round-off, as in the playback's verdict

_UNTYPED = MessageSchema("", "", b"")
_FOLDER = re.compile(rf"\d{{3}}-[\w-]+/({'|'.join(replay_bag.CRTK_ARMS)})/\1\.mcap", re.ASCII)
Parts = dict[str, tuple[replay_bag.ArmMotion, float]]  # by folder, in order; with the millimetres of `_check_form`
_JOINTS = Wanted(("position", "velocity"))


# ---- the parts of the papers that are checked -------------------------------------------------------------------


class PolicyPaper(BaseModel):
    """The policy that the plan follows."""

    sha256: StrictStr


class PathPaper(BaseModel):
    """A pass: its path in mm, shape (K, 3)."""

    path_mm: Annotated[list[tuple[float, float, float]], Field(min_length=1)]


class OtherArmPaper(BaseModel):
    """PSM_M; without a base it does not move."""

    base_mm: tuple[float, float, float] | None
    instrument: StrictStr = ""


class PlanPaper(BaseModel):
    """The plan."""

    sha256: StrictStr
    policy: PolicyPaper
    arm: StrictStr
    frame: StrictStr
    instrument: StrictStr
    rate_hz: float = Field(validation_alias=AliasPath("trajectory", "rate_hz"))
    samples: int = Field(validation_alias=AliasPath("trajectory", "samples"))
    passes: Annotated[list[PathPaper], Field(min_length=1)]
    psm_m: OtherArmPaper | None


class JointPaper(BaseModel):
    """The judged figures of a joint: its range in rad or mm, and its peaks as parts of the limits."""

    lowest: float
    highest: float
    peak_speed_ratio: float
    peak_acceleration_ratio: float


class ArmPaper(BaseModel):
    """The judged figures of an arm."""

    name: Role
    joints: Annotated[list[JointPaper], Field(min_length=len(JOINTS), max_length=len(JOINTS))]


class ReportPaper(BaseModel):
    """The report of the verdict."""

    feasible: StrictBool
    trajectory: StrictStr | None = None
    arms: list[ArmPaper]


class VerdictPaper(BaseModel):
    """The verdict; `report` is as written, because its digest covers all of it."""

    sha256: StrictStr
    plan: StrictStr
    policy: StrictStr
    feasible: StrictBool
    report: dict[str, Any]


JUDGED = tuple(JointPaper.model_fields)
Paper = TypeVar("Paper", bound=BaseModel)


@dataclass(frozen=True)
class Papers:
    """The documents of a bag, of which plan, verdict and policy belong together."""

    plan: PlanPaper
    verdict: VerdictPaper
    report: ReportPaper
    policy: PolicyPaper


def verify_bag(file: BinaryIO, key: PublicKey | None = None) -> list[str]:
    """Verify a replay bag, and return the checks that passed as text.

    Args:
        file: The bag.
        key: The public key of the service that must have signed it. Without it a signature is not verified.

    Raises:
        BadBag: It must not be played; the message has the reason.
        BadSignature: Another key signed it, or it was changed since.
        UnreadableRecording: The archive or a file in it is damaged or dangerous.
    """
    archive = Archive(file)
    folders = _folders_in(archive.names)
    sums = _check_sums(archive)
    signed, statement = _check_signature(archive, sums, key)
    papers = _read_papers(archive)
    plan, verdict = papers.plan, papers.verdict
    _check_statement(statement, papers)
    index = _paper(archive, SEGMENTS, SegmentIndex)
    parts = {folder: _read_arm(archive, folder, plan) for folder in folders}
    _check_index(index, plan, parts)
    motions = [_joined(name, parts) for name in sorted({motion.name for motion, _ in parts.values()})]
    _check_roles(motions, plan, _by_hand(index, plan.rate_hz))
    for motion in motions:
        _check_judged(motion, papers.report)
    read = [(motion, max(off for part, off in parts.values() if part.name == motion.name)) for motion in motions]
    return [
        f"{len(archive.names)} files, and {SUMS} has the right checksum of each other file.",
        f"Plan {plan.sha256[:12]}, the feasible verdict {verdict.sha256[:12]} and policy {papers.policy.sha256[:12]} "
        "belong together.",
        f"{len(index.segments)} segments: {', '.join(one.name for one in index.segments)}.",
        *(_describe(motion, off_mm) for motion, off_mm in read),
        *([] if plan.psm_m else ["It has no hand-off: no PSM_M, no A2."]),
        signed,
    ]


# ---- the archive and its papers ---------------------------------------------------------------------------------


def _folders_in(names: list[str]) -> list[str]:
    """Return the folders, such as 000-A1/PSM1, in order; and refuse any file besides them and the papers."""
    folders = sorted({name.rpartition("/")[0] for name in names if _FOLDER.fullmatch(name)})
    expected = {SUMS, *PAPERS}
    expected |= {f"{folder}/{file}" for folder in folders for file in (METADATA, f"{folder[-4:]}.mcap")}
    missing, extra = sorted(expected - set(names)), sorted(set(names) - expected - {SIGNATURE})
    arms = {folder[-4:] for folder in folders}
    if not 1 <= len(arms) <= 2:
        raise BadBag(
            f"A bag for replay has folders of one or two arms for its segments; this has {len(arms)}. Export it again."
        )
    if missing or extra:
        what = f"lacks {missing[0]}" if missing else f"has {shown(extra[0])}, which does not belong to it"
        raise BadBag(f"The bag {what}. Export it again.")
    return folders


def _check_sums(archive: Archive) -> dict[str, str]:
    """Return the SHA-256 of each file, in hex by name, after comparing it with the file."""
    sums = read_sums(archive.text(SUMS))
    if set(sums) != {*archive.names} - {SUMS}:
        raise BadBag(f"{SUMS} must list every other file of the bag exactly once, and no others. Export it again.")
    for name, digest in sorted(sums.items()):
        with archive.unpacked(name) as file:
            if digest_of(file) != digest:
                raise BadBag(
                    f"{name} does not match its checksum in {SUMS}: it was changed or damaged. Export it again."
                )
    return sums


def _check_signature(archive: Archive, sums: dict[str, str], key: PublicKey | None) -> tuple[str, Statement | None]:
    """Check that the signature covers exactly the other files; return a sentence about it, and what was signed."""
    covered = {name: digest for name, digest in sums.items() if name != SIGNATURE}
    if SIGNATURE not in sums:
        if key is not None:
            raise BadBag(f"The bag has no {SIGNATURE}: it was removed. Export it again.")
        return f"UNSIGNED: it has no {SIGNATURE}, and anybody could have written it.", None
    try:
        envelope = read_envelope(archive.text(SIGNATURE).encode())
        statement = envelope.statement if key is None else envelope.statement_by(key)
        head = read_notes(statement.facts["checkpoint"])[0]
    except (Corrupt, LookupError, TypeError) as error:
        raise BadBag(f"{SIGNATURE} cannot be read. Export the bag again.") from error
    if statement.subjects != covered:
        raise BadBag(f"{SIGNATURE} is of other files than the bag has: they were changed. Export it again.")
    if key is None:
        return f"SIGNATURE NOT VERIFIED, of the key {envelope.signers}: give the public key of the service.", statement
    if not head.signed_by(key.key):
        raise BadBag(f"The checkpoint in {SIGNATURE} is not of the key that signed it. Export the bag again.")
    size, root = head.checkpoint.size, head.checkpoint.root.hex()
    return f"Signed with the key {key.number}, under the history of {size} leaves with the root {root[:12]}.", statement


def _check_statement(statement: Statement | None, papers: Papers) -> None:
    """Check that what was signed is about this plan, its verdict, its policy and the motion that was judged."""
    expected = {
        "kind": "replay-bag",
        "plan": papers.plan.sha256,
        "verdict": papers.verdict.sha256,
        "policy": papers.policy.sha256,
        "trajectory": papers.report.trajectory,
    }
    if statement is not None and {name: statement.facts.get(name) for name in expected} != expected:
        raise BadBag(f"{SIGNATURE} is about another plan, verdict, policy or motion. Export the bag again.")


@contextmanager
def _valid(name: str) -> Iterator[None]:
    try:
        yield
    except ValidationError as error:
        if error.errors()[0]["type"] in ("json_invalid", "model_type") and not error.errors()[0]["loc"]:
            raise BadBag(f"{name} is not a JSON object. Export the bag again.") from error
        raise BadBag(f"{name} has a missing or invalid field. Export the bag again.") from error


def _paper(archive: Archive, name: str, kind: type[Paper]) -> Paper:
    with _valid(name):
        return kind.model_validate_json(archive.text(name))


def _read_papers(archive: Archive) -> Papers:
    """Read plan, verdict and policy, which must belong together; the verdict must be feasible and unchanged."""
    plan, policy = _paper(archive, PLAN, PlanPaper), _paper(archive, POLICY, PolicyPaper)
    verdict = _paper(archive, VERDICT, VerdictPaper)
    if verdict.plan != plan.sha256:
        raise BadBag(f"{VERDICT} belongs to another plan than {PLAN}. Export the bag again.")
    policies = {plan.policy.sha256, verdict.policy, policy.sha256}
    if len(policies) != 1:
        raise BadBag(f"{PLAN}, {VERDICT} and {POLICY} name {len(policies)} policies. Export the bag again.")
    if sha256(canonical([plan.sha256, verdict.report])) != verdict.sha256:
        raise BadBag(f"{VERDICT} does not match its digest. Export the bag again.")
    with _valid(VERDICT):
        report = ReportPaper.model_validate(verdict.report)
    if not (verdict.feasible and report.feasible):
        raise BadBag(f"{VERDICT} does not find the plan feasible; it must not be played.")
    return Papers(plan, verdict, report, policy)


# ---- the segments -----------------------------------------------------------------------------------------------


def _check_index(index: SegmentIndex, plan: PlanPaper, parts: Parts) -> None:
    """Check that the index is this plan's, and that its segments and the folders are the same, one after the other.

    Each arm begins a segment where it ended the one before; only its jaw may have been changed by hand.
    """
    states: dict[str, ArmStart] = {}
    end_ns, expected = 0, set[str]()
    for number, segment in enumerate(index.segments):
        moving = {one.arm: f"{segment.name}/{one.arm}" for one in segment.arms if one.moves}
        expected |= set(moving.values())
        read = {arm: parts[folder][0] for arm, folder in moving.items() if folder in parts}
        good = bool(moving) and read.keys() == moving.keys() and segment.from_ns >= end_ns
        good &= segment.name == f"{number:03d}-{segment.kind}"
        good &= segment.needle_held_by == replay_bag.held_by(segment.kind, len(segment.arms))
        end_ns = segment.to_ns
        for one in segment.arms:
            before = states.get(one.arm, one)
            changed = ("moves", "jaw_rad") if segment.by_hand else ("moves",)
            good &= one.model_dump(exclude={*changed}) == before.model_dump(exclude={*changed})
            states[one.arm] = one
            if (motion := read.get(one.arm)) is not None:
                ends_ns = (int(motion.stamps_ns[0]), int(motion.stamps_ns[-1]))
                good &= motion.start(0, moves=True) == one and ends_ns == (segment.from_ns, segment.to_ns)
                states[one.arm] = motion.start(-1, moves=True)
        if not good:
            raise BadBag(f"{SEGMENTS} is not the index of this bag, at {shown(segment.name)}. Export the bag again.")
    if index.plan != plan.sha256 or expected != parts.keys():
        raise BadBag(f"{SEGMENTS} is not the index of this bag. Export the bag again.")


def _joined(name: str, parts: Parts) -> replay_bag.ArmMotion:
    """Return the motion of an arm over all segments; a sample that two of them share is in it once."""
    mine = [part for part, _ in parts.values() if part.name == name]
    if len({(part.role, part.instrument, part.rate_hz) for part in mine}) > 1:
        raise BadBag(f"{name} has another role, instrument or rate in one segment than in another.")
    kept = [part.part(slice(None), "") for part in mine]
    kept[1:] = [
        part.part(slice(1, None), "") if part.stamps_ns[0] == before.stamps_ns[-1] else part
        for before, part in pairwise(kept)
    ]
    return replay_bag.joined(kept)


def _by_hand(index: SegmentIndex, rate_hz: float) -> int:
    """Return how many samples of the plan are between its segments, where the surgeon changes the jaws."""
    within = [(one, then) for one, then in pairwise(index.segments) if one.pass_index == then.pass_index]
    ticks = [round((then.from_ns - one.to_ns) * rate_hz / 1e9) for one, then in within]
    return sum(one - 1 for one in ticks if one)


# ---- one arm ----------------------------------------------------------------------------------------------------


@dataclass
class _Topic:
    """The messages of one topic, in the order of the file."""

    type: str
    wanted: Wanted
    columns: list[Columns] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)

    @property
    def stamps_ns(self) -> Ints:
        """The stamps of the headers, shape (T,); both message types have a header."""
        return np.concatenate([columns.stamps_ns for columns in self.columns if columns.stamps_ns is not None])

    @property
    def values(self) -> Floats:
        """The numbers, shape (T, K)."""
        widths = {columns.values.shape[1] for columns in self.columns}
        if len(widths) != 1:
            raise BadBag("A topic of the bag has messages with different numbers of values. Export the bag again.")
        return np.concatenate([columns.values for columns in self.columns])


def _read_arm(archive: Archive, folder: str, plan: PlanPaper) -> tuple[replay_bag.ArmMotion, float]:
    """Read one arm's folder, and run all checks that concern it alone; see `_check_form` for the number."""
    segment, _, name = folder.partition("/")
    file_name = f"{name}.mcap"
    with archive.unpacked(f"{folder}/{file_name}") as file:
        walker, topics = _walk(file, name)
    motion = _motion(name, topics, walker.notes, plan, segment)
    _check_stamps(motion, topics)
    counts = {(topic, said.type): len(said.messages) for topic, said in topics.items()}
    written = Written(counts, int(motion.stamps_ns[0]), int(motion.stamps_ns[-1]))
    if archive.text(f"{folder}/{METADATA}").encode() != metadata_of(written, file_name):
        raise BadBag(f"{folder}/{METADATA} does not describe {file_name}. Export the bag again.")
    _check_joints(motion, topics)
    off_mm = _check_form(motion)
    _check_written(motion, walker.notes, topics, plan)
    return motion, off_mm


def _walk(file: BinaryIO, name: str) -> tuple[Walker, dict[str, _Topic]]:
    """Read the three topics of an arm; refuse any other topic."""
    topics = {
        f"/{name}/setpoint_js": _Topic(JOINT_STATE, _JOINTS),
        f"/{name}/setpoint_cp": _Topic(POSE, WANTED_POSE),
        f"/{name}/jaw/setpoint_js": _Topic(JOINT_STATE, _JOINTS),
    }
    walker, decoders = Walker(file), dict[int, Decoder]()
    for part in walker.parts():
        for number in part.numbers:
            channel = walker.channels[number]
            if channel.topic not in topics:
                raise BadBag(
                    f"{name}.mcap has the topic {channel.topic[:100]!r}, which is not a setpoint topic of {name}."
                )
            said = topics[channel.topic]
            if number not in decoders:
                decoders[number] = _decoder(channel, walker.schemas.get(channel.schema, _UNTYPED), said)
            begin, length = part.of(number)
            said.columns.append(decoders[number].decode(part.data, begin, length))
            spans = zip(begin.tolist(), length.tolist(), strict=True)
            said.messages += [part.data[at : at + size].tobytes() for at, size in spans]
            if len(said.messages) > SAMPLES_LIMIT:
                raise BadBag(f"{channel.topic} has more than {SAMPLES_LIMIT} messages; a plan is never so long.")
    if walker.integrity != "full":
        raise BadBag(f"Not every message of {name}.mcap is covered by a checksum. Export the bag again.")
    return walker, topics


def _decoder(channel: Channel, schema: MessageSchema, said: _Topic) -> Decoder:
    """Return the decoder of a channel of exactly the type that is written."""
    expected = ("cdr", said.type, "ros2msg", DEFINITIONS[said.type].encode())
    if (channel.encoding, schema.name, schema.encoding, schema.definition) != expected:
        raise BadBag(f"{channel.topic} does not have the type {said.type}. Export the bag again.")
    return Decoder(channel.topic, fields_of(schema.name, schema.definition.decode()), said.wanted)


def _motion(
    name: str, topics: dict[str, _Topic], notes: dict[str, str], plan: PlanPaper, segment: str
) -> replay_bag.ArmMotion:
    """Convert the messages that were read back into an `ArmMotion`."""
    on_joints, on_tip, on_jaw = topics.values()
    counts = [len(said.messages) for said in (on_joints, on_tip, on_jaw)]
    if len(set(counts)) != 1 or not counts[0]:
        raise BadBag(
            f"{name} has {counts[0]} setpoints of its joints, {counts[1]} of its tip and {counts[2]} of its jaw; "
            "the numbers must be equal. Export the bag again.",
            joints=counts[0],
            tip=counts[1],
            jaw=counts[2],
        )
    joints, tip, jaw = on_joints.values, on_tip.values, on_jaw.values
    if (joints.shape[1], jaw.shape[1]) != (2 * len(JOINTS), 2):
        raise BadBag(f"{name} has a setpoint without its velocities, or with other joints than a PSM's.")
    if not all(np.isfinite(values).all() for values in (joints, tip, jaw)):
        raise BadBag(f"{name} has NaN or infinity in a setpoint; it must not be played.")
    try:
        instrument_of(instrument := notes["instrument"])
        role: Role = "PSM_A" if notes["role"] == "PSM_A" else "PSM_M"
        rate_hz = float(notes["rate_hz"])
        frame = plan.frame if role == "PSM_A" else f"{name}_base"
        if not 10 <= rate_hz <= 2000:
            raise ValueError(rate_hz)
    except (LookupError, ValueError, UnknownInstrument) as error:
        raise BadBag(f"{name}.mcap does not name its role, its instrument and its rate. Export it again.") from error
    return replay_bag.ArmMotion(
        name=name,
        role=role,
        instrument=instrument,
        frame=frame,
        rate_hz=rate_hz,
        stamps_ns=on_joints.stamps_ns,
        joints=joints[:, : len(JOINTS)],
        tip_m=tip[:, :3],
        rotation_xyzw=tip[:, 3:],
        jaw_rad=jaw[:, 0],
        segment=segment,
    )


def _check_stamps(motion: replay_bag.ArmMotion, topics: dict[str, _Topic]) -> None:
    """Check the stamps of all topics.

    They are above 0, strictly increasing, spaced by the rate, and equal on all three topics and in the log.
    """
    stamps_ns = motion.stamps_ns
    later = np.diff(stamps_ns, prepend=0) > 0
    if not later.all():
        sample = int(np.argmin(later))
        raise BadBag(
            f"{motion.place}: the stamp of sample {sample} is {stamps_ns[sample]} ns, not later than the one before; a "
            "robot would drop it. Export the bag again.",
            sample=sample,
        )
    in_time = np.abs(np.diff(stamps_ns) - 1e9 / motion.rate_hz) <= 1.0  # ns, for rounding
    if not in_time.all():
        sample = int(np.argmin(in_time)) + 1
        raise BadBag(
            f"{motion.place}: sample {sample} is earlier or later than {motion.rate_hz:g} Hz has it; the arm would "
            "move in another way than was checked. Export the bag again.",
            sample=sample,
        )
    for topic, said in topics.items():
        log_ns = np.concatenate([columns.log_ns for columns in said.columns])
        if not (np.array_equal(said.stamps_ns, stamps_ns) and np.array_equal(log_ns, stamps_ns)):
            raise BadBag(
                f"{topic} has stamps or log times that differ from those of {motion.topics[0]}. Export it again."
            )


def _check_joints(motion: replay_bag.ArmMotion, topics: dict[str, _Topic]) -> None:
    """Check that positions and speeds of the joints are within their limits, and that velocities match positions."""
    on_joints, _, on_jaw = topics.values()
    tool = instrument_of(motion.instrument)
    joints = in_mm(motion.joints)
    _check_samples("is beyond its limit", motion, joint_margins(joints, motion.instrument) >= -1e-9)
    tick_s = 1.0 / motion.rate_hz
    speeds = np.abs(np.diff(joints, axis=0, prepend=joints[:1])) / tick_s / tool.speed
    _check_samples("jumps: it would be faster than its limit", motion, speeds <= SPEED_RATIO)
    velocities = replay_bag.velocities_of(motion.stamps_ns, motion.joints)
    _check_samples(
        "has a velocity that does not match the differences of its positions",
        motion,
        on_joints.values[:, len(JOINTS) :] == velocities,
    )
    low, high = tool.jaw_rad
    opening = replay_bag.velocities_of(motion.stamps_ns, motion.jaw_rad[:, None])
    if not (((low <= motion.jaw_rad) & (motion.jaw_rad <= high)).all() and (on_jaw.values[:, 1:] == opening).all()):
        raise BadBag(
            f"{motion.place}: the jaw has an angle that the instrument cannot have, or a velocity that does not match."
        )


def _check_samples(what: str, motion: replay_bag.ArmMotion, good: Flags) -> None:
    """Raise an error for the first sample and joint that fails a check.

    Args:
        what: The failure, as the predicate of the message.
        motion: The arm.
        good: True where the check passes, shape (T, 6).
    """
    if not good.all():
        sample, joint = (int(index) for index in np.argwhere(~good)[0])
        raise BadBag(
            f"{motion.place}, sample {sample}: {JOINTS[joint]} {what}. It must not be played; export the bag again.",
            sample=sample,
            joint=JOINTS[joint],
        )


def _check_form(motion: replay_bag.ArmMotion) -> float:
    """Check that the tip's poses agree with the joints' forward kinematics; return their greatest distance in mm."""
    off_mm = off_rad = np.nan  # as they remain if a quaternion is not of length one
    if (np.abs(np.linalg.norm(motion.rotation_xyzw, axis=1) - 1.0) <= FORM_RAD).all():
        tip_mm, rotation = forward(in_mm(motion.joints), motion.instrument)
        off_mm = float(np.linalg.norm(1000.0 * motion.tip_m - tip_mm, axis=1).max())
        off_rad = float(angle_between(matrix_of(motion.rotation_xyzw), rotation).max())
    if not (off_mm <= FORM_MM and off_rad <= FORM_RAD):
        raise BadBag(
            f"{motion.place}: {motion.topics[1]} is up to {off_mm:.3g} mm and {off_rad:.3g} rad from the pose at "
            f"which {motion.topics[0]} puts the tip of a {motion.instrument}. It must not be played.",
            off_mm=off_mm,
            off_rad=off_rad,
        )
    return off_mm


def _check_written(
    motion: replay_bag.ArmMotion, notes: dict[str, str], topics: dict[str, _Topic], plan: PlanPaper
) -> None:
    """Write the arm's messages again and compare them byte for byte, which covers names, frames and all else."""
    if notes != replay_bag.notes_of(motion, plan.sha256):
        raise BadBag(f"{motion.name}.mcap was made from another plan than {PLAN}. Export the bag again.")
    left = {topic: iter(said.messages) for topic, said in topics.items()}
    if any(next(left[message.topic]) != message.data for message in replay_bag.messages_of(motion)):
        raise BadBag(f"{motion.name}.mcap has other names of joints or frames than the plan. Export the bag again.")


# ---- the arms together ------------------------------------------------------------------------------------------


def _check_roles(motions: list[replay_bag.ArmMotion], plan: PlanPaper, by_hand: int) -> None:
    """Check that one arm of the bag executes the plan, and that the other one matches it.

    The first must have the plan's arm, instrument, rate and samples (but for those by hand), and end where it does.
    """
    planned = [motion for motion in motions if motion.role == "PSM_A"]
    if [one.name for one in planned] != [replay_bag.arm_names(plan.arm)[0]]:
        raise BadBag(f"The plan is for {plan.arm}, but the bag has another PSM_A, or none.")
    psm_a, other = planned[0], plan.psm_m
    goal_mm = plan.passes[-1].path_mm[-1]
    same = (psm_a.instrument, psm_a.rate_hz) == (plan.instrument, plan.rate_hz)
    others = [] if other is None or other.base_mm is None else [other.instrument]
    samples = len(np.unique(np.concatenate([motion.stamps_ns for motion in motions]))) + by_hand
    off_mm = float(np.linalg.norm(1000.0 * psm_a.tip_m[-1] - goal_mm))
    if not (same and samples == plan.samples):
        raise BadBag(f"{psm_a.name} has another instrument, rate or number of samples than {PLAN}.")
    if [motion.instrument for motion in motions if motion.role == "PSM_M"] != others:
        raise BadBag(f"PSM_M is in the bag and not in {PLAN}, or the other way round, or with another instrument.")
    if not off_mm <= GOAL_MM:
        raise BadBag(f"{psm_a.name} ends {off_mm:.3g} mm from the end of the motion in {PLAN}. It must not be played.")


def _check_judged(motion: replay_bag.ArmMotion, report: ReportPaper) -> None:
    """Check the accelerations, and that the joints' ranges, speeds and accelerations are those that were judged."""
    joints = in_mm(motion.joints)
    all_one = np.zeros(len(joints), np.int64)  # as the verdict has it: neither arm may jump between passes
    speed, acceleration = joint_ratios(joints, all_one, motion.rate_hz, motion.instrument)
    _check_samples("accelerates beyond its limit", motion, acceleration <= SPEED_RATIO)
    arms = [arm for arm in report.arms if arm.name == motion.role]
    if len(arms) != 1:
        raise BadBag(f"{VERDICT} has a missing or invalid field: {motion.role}. Export the bag again.")
    judged = np.array([[getattr(joint, figure) for joint in arms[0].joints] for figure in JUDGED])
    here = np.stack([joints.min(axis=0), joints.max(axis=0), speed.max(axis=0), acceleration.max(axis=0)])
    within = np.abs(here - judged) <= JUDGED_OFF
    if not within.all():
        figure, joint = (int(index) for index in np.argwhere(~within)[0])
        raise BadBag(
            f"{motion.name} is not the motion that was judged: of {JOINTS[joint]}, {JUDGED[figure]} is "
            f"{here[figure, joint]:g}, and {VERDICT} has {judged[figure, joint]:g}. It must not be played.",
            joint=JOINTS[joint],
        )


def _describe(motion: replay_bag.ArmMotion, off_mm: float) -> str:
    """Return the summary of an arm's checks, with the bounding box of its motion."""
    box = ", ".join(f"{axis} [{low:.2f}, {high:.2f}]" for axis, low, high in motion.box)
    seconds = float(motion.stamps_ns[-1] - motion.stamps_ns[0]) / 1e9
    return (
        f"{motion.name} ({motion.role}, {motion.instrument}): {len(motion.stamps_ns)} samples in {seconds:.2f} s, "
        "stamps, jaw and velocities correct, joints and their speeds within the limits, the tip within "
        f"{off_mm:.1g} mm of the closed form; {box} mm in {motion.frame}."
    )
