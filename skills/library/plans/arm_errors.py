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
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from skills.arrays import Floats, Ints
from skills.dynamics import Servo
from skills.errors import BadInput, BadRecording, BadSettings
from skills.formats import SUFFIXES, media_type_of, read_recording
from skills.formats.cells import TableLayout, header_of, open_text, read_numbers
from skills.formats.rosbag import Suffix, positions_on
from skills.kinematics import DEFAULT_INSTRUMENT, INSERTION, forward, matrix_of
from skills.verification.arm_calibration import MeasuredArm
from skills.verification.arm_errors import NAMED, SIZES, ArmErrors, checked_own

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
    with file.open("rb") as opened:
        header = opened.readline(4096).decode("utf-8", "replace").strip().lower().split(",")
        if set(_NEEDED) & set(header):
            if tracker is not None:
                raise BadInput(f"A table has the tracker's positions in {', '.join(_MARKER)}; omit the topic.")
            opened.seek(0)
            return _of_table(opened, instrument, rate_hz)
        opened.seek(0)
        recording = read_recording(opened)
        kind = media_type_of(opened)
    motion = recording.motion_of(arm=arm)
    setpoints = recording.setpoint_of(motion)
    if setpoints is None:
        raise BadRecording(
            f"The recording has no setpoints of {motion.arm} in the frame {motion.frame}; record its setpoint_cp "
            "beside its measured_cp."
        )
    if motion.rotation_xyzw is None or setpoints.rotation_xyzw is None:
        raise BadRecording(f"The poses of {motion.arm} have no rotations; record its setpoint_cp and measured_cp.")
    after = np.minimum(np.searchsorted(setpoints.stamps_ns, motion.stamps_ns), len(setpoints.stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    sooner = motion.stamps_ns - setpoints.stamps_ns[before] < setpoints.stamps_ns[after] - motion.stamps_ns
    nearest = np.where(sooner, before, after)
    period_ns = np.median(np.diff(setpoints.stamps_ns)) if len(setpoints.stamps_ns) > 1 else 0
    beside = np.abs(setpoints.stamps_ns[nearest] - motion.stamps_ns) <= period_ns
    if not beside.any():
        raise BadRecording("No setpoint was recorded within one period of a measured pose; record both at once.")
    marker_mm = None
    if tracker is not None:
        if SUFFIXES[kind] not in get_args(Suffix):
            raise BadInput(
                "A tracker is read from a ROS 1 bag, a .db3 or an MCAP file; give the file in the bag's folder."
            )
        marker_mm = _marker_mm(file, SUFFIXES[kind], tracker, motion.stamps_ns)
        beside &= np.isfinite(marker_mm).all(axis=1)
        if not beside.any():
            raise BadRecording(
                f"At no time of {motion.topic} did {tracker} see its marker; record both at once, with one clock."
            )
        marker_mm = marker_mm[beside]
    return MeasuredArm(
        setpoint_mm=setpoints.tip_mm[nearest][beside],
        setpoint=matrix_of(setpoints.rotation_xyzw[nearest][beside]),
        measured_mm=motion.tip_mm[beside],
        measured=matrix_of(motion.rotation_xyzw[beside]),
        stamps_s=recording.seconds(motion.stamps_ns[beside]),
        marker_mm=marker_mm,
    )


def _marker_mm(file: Path, suffix: str, tracker: str, at_ns: Ints) -> Floats:
    """Return the marker's positions at the stamps, (N, 3); NaN where it was not seen shortly before and after."""
    with tempfile.TemporaryDirectory() as folder:  # rosbags knows a format by its suffix alone
        named = Path(folder) / f"bag{suffix}"
        shutil.copyfile(file, named)
        stamps_ns, place_mm = positions_on(named, tracker)
    begin = stamps_ns[0]
    times, at = (stamps_ns - begin).astype(np.float64), (at_ns - begin).astype(np.float64)
    found = np.stack([np.interp(at, times, axis, left=np.nan, right=np.nan) for axis in place_mm.T], axis=1)
    gaps = np.diff(times)
    if len(gaps):
        found[gaps[np.searchsorted(times[1:-1], at)] > LOST_PERIODS * np.median(gaps)] = np.nan
    return found


def _of_table(opened: BinaryIO, instrument: str, rate_hz: float | None) -> MeasuredArm:
    with open_text(opened) as text:
        names, separator = header_of(text)
        names = [name.lower() for name in names]
        if missing := [name for name in _NEEDED if name not in names]:
            raise BadInput(f"The table has no column {missing[0]}; give {', '.join(_NEEDED)} in rad and m.")
        wanted = [name for name in (*_NEEDED, *_MARKER, "t_s") if name in names]
        layout = TableLayout(names, [[names.index(name)] for name in wanted], separator)
        numbers = read_numbers(text, layout)
    columns = {name: group[:, 0] for name, group in zip(wanted, numbers.groups, strict=True)}
    if rate_hz is not None and not 0 < rate_hz <= 10_000:
        raise BadInput("The rate must be a number of samples per second above 0, at most 10000.", rate_hz=rate_hz)
    stamps_s = columns.get("t_s")
    if stamps_s is None and rate_hz is not None:
        stamps_s = np.arange(numbers.rows) / rate_hz
    (setpoint_mm, setpoint), (measured_mm, measured) = (
        forward(_joints(columns, kind), instrument) for kind in ("setpoint", "measured")
    )
    marked = set(_MARKER) <= set(columns)
    marker_mm = np.stack([columns[name] for name in _MARKER], axis=1) * _M_TO_MM if marked else None
    return MeasuredArm(setpoint_mm, setpoint, measured_mm, measured, stamps_s, marker_mm)


def _joints(columns: dict[str, Floats], kind: str) -> Floats:
    """Return the joints of a table in rad and mm, shape (N, 6)."""
    joints = np.stack([columns[f"{kind}_{joint}"] for joint in _JOINTS], axis=1)
    joints[:, INSERTION] *= _M_TO_MM
    return joints
