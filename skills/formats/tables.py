"""CSV tables of one arm's motion, with named columns.

`read_table` reads one row per sample, with these columns:

    t_s                            or t_ms, t_us, t_ns, never decreasing; or `rate_hz` from the caller, for tables
                                   without times
    x_m, y_m, z_m                  the tip, or x_mm, y_mm, z_mm; one unit for all three
    qx, qy, qz, qw                 its orientation as a unit quaternion, or
    roll_rad, pitch_rad, yaw_rad   as rotations about the fixed axes x, then y, then z (or _deg), or
    rx_rad, ry_rad, rz_rad         as a rotation vector (or _deg)
    jaw_rad                        the jaw's angle (or jaw_deg)
    clutch                         0 released, 1 pressed, 2 a quick tap
    q1_rad, q2_rad, q3_m,          the measured joints; joints alone become poses by forward kinematics with the
    q4_rad, q5_rad, q6_rad         instrument that the caller states

Under other names, a column is what the caller says: `x_mm=PosX`, or `x=PosX` with the unit `mm`. Columns that are
neither named like this nor mapped are refused, because a time or an orientation under another name would be ignored
silently; where the caller maps columns, the others are not used. Nothing is guessed from the values.

Two headers mean the same as these: that of the paper's raw recordings, `Rot R, Rot P, Rot Y, Pos X, Pos Y, Pos Z` (rad
and m), and that of joint tables of calibrations, `measured_q1` ... `measured_q6`, `measured_x` ... `measured_rz` (rad
and m, a rotation vector). Roll, pitch and yaw are those of KDL's `Rotation::RPY`, which the dVRK's tools use:
R = Rz(yaw) Ry(pitch) Rx(roll).

A table has no checksum, so its integrity is "none".
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.plausible import MOST_HZ
from skills.demonstration.recording import (
    Column,
    Recording,
    Signal,
    Topic,
    recorded_joints,
    recorded_motion,
    recorded_signal,
)
from skills.errors import BadColumns, BadSettings, NoUsableTopic
from skills.formats import cells
from skills.formats.columns import (
    BASE,
    base_of,
    check_joints,
    check_outside,
    posed,
    quaternion_of_rpy,
    quaternion_of_vector,
    scaled,
)
from skills.kinematics import JOINTS, UNITS, instrument_of
from skills.remedies import Action, Remedy, did_you_mean

TOPIC = "table"
DEFAULT_ARM = "PSM"
NOT_ENDED = ("last row", "It has no line end: if the file was cut, its last number lacks digits.")

LENGTHS: Mapping[str, float] = {"m": 1000.0, "mm": 1.0}  # in mm
ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": np.pi / 180}  # in rad
_DIMENSIONS: tuple[Mapping[str, float], ...] = (cells.NS_PER, LENGTHS, ANGLES)
PLAIN: Mapping[str, float] = {"": 1.0}
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
RPY, ROTATION_VECTOR = ("roll", "pitch", "yaw"), ("rx", "ry", "rz")
JOINT_NAMES = tuple(f"q{k}" for k in range(1, len(JOINTS) + 1))
QUANTITIES: Mapping[str, Mapping[str, float]] = {
    "t": cells.NS_PER,
    **dict.fromkeys(POSITION, LENGTHS),
    **dict.fromkeys(QUATERNION, PLAIN),
    **dict.fromkeys((*RPY, *ROTATION_VECTOR, "jaw"), ANGLES),
    "clutch": PLAIN,
    **{name: LENGTHS if unit == "mm" else ANGLES for name, unit in zip(JOINT_NAMES, UNITS, strict=True)},
}
# Ours: the greatest number of an orientation, of joints or of a jaw, if it is in radians. Smaller ones are no motion.
_RADIANS: Mapping[tuple[str, ...], tuple[float, float]] = {
    RPY: (0.5, np.pi),
    ROTATION_VECTOR: (0.5, np.pi),
    tuple(name for name in JOINT_NAMES if QUANTITIES[name] is ANGLES): (0.1, 4.6),
    ("jaw",): (0.3, 1.6),
}
KNOWN = (
    "t_s (or t_ms, t_us, t_ns), x_m, y_m, z_m (or _mm), qx, qy, qz, qw, roll_rad, pitch_rad, yaw_rad, rx_rad, ry_rad, "
    "rz_rad, jaw_rad (or _deg), clutch, q1_rad, q2_rad, q3_m, q4_rad, q5_rad, q6_rad"
)
_INDICES = ("", "Unnamed: 0", "index")  # the first column of a table by pandas: the numbers of its rows
_PAPER_NAMES = {
    "Rot R": "roll_rad",
    "Rot P": "pitch_rad",
    "Rot Y": "yaw_rad",
    "Pos X": "x_m",
    "Pos Y": "y_m",
    "Pos Z": "z_m",
}
_CALIBRATION_NAMES = {
    f"measured_{name}": f"{name}_{'m' if QUANTITIES[name] is LENGTHS else 'rad'}"
    for name in (*JOINT_NAMES, *POSITION, *ROTATION_VECTOR)
}
_OTHERS_OF_CALIBRATIONS = re.compile(r"traj_index|(marker|setpoint)_\w+")


@dataclass(frozen=True)
class ReadingOptions:
    """Statements about a table that the table itself does not make.

    Attributes:
        rate_hz: Samples per second, for a table without times.
        frame: The frame of the positions, or `BASE`; by default the base of the arm, but needed for mapped positions.
        column: The columns under other names, each as `x_mm=PosX` or `x=PosX`.
        unit: The units of columns without a unit: of lengths, angles and times, one each.
        decimal: The decimal mark.
        table_arm: The name of the arm.
        instrument: The number of its instrument.
        untimed: Count the samples of a table without times, instead of refusing it: for a preview.
    """

    rate_hz: float | None = None
    frame: str | None = None
    column: Sequence[str] = ()
    unit: Sequence[str] = ()
    decimal: cells.Decimals = "point"
    table_arm: str | None = None
    instrument: str | None = None
    untimed: bool = False

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0 < self.rate_hz <= MOST_HZ:
            raise BadSettings(f"rate_hz is {self.rate_hz}; give samples per second, above 0 and up to {MOST_HZ:g}.")
        if self.decimal not in ("point", "comma"):
            raise BadSettings(f"decimal is {self.decimal!r}; it is point or comma.")
        if self.instrument is not None:
            instrument_of(self.instrument)


@dataclass(frozen=True)
class _Use:
    """A column that is read: its index, and the unit in which it has its quantity."""

    index: int
    unit: str


@dataclass(frozen=True)
class _Table:
    """The columns of a table in mm and rad by quantity, each of shape (T,), and the stamps."""

    columns: dict[str, Floats]
    stamps_ns: Ints

    def stacked(self, names: Iterable[str]) -> Floats:
        """Return some columns as one array, shape (T, number of names)."""
        return np.stack([self.columns[name] for name in names], axis=1)


def read_table(file: BinaryIO, reading: ReadingOptions | None = None) -> Recording:
    """Read one arm's motion from a table.

    Args:
        file: The file, at its beginning; UTF-8, separated by commas, semicolons or tabs, with the header in its first
            line.
        reading: What the caller says about it.

    Returns:
        The recording, in millimetres.

    Raises:
        BadColumns: A column is unknown, duplicate, missing or ambiguous, or time is given twice or not at all.
        BadSettings: A mapping or a unit is impossible or contradicts a column.
        NoUsableTopic: There are neither positions nor joints with a stated instrument.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows, or a last number that was
            cut; without a line end after it, the recording has a note that it may have been.
        NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: As in `skills.demonstration.recording`.
    """
    options = reading or ReadingOptions()
    is_ended = cells.ends_with_line(file)
    with cells.open_text(file) as text:
        names, separator = cells.header_of(text)
        uses = _uses(names, options)
        _check_groups(uses)
        time = uses.get("t")
        check_time(None if time is None else names[time.index], options)
        at = None if time is None else (time.index, time.unit)
        used = [[use.index] for use in uses.values()]
        numbers = cells.read_numbers(text, cells.TableLayout(names, used, separator, options.decimal, at))
    if not is_ended:
        cells.check_last_number(file, separator, options.decimal)
    stamps_ns = stamps_of(numbers.stamps_ns, numbers.rows, options)
    columns = {
        name: scaled(found[:, 0], QUANTITIES[name][use.unit])
        for found, (name, use) in zip(numbers.groups, uses.items(), strict=True)
    }
    _check_degrees(names, uses, columns)
    meant = {use.index: (quantity, use.unit) for quantity, use in uses.items()}
    listed = tuple(Column(name, *meant.get(index, ("", ""))) for index, name in enumerate(names))
    recording = _recording(_Table(columns, stamps_ns), options, listed)
    return recording if is_ended else replace(recording, notes=(NOT_ENDED,))


def _recording(table: _Table, options: ReadingOptions, columns: tuple[Column, ...]) -> Recording:
    """Return the recording of the numbers of a table; raises as `read_table`."""
    arm = options.table_arm or DEFAULT_ARM
    joints = None
    if JOINT_NAMES[0] in table.columns:
        joints = table.stacked(JOINT_NAMES)
        check_joints(TOPIC, joints)
    if POSITION[0] in table.columns:
        _check_frame(options)
        tip_mm, rotation = table.stacked(POSITION), _rotation_xyzw(table)
        frame = options.frame if options.frame not in (None, BASE) else f"{arm}_base"
    else:
        assert joints is not None  # `_check_groups`
        tip_mm, rotation = posed(TOPIC, joints, options.instrument)
        frame = base_of(arm, options.frame)
    motion = recorded_motion(
        arm=arm, topic=TOPIC, frame=frame, stamps_ns=table.stamps_ns, tip_mm=tip_mm, rotation_xyzw=rotation
    )
    motion = replace(motion, from_joints=POSITION[0] not in table.columns)
    check_outside(motion)
    return Recording(
        format="csv",
        integrity="none",
        motions=(motion,),
        jaws=tuple((arm, signal) for signal in [_signal(table, "jaw", "jaw_rad")] if signal is not None),
        clutch=_signal(table, "clutch", "clutch"),
        topics=(Topic(TOPIC, "text/csv", len(table.stamps_ns)),),
        joints=() if joints is None else (recorded_joints(arm, f"{TOPIC} joints", table.stamps_ns, joints),),
        tools=() if options.instrument is None else ((arm, options.instrument),),
        columns=columns,
    )


# ---- the meaning of the columns ----------------------------------------------------------------------------------


def _uses(names: list[str], options: ReadingOptions) -> dict[str, _Use]:
    """Return the columns to read by quantity, in the order of the header.

    Raises:
        BadColumns: A column is unknown or duplicate, or a mapping names one that does not exist.
        BadSettings: A mapping or a unit is impossible, or contradicts another.
    """
    if all(map(cells.is_number, names)):
        raise BadColumns(
            "The table has no header: its first row has numbers. Write the names of the columns above it, separated as "
            f"the numbers are. Known columns: {KNOWN}."
        )
    units, needed = _units(options), set[str]()
    of_calibration = all(f"measured_{name}" in names for name in JOINT_NAMES)
    aliases = _CALIBRATION_NAMES if of_calibration else _PAPER_NAMES
    mapped = _mapped(names, options, units, needed)
    taken, own, unknown = {use.index for use in mapped.values()}, dict[str, _Use](), list[str]()
    for index, name in enumerate(names):
        if index in taken:
            continue
        quantity, unit = _named(aliases.get(name, name))
        if not quantity or (not unit and QUANTITIES[quantity] is not PLAIN):
            is_index = index == 0 and name in _INDICES  # it is listed as not used
            if not mapped and not is_index and not (of_calibration and _OTHERS_OF_CALIBRATIONS.fullmatch(name)):
                unknown.append(name)
        elif quantity in own:
            one, other = _full(quantity, own[quantity].unit), _full(quantity, unit)
            what = f"column {one!r} twice" if one == other else f"same quantity twice, as {one} and as {other}"
            raise BadColumns(f"The table has the {what}; keep one of them.", doubled=[one, other])
        elif quantity not in mapped:
            own[quantity] = _Use(index, unit)
    if unknown:
        raise BadColumns(
            f"The table has the unknown column {unknown[0][:80]!r}. Known columns: {KNOWN}.",
            Remedy(Action.NAME_COLUMNS),
            unknown=unknown[:20],
        )
    unneeded = [unit for unit in units.values() if unit not in needed]
    if unneeded:
        raise BadSettings(
            f"The unit {unneeded[0]} belongs to no mapped column without a unit; omit it, or map one, as in x=NAME."
        )
    return dict(sorted({**mapped, **own}.items(), key=lambda one: one[1].index))


def _named(name: str) -> tuple[str, str]:
    """Split a name such as "x_mm" into quantity and unit; ("", "") for any other, no unit where none is named."""
    if name in QUANTITIES:
        return name, ""
    quantity, _, unit = name.rpartition("_")
    return (quantity, unit) if unit and unit in QUANTITIES.get(quantity, ()) else ("", "")


def _full(quantity: str, unit: str) -> str:
    return f"{quantity}_{unit}" if unit else quantity


def _mapped(names: list[str], options: ReadingOptions, units: Mapping[int, str], needed: set[str]) -> dict[str, _Use]:
    """Return the columns that the caller maps, by quantity; raises as `_uses`."""
    mapped: dict[str, _Use] = {}
    for one in options.column:
        target, equals, column = one.partition("=")
        quantity, unit = _named(target.strip())
        column = column.strip()
        if not equals or not quantity or not column:
            raise BadSettings(f"The mapping {one[:80]!r} is not of the form x_mm=NAME. Known columns: {KNOWN}.")
        if column not in names:
            raise BadColumns(
                f"The table has no column {column[:80]!r}; it has {', '.join(names)[:500]}.",
                *did_you_mean(column, names),
                column=column[:80],
            )
        if names.count(column) > 1:
            raise BadColumns(f"The table has the column {column[:80]!r} twice; rename one.", doubled=[column[:80]])
        if quantity in mapped or names.index(column) in {use.index for use in mapped.values()}:
            raise BadSettings(
                f"The mapping {one[:80]!r} names {quantity} or its column a second time; keep one of them."
            )
        mapped[quantity] = _Use(names.index(column), _unit_of(quantity, unit, column, units, needed))
    return mapped


def _unit_of(quantity: str, unit: str, column: str, units: Mapping[int, str], needed: set[str]) -> str:
    """Return the unit of a mapped column; of the units that the caller gave, those that apply are added to `needed`."""
    possible = QUANTITIES[quantity]
    given = units.get(id(possible), "")
    if given:
        needed.add(given)
    if unit and given and unit != given:
        raise BadSettings(
            f"The column {column[:80]!r} is mapped in {unit}, and the unit is {given}; which is it? Omit the other."
        )
    if not unit and not given and possible is not PLAIN:
        one, *_, other = possible
        remedy = Remedy(Action.NAME_UNIT, one=one, other=other)
        raise BadSettings(f"In which unit is the column {column[:80]!r}: {', '.join(possible)}?", remedy)
    return unit or given


def _units(options: ReadingOptions) -> dict[int, str]:
    """Return the units that the caller gives, by the identity of their dimension."""
    units: dict[int, str] = {}
    for unit in options.unit:
        dimension = next((one for one in _DIMENSIONS if unit in one), None)
        if dimension is None:
            known = ", ".join(unit for one in _DIMENSIONS for unit in one)
            raise BadSettings(f"The unit {unit[:20]!r} is unknown; use one of {known}.")
        if units.setdefault(id(dimension), unit) != unit:
            raise BadSettings(
                f"The units {units[id(dimension)]} and {unit} contradict each other; which of them is it?"
            )
    return units


def _check_groups(uses: Mapping[str, _Use]) -> None:
    """Refuse incomplete groups of columns, and two orientations.

    Raises:
        BadColumns: A group is incomplete or given twice.
        NoUsableTopic: There are neither positions nor joints.
    """
    if not {*POSITION, *JOINT_NAMES} & set(uses):
        raise NoUsableTopic(
            "The table has no position; name the columns x_m, y_m, z_m (or _mm).", Remedy(Action.NAME_COLUMNS)
        )
    for group in (POSITION, QUATERNION, RPY, ROTATION_VECTOR, JOINT_NAMES):
        here = [name for name in group if name in uses]
        if not here:
            continue
        missing = [name for name in group if name not in uses]
        units = {} if group == JOINT_NAMES else {uses[name].unit for name in here}
        first = uses[here[0]].unit
        if len(units) > 1:  # one in m and another in mm
            missing = [name for name in here if uses[name].unit != first]
        if missing:
            full = [
                _full(name, first if group != JOINT_NAMES else "m" if QUANTITIES[name] is LENGTHS else "rad")
                for name in group
            ]
            gone = full[group.index(missing[0])]
            raise BadColumns(f"The table needs all of {', '.join(full)}: {gone} is missing.", missing=missing)
    turns = [group for group in (QUATERNION, RPY, ROTATION_VECTOR) if group[0] in uses]
    if len(turns) > 1:
        raise BadColumns(
            f"The table has the same quantity twice, as {turns[0][0]} ... and as {turns[1][0]} ...; keep one of them."
        )


# ---- what tables of every kind share -----------------------------------------------------------------------------


def _check_frame(options: ReadingOptions) -> None:
    """Refuse positions under another name without a frame: only our own names mean the base of the arm.

    Raises:
        BadColumns: There is none.
    """
    mapped = {one.partition("=")[0].partition("_")[0] for one in options.column}
    if options.frame is None and mapped & set(POSITION):
        raise BadColumns("The table does not say in which frame its positions are.", Remedy(Action.NAME_FRAME))


def check_time(column: str | None, options: ReadingOptions) -> None:
    """Refuse a table whose times are given twice or not at all.

    Raises:
        BadColumns: There are a column of times and a rate, or neither.
    """
    if column is not None and options.rate_hz is not None:
        raise BadColumns(f"The table has the column {column} and the request has rate_hz; use one of them.")
    if column is None and options.rate_hz is None and not options.untimed:
        raise BadColumns("The table has no column t_s, and there is no rate.", Remedy(Action.NAME_RATE))


def stamps_of(stamps_ns: Ints | None, count: int, options: ReadingOptions) -> Ints:
    """Return the stamps of a table: its own, those of the rate, or a second per sample where neither is known."""
    if stamps_ns is not None:
        return stamps_ns
    even: Ints = np.rint(np.arange(count) * (1e9 / (options.rate_hz or 1.0))).astype(np.int64)
    return even


def _check_degrees(names: Sequence[str], uses: Mapping[str, _Use], columns: Mapping[str, Floats]) -> None:
    """Ask about degrees that stay within the numbers that radians have.

    Raises:
        BadColumns: The greatest number of a group is within its limits in `_RADIANS`.
    """
    for group, (least, most) in _RADIANS.items():
        read = {name: np.degrees(columns[name]) for name in group if name in uses and uses[name].unit == "deg"}
        greatest = max((float(np.abs(values).max()) for values in read.values()), default=0.0)
        if least <= greatest <= most:
            name = next(iter(read))
            first = names[uses[name].index][:80]
            raise BadColumns(
                f"The angles of {', '.join(read)} are at most {greatest:.3g}, read as degrees; radians have such "
                f"numbers. Name the columns with the right unit, as in {name}_rad={first}; if they are degrees, give "
                "them in radians.",
                column=first,
            )


def _rotation_xyzw(table: _Table) -> Floats | None:
    """Return the orientations as unit quaternions, (T, 4); None if the table has none."""
    if QUATERNION[0] in table.columns:
        return table.stacked(QUATERNION)
    if RPY[0] in table.columns:
        return quaternion_of_rpy(TOPIC, table.stacked(RPY))
    return quaternion_of_vector(TOPIC, table.stacked(ROTATION_VECTOR)) if ROTATION_VECTOR[0] in table.columns else None


def _signal(table: _Table, quantity: str, name: str) -> Signal | None:
    if quantity not in table.columns:
        return None
    return recorded_signal(table.stamps_ns, table.columns[quantity], f"{TOPIC} {name}")
