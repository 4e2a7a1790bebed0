"""Short recordings of strokes along a line, for cases worked by hand."""

import numpy as np

from skills.demonstration.recording import Motion, Recording, Signal

RATE = 100


def motion(tip_mm, *, arm="PSM2", topic=None, rotation=None, start_ns=0):
    stamps_ns = start_ns + np.arange(len(tip_mm)) * (10**9 // RATE)
    return Motion(arm, topic or f"/{arm}/local/measured_cp", f"{arm}_base", stamps_ns, np.asarray(tip_mm), rotation)


def recording(*motions, jaw=None, clutch=None):
    jaws = () if jaw is None else ((motions[0].arm, Signal(motions[0].stamps_ns, jaw)),)
    return Recording(format="mcap", integrity="full", motions=motions, jaws=jaws, clutch=clutch)


def line(seconds, speed_mm_s):
    """Return tip positions along x at one speed."""
    t = np.arange(int(seconds * RATE) + 1) / RATE
    return np.stack([speed_mm_s * t, 0 * t, 0 * t], axis=1)


def along_x(*parts):
    """Return a sequence of rests and strokes: (seconds, mm/s)."""
    speeds = np.concatenate([np.full(int(seconds * RATE), float(speed)) for seconds, speed in parts])
    x = np.concatenate(([0.0], np.cumsum(speeds / RATE)))
    return np.stack([x, 0 * x, 0 * x], axis=1)
