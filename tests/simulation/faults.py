"""Simulators with one fault each, to be named to `play` or `make_film` in place of the real one."""

from collections.abc import Callable
from dataclasses import make_dataclass
from typing import Any, BinaryIO

import numpy as np

from skills import packing
from skills.arrays import Floats
from skills.simulation import referee, simulator
from skills.verification.playback import Playback
from tests.sandbox.faults import crash, eat_memory, fail, garbage, hang, nothing, with_pickles  # noqa: F401 - by name


def _answering(**changed: Any) -> Callable[[BinaryIO, BinaryIO], None]:
    """Return a simulator that measures exactly the requested values, but for changed fields of its answer."""

    def simulate(given: BinaryIO, answer: BinaryIO) -> None:
        playback = _exact(packing.read(given, simulator.CLASSES))
        for name, value in changed.items():  # not through the constructor, which checks them
            object.__setattr__(playback, name, value(getattr(playback, name)) if callable(value) else value)
        packing.write(answer, playback, simulator.CLASSES)

    return simulate


def _exact(asked: simulator.PlayRequest) -> Playback:
    motion = asked.trajectory
    count, looks = len(motion), len(asked.looks)
    return Playback(
        trajectory=motion,
        tip_mm=motion.tip_mm,
        rotation_xyzw=motion.rotation_xyzw,
        joints=motion.joints,
        tracking_mm=np.zeros(count),
        efforts=np.zeros((count, 6)),
        contact_n=np.zeros(count),
        windows=np.zeros((0, 2), np.int64),
        looked_at=asked.looks,
        clearances_mm=np.full((looks, 4), 5.0),
        shaft_off_mm=np.zeros(looks),
        psm_m_tip_mm=None,
        pad_mm=np.append(motion.tip_mm[:, :2].mean(axis=0), asked.pad_top_mm),
        picture_png=b"\x89PNG\r\n\x1a\n",
        engine="none",
        files={"psm.urdf": "0" * 64},
    )


def _with_nan(at: Any) -> Callable[[Floats], Floats]:
    def change(values: Floats) -> Floats:
        changed = values.copy()
        changed[at] = np.nan
        return changed

    return change


sound = _answering()
not_a_number = _answering(tracking_mm=_with_nan(3))
nan_joint = _answering(joints=_with_nan((3, 2)))
nan_clearance = _answering(clearances_mm=_with_nan((3, 1)))
looked_the_other_way = _answering(looked_at=lambda samples: samples[::-1])
no_such_file = _answering(files={"../psm.urdf": "0" * 64})
no_digest = _answering(files={"psm.urdf": 0})
too_short = _answering(tip_mm=lambda tip_mm: tip_mm[:-1])
no_numbers = _answering(joints="joints")
another_arm = _answering(psm_m_tip_mm=lambda _: np.zeros((1, 3)))
no_picture = _answering(picture_png=b"GIF89a")
no_bytes = _answering(picture_png="\x89PNG\r\n\x1a\n")
no_name = _answering(engine="")


def _writing(value: Any) -> Callable[[BinaryIO, BinaryIO], None]:
    return lambda given, answer: packing.write(answer, value, packing.known(type(value)) if value else {})


incomplete = _writing(make_dataclass("Playback", ["engine"])("none"))
no_film = _writing({})
no_gif = _writing(make_dataclass("Film", ["mp4", "gif"])(b"\0\0\0\x20ftypisom", b"GIF"))
film_in_words = _writing(make_dataclass("Film", ["mp4", "gif"])("\0\0\0\x20ftypisom", ["GIF89a"]))


# ---- of the contact referee --------------------------------------------------------------------------------------


def _refereeing(**changed: Any) -> Callable[[BinaryIO, BinaryIO], None]:
    """Return a referee that holds every needle, but for a change to its answer."""

    def trials(given: BinaryIO, answer: BinaryIO) -> None:
        total = sum(packing.read(given, referee.CLASSES).counts)
        outcomes = referee.Outcomes(np.zeros(total, np.int64), np.zeros((total, 3)), "none")
        for name, value in changed.items():
            object.__setattr__(outcomes, name, value)
        packing.write(answer, outcomes, referee.CLASSES)

    return trials


unknown_end = _refereeing(ended=np.array([0, 4]))
nan_motion = _refereeing(motion=np.full((2, 3), np.nan))
too_few_ends = _refereeing(ended=np.zeros(1, np.int64))
nameless = _refereeing(engine="")
