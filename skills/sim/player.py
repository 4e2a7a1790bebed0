"""Play a trajectory in the simulator: metres and PyBullet on the other side, millimetres and values on ours."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skills.errors import BadInput, SimulationFailed
from skills.sim import confined, scene, wire
from skills.style.kinematics import JAW_TIP_MM, matrix_of
from skills.style.playback import Playback, WaitingArm
from skills.style.trajectory import Trajectory

SIMULATOR = "skills.sim.scene:simulate"
PAD_BELOW_MM = 5.0  # ours: how far the finger tips stay above a pad whose height nobody gave
_PNG = b"\x89PNG\r\n\x1a\n"


def play(
    trajectory: Trajectory,
    *,
    pad_top_mm: float | None = None,
    psm_m: WaitingArm | None = None,
    timeout_s: float = 60.0,
    memory_bytes: int = 1 << 30,
    target: str = SIMULATOR,
) -> Playback:
    """Play a trajectory in a process of its own and bring back what was measured.

    The same trajectory gives the same measurements to the last bit, all but `seconds_per_step`.

    Args:
        trajectory: What to play.
        pad_top_mm: Height of the suture pad's top in the PSM base frame; by default `PAD_BELOW_MM` under the lowest
            finger tip (`default_pad_top`).
        psm_m: The other arm, waiting; None where its place is not known.
        timeout_s: Wall time after which the simulator is killed.
        memory_bytes: What the simulator may use.
        target: The simulator, as `module:function`, from bytes to bytes.

    Raises:
        BadInput: The pad's height is not finite, or PSM_M has not one pose for each pass.
        SimulationFailed: PyBullet is missing, or it crashed, hung, ran out of memory or answered nonsense.
    """
    pad = default_pad_top(trajectory) if pad_top_mm is None else float(pad_top_mm)
    if not np.isfinite(pad):
        raise BadInput("The pad's height must be a number; give it in mm in the PSM base frame.", pad_top_mm=pad)
    if target == SIMULATOR:
        scene.require_pybullet()
    answer = confined.run(target, _request(trajectory, pad, psm_m), timeout_s=timeout_s, memory_bytes=memory_bytes)
    return _playback(wire.unpack(answer), trajectory, pad, psm_m is not None)


def default_pad_top(trajectory: Trajectory) -> float:
    """Put the pad a little under the lowest finger tip, in mm; a trajectory's tip is the hinge, not the fingers."""
    approach = matrix_of(trajectory.rotation_xyzw)[:, 2, 2]
    fingers = trajectory.tip_mm[:, 2] + JAW_TIP_MM * np.minimum(approach, 0.0)
    return float(fingers.min()) - PAD_BELOW_MM


def _request(trajectory: Trajectory, pad_top_mm: float, psm_m: WaitingArm | None) -> bytes:
    asked: dict[str, ArrayLike] = {
        "tip_mm": trajectory.tip_mm,
        "rotation_xyzw": trajectory.rotation_xyzw,
        "joints": trajectory.joints,
        "pass_index": trajectory.pass_index,
        "phase": trajectory.phase,
        "rate_hz": trajectory.rate_hz,
        "instrument": trajectory.instrument,
        "pad_top_mm": pad_top_mm,
    }
    if psm_m is not None:
        if len(psm_m.joints) != trajectory.passes:
            raise BadInput(
                f"PSM_M has {len(psm_m.joints)} poses for {trajectory.passes} passes; give one for each.",
                poses=len(psm_m.joints),
                passes=trajectory.passes,
            )
        asked |= {
            "m_base_mm": psm_m.base_mm,
            "m_base_xyzw": psm_m.base_xyzw,
            "m_joints": psm_m.joints,
            "m_enters_after_a1": psm_m.enters_after_a1,
        }
    return wire.pack(asked)


def _playback(answer: dict[str, NDArray[Any]], trajectory: Trajectory, pad_top_mm: float, with_m: bool) -> Playback:
    """Check every number that came back; none is believed."""
    count = len(trajectory)
    picture = _checked(answer, "picture_png", np.uint8, (None,)).tobytes()
    if not picture.startswith(_PNG):
        raise _nonsense("picture_png")
    return Playback(
        tip_mm=_checked(answer, "tip_mm", np.float64, (count, 3)),
        rotation_xyzw=_checked(answer, "rotation_xyzw", np.float64, (count, 4)),
        joints=_checked(answer, "joints", np.float64, (count, 6)),
        tracking_mm=_checked(answer, "tracking_mm", np.float64, (count,)),
        clearance_pad_mm=_checked(answer, "clearance_pad_mm", np.float64, (count,)),
        clearance_psm_m_mm=_checked(answer, "clearance_psm_m_mm", np.float64, (count,)) if with_m else None,
        pad_top_mm=pad_top_mm,
        picture_png=picture,
        engine=_text(answer, "engine"),
        seconds_per_step=float(_checked(answer, "seconds_per_step", np.float64, ())),
    )


def _checked(answer: dict[str, NDArray[Any]], name: str, dtype: Any, shape: tuple[int | None, ...]) -> NDArray[Any]:
    array = answer.get(name)
    if array is None or array.dtype != dtype or array.ndim != len(shape):
        raise _nonsense(name)
    if any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise _nonsense(name)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise _nonsense(name)
    return array


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
