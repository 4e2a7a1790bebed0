"""Read a recording from a table: one row per sample, columns named with their units.

    t_s                            seconds, never decreasing; or `rate_hz` from the caller, for tables without times
    x_m, y_m, z_m                  the tip, or x_mm, y_mm, z_mm; one unit for all three
    qx, qy, qz, qw                 its orientation as a unit quaternion, or
    roll_rad, pitch_rad, yaw_rad   as turns about the fixed axes x, then y, then z
    jaw_rad                        the jaw's angle
    clutch                         0 released, 1 pressed, 2 a quick tap

The header of the paper's raw recordings, `Rot R, Rot P, Rot Y, Pos X, Pos Y, Pos Z` (rad and m), means the same as
`roll_rad, pitch_rad, yaw_rad, x_m, y_m, z_m`. Roll, pitch, yaw are those of KDL's `Rotation::RPY`, which the dVRK's
tools use: R = Rz(yaw) Ry(pitch) Rx(roll). Any other column is refused, since a time or an orientation under another
name would be lost without a word. A table has no checksum, so its integrity is "none".
"""

import csv
import io
from array import array
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from skills.errors import BadColumns, BadSettings, NotFinite, NotMetres, NoUsableTopic, UnreadableRecording
from skills.style._arrays import Floats, Ints
from skills.style.kinematics import CANNULA_MM, INSTRUMENTS
from skills.style.recording import Motion, Recording, Signal, TopicInfo, recorded_motion

TOPIC = "table"
DEFAULT_FRAME = "PSM_base"  # relative to the remote centre of motion
DEFAULT_ARM = "PSM"
# The tip is further from the remote centre than the wrist, for that bends by less than a right angle. What reaches
# 290 mm reaches 11.4 inches: a path in inches never comes so far.
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
_LATEST_S = 4e9  # the year 2096; later is a time in milliseconds or worse
_FASTEST_HZ = 100_000.0
_FIRST_ROW = 2  # the header is row 1


@dataclass(frozen=True)
class _Table:
    """The cells as numbers: columns by name, each of shape (T,); the exact stamps where there was a `t_s`."""

    columns: dict[str, Floats]
    stamps_ns: Ints | None
    rows: int

    def stacked(self, names: tuple[str, ...]) -> Floats:
        """Return some columns side by side, shape (T, len(names))."""
        return np.stack([self.columns[name] for name in names], axis=1)


def read_table(
    file: BinaryIO, *, rate_hz: float | None = None, frame: str = DEFAULT_FRAME, arm: str = DEFAULT_ARM
) -> Recording:
    """Read one arm's motion from a CSV file.

    Args:
        file: The file, at its beginning; UTF-8, comma-separated, the header in its first line.
        rate_hz: Samples per second, for a table without `t_s`.
        frame: The frame in which the positions are given.
        arm: The arm's name.

    Raises:
        BadColumns: The header is unknown, doubled, incomplete or ambiguous, or time is said twice or not at all.
        NoUsableTopic: No column has a position.
        UnreadableRecording: A row of another length, a cell that is no number, no rows.
        NotFinite, NotMetres, BackwardStamps, RepeatedStamps, NotAQuaternion: As in `skills.style.recording`.
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
        topics=(TopicInfo(TOPIC, "text/csv", table.rows),),
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
        rows = csv.reader(text, strict=True)
        names = _checked_header([_PAPER_NAMES.get(name.strip(), name.strip()) for name in next(rows, [])], rate_hz)
        return _numbers(names, rows)
    except (csv.Error, UnicodeDecodeError) as error:
        raise UnreadableRecording(f"The table is no comma-separated UTF-8 text: {error}. Export it again.") from error
    finally:
        text.detach()  # the file is the caller's


def _checked_header(names: list[str], rate_hz: float | None) -> list[str]:
    unknown = [name for name in names if name not in KNOWN]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if unknown or doubled:
        what = f"does not know the column {unknown[0]!r}" if unknown else f"has the column {doubled[0]!r} twice"
        raise BadColumns(f"The table {what}; known are {', '.join(KNOWN)}.", unknown=unknown, doubled=doubled)
    if not {*_METRES, *_MILLIMETRES} & set(names):
        raise NoUsableTopic("The table has no position; name the columns x_m, y_m, z_m (or _mm).")
    for group in (_METRES, _MILLIMETRES, _QUATERNION, _RPY):
        missing = [name for name in group if name not in names]
        if 0 < len(missing) < len(group):
            raise BadColumns(f"The table has not all of {', '.join(group)}: {missing[0]} is missing.", missing=missing)
    for one, other in ((_METRES, _MILLIMETRES), (_QUATERNION, _RPY)):
        if one[0] in names and other[0] in names:
            raise BadColumns(f"The table says it twice, by {one[0]} ... and by {other[0]} ...; keep one of them.")
    _check_time(has_times="t_s" in names, rate_hz=rate_hz)
    return names


def _check_time(*, has_times: bool, rate_hz: float | None) -> None:
    if has_times and rate_hz is not None:
        raise BadColumns("The table has the column t_s and rate_hz is given too; keep one of them.")
    if rate_hz is not None and not 0 < rate_hz <= _FASTEST_HZ:
        raise BadSettings(f"rate_hz is {rate_hz}; give samples per second, above 0 and up to {_FASTEST_HZ:g}.")


def _numbers(names: list[str], rows: "_Rows") -> _Table:
    cells, times, blank_line = array("d"), list[str](), 0
    time_column = names.index("t_s") if "t_s" in names else None
    for row in rows:
        if not row:
            blank_line = blank_line or rows.line_num
            continue
        if blank_line or len(row) != len(names):
            line = blank_line or rows.line_num
            found = 0 if blank_line else len(row)
            raise UnreadableRecording(f"Row {line} has {found} cells, the header {len(names)}. Export the table again.")
        try:
            cells.extend(map(float, row))
        except ValueError:
            raise _no_number(names, row, rows.line_num) from None
        if "_" in "".join(row):  # Python reads 1_000 as a number, no exporter writes it
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
    name = next(name for name, cell in zip(names, row, strict=True) if "_" in cell or not _is_number(cell))
    return UnreadableRecording(
        f"Row {line}, column {name}: this is not a number; export the table again.", row=line, column=name
    )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _check_finite(names: list[str], columns: Floats) -> None:
    wrong = ~np.isfinite(columns)
    if wrong.any():
        row, column = np.argwhere(wrong)[0].tolist()
        line, name = row + _FIRST_ROW, names[column]
        raise NotFinite(f"Row {line}, column {name}: NaN or infinity; cut the row.", row=line, column=name)


def _exact_ns(times: list[str], seconds: Floats) -> Ints:
    """Return whole nanoseconds: a float of seconds since 1970 is only good to 240 ns."""
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
        raise BadColumns("The table has no column t_s; add it, or give rate_hz for evenly timed samples.")
    even: Ints = np.rint(np.arange(table.rows) * (1e9 / rate_hz)).astype(np.int64)
    return even


def _tip_mm(table: _Table) -> Floats:
    return 1000.0 * table.stacked(_METRES) if "x_m" in table.columns else table.stacked(_MILLIMETRES)


def _check_outside(motion: Motion) -> None:
    """Refuse a path that never leaves the cannula: its numbers are in another unit, or from another origin."""
    if not motion.frame.endswith("_base"):
        return
    away_mm = np.sqrt(np.einsum("ij,ij->i", motion.tip_mm, motion.tip_mm))
    furthest = int(np.argmax(away_mm))
    if away_mm[furthest] < OUTSIDE_MM:
        at_s = (int(motion.stamps_ns[furthest]) - int(motion.stamps_ns[0])) / 1e9
        raise NotMetres(
            f"The tip is never further from the remote centre than {away_mm[furthest]:.3g} mm (at {at_s:.3f} s); with "
            f"less than {OUTSIDE_MM:.3g} mm its wrist is inside the cannula. Give the positions in the unit that the "
            "columns name, not in inches; or name the frame, if they are not from the remote centre.",
            sample=furthest,
            furthest_mm=float(away_mm[furthest]),
        )


def _rotation_xyzw(table: _Table) -> Floats | None:
    if "qx" in table.columns:
        return table.stacked(_QUATERNION)
    return quaternion_of_rpy(table.stacked(_RPY)) if "roll_rad" in table.columns else None


def _signal(table: _Table, name: str, stamps_ns: Ints) -> Signal | None:
    return Signal(stamps_ns, table.columns[name], f"{TOPIC} {name}") if name in table.columns else None
