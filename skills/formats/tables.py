"""CSV tables of one arm's motion: with columns named by their units, or as dVRK recorders extract them from a bag.

`read_table` reads one row per sample, with these columns:

    t_s                            seconds, never decreasing; or `rate_hz` from the caller, for tables without times
    x_m, y_m, z_m                  the tip, or x_mm, y_mm, z_mm; one unit for all three
    qx, qy, qz, qw                 its orientation as a unit quaternion, or
    roll_rad, pitch_rad, yaw_rad   as rotations about the fixed axes x, then y, then z
    jaw_rad                        the jaw's angle
    clutch                         0 released, 1 pressed, 2 a quick tap

The header of the paper's raw recordings, `Rot R, Rot P, Rot Y, Pos X, Pos Y, Pos Z` (rad and m), means the same as
`roll_rad, pitch_rad, yaw_rad, x_m, y_m, z_m`. Roll, pitch and yaw are those of KDL's `Rotation::RPY`, which the dVRK's
tools use: R = Rz(yaw) Ry(pitch) Rx(roll). Any other column is refused, because a time or an orientation under another
name would be ignored silently.

`read_extract` reads the extract of one pose topic:

    # Topic: /PSM1/local/measured_cp
    # Type: geometry_msgs/msg/PoseStamped
    timestamp,header.frame_id,header.stamp.nanosec,header.stamp.sec,pose.orientation.w,...

Its columns are the message's fields by their dotted names, in any order: metres, a unit quaternion, the header's stamp.
`timestamp`, the time of reception, and all other columns are not used.

A table has no checksum, so its integrity is "none". The length of each line is limited before it is parsed.
"""

import csv
import io
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, BinaryIO, TextIO

import numpy as np

from skills.arrays import Floats, Ints
from skills.demonstration.recording import Motion, Recording, Signal, Topic, recorded_motion
from skills.errors import BadColumns, BadSettings, MixedFrames, NotFinite, NotMetres, NoUsableTopic, UnreadableRecording
from skills.formats import topics
from skills.kinematics import CANNULA_MM, INSTRUMENTS

LINE_CHARACTERS = 16_384  # a row of the widest supported table has 2,500

if TYPE_CHECKING:
    from _csv import Reader


def csv_rows(text: TextIO, *, first_line: int = 1) -> "Reader":
    """Return an iterator over comma-separated rows, each from one line of at most `LINE_CHARACTERS` characters.

    A row of numbers never continues on a second line; with quoted cells that do, a row could be unlimited in length.
    Iterating raises `csv.Error`, and `UnreadableRecording` for a line that is longer or has an unclosed quoted cell.

    Args:
        text: Positioned at the first row.
        first_line: The number of the line at which `text` is positioned, for messages.
    """
    return csv.reader(_lines(text, first_line), strict=True)


def _lines(text: TextIO, number: int) -> Iterator[str]:
    while line := text.readline(LINE_CHARACTERS + 1):
        if len(line) > LINE_CHARACTERS:
            raise UnreadableRecording(
                f"Line {number} of the table has more than {LINE_CHARACTERS} characters; export the table again.",
                line=number,
            )
        if line.count('"') % 2:
            raise UnreadableRecording(
                f"The table is not comma-separated text: line {number} opens a quoted cell and does not close it. "
                "Export the table again.",
                line=number,
            )
        yield line
        number += 1


TOPIC = "table"
DEFAULT_FRAME = "PSM_base"  # relative to the remote centre of motion
DEFAULT_ARM = "PSM"
# The tip is further from the remote centre than the wrist, because the wrist bends by less than a right angle. A reach
# of 290 mm is 11.4 inches, so a path in inches never exceeds this limit.
OUTSIDE_MM = min(CANNULA_MM - instrument.wrist_offset_mm for instrument in INSTRUMENTS.values())

if TYPE_CHECKING:
    from _csv import Reader as _Rows

_PAPER_NAMES = {
    "Rot R": "roll_rad",
    "Rot P": "pitch_rad",
    "Rot Y": "yaw_rad",
    "Pos X": "x_m",
    "Pos Y": "y_m",
    "Pos Z": "z_m",
}
_METRES, _MILLIMETRES = ("x_m", "y_m", "z_m"), ("x_mm", "y_mm", "z_mm")
_QUATERNION, _RPY = ("qx", "qy", "qz", "qw"), ("roll_rad", "pitch_rad", "yaw_rad")
KNOWN = ("t_s", *_METRES, *_MILLIMETRES, *_QUATERNION, *_RPY, "jaw_rad", "clutch")
COLUMNS = 100  # there are 17 names; up to this number the message names the first unknown or duplicate one
ROWS = 5_000_000  # 14 hours at 100 Hz
_LATEST_S = 4e9  # the year 2096; larger values are in milliseconds or a smaller unit
_FASTEST_HZ = 100_000.0
_FIRST_ROW = 2  # the header is row 1


@dataclass(frozen=True)
class _Table:
    """The cells as numbers: columns by name, each of shape (T,), and exact stamps if there is a column `t_s`."""

    columns: dict[str, Floats]
    stamps_ns: Ints | None
    rows: int

    def stacked(self, names: tuple[str, ...]) -> Floats:
        """Return some columns as one array, shape (T, len(names))."""
        return np.stack([self.columns[name] for name in names], axis=1)


def read_table(
    file: BinaryIO, *, rate_hz: float | None = None, frame: str = DEFAULT_FRAME, arm: str = DEFAULT_ARM
) -> Recording:
    """Read one arm's motion from a CSV file.

    Args:
        file: The file, at its beginning; UTF-8, comma-separated, with the header in its first line.
        rate_hz: Samples per second, for a table without `t_s`.
        frame: The frame of the positions.
        arm: The arm's name.

    Returns:
        The recording, in millimetres.

    Raises:
        BadColumns: A column is unknown, duplicate, missing or ambiguous, or time is given twice or not at all.
        BadSettings: `rate_hz` is not a rate.
        NoUsableTopic: There are no position columns.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows.
        NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: As in `skills.demonstration.recording`.
    """
    table = _read(file, rate_hz)
    stamps_ns = _stamps_ns(table, rate_hz)
    motion = recorded_motion(
        arm=arm,
        topic=TOPIC,
        frame=frame,
        stamps_ns=stamps_ns,
        tip_mm=_tip_mm(table),
        rotation_xyzw=_rotation_xyzw(table),
    )
    _check_outside(motion)
    return Recording(
        format="csv",
        integrity="none",
        motions=(motion,),
        jaws=tuple((arm, signal) for signal in [_signal(table, "jaw_rad", stamps_ns)] if signal is not None),
        clutch=_signal(table, "clutch", stamps_ns),
        topics=(Topic(TOPIC, "text/csv", table.rows),),
    )


def quaternion_of_rpy(rpy_rad: Floats) -> Floats:
    """Return the unit quaternions x, y, z, w of R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        rpy_rad: Roll, pitch, yaw about the fixed axes x, y, z, shape (T, 3).

    Returns:
        Shape (T, 4).
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad.T / 2), np.sin(rpy_rad.T / 2)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.stack([x, y, z, w], axis=1)


def _read(file: BinaryIO, rate_hz: float | None) -> _Table:
    text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
    try:
        rows = csv_rows(text)
        names = _checked_header([_PAPER_NAMES.get(name.strip(), name.strip()) for name in next(rows, [])], rate_hz)
        return _numbers(names, rows)
    except (csv.Error, UnicodeDecodeError) as error:
        raise UnreadableRecording(f"The table is not comma-separated UTF-8 text: {error}. Export it again.") from error
    finally:
        text.detach()  # otherwise the wrapper would close the caller's file


def _checked_header(names: list[str], rate_hz: float | None) -> list[str]:
    if len(names) > COLUMNS:
        raise BadColumns(
            f"The table has {len(names)} columns, more than the limit of {COLUMNS}; keep those with the motion. "
            f"Known columns: {', '.join(KNOWN)}.",
            columns=len(names),
        )
    unknown = [name for name in names if name not in KNOWN]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if unknown or doubled:
        what = f"has the unknown column {unknown[0]!r}" if unknown else f"has the column {doubled[0]!r} twice"
        raise BadColumns(f"The table {what}; known columns: {', '.join(KNOWN)}.", unknown=unknown, doubled=doubled)
    if not {*_METRES, *_MILLIMETRES} & set(names):
        raise NoUsableTopic("The table has no position; name the columns x_m, y_m, z_m (or _mm).")
    for group in (_METRES, _MILLIMETRES, _QUATERNION, _RPY):
        missing = [name for name in group if name not in names]
        if 0 < len(missing) < len(group):
            raise BadColumns(f"The table needs all of {', '.join(group)}: {missing[0]} is missing.", missing=missing)
    for one, other in ((_METRES, _MILLIMETRES), (_QUATERNION, _RPY)):
        if one[0] in names and other[0] in names:
            raise BadColumns(
                f"The table has the same quantity twice, as {one[0]} ... and as {other[0]} ...; keep one of them."
            )
    _check_time(has_times="t_s" in names, rate_hz=rate_hz)
    return names


def _check_time(*, has_times: bool, rate_hz: float | None) -> None:
    if has_times and rate_hz is not None:
        raise BadColumns("The table has the column t_s and the request has rate_hz; use one of them.")
    if rate_hz is not None and not 0 < rate_hz <= _FASTEST_HZ:
        raise BadSettings(f"rate_hz is {rate_hz}; give samples per second, above 0 and up to {_FASTEST_HZ:g}.")


def _numbers(names: list[str], rows: "_Rows") -> _Table:
    # Times are also stored as text, because a float is too coarse for nanoseconds (`_exact_ns`).
    cells, times, blank_line = array("d"), list[str](), 0
    time_column = names.index("t_s") if "t_s" in names else None
    for row in rows:
        if not row:
            blank_line = blank_line or rows.line_num
            continue
        if len(cells) >= ROWS * len(names):
            raise UnreadableRecording(f"The table has more than {ROWS} rows; cut it into parts and send each part.")
        if blank_line or len(row) != len(names):
            line = blank_line or rows.line_num
            found = 0 if blank_line else len(row)
            raise UnreadableRecording(f"Row {line} has {found} cells, the header {len(names)}. Export the table again.")
        try:
            cells.extend(map(float, row))
        except ValueError:
            raise _no_number(names, row, rows.line_num) from None
        if "_" in "".join(row):  # Python parses 1_000, which no exporter writes
            raise _no_number(names, row, rows.line_num)
        if time_column is not None:
            times.append(row[time_column])
    if not cells:
        raise UnreadableRecording("The table has a header and no rows.")
    columns = np.frombuffer(cells).reshape(-1, len(names))
    _check_finite(names, columns)
    return _Table(
        columns={name: columns[:, k] for k, name in enumerate(names)},
        stamps_ns=None if time_column is None else _exact_ns(times, columns[:, time_column]),
        rows=len(columns),
    )


def _no_number(names: list[str], row: list[str], line: int) -> UnreadableRecording:
    name = next(name for name, cell in zip(names, row, strict=True) if not is_number(cell))
    return UnreadableRecording(
        f"Row {line}, column {name}: not a number; export the table again.", row=line, column=name
    )


def is_number(cell: str) -> bool:
    """Return whether a cell of a table is a number, in any form that an exporter writes."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # Python parses 1_000, which no exporter writes


def _check_finite(names: list[str], columns: Floats) -> None:
    wrong = ~np.isfinite(columns)
    if wrong.any():
        row, column = np.argwhere(wrong)[0].tolist()
        line, name = row + _FIRST_ROW, names[column]
        raise NotFinite(f"Row {line}, column {name}: NaN or infinity; cut the row.", row=line, column=name)


def _exact_ns(times: list[str], seconds: Floats) -> Ints:
    """Convert seconds to whole nanoseconds exactly: a float of seconds since 1970 is only accurate to 240 ns."""
    late = np.abs(seconds) > _LATEST_S
    if late.any():
        row = int(np.argmax(late))
        raise BadColumns(
            f"Row {row + _FIRST_ROW}, column t_s: {seconds[row]:g} s is after the year 2096; give seconds.",
            row=row + _FIRST_ROW,
        )
    return np.array([round(Decimal(cell.strip()) * 1_000_000_000) for cell in times], dtype=np.int64)


def _stamps_ns(table: _Table, rate_hz: float | None) -> Ints:
    if table.stamps_ns is not None:
        return table.stamps_ns
    if rate_hz is None:
        raise BadColumns("The table has no column t_s; add it, or give rate_hz for samples at a constant rate.")
    even: Ints = np.rint(np.arange(table.rows) * (1e9 / rate_hz)).astype(np.int64)
    return even


def _tip_mm(table: _Table) -> Floats:
    return 1000.0 * table.stacked(_METRES) if "x_m" in table.columns else table.stacked(_MILLIMETRES)


def _check_outside(motion: Motion) -> None:
    """Refuse a path that never leaves the cannula: its numbers are in another unit, or from another origin."""
    if not motion.frame.endswith("_base"):  # only there the origin is the remote centre
        return
    away_mm = np.sqrt(np.einsum("ij,ij->i", motion.tip_mm, motion.tip_mm))
    furthest = int(np.argmax(away_mm))
    if away_mm[furthest] < OUTSIDE_MM:
        at_s = (int(motion.stamps_ns[furthest]) - int(motion.stamps_ns[0])) / 1e9
        raise NotMetres(
            f"The tip is at most {away_mm[furthest]:.3g} mm from the remote centre (at {at_s:.3f} s); below "
            f"{OUTSIDE_MM:.3g} mm its wrist is inside the cannula. Give the positions in the unit of the column "
            "names, not in inches; or name the frame, if they are not relative to the remote centre.",
            sample=furthest,
            furthest_mm=float(away_mm[furthest]),
        )


def _rotation_xyzw(table: _Table) -> Floats | None:
    if "qx" in table.columns:
        return table.stacked(_QUATERNION)
    return quaternion_of_rpy(table.stacked(_RPY)) if "roll_rad" in table.columns else None


def _signal(table: _Table, name: str, stamps_ns: Ints) -> Signal | None:
    return Signal(stamps_ns, table.columns[name], f"{TOPIC} {name}") if name in table.columns else None


FIRST = "# Topic:"

_SECOND = "# Type:"
_HEADER_LINE = 3
_FRAME, _SEC, _NANOSEC = "header.frame_id", "header.stamp.sec", "header.stamp.nanosec"
_PLACES = {
    topics.POSE: ("pose.position.", "pose.orientation."),
    topics.TRANSFORM: ("transform.translation.", "transform.rotation."),
}


def read_extract(file: BinaryIO) -> Recording:
    """Read one arm's motion from the extract of its pose topic.

    Args:
        file: The file, at its beginning; UTF-8, comma-separated.

    Returns:
        The recording, in millimetres.

    Raises:
        NoUsableTopic: The topic is not a pose of a PSM.
        BadColumns: A column is missing or duplicate.
        UnreadableRecording: A row of another length, a cell that is not a number, no rows.
        MixedFrames, NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: See `skills.errors`.
    """
    text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
    try:
        first, second = text.readline(LINE_CHARACTERS), text.readline(LINE_CHARACTERS)
        topic, kind = first.removeprefix(FIRST).strip(), second.removeprefix(_SECOND).strip()
        arm = topics.arm_of_pose(topic, kind)
        if arm is None:
            raise NoUsableTopic(f"The table is of {topic[:200]} ({kind[:200]}), which is not the pose of a PSM.")
        stamps_ns, poses, frames = _samples(text, _PLACES[kind])
    except (csv.Error, UnicodeDecodeError) as error:
        raise UnreadableRecording(f"The table is not comma-separated UTF-8 text: {error}. Extract it again.") from error
    finally:
        text.detach()  # otherwise the wrapper would close the caller's file
    if len(frames) > 1:
        raise MixedFrames(
            f"{topic} has poses in {len(frames)} frames; record each frame on a separate topic.", frames=frames[:20]
        )
    motion = recorded_motion(
        arm=arm,
        topic=topic,
        frame=frames[0],
        stamps_ns=stamps_ns,
        tip_mm=1000.0 * poses[:, :3],  # the recorders write metres
        rotation_xyzw=poses[:, 3:],
    )
    return Recording(format="csv", integrity="none", motions=(motion,), topics=(Topic(topic, kind, len(poses)),))


def _samples(text: TextIO, parts: tuple[str, str]) -> tuple[Ints, Floats, list[str]]:
    """Return stamps, shape (T,), positions and quaternions, shape (T, 7), and the distinct frames."""
    rows = csv_rows(text, first_line=_HEADER_LINE)
    columns = _columns(next(rows, []), parts)
    stamps, numbers, frames = array("q"), array("d"), dict[str, None]()
    for row in rows:
        try:
            sec, nanosec, frame, *pose = (row[column] for column in columns)
            stamps.append(int(sec) * 1_000_000_000 + int(nanosec))
            numbers.extend(map(float, pose))
        except (ValueError, IndexError, OverflowError):
            line = rows.line_num + _HEADER_LINE - 1
            raise UnreadableRecording(
                f"Row {line} is not a pose with a stamp; extract the bag again.", row=line
            ) from None
        frames[frame] = None
    if not stamps:
        raise UnreadableRecording("The table has a header and no rows.")
    return np.frombuffer(stamps, dtype=np.int64), np.frombuffer(numbers).reshape(-1, 7), list(frames)


def _columns(header: list[str], parts: tuple[str, str]) -> list[int]:
    """Return the column indices of the stamp, the frame, the position and the quaternion."""
    place, turn = parts
    names = [_SEC, _NANOSEC, _FRAME, *(place + axis for axis in "xyz"), *(turn + axis for axis in "xyzw")]
    wrong = [name for name in names if header.count(name) != 1]
    if wrong:
        raise BadColumns(
            f"The table must have the column {wrong[0]} exactly once; extract the bag again.", missing=wrong
        )
    return [header.index(name) for name in names]
