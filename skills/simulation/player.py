"""The player of trajectories in the simulator: metres and PyBullet in its process, millimetres and values in ours."""

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from skills import packing
from skills.arrays import Floats, Ints
from skills.dynamics import Servo
from skills.errors import BadInput, SimulationFailed, Unanswered
from skills.kinematics import JAW_TIP_MM, matrix_of
from skills.planning.handoff import HOLDING_RAD
from skills.planning.trajectory import Trajectory
from skills.sandbox import ProcessLimits
from skills.sandbox.forked import call_alone
from skills.simulation import simulator
from skills.simulation.simulator import CLASSES, PlayRequest
from skills.verification.clearance import FINGER_REACH_MM, openings, psm_m_poses
from skills.verification.playback import Playback

SIMULATOR = "skills.simulation.simulator:simulate"
LOOPS_READY = "skills.simulation.simulator:get_ready"
PAD_BELOW_MM = 5.0  # ours: height of the finger tips above a pad whose height is not given
CLEARANCE_EVERY = 4  # samples: 0.33 mm of the tip's path at 20 mm/s and 240 Hz, for which the bounds on distances allow
Answer = TypeVar("Answer")
_PNG = b"\x89PNG\r\n\x1a\n"
_FILE, _DIGEST = re.compile(r"\w+\.urdf"), re.compile("[0-9a-f]{64}")
_ADVICE = {
    "hung": "play fewer passes",
    "crashed": "play it again, and report it if it happens again",
    "contained": "report it with the log",
    "out of memory": "play fewer passes or allow more",
    "too much": "which no playback does; report it",
    "failed": "play it again, and report it if it happens again",
    "nonsense": "play it again, and report it if it happens again",
}


def play(
    trajectory: Trajectory,
    *,
    servo: Servo | None = None,
    pad_top_mm: float | None = None,
    clearance_every: int = CLEARANCE_EVERY,
    timeout_s: float = 60.0,
    memory_bytes: int = 1 << 30,
    target: str = SIMULATOR,
) -> Playback:
    """Play a trajectory in a separate process and return the measurements.

    PSM_M is in the scene if the trajectory has its motion. The same trajectory gives the same measurements to the last
    bit.

    Args:
        trajectory: The trajectory to play.
        servo: How the arm is driven; None: its motion is not executed.
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
    limits = ProcessLimits(memory_bytes, timeout_s)
    asked, ready = request(trajectory, pad, clearance_every, servo), () if servo is None else (LOOPS_READY,)
    playback = simulated(target, asked, Playback, CLASSES, limits, ready)
    try:
        mine = replace(playback, trajectory=trajectory)  # checks all shapes again
    except BadInput as error:
        raise _nonsense(str(error)) from error
    _check(mine)
    return mine


def _check(playback: Playback) -> None:
    """Refuse a playback with a number that is not finite, or with texts and files that no simulator has.

    Raises:
        SimulationFailed: It has.
    """
    for field in fields(playback):
        value = getattr(playback, field.name)
        if isinstance(value, np.ndarray) and not np.isfinite(value).all():
            raise _nonsense(f"{field.name} has numbers that are not finite.")
    named = all(isinstance(text, str) for pair in playback.files.items() for text in pair) and all(
        _FILE.fullmatch(name) and _DIGEST.fullmatch(digest) for name, digest in playback.files.items()
    )
    pictured = isinstance(playback.picture_png, bytes) and playback.picture_png.startswith(_PNG)
    engine = isinstance(playback.engine, str) and 0 < len(playback.engine) <= 100
    both = (playback.psm_m_tip_mm is None) == (playback.trajectory.psm_m is None)
    if not (named and pictured and engine and both):
        raise _nonsense("the picture, the engine, its files or the arms.")


def _nonsense(why: str) -> SimulationFailed:
    return SimulationFailed(f"The simulator returned invalid data; play it again: {why}", cause="nonsense")


def default_pad_top(trajectory: Trajectory) -> float:
    """Return a pad height, mm, a little under the lowest finger tip of either arm, however far PSM_A's jaw opens."""
    lowest = _lowest_finger(trajectory.tip_mm, matrix_of(trajectory.rotation_xyzw))
    if trajectory.psm_m is not None:
        lowest = min(lowest, _lowest_finger(*psm_m_poses(trajectory, np.arange(len(trajectory)))))
    opened = float(openings(trajectory.arms[0]).max()) - HOLDING_RAD
    return lowest - PAD_BELOW_MM - FINGER_REACH_MM * opened  # as far as the gates allow for it


def _lowest_finger(tip_mm: Floats, rotation: Floats) -> float:
    """Return the least height of the hinge and of the tips of closed jaws, mm."""
    return float((tip_mm[:, 2] + JAW_TIP_MM * np.minimum(rotation[:, 2, 2], 0.0)).min())


def looks(trajectory: Trajectory, every: int) -> Ints:
    """Choose the samples at which distances are measured first: one in so many, and both ends of each phase."""
    ends = np.flatnonzero(np.diff(trajectory.pass_index * 3 + trajectory.phase))
    count = len(trajectory)
    return np.unique(np.concatenate([np.arange(0, count, every), ends, ends + 1, [count - 1]])).astype(np.int64)


def simulated(
    target: str,
    request: object,
    returns: type[Answer],
    classes: packing.Known,
    limits: ProcessLimits,
    ready: Sequence[str] = (),
) -> Answer:
    """Send a request to a simulator in a new process and return its answer.

    Each call starts a new interpreter, because loading PyBullet takes only a small part of the time.

    Args:
        target: The simulator, as `module:function`.
        request: Its input.
        returns: The class of its answer.
        classes: The classes that may occur in the request and in the answer, by name.
        limits: Limits of its process.
        ready: Modules of it, as for `call_alone`.

    Raises:
        SimulationFailed: It hung, crashed, ran out of memory, failed, or returned too much or anything else;
            `numbers["cause"]` has the cause, and the end of its output is a note of the error.
    """
    try:
        return call_alone(target, request, returns=(returns,), classes=classes, limits=limits, ready=ready)
    except Unanswered as error:
        raise error.translated(SimulationFailed, "The simulator", _ADVICE) from error.__cause__


def request(
    trajectory: Trajectory, pad_top_mm: float, every: int = CLEARANCE_EVERY, servo: Servo | None = None
) -> PlayRequest:
    """Return the request for the simulator."""
    return PlayRequest(trajectory, pad_top_mm, looks(trajectory, every), servo)
