"""A laboratory's own errors: as it states them, and from setpoints and measured poses of a recording or a table.

    name or JSON --stated_errors--> ArmErrors
    JSON --stated_servo--> Servo: how the arms are driven
    recording or table --read_measured--> Measured --calibrate_arm--> ArmCalibration

A *recording* needs `measured_cp` and `setpoint_cp` of the arm in one frame. Each measured pose is compared with the
setpoint before or after it that is nearest in time. With a tracker on a topic of the bag (a ROS 1 bag, .db3 or MCAP
file) it is compared with the marker too, interpolated between the two positions that the tracker saw around it.

A *table* needs the columns `measured_q1` to `measured_q6` and `setpoint_q1` to `setpoint_q6`, in rad and m as the
dVRK's `measured_js` has them. With a tracker it also has `marker_x`, `marker_y` and `marker_z`, in m; with times `t_s`.
"""

import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from skills.arrays import Flags, Floats, Ints, nearest
from skills.dynamics import Servo
from skills.errors import BadInput, BadRecording, BadSettings, NoUsableTopic
from skills.formats import SUFFIXES, media_type_of, read_recording
from skills.formats.cells import TableLayout, header_of, open_text, read_numbers
from skills.formats.rosbag import PLACES, STATES, Suffix, numbers_on, topics_in
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, forward, matrix_of
from skills.verification.arm_calibration import MeasuredArm
from skills.verification.arm_errors import NAMED, SIZES, ArmErrors, checked_own
from skills.verification.servo_fit import RECORD

LOST_PERIODS = 3.0  # ours: between positions further apart than so many of its periods the tracker had lost the marker
_JOINTS = tuple(f"q{number}" for number in range(1, 7))
_NEEDED = tuple(f"{kind}_{joint}" for kind in ("measured", "setpoint") for joint in _JOINTS)
_MARKER = ("marker_x", "marker_y", "marker_z")
_M_TO_MM = 1000.0


def stated_errors(stated: str) -> ArmErrors:
    """Return the errors that a laboratory states: "calibrated", "uncalibrated", or its own as JSON.

    Raises:
        BadSettings: The text is neither of them, a size is missing or impossible, or has no source; or its own errors
            have the name of a default.
    """
    if stated in NAMED:
        return NAMED[stated]
    try:
        read = json.loads(stated)
        own = ArmErrors(**read)
    except (ValueError, TypeError, AttributeError):
        raise BadSettings(
            f"The errors of an arm are {' or '.join(NAMED)}, or JSON with name, {', '.join(SIZES)} and sources."
        ) from None
    return checked_own(own)


def stated_servo(stated: str) -> Servo | None:
    """Return how a laboratory drives its arms, from JSON; None where the text is empty.

    Raises:
        BadSettings: It is no JSON, has a field that no servo has, or a number that is impossible.
    """
    try:
        return TypeAdapter(Servo).validate_json(stated) if stated.strip() else None
    except ValidationError as error:
        first = error.errors()[0]
        raise BadSettings(
            f"A servo's {'.'.join(map(str, first['loc'])) or 'JSON'}: {first['msg']} (docs/execution.md)."
        ) from None


def read_measured(
    file: Path,
    *,
    arm: str | None = None,
    instrument: str = DEFAULT_INSTRUMENT,
    rate_hz: float | None = None,
    tracker: str | None = None,
) -> MeasuredArm:
    """Read setpoints and measured poses of an arm.

    Args:
        file: A recording, or a table whose header has the columns of joints.
        arm: The arm of a recording with several.
        instrument: Number of the instrument, for a table.
        rate_hz: Samples per second of a table without times; None: its times stay unknown.
        tracker: The topic of a recording with a tracker's positions of a marker on the tool; None: there is none.

    Raises:
        BadInput: The table lacks a column, has a cell that is not a finite number, no rows or too many; or a tracker is
            named for a table.
        BadRecording: The recording cannot be used, or has no setpoints of the arm.
        OSError: The file cannot be read.
    """
    if (columns := _columns(file, rate_hz)) is not None:
        if tracker is not None:
            raise BadInput(f"A table has the tracker's positions in {', '.join(_MARKER)}; omit the topic.")
        return _of_table(columns, instrument)
    with file.open("rb") as opened:
        recording = read_recording(opened)
    motion = recording.motion_of(arm=arm)
    setpoints = recording.setpoint_of(motion)
    if setpoints is None:
        raise BadRecording(
            f"The recording has no setpoints of {motion.arm} in the frame {motion.frame}; record its setpoint_cp "
            "beside its measured_cp."
        )
    if motion.rotation_xyzw is None or setpoints.rotation_xyzw is None:
        raise BadRecording(f"The poses of {motion.arm} have no rotations; record its setpoint_cp and measured_cp.")
    chosen, beside = _beside(motion.stamps_ns, setpoints.stamps_ns)
    if not beside.any():
        raise BadRecording("No setpoint was recorded within one period of a measured pose; record both at once.")
    marker_mm = None
    if tracker is not None:
        marker_mm = _marker_mm(file, tracker, motion.stamps_ns)
        beside &= np.isfinite(marker_mm).all(axis=1)
        if not beside.any():
            raise BadRecording(
                f"At no time of {motion.topic} did {tracker} see its marker; record both at once, with one clock."
            )
        marker_mm = marker_mm[beside]
    return MeasuredArm(
        setpoint_mm=setpoints.tip_mm[chosen][beside],
        setpoint=matrix_of(setpoints.rotation_xyzw[chosen][beside]),
        measured_mm=motion.tip_mm[beside],
        measured=matrix_of(motion.rotation_xyzw[beside]),
        stamps_s=recording.seconds(motion.stamps_ns[beside]),
        marker_mm=marker_mm,
    )


def read_states(file: Path, *, arm: str | None = None, rate_hz: float | None = None) -> tuple[Floats, Floats, Floats]:
    """Read measured states and setpoints of an arm's joints.

    Args:
        file: A ROS 1 bag, a .db3 or an MCAP file, or a table whose header has the columns of joints.
        arm: The arm of a bag with several.
        rate_hz: Samples per second of a table without times; None: the arm is taken to rest at each sample.

    Returns:
        Times in s, measured states, and the setpoints nearest in time, as for `skills.verification.servo_fit`.

    Raises:
        BadInput, OSError: As for `read_measured`.
        BadRecording: The bag cannot be read, or lacks measured joints or setpoints of the arm.
    """
    if (columns := _columns(file, rate_hz)) is not None:
        stamps_s = columns.get("t_s", np.arange(len(columns[_NEEDED[0]]), dtype=np.float64))
        states = np.full((2, len(stamps_s), 3, 6), np.nan)
        states[:, :, 0] = np.reshape([columns[name] for name in _NEEDED], (2, 6, -1)).swapaxes(1, 2)
        states[0, :, 1] = np.nan if "t_s" in columns else 0.0
        return stamps_s, states[0], states[1]
    with _suffixed(file) as bag:
        names = sorted(one.name for one in topics_in([bag]))
        found = [name for name in names if re.search(f"/{re.escape(arm) if arm else 'PSM[0-9]*'}/measured_js$", name)]
        pair = [*found, *(name.replace("measured", "setpoint") for name in found)]
        if len(pair) != 2 or pair[1] not in names:
            raise NoUsableTopic(f"No measured_js with setpoint_js, or not of one --arm: {names[:20]}. {RECORD}")
        (at_ns, measured), (sent_ns, setpoints) = (numbers_on(bag, topic, STATES) for topic in pair)
    chosen, beside = _beside(at_ns, sent_ns)
    states = np.stack([measured, setpoints[chosen]])[:, beside].reshape(2, -1, 3, 6)
    return (at_ns - at_ns[0])[beside] / 1e9, states[0], states[1]


def _beside(stamps_ns: Ints, setpoints_ns: Ints) -> tuple[Ints, Flags]:
    """Return the setpoint nearest to each stamp, and whether it is within one period of the setpoints."""
    chosen = nearest(setpoints_ns, stamps_ns)
    period_ns = np.median(np.diff(setpoints_ns)) if len(setpoints_ns) > 1 else 0
    return chosen, np.abs(setpoints_ns[chosen] - stamps_ns) <= period_ns


@contextmanager
def _suffixed(file: Path) -> Iterator[Path]:
    """Copy a bag to a path with the suffix of its format, as rosbags knows a format by its suffix alone."""
    with file.open("rb") as opened:
        suffix = SUFFIXES[media_type_of(opened)]
    if suffix not in get_args(Suffix):
        raise BadInput("Topics are read from a ROS 1 bag, a .db3 or an MCAP file; give the file in the bag's folder.")
    with tempfile.TemporaryDirectory() as folder:
        yield shutil.copyfile(file, Path(folder) / f"bag{suffix}")


def _marker_mm(file: Path, tracker: str, at_ns: Ints) -> Floats:
    """Return the marker's positions at the stamps, (N, 3); NaN where it was not seen shortly before and after."""
    with _suffixed(file) as bag:
        stamps_ns, place_m = numbers_on(bag, tracker, PLACES)
    begin = stamps_ns[0]
    times, at = (stamps_ns - begin).astype(np.float64), (at_ns - begin).astype(np.float64)
    found = np.stack([np.interp(at, times, axis, left=np.nan, right=np.nan) for axis in place_m.T * _M_TO_MM], axis=1)
    gaps = np.diff(times)
    if len(gaps):
        found[gaps[np.searchsorted(times[1:-1], at)] > LOST_PERIODS * np.median(gaps)] = np.nan
    return found


def _columns(file: Path, rate_hz: float | None) -> dict[str, Floats] | None:
    """Return the columns of a table of joints, with times where they are known; None for a recording."""
    with file.open("rb") as opened:
        header = opened.readline(4096).decode("utf-8", "replace").strip().lower().split(",")
        if not set(_NEEDED) & set(header):
            return None
        opened.seek(0)
        with open_text(opened) as text:
            names, separator = header_of(text)
            names = [name.lower() for name in names]
            if missing := [name for name in _NEEDED if name not in names]:
                raise BadInput(f"The table has no column {missing[0]}; give {', '.join(_NEEDED)} in rad and m.")
            wanted = [name for name in (*_NEEDED, *_MARKER, "t_s") if name in names]
            numbers = read_numbers(text, TableLayout(names, [[names.index(name)] for name in wanted], separator))
    columns = {name: group[:, 0] for name, group in zip(wanted, numbers.groups, strict=True)}
    if rate_hz is not None and not 0 < rate_hz <= 10_000:
        raise BadInput("The rate must be a number of samples per second above 0, at most 10000.", rate_hz=rate_hz)
    return columns if rate_hz is None else {"t_s": np.arange(numbers.rows) / rate_hz} | columns


def _of_table(columns: dict[str, Floats], instrument: str) -> MeasuredArm:
    (setpoint_mm, setpoint), (measured_mm, measured) = (
        forward(_joints(columns, kind), instrument) for kind in ("setpoint", "measured")
    )
    marked = set(_MARKER) <= set(columns)
    marker_mm = np.stack([columns[name] for name in _MARKER], axis=1) * _M_TO_MM if marked else None
    return MeasuredArm(setpoint_mm, setpoint, measured_mm, measured, columns.get("t_s"), marker_mm)


def _joints(columns: dict[str, Floats], kind: str) -> Floats:
    """Return the joints of a table in rad and mm, shape (N, 6)."""
    joints = np.stack([columns[f"{kind}_{joint}"] for joint in _JOINTS], axis=1)
    joints[:, INSERTION] *= _M_TO_MM
    return joints
