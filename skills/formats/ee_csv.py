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
from dataclasses import replace
from typing import BinaryIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration import recording
from skills.errors import BadColumns, BadSettings, MixedFrames, NoUsableTopic, SkillsError
from skills.formats import cells
from skills.formats.columns import (
    BASE,
    POSE_PARTS,
    SETPOINTS,
    Parts,
    Quantity,
    base_of,
    check_joints,
    check_outside,
    pose_motion,
    posed,
    setpoints_in,
    topic_of,
)
from skills.formats.tables import (
    JOINT_NAMES,
    POSITION,
    QUATERNION,
    ReadingOptions,
    check_time,
    stamps_of,
)
from skills.kinematics import INSERTION
from skills.remedies import Action, Remedy

TIME = "timestamp"
_FIRST = re.compile(r"psm\d+_(pose\.position\.x|(measured_)?js\[0\])")
_USED = re.compile(
    r"(?P<arm>psm\d+)_((?P<pose>pose|rcm_pose|sp)\.(?P<part>position\.[xyz]|orientation\.[xyzw])"
    r"|(?P<jaw>jaw|jaw_sp)"
    r"|(measured_)?js\[(?P<joint>\d)\])"
)
_KINDS = {"pose": "pose", "rcm_pose": "local_pose", "sp": "setpoint", "jaw": "jaw", "jaw_sp": "jaw_setpoint"}
_POSE = (*POSITION, *QUATERNION)
_PARTS = {"joints": JOINT_NAMES, "jaw": ("jaw",), "jaw_setpoint": ("jaw",)}  # of any other kind `_POSE`
_PLACES = {"local_pose": "local ", "setpoint": "setpoint ", "jaw_setpoint": "setpoint "}  # in the list of columns
_KIND = "ee_csv"

Indices = tuple[int, ...]  # of the columns of a quantity, in the header


def is_header(names: Iterable[str]) -> bool:
    """Return whether a table with these columns is an ee_csv."""
    return any(_FIRST.fullmatch(name) for name in names)


def read_ee_csv(file: BinaryIO, options: ReadingOptions) -> recording.Recording:
    """Read the motions of all arms.

    Args:
        file: The file, at its beginning.
        options: What the caller says about it: the frame, and a rate or an instrument where needed.

    Returns:
        The recording, in millimetres.

    Raises:
        BadColumns: A column is missing or duplicate, the frame is not named, or `timestamp` is not in nanoseconds.
        BadSettings: The caller names the arm or a unit, which the format names already.
        NoUsableTopic: No arm was recorded, or one has joints and no poses, and no instrument is stated.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows.
        MixedFrames, NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: See `skills.errors`.
    """
    if options.table_arm is not None:
        raise BadSettings("The columns name their arms; omit table_arm.")
    if options.unit:
        raise BadSettings("The columns of an ee_csv are in m, rad and ns; omit unit, or map the columns of one arm.")
    cells.check_whole(file)
    with cells.open_text(file) as text:
        names, _ = cells.header_of(text)
    groups, faults = _groups(names)
    if names.count(TIME) > 1:
        raise _doubled(TIME)
    time = names.index(TIME) if TIME in names else None
    check_time(TIME if time is not None else None, options)
    try:
        stamps_ns, values = _read(file, groups, time, options)
    except SkillsError as error:
        measured = {one: columns for one, columns in groups.items() if one[1] not in SETPOINTS}
        if len(measured) == len(groups):
            raise
        stamps_ns, values = _read(file, measured, time, options)
        faults |= {topic_of(*one): str(error) for one in groups if one[1] in SETPOINTS}
        groups = measured
    return _recording(values, stamps_ns, options, _columns(names, groups, time), faults)


def _read(
    file: BinaryIO, groups: Mapping[Quantity, Indices], time: int | None, options: ReadingOptions
) -> tuple[Ints, dict[Quantity, Parts]]:
    """Return the stamps, shape (T,), and the numbers of each quantity."""
    file.seek(0)
    with cells.open_text(file) as text:
        names, separator = cells.header_of(text)
        apart = {one: [columns] if one[1] in _PARTS else [columns[:3], columns[3:]] for one, columns in groups.items()}
        used = [*([[time]] if time is not None else []), *(list(part) for parts in apart.values() for part in parts)]
        at = None if time is None else (time, "ns")
        numbers = cells.read_numbers(text, cells.TableLayout(names, used, separator, options.decimal, at))
    found = iter(numbers.groups)
    if time is not None:
        _check_whole(next(found))
    stamps_ns = stamps_of(numbers.stamps_ns, numbers.rows, options)
    stamps_ns.setflags(write=False)  # so that all streams share it
    values = {one: tuple(next(found) for _ in parts) for one, parts in apart.items()}
    for (_, kind), (first, *others) in values.items():
        with np.errstate(over="ignore"):  # infinite ones are refused by the recording's values
            if kind == "joints":
                first[:, INSERTION] *= 1000.0  # the recorders write metres
            elif kind not in _PARTS:
                first *= 1000.0
        for part in (first, *others):
            part.setflags(write=False)  # so that the recording's values need no copy
    return stamps_ns, values


def _groups(names: Sequence[str]) -> tuple[dict[Quantity, Indices], dict[str, str]]:
    """Return the columns of each quantity, and the topics of setpoints whose columns are not usable, with the faults.

    Raises:
        BadColumns: Another column is missing or there twice.
    """
    found: dict[Quantity, dict[int, list[int]]] = {}
    for index, name in enumerate(names):
        if (match := _USED.fullmatch(name)) is None:
            continue
        kind = _KINDS.get(match["pose"] or match["jaw"], "joints")
        part = POSE_PARTS.index(match["part"]) if match["part"] else int(match["joint"] or 0)
        found.setdefault((match["arm"].upper(), kind), {}).setdefault(part, []).append(index)
    groups, faults = {}, {}
    for quantity, columns in sorted(found.items()):
        try:
            groups[quantity] = _whole(names, quantity, columns)
        except BadColumns as error:
            if quantity[1] not in SETPOINTS:
                raise
            faults[topic_of(*quantity)] = str(error)
    return groups, faults


def _whole(names: Sequence[str], quantity: Quantity, columns: Mapping[int, Sequence[int]]) -> Indices:
    """Return the columns of a quantity in order; raises as `_groups`."""
    (arm, kind), parts = quantity, _PARTS.get(quantity[1], _POSE)
    for indices in columns.values():
        if len(indices) > 1:
            raise _doubled(names[indices[0]])
    missing = [part for k, part in enumerate(parts) if k not in columns]
    if missing or len(columns) > len(parts):
        which = f"{missing[0]} of {arm}'s {kind} is missing" if missing else f"{arm} has more joints than a PSM"
        raise BadColumns(f"The table is incomplete: {which}; export the table again.", missing=missing)
    return tuple(columns[k][0] for k in range(len(parts)))


def _doubled(name: str) -> BadColumns:
    return BadColumns(f"The table has the column {name!r} twice; export the table again.", doubled=[name])


def _columns(
    names: Sequence[str], groups: Mapping[Quantity, Indices], time: int | None
) -> tuple[recording.Column, ...]:
    """Return all columns of the header, each with what it was read as."""
    meant = {} if time is None else {time: ("t", "ns")}
    for (arm, kind), columns in groups.items():
        for index, part in zip(columns, _PARTS.get(kind, _POSE), strict=True):
            unit = "m" if part in POSITION or part == JOINT_NAMES[INSERTION] else "" if part in QUATERNION else "rad"
            meant[index] = (f"{arm} {_PLACES.get(kind, '')}{part}", unit)
    return tuple(recording.Column(name, *meant.get(index, ("", ""))) for index, name in enumerate(names))


def _check_whole(times: Floats) -> None:
    """Refuse times that are not whole nanoseconds."""
    if (times != np.rint(times)).any():
        raise BadColumns(
            f"The column {TIME} is not in whole nanoseconds, which this format has; in which unit is it? Name "
            f"the columns of one arm instead, with t_s={TIME}, t_ms={TIME} or t_us={TIME}.",
            Remedy(Action.NAME_COLUMNS),
        )


def _recording(
    values: Mapping[Quantity, Parts],
    stamps_ns: Ints,
    options: ReadingOptions,
    columns: tuple[recording.Column, ...],
    faults: Mapping[str, str],
) -> recording.Recording:
    """Return the recording of the numbers of each quantity; raises as `read_ee_csv`."""
    motions: list[recording.Motion] = []
    joints: list[recording.Joints] = []
    jaws: list[tuple[str, recording.Signal]] = []
    left_out: list[tuple[str, str]] = list(faults.items())
    posing = [arm for (arm, kind), parts in values.items() if kind == "pose" and any(part.any() for part in parts)]
    for (arm, kind), parts in values.items():
        topic = topic_of(arm, kind)
        if kind == "joints":
            (positions,) = parts
            check_joints(topic, positions)
            joints.append(recording.recorded_joints(arm, topic, stamps_ns, positions))
            if (arm, "pose") not in values:
                pose = posed(topic, positions, options.instrument)
                computed = pose_motion(arm, kind, base_of(arm, options.frame), stamps_ns, pose)
                motions.append(replace(computed, from_joints=True))
        elif kind == "jaw":
            jaws.append((arm, recording.recorded_signal(stamps_ns, parts[0][:, 0], topic)))
        elif kind == "pose" and arm in posing:
            motions.append(pose_motion(arm, kind, _frame(arm, posing, options), stamps_ns, parts))
        elif kind == "pose":
            left_out.append((topic, "All its numbers are 0: the arm was not recorded."))
    for (arm, kind), parts in values.items():
        if kind == "local_pose":
            seen = next((one for one in motions if one.topic == topic_of(arm, "pose")), None)
            try:
                motions.append(_local(arm, stamps_ns, parts, seen))
            except SkillsError as error:  # no demonstration depends on it, where the arm has another pose
                left_out.append((topic_of(arm, kind), str(error)))
    if not motions:
        raise NoUsableTopic("The table has the pose of no arm: all its poses are 0.")
    for motion in motions:
        check_outside(motion)
    tips, jaw_setpoints, unusable = setpoints_in(values, motions, {}, stamps_ns)
    here = {motion.topic for motion in (*motions, *tips)} | {one.topic for one in joints}
    here |= {signal.topic for _, signal in (*jaws, *jaw_setpoints)}
    arms = sorted({motion.arm for motion in motions})
    return recording.Recording(
        format="csv",
        integrity="none",
        motions=tuple(motions),
        jaws=tuple(jaws),
        topics=tuple(recording.Topic(name, _KIND, len(stamps_ns)) for name in sorted(here)),
        joints=tuple(joints),
        tools=() if options.instrument is None else tuple((arm, options.instrument) for arm in arms),
        left_out=(*left_out, *unusable),
        columns=columns,
        setpoints=tuple(tips),
        jaw_setpoints=tuple(jaw_setpoints),
    )


def _frame(arm: str, arms: Sequence[str], options: ReadingOptions) -> str:
    """Return the frame of an arm's poses, which the caller names.

    Raises:
        BadColumns: The caller does not.
        MixedFrames: The caller names the base of one arm for several.
    """
    if options.frame is None:
        raise BadColumns("The table does not say in which frame its poses are.", Remedy(Action.NAME_FRAME))
    if options.frame == BASE:
        return f"{arm}_base"
    if options.frame.endswith("_base") and len(arms) > 1:
        raise MixedFrames(
            f"The poses are of {', '.join(arms)}, and {options.frame!r} is the base of one arm.",
            Remedy(Action.NAME_FRAME),
            frames=[options.frame],
        )
    return options.frame


def _local(arm: str, stamps_ns: Ints, pose: Parts, seen: recording.Motion | None) -> recording.Motion:
    """Return the motion in the arm's base.

    Args:
        arm: The arm.
        stamps_ns: Shape (T,).
        pose: The numbers of `rcm_pose`.
        seen: The arm's motion in another frame, if it has one.

    Raises:
        MixedFrames: `rcm_pose` is not known to be the tip in the arm's base.
    """
    local = pose_motion(arm, "local_pose", f"{arm}_base", stamps_ns, pose)
    if np.ptp(local.tip_mm, axis=0).max() < recording.WIDE_MM:
        raise MixedFrames("It stands still: it may be the pose of the arm's base, and not of its tip.")
    if seen is None:
        raise MixedFrames("The arm has no other pose that would show whether it is the tip in the arm's base.")
    bases = recording.base_frames(recording.Recording("csv", "none", (local, replace(seen, frame="other"))))
    if not (bases and bases[0].is_steady):
        raise MixedFrames("No fixed transform leads from it to the arm's other pose, so its frame is not known.")
    return local
