"""Play a trajectory in the simulator: metres and PyBullet on the other side, millimetres and values on ours."""

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import BadInput, SimulationFailed
from skills.sim import confined, scene, wire
from skills.style._arrays import Floats, Ints
from skills.style.kinematics import JAW_TIP_MM, matrix_of
from skills.style.needle import psm_m_poses
from skills.style.playback import Playback, link_pairs
from skills.style.trajectory import Trajectory

SIMULATOR = "skills.sim.passes:simulate"
PAD_BELOW_MM = 5.0  # ours: how far the finger tips stay above a pad whose height nobody gave
CLEARANCE_EVERY = 4  # samples: 0.33 mm of the tip's way at 20 mm/s and 240 Hz, and what moves is allowed for
_PNG = b"\x89PNG\r\n\x1a\n"


def play(
    trajectory: Trajectory,
    *,
    pad_top_mm: float | None = None,
    clearance_every: int = CLEARANCE_EVERY,
    timeout_s: float = 60.0,
    memory_bytes: int = 1 << 30,
    target: str = SIMULATOR,
) -> Playback:
    """Play a trajectory in a process of its own and bring back what was measured.

    PSM_M is in the scene where the trajectory has its motion. The same trajectory gives the same measurements to the
    last bit, all but `seconds_per_step`.

    Args:
        trajectory: What to play.
        pad_top_mm: Height of the suture pad's top in the PSM base frame; by default `PAD_BELOW_MM` under the lowest
            finger tip (`default_pad_top`).
        clearance_every: Distances are measured at every so many samples; and at the first and last of each phase, and
            at every sample where they are small or may have become so between two looks.
        timeout_s: Wall time after which the simulator is killed.
        memory_bytes: What the simulator may use.
        target: The simulator, as `module:function`, from bytes to bytes.

    Raises:
        BadInput: The pad's height is not finite, or `clearance_every` is below 1.
        SimulationFailed: PyBullet is missing, or it crashed, hung, ran out of memory or answered nonsense.
    """
    pad = default_pad_top(trajectory) if pad_top_mm is None else float(pad_top_mm)
    if not np.isfinite(pad):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad)
    if clearance_every < 1:
        raise BadInput("Distances are measured at every so many samples; give 1 or more.", given=clearance_every)
    if target == SIMULATOR:
        scene.require_pybullet()
    asked = request(trajectory, pad, clearance_every)
    answer = confined.run(target, asked, timeout_s=timeout_s, memory_bytes=memory_bytes)
    return _playback(wire.unpack(answer), trajectory, pad)


def default_pad_top(trajectory: Trajectory) -> float:
    """Put the pad a little under the lowest finger tip of either arm, in mm; a tip is the hinge, not the fingers."""
    lowest = _lowest_finger(trajectory.tip_mm, matrix_of(trajectory.rotation_xyzw))
    if trajectory.psm_m is not None:
        lowest = min(lowest, _lowest_finger(*psm_m_poses(trajectory, np.arange(len(trajectory)))))
    return lowest - PAD_BELOW_MM


def _lowest_finger(tip_mm: Floats, rotation: Floats) -> float:
    return float((tip_mm[:, 2] + JAW_TIP_MM * np.minimum(rotation[:, 2, 2], 0.0)).min())


def looks(trajectory: Trajectory, every: int) -> Ints:
    """Choose the samples at which distances are measured first: every so many, and both ends of each phase."""
    ends = np.flatnonzero(np.diff(trajectory.pass_index * 3 + trajectory.phase))
    count = len(trajectory)
    return np.unique(np.concatenate([np.arange(0, count, every), ends, ends + 1, [count - 1]])).astype(np.int64)


def request(trajectory: Trajectory, pad_top_mm: float, every: int = CLEARANCE_EVERY) -> bytes:
    """Write what the simulator is asked for."""
    asked: dict[str, ArrayLike] = {
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
    return wire.pack(asked)


# ---- what comes back -------------------------------------------------------------------------------------------


def _playback(answer: dict[str, NDArray[Any]], trajectory: Trajectory, pad_top_mm: float) -> Playback:
    """Check every number that came back; none is believed."""
    count, with_m = len(trajectory), trajectory.psm_m is not None
    picture = _checked(answer, "picture_png", np.uint8, (None,)).tobytes()
    if not picture.startswith(_PNG):
        raise _nonsense("picture_png")
    looked_at = _checked(answer, "looked_at", np.int64, (None,))
    seen = len(looked_at)
    low, high = trajectory.tip_mm[:, :2].min(axis=0), trajectory.tip_mm[:, :2].max(axis=0)
    try:
        return Playback(
            tip_mm=_checked(answer, "tip_mm", np.float64, (count, 3)),
            rotation_xyzw=_checked(answer, "rotation_xyzw", np.float64, (count, 4)),
            joints=_checked(answer, "joints", np.float64, (count, 6)),
            tracking_mm=_checked(answer, "tracking_mm", np.float64, (count,)),
            efforts=_checked(answer, "efforts", np.float64, (count, 6)),
            contact_n=_checked(answer, "contact_n", np.float64, (count,)),
            looked_at=looked_at,
            clearances_mm=_checked(answer, "clearances_mm", np.float64, (seen, len(link_pairs(with_m)))),
            shaft_off_mm=_checked(answer, "shaft_off_mm", np.float64, (seen,)),
            psm_m_tip_mm=_checked(answer, "psm_m_tip_mm", np.float64, (seen, 3)) if with_m else None,
            pad_mm=np.append((low + high) / 2, pad_top_mm),
            picture_png=picture,
            engine=_text(answer, "engine"),
            files=_digests(answer),
            seconds_per_step=float(_checked(answer, "seconds_per_step", np.float64, ())),
        )
    except BadInput:
        raise _nonsense("looked_at") from None


def _checked(answer: dict[str, NDArray[Any]], name: str, dtype: Any, shape: tuple[int | None, ...]) -> NDArray[Any]:
    array = answer.get(name)
    if array is None or array.dtype != dtype or array.ndim != len(shape):
        raise _nonsense(name)
    if any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise _nonsense(name)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise _nonsense(name)
    return array


def _digests(answer: dict[str, NDArray[Any]]) -> dict[str, str]:
    names, digests = (answer.get(name, np.empty(0)) for name in ("files", "digests"))
    if any(part.dtype.kind != "U" or part.ndim != 1 for part in (names, digests)) or len(names) != len(digests):
        raise _nonsense("files")
    found = {str(name): str(digest) for name, digest in zip(names, digests, strict=True)}
    if not all(re.fullmatch(r"\w+\.urdf", name) and re.fullmatch("[0-9a-f]{64}", found[name]) for name in found):
        raise _nonsense("files")
    return found


def _text(answer: dict[str, NDArray[Any]], name: str) -> str:
    array = answer.get(name)
    if array is None or array.dtype.kind != "U" or array.shape != () or not 0 < len(str(array)) <= 100:
        raise _nonsense(name)
    return str(array)


def _nonsense(name: str) -> SimulationFailed:
    return SimulationFailed(
        f"The simulator answered nonsense in {name}; play it again, and report it if it stays.",
        cause="nonsense",
        quantity=name,
    )
