"""Refusals of recordings whose times or lengths are in another unit than they were read in.

What is impossible for a PSM is refused in every format. Columns declare their units in names, which people type: a pace
that no hand-off has, with units from the names alone, is asked about. Who states both units in the request has
answered.
"""

from collections.abc import Sequence

import numpy as np

from skills.demonstration.plausible import LEAST_HZ, MOST_HZ, TIP_MM_S, USUAL_HZ, USUAL_MM_S, MotionPace, pace_of
from skills.demonstration.recording import Column, Motion, Recording
from skills.errors import ImplausibleMotion
from skills.formats.cells import NS_PER
from skills.formats.tables import ReadingOptions

FEWEST = 4  # poses: with fewer, neither a rate nor a speed is known
SMALL_MM = 1.0  # a path that is no wider is refused when it is cut


def check_pace(recording: Recording, options: ReadingOptions) -> None:
    """Refuse a recording whose times or lengths cannot be those of a PSM, or ask in which unit they are.

    Raises:
        ImplausibleMotion: The poses are too rare, or the tip too fast, or both unusual where only names state units.
    """
    moved = [motion for motion in recording.motions if len(motion.stamps_ns) >= FEWEST]
    if not moved or (options.untimed and options.rate_hz is None and not recording.is_timed):
        return  # too short to be judged, or a preview of a table without times
    pace = _pace(moved)
    fault = _impossible(pace) or (_unusual(recording, pace) if _is_declared(recording, options) else None)
    if fault is not None:
        time = _time_of(recording)
        what = "The stamps" if time is None else f"The times of the column {time.name[:80]}, read as {time.unit},"
        raise ImplausibleMotion(
            f"{what} give {pace}: {fault}. {_fitting(recording, moved)}",
            rate_hz=pace.rate_hz,
            speed_mm_s=pace.speed_mm_s,
        )


def _impossible(pace: MotionPace) -> str | None:
    """Return what no PSM's recording has, in words."""
    if not pace.rate_hz >= LEAST_HZ:
        return f"with fewer than {LEAST_HZ:g} poses per second the path between them is not known"
    if not pace.rate_hz <= MOST_HZ:
        return f"no recorder takes more than {MOST_HZ:g} poses per second"
    return None if pace.speed_mm_s <= TIP_MM_S else f"the tip of a PSM moves at most at {TIP_MM_S:.0f} mm/s"


def _is_declared(recording: Recording, options: ReadingOptions) -> bool:
    """Return whether the units of times or lengths are known from names in the file alone."""
    stated = {one.partition("=")[0].partition("_")[0].strip() for one in options.column}
    timed = options.rate_hz is not None or "t" in stated
    return recording.format in ("csv", "lerobot") and not (timed and {"x", "q3"} & stated)


def _unusual(recording: Recording, pace: MotionPace) -> str | None:
    """Return what no hand-off has, in words."""
    least, most = USUAL_MM_S
    if pace.rate_hz > USUAL_HZ and pace.speed_mm_s > most:
        return f"recorders of more than {USUAL_HZ:g} poses per second see hand-offs at 10 to 90 mm/s"
    if recording.format != "csv" or pace.speed_mm_s >= least:
        return None
    wide = any(np.ptp(motion.tip_mm, axis=0).max() > SMALL_MM for motion in recording.motions)
    return f"known hand-offs are faster than {least:g} mm/s, other work is not always" if wide else None


def _time_of(recording: Recording) -> Column | None:
    return next((column for column in recording.columns if column.quantity == "t"), None)


def _pace(motions: Sequence[Motion], factor: float = 1.0) -> MotionPace:
    """Return the pace of the motions with the highest, if their times were multiplied by a factor."""
    paces = [pace_of(one.stamps_ns, one.tip_mm, factor) for one in motions]
    return MotionPace(max(one.rate_hz for one in paces), max(one.speed_mm_s for one in paces))


def _fitting(recording: Recording, moved: Sequence[Motion]) -> str:
    """Return the unit of time that would make sense, or what to do if there is none."""
    time = _time_of(recording)
    for unit, ns in NS_PER.items():
        factor = ns / NS_PER[time.unit if time else "s"]
        found = _pace(moved, factor)
        if time is not None and unit != time.unit and found.is_usual:
            return (
                f"In {unit} they would give {found}. In which unit are they? Name their column as "
                f"t_{unit}={time.name[:80]}, or as t_{time.unit} together with the positions if all are right."
            )
        if time is None and factor != 1 and (found.is_usual or _pace(moved, 1 / factor).is_usual):
            return f"Times in another unit, {factor:g} of a second or the reverse, would give a usual pace: correct it."
    return (
        "Check the units of times and positions (m or mm, not cm or inches), and name the columns with the right ones: "
        "t_s=NAME or t_ms=NAME, x_mm=NAME or x_m=NAME."
        if recording.columns
        else "Check the clock and the units of the recorder; the poses of two arms on one topic look like this too."
    )
