"""Reader of `ee_csv.csv`, the table that recorders of SutureBot, SRT and Open-H write beside their pictures.

Its columns are named by arm, each row being one picture:

    timestamp                                  whole nanoseconds; or `rate_hz` from the caller, for tables without times
    psm1_pose.position.x, y, z                 the tip in m, as of /PSM1/measured_cp
    psm1_pose.orientation.x, y, z, w           its unit quaternion
    psm1_jaw                                   the jaw's angle in rad
    psm1_js[0] ... psm1_js[5]                  the measured joints, rad and m (or psm1_measured_js[0] ...)
    psm1_rcm_pose.position.x ... orientation.w the tip in the arm's base, as of /PSM1/local/measured_cp (see below)
    psm1_sp.position.x ... orientation.w       the setpoint of the tip, as of /PSM1/setpoint_cp
    psm1_jaw_sp                                the setpoint of the jaw in rad

and the same for the other arms. Motions, joints and jaws have the names of the topics that the recorders subscribe to.
Setpoints of the joints (psm1_set_js), the endoscope's and the set-up joints' columns are not used, nor is any other; no
value of the used columns depends on them. Setpoints that are not usable are left out, whatever their fault.

The file does not say in which frame the poses are, and laboratories differ: the caller must name it, as "base" for each
arm's own base. `rcm_pose` is the tip in the arm's base in most recorders and the pose of the base itself in one. It is
read as the tip if it moves, and one fixed transform leads from it to the other pose; otherwise it is left out. An arm
whose pose is 0 in every row, quaternion included, was not recorded, and is left out.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.recording import (
    WIDE_MM,
    Column,
    Joints,
    Motion,
    Recording,
    Signal,
    Topic,
    base_frames,
    recorded_joints,
    recorded_motion,
    recorded_signal,
)
from skills.errors import BadColumns, BadSettings, MixedFrames, NoUsableTopic, SkillsError
from skills.formats.cells import check_whole, header_of, open_text, read_numbers
from skills.formats.columns import BASE, ColumnSetpoints, base_of, check_joints, check_outside, posed
from skills.formats.tables import TableReading, check_steps, check_time, stamps_of
from skills.kinematics import INSERTION, JOINTS
from skills.remedies import Action, Remedy

TIME = "timestamp"
STEADY_MM, STEADY_RAD = 3.0, 0.05  # as of `skills.demonstration.partner`: a base that moves more has no single pose
_FIRST = re.compile(r"psm\d+_(pose\.position\.x|(measured_)?js\[0\])")
_USED = re.compile(
    r"(?P<arm>psm\d+)_((?P<pose>pose|rcm_pose|sp)\.(position\.(?P<axis>[xyz])|orientation\.(?P<part>[xyzw]))"
    r"|(?P<jaw>jaw|jaw_sp)"
    r"|(measured_)?js\[(?P<joint>\d)\])"
)
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_JOINTS = tuple(f"q{k}" for k in range(1, len(JOINTS) + 1))
_PARTS = {"js": _JOINTS, "jaw": ("jaw",), "jaw_sp": ("jaw",)}  # of any other kind `_POSE`
_SETPOINTS = {"sp": "/{}/setpoint_cp", "jaw_sp": "/{}/jaw/setpoint_js"}
_KIND = "ee_csv"

Parts = tuple[Floats, ...]  # the numbers of a group in mm and rad, an array for each of `_Group.parts`


@dataclass(frozen=True)
class _Group:
    """The columns of one arm's pose, joints or jaw: their indices in the header."""

    arm: str
    kind: str
    columns: tuple[int, ...]

    @property
    def parts(self) -> list[tuple[int, ...]]:
        """The columns in the arrays as which values need them: positions apart from quaternions."""
        return [self.columns] if self.kind in _PARTS else [self.columns[:3], self.columns[3:]]

    @property
    def topic(self) -> str:
        """The topic of a setpoint."""
        return _SETPOINTS[self.kind].format(self.arm)


def is_header(names: Iterable[str]) -> bool:
    """Return whether a table with these columns is an ee_csv."""
    return any(_FIRST.fullmatch(name) for name in names)


def read_ee_csv(file: BinaryIO, said: TableReading) -> Recording:
    """Read the motions of all arms.

    Args:
        file: The file, at its beginning.
        said: What the caller says about it: the frame, and a rate or an instrument where needed.

    Returns:
        The recording, in millimetres.

    Raises:
        BadColumns: A column is missing or duplicate, the frame is not named, or `timestamp` is not in nanoseconds.
        BadSettings: The caller names the arm or a unit, which the format names already.
        NoUsableTopic: No arm was recorded, or one has joints and no poses, and no instrument is stated.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows.
        MixedFrames, NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: See `skills.errors`.
    """
    if said.table_arm is not None:
        raise BadSettings("The columns name their arms; omit table_arm.")
    if said.unit:
        raise BadSettings("The columns of an ee_csv are in m, rad and ns; omit unit, or map the columns of one arm.")
    check_whole(file)
    with open_text(file) as text:
        names, _ = header_of(text)
    groups, faults = _groups(names)
    time = _time(names)
    check_time(TIME if time is not None else None, said)
    try:
        stamps_ns, parts = _read(file, groups, time, said)
    except SkillsError as error:
        measured = [one for one in groups if one.kind not in _SETPOINTS]
        if len(measured) == len(groups):
            raise
        stamps_ns, parts = _read(file, measured, time, said)
        faults |= {one.topic: str(error) for one in groups if one.kind in _SETPOINTS}
        groups = measured
    return _recording(parts, stamps_ns, said, _columns(names, groups, time), faults)


def _read(
    file: BinaryIO, groups: Sequence[_Group], time: int | None, said: TableReading
) -> tuple[Ints, dict[tuple[str, str], Parts]]:
    """Return the stamps, shape (T,), and the numbers of each arm and kind."""
    file.seek(0)
    with open_text(file) as text:
        names, separator = header_of(text)
        used = [*([[time]] if time is not None else []), *(part for one in groups for part in one.parts)]
        numbers = read_numbers(text, names, used, separator, said.decimal, None if time is None else (time, "ns"))
    found = iter(numbers.groups)
    if time is not None:
        _check_whole(next(found))
        assert numbers.stamps_ns is not None
        check_steps(TIME, "ns", numbers.stamps_ns)
    stamps_ns, read = stamps_of(numbers.stamps_ns, numbers.rows, said), dict[tuple[str, str], Parts]()
    for one in groups:
        parts = tuple(next(found) for _ in one.parts)
        with np.errstate(over="ignore"):  # infinite ones are refused by the recording's values
            if one.kind == "js":
                parts[0][:, INSERTION] *= 1000.0  # the recorders write metres
            elif one.kind not in _PARTS:
                parts[0][:] *= 1000.0
        for part in parts:
            part.setflags(write=False)  # so that the recording's values need no copy
        read[one.arm, one.kind] = parts
    stamps_ns.setflags(write=False)
    return stamps_ns, read


def _groups(names: Sequence[str]) -> tuple[list[_Group], dict[str, str]]:
    """Return the groups of columns, and the topics of setpoints whose columns are not usable, with the fault of each.

    Raises:
        BadColumns: Another column is missing or there twice.
    """
    found: dict[tuple[str, str], dict[str, list[int]]] = {}
    for index, name in enumerate(names):
        said = _USED.fullmatch(name)
        if said is None:
            continue
        kind = said["pose"] or said["jaw"] or "js"
        part = said["axis"] or (said["part"] and f"q{said['part']}") or (said["joint"] and f"q{int(said['joint']) + 1}")
        found.setdefault((said["arm"].upper(), kind), {}).setdefault(part or "jaw", []).append(index)
    groups, faults = [], {}
    for (arm, kind), group in sorted(found.items()):
        try:
            groups.append(_group(names, arm, kind, group))
        except BadColumns as error:
            if kind not in _SETPOINTS:
                raise
            faults[_SETPOINTS[kind].format(arm)] = str(error)
    return groups, faults


def _group(names: Sequence[str], arm: str, kind: str, found: Mapping[str, Sequence[int]]) -> _Group:
    wanted = _PARTS.get(kind, _POSE)
    doubled = [names[indices[0]] for indices in found.values() if len(indices) > 1]
    if doubled:
        raise BadColumns(f"The table has the column {doubled[0]!r} twice; export the table again.", doubled=doubled)
    missing = [part for part in wanted if part not in found]
    if missing or len(found) > len(wanted):
        which = f"{missing[0]} of {arm}'s {kind} is missing" if missing else f"{arm} has more joints than a PSM"
        raise BadColumns(f"The table is incomplete: {which}; export the table again.", missing=missing)
    return _Group(arm, kind, tuple(found[part][0] for part in wanted))


def _time(names: Sequence[str]) -> int | None:
    count = names.count(TIME)
    if count > 1:
        raise BadColumns(f"The table has the column {TIME!r} twice; export the table again.", doubled=[TIME])
    return names.index(TIME) if count else None


def _columns(names: Sequence[str], groups: Sequence[_Group], time: int | None) -> tuple[Column, ...]:
    meant = {} if time is None else {time: ("t", "ns")}
    for group in groups:
        parts = _PARTS.get(group.kind, _POSE)
        place = {"rcm_pose": "local ", "sp": "setpoint ", "jaw_sp": "setpoint "}.get(group.kind, "")
        for index, part in zip(group.columns, parts, strict=True):
            meant[index] = (f"{group.arm} {place}{part}", _unit(group.kind, part))
    return tuple(Column(name, *meant.get(index, ("", ""))) for index, name in enumerate(names))


def _unit(kind: str, part: str) -> str:
    if kind in _PARTS:
        return "m" if part == _JOINTS[INSERTION] else "rad"
    return "m" if part in ("x", "y", "z") else ""


def _check_whole(times: Floats) -> None:
    if (times != np.rint(times)).any():
        raise BadColumns(
            f"The column {TIME} is not in whole nanoseconds, which this format has; in which unit is it? Name "
            f"the columns of one arm instead, with t_s={TIME}, t_ms={TIME} or t_us={TIME}.",
            Remedy(Action.NAME_COLUMNS),
        )


def _recording(
    parts: Mapping[tuple[str, str], Parts],
    stamps_ns: Ints,
    said: TableReading,
    columns: tuple[Column, ...],
    faults: Mapping[str, str],
) -> Recording:
    motions: list[Motion] = []
    joints: list[Joints] = []
    jaws: list[tuple[str, Signal]] = []
    left_out: list[tuple[str, str]] = list(faults.items())
    posing = [arm for arm, kind in parts if kind == "pose" and any(part.any() for part in parts[arm, kind])]
    for (arm, kind), values in parts.items():
        if kind == "js":
            (positions,) = values
            topic = f"/{arm}/measured_js"
            check_joints(topic, positions)
            joints.append(recorded_joints(arm, topic, stamps_ns, positions))
            if (arm, "pose") not in parts:
                tip_mm, rotation = posed(topic, positions, said.instrument)
                posed_motion = _motion(arm, topic, base_of(arm, said.frame), stamps_ns, tip_mm, rotation)
                motions.append(replace(posed_motion, from_joints=True))
        elif kind == "jaw":
            jaws.append((arm, recorded_signal(stamps_ns, values[0][:, 0], f"/{arm}/jaw/measured_js")))
        elif kind == "pose" and arm in posing:
            frame = _frame(arm, posing, said)
            motions.append(_motion(arm, f"/{arm}/measured_cp", frame, stamps_ns, *values))
        elif kind == "pose":
            left_out.append((f"/{arm}/measured_cp", "All its numbers are 0: the arm was not recorded."))
    for (arm, kind), values in parts.items():
        if kind == "rcm_pose":
            motion = next((one for one in motions if one.topic == f"/{arm}/measured_cp"), None)
            local, why = _local(arm, stamps_ns, values, motion)
            motions += [] if local is None else [local]
            left_out += [(f"/{arm}/local/measured_cp", why)] if why else []
    if not motions:
        raise NoUsableTopic("The table has the pose of no arm: all its poses are 0.")
    for motion in motions:
        check_outside(motion)
    setpoints = _setpoints(parts, stamps_ns, motions)
    here = {motion.topic for motion in (*motions, *setpoints.tips)} | {one.topic for one in joints}
    here |= {signal.topic for _, signal in (*jaws, *setpoints.jaws)}
    return Recording(
        format="csv",
        integrity="none",
        motions=tuple(motions),
        jaws=tuple(jaws),
        topics=tuple(Topic(name, _KIND, len(stamps_ns)) for name in sorted(here)),
        joints=tuple(joints),
        tools=()
        if said.instrument is None
        else tuple((arm, said.instrument) for arm in sorted({m.arm for m in motions})),
        left_out=(*left_out, *setpoints.left_out),
        columns=columns,
        setpoints=tuple(setpoints.tips),
        jaw_setpoints=tuple(setpoints.jaws),
    )


def _setpoints(parts: Mapping[tuple[str, str], Parts], stamps_ns: Ints, motions: Sequence[Motion]) -> ColumnSetpoints:
    setpoints = ColumnSetpoints()
    for (arm, kind), values in parts.items():
        measured = next((one for one in motions if one.topic == f"/{arm}/measured_cp"), None)
        topic = _SETPOINTS.get(kind, "").format(arm)
        if kind == "jaw_sp":
            setpoints.add_jaw(arm, topic, stamps_ns, values[0][:, 0])
        elif kind == "sp" and measured is None:
            setpoints.left_out.append((topic, "The arm has no measured pose beside it."))
        elif kind == "sp" and measured is not None:
            tip_mm, rotation = values
            setpoints.add_tip(topic, stamps_ns, tip_mm, rotation, measured)
    return setpoints


def _motion(arm: str, topic: str, frame: str, stamps_ns: Ints, tip_mm: Floats, rotation_xyzw: Floats) -> Motion:
    return recorded_motion(
        arm=arm, topic=topic, frame=frame, stamps_ns=stamps_ns, tip_mm=tip_mm, rotation_xyzw=rotation_xyzw
    )


def _frame(arm: str, arms: Sequence[str], said: TableReading) -> str:
    """Return the frame of an arm's poses, which the caller names.

    Raises:
        BadColumns: The caller does not.
        MixedFrames: The caller names the base of one arm for several.
    """
    if said.frame is None:
        raise BadColumns("The table does not say in which frame its poses are.", Remedy(Action.NAME_FRAME))
    if said.frame == BASE:
        return f"{arm}_base"
    if said.frame.endswith("_base") and len(arms) > 1:
        raise MixedFrames(
            f"The poses are of {', '.join(arms)}, and {said.frame!r} is the base of one arm.",
            Remedy(Action.NAME_FRAME),
            frames=[said.frame],
        )
    return said.frame


def _local(arm: str, stamps_ns: Ints, values: Parts, motion: Motion | None) -> tuple[Motion | None, str]:
    """Return the motion in the arm's base, or the reason why `rcm_pose` is not one."""
    topic = f"/{arm}/local/measured_cp"
    try:
        local = _motion(arm, topic, f"{arm}_base", stamps_ns, *values)
    except SkillsError as error:  # no demonstration depends on it, where the arm has another pose
        return None, str(error)
    if np.ptp(local.tip_mm, axis=0).max() < WIDE_MM:
        return None, "It stands still: it may be the pose of the arm's base, and not of its tip."
    if motion is None:
        return None, "The arm has no other pose that would show whether it is the tip in the arm's base."
    seen = Motion(arm, motion.topic, "other", motion.stamps_ns, motion.tip_mm, motion.rotation_xyzw)
    bases = base_frames(Recording("csv", "none", (local, seen)))
    if not bases or bases[0].spread_mm > STEADY_MM or bases[0].spread_rad > STEADY_RAD:
        return None, "No fixed transform leads from it to the arm's other pose, so its frame is not known."
    return local, ""
