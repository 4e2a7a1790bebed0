"""Reader of one episode of a LeRobot dataset.

A column's meaning is that of its name, or of the name that `columns` in `meta/suture-skills.json` gives it (N is the
arm's number):

    psmN_pose.position.x ... psmN_pose.orientation.w   pose of the tip, m and a unit quaternion; the frame is not in the
                                                       dataset and must be stated
    psmN_local_pose.position.x ...                     the same relative to the arm's own remote centre
    psmN_joint_1 ... psmN_joint_6                      the measured joints, rad, the third in m
    psmN_jaw                                           the jaw's angle, rad
    psmN_sp.position.x ... psmN_sp.orientation.w       setpoint of the tip, in the frame of psmN_pose
    psmN_local_sp.position.x ...                       the same in the frame of psmN_local_pose
    psmN_joint_sp_1 ... psmN_joint_sp_6                setpoints of the joints, rad, the third in m
    psmN_jaw_sp                                        setpoint of the jaw, rad

Separators may be dots, as in `observation.cartesian_state.psm1.pose.position.x`, and joints may be named, as in
`observation.state.psm1.joint_position` with `yaw`. Where an arm has joints and no local pose, forward kinematics makes
one, with the instrument whose number is in the dataset's tool name (`observation.meta.tool.psm1`), or in `tools` of our
own file. Motions are called by the topics of a dVRK from which recorders take such columns.

The exporter of jhu-dvrk/data_collection has a feature per topic, and names numbers after their place in the message:

    ros.PSM1.local.measured_cp  pose.position.x ...  as psm1_local_pose; measured_cp, measured_js, jaw.measured_js and
                                                     the setpoints likewise
    observation.state           joint_0 ... joint_5, jaw  of one arm, which `tools` in our own file names
    timestamp_ns                                          the clock; its `fps` are nominal

Of actions only those are used whose names say that they are setpoints, with `_sp` or `_setpoint`: under the names of
the state an action may as well be the next state, or a difference. Setpoints that are not usable are left out.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.recording import Joints, Motion, Recording, Topic, recorded_signal
from skills.errors import (
    BackwardStamps,
    BadColumns,
    ImplausibleMotion,
    MixedFrames,
    NotFinite,
    NoUsableTopic,
    UnreadableRecording,
)
from skills.formats import columns
from skills.formats.archive import printable
from skills.formats.lerobot import INFO, STATEMENTS, VERSIONS, Dataset, Feature, Files, read_dataset
from skills.formats.lerobot.parquet import ParquetTable, read_columns
from skills.kinematics import INSTRUMENTS, JOINTS
from skills.remedies import Action, Remedy, did_you_mean

NOTE_CHARACTERS = 200
COARSE_S = 1e-3  # timestamps that are coarser, a float32 after 2.3 hours or in seconds since 1970, are no clock
RATE_FACTOR, FEWEST_STEPS = 1.25, 3  # ours: recorders of 30 pictures a second really take 28
CLOCK = "the recorder's clock"
SAME_S = 1e-4  # LeRobot's own tolerance between timestamps and its rate

_POSE = re.compile(
    r"(?:observation\.cartesian_state\.)?(psm\d{1,2})[._](local_)?(pose|sp|setpoint)"
    r"\.(position\.[xyz]|orientation\.[xyzw])",
    re.I,
)
_JOINT = re.compile(
    r"(?:observation\.state\.)?(psm\d{1,2})[._]joint(?:_position)?(_sp|_setpoint)?[._]"
    r"([1-6]|yaw|pitch|insertion|roll|wrist_pitch|wrist_yaw)",
    re.I,
)
_JAW = re.compile(r"(?:observation\.state\.)?(psm\d{1,2})[._](?:jaw|gripper)(_sp|_setpoint)?", re.I)
_ROS = r"ros\.(?:(?!SUJ\.)\w+\.)*?(psm\d{1,2})\."
_ROS_POSE = re.compile(
    _ROS + r"(local\.)?(measured_cp|setpoint_cp)\.(?:pose|transform)"
    r"\.(?:(?:position|translation)\.([xyz])|(?:orientation|rotation)\.([xyzw]))",
    re.I,
)
_ROS_ANGLE = re.compile(_ROS + r"(jaw\.)?(measured_js|setpoint_js)\.position\.([0-5])", re.I)
_BARE_JOINTS, _BARE_JAW = tuple(f"joint_{k}" for k in range(6)), "jaw"
_TOOL = re.compile(r"(?:observation\.meta\.tool\.)?(psm\d{1,2})(?:_tool_type)?", re.I)
_NUMBER = re.compile(r"(?:^|:)(\d+)(?:\[|$)")  # of "LARGE_NEEDLE_DRIVER:400006[..11]", or alone
_SCALARS = ("timestamp", "frame_index", "episode_index", "task_index")
_CLOCKS = "observation.meta.ros_time_sec", "observation.meta.ros_time_nsec", "timestamp_ns"
_SEC, _NANOSEC, _STAMP = _CLOCKS

Place = tuple[str, int]  # a feature, and the index of one of its numbers
LeftOut = tuple[str, str]  # a topic or a feature, and why it is not used


def read_episode(files: Files, root: str, frame: str | None = None) -> Recording:
    """Read a dataset of one episode.

    Args:
        files: The dataset's files.
        root: From `root_of`.
        frame: The frame of the columns `psmN_pose`, such as "ECM"; "base" stands for the base of each arm. Not
            needed if `frames` in our own file says it.

    Returns:
        The recording, in millimetres.

    Raises:
        UnreadableRecording: It is damaged, incomplete or has several episodes.
        NoUsableTopic: It has no pose and no joints of a PSM.
        BadColumns: A column is missing or ambiguous, or the frame or the instrument is not stated.
        BackwardStamps, RepeatedStamps, NotFinite, NotMetres, NotAQuaternion: As in `skills.demonstration.recording`.
    """
    dataset = read_dataset(files, root)
    if (count := len(dataset.data)) != 1:
        claimed = dataset.info.get("total_episodes")  # v3.0 has several in a file
        if count and isinstance(claimed, int) and count < claimed < 10**9:
            count = claimed
        raise several_episodes(count)
    meanings, commanded, unknown = _meanings(dataset)
    try:
        table = _read(dataset, meanings | commanded)
    except UnreadableRecording as error:
        table = _read(dataset, meanings)  # which raises if the fault is not one of setpoints
        unknown += [(columns.topic_of(*quantity), str(error)) for quantity in commanded]
        commanded = {}
    _check_one_episode(dataset, table)
    stamps_ns, clock = _stamps_ns(dataset, table)
    _check_rate(dataset, table, stamps_ns, clock)
    stamps_ns.setflags(write=False)  # so that all streams share it
    values = _values(table, meanings)
    for arm, kind in [one for one, parts in values.items() if one[1] == "jaw" and np.isnan(parts[0]).all()]:
        del values[arm, kind]
        unknown.append((columns.topic_of(arm, kind), "All its numbers are NaN: it was not recorded."))
    tools = _tools(dataset, table)
    joints = {
        arm: Joints(arm, columns.topic_of(arm, kind), stamps_ns, one[0])
        for (arm, kind), one in values.items()
        if kind == "joints"
    }
    for one in joints.values():
        columns.check_joints(one.topic, one.positions)
    motions, left_out = _motions(values, joints, tools, stamps_ns, _frames(dataset, frame, {arm for arm, _ in values}))
    instruments = {arm: number for arm, tool in tools.items() if (number := _number(tool)) is not None}
    tips, jaw_setpoints, unusable = columns.setpoints_in(_values(table, commanded), motions, instruments, stamps_ns)
    return Recording(
        format="lerobot",
        integrity="full",  # a zip archive has a checksum (CRC-32) of every file in it
        motions=motions,
        jaws=tuple(
            (arm, recorded_signal(stamps_ns, one[0][:, 0], columns.topic_of(arm, kind)))
            for (arm, kind), one in values.items()
            if kind == "jaw"
        ),
        topics=tuple(Topic(one.name[:NOTE_CHARACTERS], one.dtype[:20], table.rows) for one in dataset.features),
        joints=tuple(joints.values()),
        tools=tuple(sorted(tools.items())),
        notes=(*_notes(dataset, table), ("stamps", clock)),
        left_out=(*left_out, *unknown, *unusable),
        setpoints=tuple(tips),
        jaw_setpoints=tuple(jaw_setpoints),
    )


def _read(dataset: Dataset, meanings: Mapping[columns.Quantity, Mapping[int, Place]]) -> ParquetTable:
    """Read the columns of some quantities, the scalars and the tools."""
    used = {feature for places in meanings.values() for feature, _ in places.values()} | {*_SCALARS, *_CLOCKS}
    features = [one for one in dataset.features if (one.name in used and not one.is_text) or _arms_of_tools(one)]
    with dataset.files.unpacked(dataset.data[0]) as file:
        return read_columns(file, [one.column for one in features])


def _values(
    table: ParquetTable, meanings: Mapping[columns.Quantity, Mapping[int, Place]]
) -> dict[columns.Quantity, columns.Parts]:
    """Return the numbers of each quantity."""
    values: dict[columns.Quantity, columns.Parts] = {}
    for (arm, kind), places in sorted(meanings.items()):
        numbers = table.stacked([place for _, place in sorted(places.items())])
        if kind.startswith("joint"):
            values[arm, kind] = (columns.in_mm(numbers),)
        elif kind.startswith("jaw"):
            values[arm, kind] = (numbers,)
        else:  # the recorders write metres
            values[arm, kind] = (
                columns.scaled(numbers[:, :3], 1000.0),
                *([numbers[:, 3:]] if numbers.shape[1] > 3 else []),
            )
    return values


def episode_stamps(files: Files, root: str) -> Ints:
    """Return the stamps of a dataset of one episode, shape (T,); arguments and errors as `read_episode`."""
    dataset = read_dataset(files, root)
    if len(dataset.data) != 1:
        raise several_episodes(len(dataset.data))
    table = _read(dataset, {})
    _check_one_episode(dataset, table)
    return _stamps_ns(dataset, table)[0]


def several_episodes(episodes: int) -> UnreadableRecording:
    """Return the error that a dataset has no episode, or more than one."""
    if not episodes:
        return UnreadableRecording("The dataset has no .parquet file in its folder `data`; copy it again.")
    return UnreadableRecording(
        f"The dataset has {episodes} episodes. A recording is one of them, so that a surgeon's can be erased alone.",
        Remedy(Action.CUT_EPISODE),
        episodes=episodes,
    )


def _check_one_episode(dataset: Dataset, table: ParquetTable) -> None:
    """Refuse data of no frames, of several episodes, or of another length than the metadata claim."""
    if not table.rows:
        raise UnreadableRecording("The episode has no frames.")
    numbers = table.column("episode_index")
    if numbers is not None and len(found := np.unique(numbers)) > 1:
        raise several_episodes(len(found))
    dataset.check_length(None if numbers is None else int(numbers[0]), table.rows)


# ---- columns and their meanings ------------------------------------------------------------------------------------


def _meanings(
    dataset: Dataset,
) -> tuple[dict[columns.Quantity, dict[int, Place]], dict[columns.Quantity, dict[int, Place]], list[LeftOut]]:
    """Return the columns of each measured quantity by component, those of setpoints, and the columns left out.

    Raises:
        BadColumns: A column is ambiguous, a measured quantity incomplete, or a stated column is not there.
        NoUsableTopic: No quantity is a pose or the joints of a PSM.
    """
    numeric = [one for one in dataset.features if not one.is_text and not one.is_picture]
    stated = _stated(dataset, numeric)
    taken = set(stated.values())
    found: dict[columns.Quantity, dict[int, Place]] = {}
    for (arm, kind, component), place in stated.items():
        found.setdefault((arm, kind), {})[component] = place
    unknown, faults = [], {}
    for feature in numeric:
        action = feature.name == "action" or feature.name.startswith("action.")
        if not (action or feature.name.startswith(("observation.", "ros."))) or feature.name in (_SEC, _NANOSEC):
            continue
        bare = _bare(dataset, feature)
        nameless = []
        for index in range(feature.width):
            place, names = (feature.name, index), feature.called(index)
            said = (meaning_of(name.removeprefix("action.") if action else name) for name in names)
            meaning = bare.get(index) or next((one for one in said if one is not None), None)
            if meaning is None or (action and meaning[1] not in columns.SETPOINTS):
                nameless += [] if place in taken else [names[0]]
            elif meaning not in stated and place not in taken:
                arm, kind, component = meaning
                if found.setdefault((arm, kind), {}).setdefault(component, place) != place:
                    double = f"Two columns of the dataset are called {printable(names[0])!r}."
                    if kind not in columns.SETPOINTS:
                        raise BadColumns(double, Remedy(Action.NAME_FEATURES))
                    faults[arm, kind] = double
        if nameless and not action:
            unknown.append((feature.name[:NOTE_CHARACTERS], f"not used: {', '.join(nameless)}"[:NOTE_CHARACTERS]))
    measured = {quantity: places for quantity, places in found.items() if quantity[1] not in columns.SETPOINTS}
    for quantity, places in sorted(measured.items()):
        if why := _incomplete(quantity, places):
            raise BadColumns(why)
    commanded = {quantity: places for quantity, places in found.items() if quantity[1] in columns.SETPOINTS}
    faults |= {quantity: why for quantity, places in commanded.items() if (why := _incomplete(quantity, places))}
    unknown += [(columns.topic_of(*quantity), why) for quantity, why in faults.items()]
    if not any(kind != "jaw" for _, kind in measured):
        listed = ", ".join(name for one in numeric for name in one.names or [one.name]) or "no named columns"
        raise NoUsableTopic(
            f"No column of the dataset is known as a pose or the joints of a PSM. It has {printable(listed, 1000)}.",
            Remedy(Action.NAME_FEATURES),
        )
    return measured, {one: places for one, places in commanded.items() if one not in faults}, unknown


def meaning_of(name: str) -> tuple[str, str, int] | None:
    """Return the arm, the quantity and the component that a column's name stands for; None for any other name."""
    if pose := _POSE.fullmatch(name):
        kind = ("local_" if pose[2] else "") + ("pose" if pose[3].lower() == "pose" else "setpoint")
        return pose[1].upper(), kind, columns.POSE_PARTS.index(pose[4].lower())
    if joint := _JOINT.fullmatch(name):
        which, kind = joint[3].lower(), "joint_setpoints" if joint[2] else "joints"
        return joint[1].upper(), kind, int(which) - 1 if which.isdecimal() else JOINTS.index(which)
    if jaw := _JAW.fullmatch(name):
        return jaw[1].upper(), "jaw_setpoint" if jaw[2] else "jaw", 0
    if pose := _ROS_POSE.fullmatch(name):
        kind = ("local_" if pose[2] else "") + ("pose" if pose[3].lower() == "measured_cp" else "setpoint")
        part = f"position.{pose[4]}" if pose[4] else f"orientation.{pose[5]}"
        return pose[1].upper(), kind, columns.POSE_PARTS.index(part.lower())
    if angle := _ROS_ANGLE.fullmatch(name):
        is_measured = angle[3].lower() == "measured_js"
        if angle[2]:
            return (angle[1].upper(), "jaw" if is_measured else "jaw_setpoint", 0) if angle[4] == "0" else None
        return angle[1].upper(), "joints" if is_measured else "joint_setpoints", int(angle[4])
    return None


def _bare(dataset: Dataset, feature: Feature) -> dict[int, tuple[str, str, int]]:
    """Return the meanings of a state's numbers that are called after joints and no arm."""
    if feature.name != "observation.state" or feature.names[:6] != _BARE_JOINTS:
        return {}
    arms = list(dataset.statements.tools)
    arm = arms[0] if len(arms) == 1 else "PSM"
    jaw = {6: (arm, "jaw", 0)} if feature.names[6:7] == (_BARE_JAW,) else {}
    return {k: (arm, "joints", k) for k in range(6)} | jaw


def _stated(dataset: Dataset, numeric: Sequence[Feature]) -> dict[tuple[str, str, int], Place]:
    """Return the columns that `columns` of our own file names, by meaning."""
    places = {name: (one.name, k) for one in numeric for k in range(one.width) for name in reversed(one.called(k))}
    stated = {}
    for ours, theirs in dataset.statements.columns.items():
        meaning = meaning_of(ours)
        if meaning is None:
            raise BadColumns(
                f"{printable(ours)!r} is no column of ours; psm1_pose.position.x and psm1_joint_1 are two."
            )
        if theirs not in places:
            near = did_you_mean(theirs[:80], [name for name in places if len(name) <= 80][:300])
            raise BadColumns(f"The dataset has no column {printable(theirs)!r}.", *near)
        stated[meaning] = places[theirs]
    if len(set(stated.values())) < len(stated):
        raise BadColumns(f"`columns` in {STATEMENTS} gives two meanings to one column.")
    return stated


def _incomplete(quantity: columns.Quantity, places: Mapping[int, Place]) -> str | None:
    """Return the fault of a quantity with a missing column; a pose may have no orientation, a setpoint may not."""
    arm, kind = quantity
    if kind.startswith("jaw"):
        return None
    names = JOINTS if kind.startswith("joint") else columns.POSE_PARTS
    count = 3 if kind in ("pose", "local_pose") and max(places) < 3 else len(names)
    missing = next((names[k] for k in range(count) if k not in places), None)
    return missing and f"The {kind} of {arm} has no column {missing}; all parts are needed."


# ---- motions -------------------------------------------------------------------------------------------------------


def _motions(
    values: Mapping[columns.Quantity, columns.Parts],
    joints: Mapping[str, Joints],
    tools: Mapping[str, str],
    stamps_ns: Ints,
    frames: Mapping[str, str],
) -> tuple[tuple[Motion, ...], list[LeftOut]]:
    """Return the motions, and what makes none: poses without a stated frame, joints without an instrument.

    Raises:
        BadColumns: There is no motion at all.
    """
    motions, left_out = [], []
    for arm in sorted({arm for arm, _ in values}):
        local, pose, base = values.get((arm, "local_pose")), values.get((arm, "pose")), f"{arm}_base"
        computed = local is None
        if computed and arm in joints:
            number = _number(tools.get(arm, ""))
            if number is None:
                left_out.append((joints[arm].topic, f"no pose from joints: the instrument of {arm} is not known"))
            else:
                local = columns.pose_of(joints[arm].positions, number)
        if local is not None:
            motions.append(
                replace(columns.pose_motion(arm, "local_pose", base, stamps_ns, local), from_joints=computed)
            )
        if pose is not None and arm in frames:
            motions.append(columns.pose_motion(arm, "pose", frames[arm], stamps_ns, pose))
        elif pose is not None:
            left_out.append((columns.topic_of(arm, "pose"), "the dataset does not say in which frame it is"))
    if motions:
        for motion in motions:
            columns.check_outside(motion)
        return tuple(motions), left_out
    if any(kind == "pose" for _, kind in values):
        raise BadColumns(
            "The dataset does not say in which frame its poses are.",
            Remedy(Action.NAME_FRAME),
        )
    raise BadColumns(
        "The dataset has joints, which give no pose without the number of the instrument; known are "
        f"{', '.join(INSTRUMENTS)}.",
        Remedy(Action.NAME_TOOL),
    )


def _frames(dataset: Dataset, frame: str | None, arms: Collection[str]) -> dict[str, str]:
    """Return the frame of each arm's poses: as stated, or else as `frames` of our own file says.

    Raises:
        BadColumns: Our own file is not valid.
        MixedFrames: The stated frame is another than in our own file.
    """
    frames = {arm: named for arm, named in dataset.statements.frames.items() if arm in arms}
    stated = {} if frame is None else {arm: f"{arm}_base" if frame == columns.BASE else frame for arm in arms}
    wrong = sorted(arm for arm in frames if stated.get(arm, frames[arm]) != frames[arm])
    if wrong:
        raise MixedFrames(
            f"The frame of {wrong[0]} was stated as {stated[wrong[0]]}, and the dataset says {frames[wrong[0]]}.",
            frames=sorted(set(frames.values()))[:20],
        )
    return frames | stated


def _arms_of_tools(feature: Feature) -> list[str | None]:
    """Return the arm that each text of a feature names the tool of; [] if none does."""
    names = [feature.name] if feature.width == 1 and _TOOL.fullmatch(feature.name) else feature.names
    arms = [found[1].upper() if (found := _TOOL.fullmatch(name)) else None for name in names]
    return arms if feature.is_text and feature.name.startswith("observation.meta.tool") and any(arms) else []


def _tools(dataset: Dataset, table: ParquetTable) -> dict[str, str]:
    """Return the tool of each arm: as `tools` of our own file states it, or else as the dataset names it.

    Raises:
        BadColumns: A stated tool is unknown, or is not the one of the dataset.
        UnreadableRecording: A tool changes within the episode.
    """
    tools: dict[str, str] = {}
    for feature in dataset.features:
        for arm, names in zip(_arms_of_tools(feature), table.texts.get(feature.name, []), strict=False):
            if len(names) > 1:
                raise UnreadableRecording(f"The tool of {arm} changes within the episode; cut it there.")
            name = next(iter(names))[:NOTE_CHARACTERS]
            tools |= {arm: name} if arm is not None and name else {}
    for arm, tool in dataset.statements.tools.items():
        number, found = _number(tool), _number(tools.get(arm, ""))
        if number is None or not re.fullmatch(r"PSM\d{1,2}", arm):
            known = ", ".join(INSTRUMENTS)
            raise BadColumns(f"{printable(tool)!r} is no known instrument of {printable(arm)!r}; known are {known}.")
        if found not in (None, number):
            raise BadColumns(f"The instrument of {arm} was stated as {number}, and the dataset names {found}.")
        tools[arm] = tool[:NOTE_CHARACTERS]
    return tools


def _number(tool: str) -> str | None:
    """Return the number in a tool's name; None where it has no known one."""
    found = _NUMBER.search(tool)
    return found[1] if found is not None and found[1] in INSTRUMENTS else None


def _notes(dataset: Dataset, table: ParquetTable) -> list[tuple[str, str]]:
    """Return the version, the robot, the episode's number and split, and its tasks."""
    version = dataset.statements.cut_from
    notes = [("dataset", f"LeRobot {version if version in VERSIONS else dataset.version}")]
    if isinstance(robot := dataset.info.get("robot_type"), str):
        notes.append(("robot", robot[:NOTE_CHARACTERS]))
    if (numbers := table.column("episode_index")) is not None and np.isfinite(numbers[0]):
        notes.append(("episode", str(int(numbers[0]))))
        notes += [("splits", ", ".join(found))] if (found := dataset.splits_of(int(numbers[0]))) else []
    if (tasks := table.column("task_index")) is not None:
        names = [dataset.tasks.get(task) for task in np.unique(tasks)[:10].tolist()]
        notes += [("task", name[:NOTE_CHARACTERS]) for name in names if name is not None]
    return notes


# ---- stamps --------------------------------------------------------------------------------------------------------


def _stamps_ns(dataset: Dataset, table: ParquetTable) -> tuple[Ints, str]:
    """Return the stamps of the frames, shape (T,), and their source in words.

    The source is, in this order: the recorder's clock; timestamps in double precision; a frame's number divided by
    `fps`, where timestamps in single precision agree with it or are too coarse for a clock; those timestamps otherwise.

    Raises:
        BackwardStamps: A frame's number is not above the one before.
        NotFinite: A timestamp is NaN or infinite.
        UnreadableRecording: A number is not that of a frame or of a clock.
    """
    sec, nanosec, whole_ns = table.column(_SEC), table.column(_NANOSEC), table.column(_STAMP)
    if sec is not None and nanosec is not None:
        if not ((np.abs(sec) < 2**33) & (np.rint(sec) == sec) & (nanosec >= 0) & (nanosec < 1e9)).all():
            raise UnreadableRecording(f"{_SEC} and {_NANOSEC} are not whole seconds and nanoseconds of a clock.")
        return sec.astype(np.int64) * 1_000_000_000 + np.rint(nanosec).astype(np.int64), CLOCK
    if whole_ns is not None and ((whole_ns >= 0) & (whole_ns < 2**62)).all():
        return whole_ns.astype(np.int64), CLOCK
    frames, seconds = table.column("frame_index"), table.column("timestamp")
    frames = np.arange(table.rows, dtype=np.float64) if frames is None else frames
    if not ((frames >= 0) & (frames < 2**40)).all():
        raise UnreadableRecording("A frame_index of the episode is negative, too large, or no number.")
    if (later := np.diff(frames) > 0).size and not later.all():
        first = int(np.argmin(later)) + 1
        raise BackwardStamps(f"The frame_index of row {first} is not above the one before it.", sample=first)
    even_s, rate = frames / dataset.fps, f"frame_index at {dataset.fps:g} Hz"
    if seconds is None:
        return _in_ns(even_s), rate
    if not np.isfinite(seconds).all():
        first = int(np.argmin(np.isfinite(seconds)))
        raise NotFinite(f"The timestamp of row {first} is NaN or infinite.", sample=first)
    if not table.is_single("timestamp"):
        return _in_ns(seconds), "timestamp"
    step_s = float(np.spacing(np.float32(np.abs(seconds).max())))
    if (np.abs(seconds - even_s) <= max(SAME_S, step_s)).all():
        return _in_ns(even_s), rate
    if step_s > COARSE_S:
        return _in_ns(even_s), f"{rate}; timestamp has steps of {step_s:g} s"
    return _in_ns(seconds), "timestamp, in single precision"


def _check_rate(dataset: Dataset, table: ParquetTable, stamps_ns: Ints, clock: str) -> None:
    """Refuse stamps that contradict the rate of the dataset.

    Raises:
        ImplausibleMotion: The median step is not that of `fps`, within a factor of `RATE_FACTOR`.
    """
    frames = table.column("frame_index")
    steps = np.ones(table.rows - 1) if frames is None else np.diff(frames)
    if len(steps) < FEWEST_STEPS or clock == CLOCK:  # which is in seconds and nanoseconds, whatever the fps are
        return
    some = slice(None, None, 1 + len(steps) // columns.NEAR_SAMPLES)
    step_s = float(np.median(np.diff(stamps_ns)[some] / 1e9 / steps[some]))
    if step_s > 0 and not 1 / RATE_FACTOR <= step_s * dataset.fps <= RATE_FACTOR:
        raise ImplausibleMotion(
            f"The frames of the episode are {step_s:.6g} s apart by {clock}, and {1 / dataset.fps:.6g} s by the fps of "
            f"{dataset.fps:g} in {INFO}: one of them is wrong, or in another unit. Correct it."
        )


def _in_ns(seconds: Floats) -> Ints:
    """Convert seconds to whole nanoseconds, shape (T,)."""
    if not (np.abs(seconds) < 9e9).all():
        raise UnreadableRecording("A timestamp is after the year 2255; give seconds.")
    whole = np.floor(seconds)  # apart, so that the fraction keeps its digits
    return whole.astype(np.int64) * 1_000_000_000 + np.rint((seconds - whole) * 1e9).astype(np.int64)
