"""Tables as people and recorders write them, from the motion of a sample recording."""

import io
from functools import cache

import numpy as np

from skills.arrays import Floats
from skills.demonstration.recording import Motion, Recording
from skills.formats import read_recording
from skills.kinematics import INSERTION, inverse, matrix_of
from skills.seeds.recordings import sample_recordings

STATES = [f"pose.position.{axis}" for axis in "xyz"] + [f"pose.orientation.{axis}" for axis in "xyzw"]
SETPOINTS = [name.replace("pose.", "sp.") for name in STATES]
LOCALS = [f"rcm_{name}" for name in STATES]
JOINTS = [f"js[{k}]" for k in range(6)]
STEP_NS = 33_333_333


@cache
def sample(surgeon: str) -> Recording:
    """Return the first sample recording of a surgeon."""
    return read_recording(io.BytesIO(next(one.data for one in sample_recordings() if one.surgeon == surgeon)))


def positions(surgeon: str = "heron", *, separator: str = ";", comma: bool = False) -> str:
    """Return the tip of a sample in mm as columns PosX, PosY and PosZ, at the rate of the sample: heron's is 100 Hz."""
    lines = [separator.join(f"{value:.4f}" for value in row) for row in sample(surgeon).motion_of().tip_mm]
    text = "\n".join([separator.join(("PosX", "PosY", "PosZ")), *lines]) + "\n"
    return text.replace(".", ",") if comma else text


def ee_csv(surgeon: str = "kestrel", *, numpy: bool = False, more: bool = False, rows: int | None = None) -> str:
    """Return a sample as an ee_csv of two arms: PSM2 demonstrates, PSM1 holds still but for its encoders' noise.

    Args:
        surgeon: The sample's surgeon.
        numpy: Write every number as np.float64(...).
        more: Write the joints, `rcm_pose` and columns of the endoscope as well.
        rows: Number of rows; None for all.
    """
    moving = sample(surgeon).motion_of()
    jaw = sample(surgeon).jaw_of(moving.arm)
    assert jaw is not None
    every = max(1, round(STEP_NS / int(np.median(np.diff(moving.stamps_ns)))))
    chosen = slice(None, None if rows is None else rows * every, every)
    stamps_ns = moving.stamps_ns[chosen]
    jaw_rad = np.interp(stamps_ns, jaw.stamps_ns, jaw.values)
    noise = np.random.default_rng(3).normal(0, 1e-6, (len(stamps_ns), 3))
    held = np.column_stack([np.array([0.02, 0.05, -0.12]) + noise, np.tile([0.0, 1.0, 0.0, 0.0], (len(noise), 1))])
    arms = {"psm1": (held, np.full(len(held), 0.3)), "psm2": (_poses(moving, chosen), jaw_rad)}
    columns: dict[str, list[str]] = {"timestamp": [str(stamp) for stamp in stamps_ns]}
    for arm, (poses, jaws) in arms.items():
        for names, numbers in ((STATES, poses), (SETPOINTS, poses), *(((LOCALS, poses),) if more else ())):
            columns |= {f"{arm}_{name}": _texts(numbers[:, k], numpy) for k, name in enumerate(names)}
        columns |= {f"{arm}_jaw": _texts(jaws, numpy), f"{arm}_jaw_sp": _texts(jaws, numpy)}
        if more:
            columns |= {f"{arm}_{name}": _texts(joints_of(poses)[:, k], numpy) for k, name in enumerate(JOINTS)}
            columns["ecm_pose.position.x"] = ["not a number"] * len(stamps_ns)
    return "\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True))]) + "\n"


def joints(surgeon: str = "kestrel") -> str:
    """Return the joints of a sample in rad and m, at about 30 Hz."""
    motion = sample(surgeon).motion_of()
    every = max(1, round(STEP_NS / int(np.median(np.diff(motion.stamps_ns)))))
    rows = joints_of(_poses(motion, slice(None, None, every)))
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    return "\n".join(["q1_rad,q2_rad,q3_m,q4_rad,q5_rad,q6_rad", *lines]) + "\n"


def joints_of(poses: Floats) -> Floats:
    """Return the joints of poses in m, rad and m."""
    joints = inverse(1000.0 * poses[:, :3], matrix_of(poses[:, 3:]))
    joints[:, INSERTION] /= 1000.0
    return joints


def _poses(motion: Motion, chosen: slice) -> Floats:
    assert motion.rotation_xyzw is not None
    return np.column_stack([motion.tip_mm[chosen] / 1000.0, motion.rotation_xyzw[chosen]])


def _texts(numbers: Floats, numpy: bool) -> list[str]:
    return [f"np.float64({value!r})" if numpy else repr(value) for value in numbers.tolist()]
