"""The player of trajectories in the simulator: metres and PyBullet in its process, millimetres and values in ours."""

import re
from collections.abc import Callable
from math import isfinite
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from skills.arrays import Floats, Ints
from skills.errors import BadInput, SimulationFailed, Unanswered
from skills.kinematics import JAW_TIP_MM, matrix_of
from skills.planning.handoff import HOLDING_RAD
from skills.planning.trajectory import Trajectory
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import call_alone
from skills.simulation import simulator
from skills.verification.clearance import FINGER_REACH_MM, openings, psm_m_poses
from skills.verification.playback import Playback, link_pairs

SIMULATOR = "skills.simulation.simulator:simulate"
PAD_BELOW_MM = 5.0  # ours: height of the finger tips above a pad whose height is not given
CLEARANCE_EVERY = 4  # samples: 0.33 mm of the tip's path at 20 mm/s and 240 Hz, for which the bounds on distances allow
Plain = TypeVar("Plain", bytes, str, float, dict[Any, Any])
_PNG = b"\x89PNG\r\n\x1a\n"
_ADVICE = {
    "hung": "play fewer passes",
    "crashed": "play it again, and report it if it happens again",
    "contained": "report it with the log",
    "out of memory": "play fewer passes or allow more",
    "too much": "which no playback does; report it",
    "failed": "its last output is in the log",
    "nonsense": "play it again, and report it if it happens again",
}


def play(
    trajectory: Trajectory,
    *,
    pad_top_mm: float | None = None,
    clearance_every: int = CLEARANCE_EVERY,
    timeout_s: float = 60.0,
    memory_bytes: int = 1 << 30,
    target: str = SIMULATOR,
) -> Playback:
    """Play a trajectory in a separate process and return the measurements.

    PSM_M is in the scene if the trajectory has its motion. The same trajectory gives the same measurements to the last
    bit, except `seconds_per_step`.

    Args:
        trajectory: The trajectory to play.
        pad_top_mm: Height of the suture pad's top in the PSM base frame; by default `PAD_BELOW_MM` under the lowest
            finger tip (`default_pad_top`).
        clearance_every: Distances are measured once in so many samples; also at the first and last of each phase, and
            at every sample at which they are small or may have become so between two measurements.
        timeout_s: Wall time after which the simulator is killed.
        memory_bytes: Memory limit of the simulator.
        target: The simulator, as `module:function`.

    Returns:
        The measurements, checked for type, shape and finite numbers.

    Raises:
        BadInput: The pad's height is not finite, or `clearance_every` is below 1.
        SimulationFailed: PyBullet is missing, or it crashed, hung, ran out of memory or returned invalid data.
    """
    pad = default_pad_top(trajectory) if pad_top_mm is None else float(pad_top_mm)
    if not np.isfinite(pad):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad)
    if clearance_every < 1:
        raise BadInput("The step between samples with distances must be 1 or more.", given=clearance_every)
    if target == SIMULATOR:
        simulator.require_pybullet()
    asked = request(trajectory, pad, clearance_every)
    answer = simulated(target, asked, ProcessLimits(memory_bytes, timeout_s))
    return _playback(answer, trajectory, pad)


def default_pad_top(trajectory: Trajectory) -> float:
    """Return a pad height, mm, a little under the lowest finger tip of either arm, however far PSM_A's jaw opens."""
    lowest = _lowest_finger(trajectory.tip_mm, matrix_of(trajectory.rotation_xyzw))
    if trajectory.psm_m is not None:
        lowest = min(lowest, _lowest_finger(*psm_m_poses(trajectory, np.arange(len(trajectory)))))
    opened = float(openings(trajectory.arms[0]).max()) - HOLDING_RAD
    return lowest - PAD_BELOW_MM - FINGER_REACH_MM * opened  # as far as the gates allow for it


def _lowest_finger(tip_mm: Floats, rotation: Floats) -> float:
    return float((tip_mm[:, 2] + JAW_TIP_MM * np.minimum(rotation[:, 2, 2], 0.0)).min())


def looks(trajectory: Trajectory, every: int) -> Ints:
    """Choose the samples at which distances are measured first: one in so many, and both ends of each phase."""
    ends = np.flatnonzero(np.diff(trajectory.pass_index * 3 + trajectory.phase))
    count = len(trajectory)
    return np.unique(np.concatenate([np.arange(0, count, every), ends, ends + 1, [count - 1]])).astype(np.int64)


def simulated(target: str, request: dict[str, Any], limits: ProcessLimits) -> dict[str, Any]:
    """Send named arrays, numbers and texts to a simulator in a new process and return its answer.

    Each call starts a new interpreter, because loading PyBullet takes only a small part of the time.

    Args:
        target: The simulator, as `module:function`.
        request: Its input.
        limits: Limits of its process.

    Raises:
        SimulationFailed: It hung, crashed, ran out of memory, failed, or returned too much or anything else;
            `numbers["cause"]` has the cause, and the end of its output is a note of the error.
    """
    try:
        return call_alone(target, request, returns=(dict,), classes={}, limits=limits)
    except Unanswered as error:
        raise error.translated(SimulationFailed, "The simulator", _ADVICE) from error.__cause__


def request(trajectory: Trajectory, pad_top_mm: float, every: int = CLEARANCE_EVERY) -> dict[str, Any]:
    """Return the request for the simulator: named arrays, numbers and texts."""
    asked = {
        "tip_mm": trajectory.tip_mm,
        "rotation_xyzw": trajectory.rotation_xyzw,
        "joints": trajectory.joints,
        "pass_index": trajectory.pass_index,
        "phase": trajectory.phase,
        "rate_hz": trajectory.rate_hz,
        "instrument": trajectory.instrument,
        "pad_top_mm": pad_top_mm,
        "looks": looks(trajectory, every),
    }
    if (m := trajectory.psm_m) is not None:
        asked |= {
            "m_base_mm": m.base_mm,
            "m_base_xyzw": m.base_xyzw,
            "m_joints": m.joints,
            "m_instrument": m.instrument,
        }
    return asked


# ---- the answer ------------------------------------------------------------------------------------------------


def _playback(answer: dict[str, Any], trajectory: Trajectory, pad_top_mm: float) -> Playback:
    """Check every number in the answer, because none is trusted, and return them as a playback."""
    count, with_m = len(trajectory), trajectory.psm_m is not None
    looked_at = array_from(answer, "looked_at", np.int64, (None,))
    seen = len(looked_at)
    low, high = trajectory.tip_mm[:, :2].min(axis=0), trajectory.tip_mm[:, :2].max(axis=0)
    try:
        return Playback(
            trajectory=trajectory,
            tip_mm=array_from(answer, "tip_mm", np.float64, (count, 3)),
            rotation_xyzw=array_from(answer, "rotation_xyzw", np.float64, (count, 4)),
            joints=array_from(answer, "joints", np.float64, (count, 6)),
            tracking_mm=array_from(answer, "tracking_mm", np.float64, (count,)),
            efforts=array_from(answer, "efforts", np.float64, (count, 6)),
            contact_n=array_from(answer, "contact_n", np.float64, (count,)),
            looked_at=looked_at,
            clearances_mm=array_from(answer, "clearances_mm", np.float64, (seen, len(link_pairs(with_m)))),
            shaft_off_mm=array_from(answer, "shaft_off_mm", np.float64, (seen,)),
            psm_m_tip_mm=array_from(answer, "psm_m_tip_mm", np.float64, (seen, 3)) if with_m else None,
            pad_mm=np.append((low + high) / 2, pad_top_mm),
            picture_png=_plain(answer, "picture_png", bytes, lambda picture: picture.startswith(_PNG)),
            engine=_plain(answer, "engine", str, lambda name: 0 < len(name) <= 100),
            files=_plain(answer, "files", dict, _are_digests),
            seconds_per_step=_plain(answer, "seconds_per_step", float, isfinite),
        )
    except BadInput:
        raise _nonsense("looked_at") from None


def array_from(answer: dict[str, Any], name: str, dtype: Any, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """Return an array of a simulator's answer.

    Args:
        answer: The answer, which is untrusted.
        name: The array's name.
        dtype: Its type.
        shape: Its shape; None: any length.

    Raises:
        SimulationFailed: It is missing, has another type or shape, or a number that is not finite.
    """
    array = answer.get(name)
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim != len(shape):
        raise _nonsense(name)
    if any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise _nonsense(name)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise _nonsense(name)
    return array


def _plain(answer: dict[str, Any], name: str, kind: type[Plain], check: Callable[[Plain], bool]) -> Plain:
    value = answer.get(name)
    if not isinstance(value, kind) or not check(value):
        raise _nonsense(name)
    return value


def _are_digests(files: dict[Any, Any]) -> bool:
    """Return whether these are names of URDF files with a SHA-256 each."""
    texts = all(isinstance(text, str) for pair in files.items() for text in pair)
    return texts and all(re.fullmatch(r"\w+\.urdf", n) and re.fullmatch("[0-9a-f]{64}", d) for n, d in files.items())


def _nonsense(name: str) -> SimulationFailed:
    return SimulationFailed(
        f"The simulator returned invalid data in {name}; play it again, and report it if it happens again.",
        cause="nonsense",
        quantity=name,
    )
