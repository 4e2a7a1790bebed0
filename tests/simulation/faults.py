"""Simulators with one fault each, to be named to `play` or `shoot` in place of the real one."""

from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

from skills import packing
from tests.sandbox.faults import crash, eat_memory, fail, garbage, hang, nothing, with_pickles  # noqa: F401 - by name


def _answering(change: Callable[[dict[str, Any]], object]) -> Callable[[BinaryIO, BinaryIO], None]:
    """Return a simulator that measures exactly the requested values, but for a change to its answer."""

    def simulate(given: BinaryIO, answer: BinaryIO) -> None:
        measured = _exact(packing.read(given, {}))
        change(measured)
        packing.write(answer, measured, {})

    return simulate


def _exact(asked: dict[str, Any]) -> dict[str, Any]:
    count = len(asked["tip_mm"])
    return {
        "tip_mm": asked["tip_mm"],
        "rotation_xyzw": asked["rotation_xyzw"],
        "joints": asked["joints"].copy(),
        "tracking_mm": np.zeros(count),
        "efforts": np.zeros((count, 6)),
        "contact_n": np.zeros(count),
        "looked_at": asked["looks"],
        "clearances_mm": np.full((len(asked["looks"]), 4), 5.0),
        "shaft_off_mm": np.zeros(len(asked["looks"])),
        "files": {"psm.urdf": "0" * 64},
        "picture_png": b"\x89PNG\r\n\x1a\n",
        "engine": "none",
        "seconds_per_step": 1e-5,
    }


def _put(name: str, at: Any, value: float) -> Callable[[dict[str, Any]], object]:
    return lambda measured: measured[name].__setitem__(at, value)


sound = _answering(lambda measured: None)
not_a_number = _answering(_put("tracking_mm", 3, np.nan))
nan_joint = _answering(_put("joints", (3, 2), np.nan))
nan_clearance = _answering(_put("clearances_mm", (3, 1), np.nan))
looked_the_other_way = _answering(lambda measured: measured.update(looked_at=measured["looked_at"][::-1]))
no_such_file = _answering(lambda measured: measured.update(files={"../psm.urdf": "0" * 64}))
no_digest = _answering(lambda measured: measured.update(files={"psm.urdf": 0}))
too_short = _answering(lambda measured: measured.update(tip_mm=measured["tip_mm"][:-1]))
whole_numbers = _answering(lambda measured: measured.update(joints=measured["joints"].astype(np.int64)))
no_array = _answering(lambda measured: measured.update(joints=measured["joints"].tolist()))
no_picture = _answering(lambda measured: measured.update(picture_png=b"GIF89a"))
no_bytes = _answering(lambda measured: measured.update(picture_png="\x89PNG\r\n\x1a\n"))
no_name = _answering(lambda measured: measured.update(engine=""))
no_duration = _answering(lambda measured: measured.update(seconds_per_step="1e-5"))
incomplete = _answering(lambda measured: measured.pop("clearances_mm"))


def no_film(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, {}, {})


def no_gif(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, {"mp4": b"\0\0\0\x20ftypisom", "gif": b"GIF"}, {})


def film_in_words(given: BinaryIO, answer: BinaryIO) -> None:
    packing.write(answer, {"mp4": "\0\0\0\x20ftypisom", "gif": ["GIF89a"]}, {})


# ---- of the contact referee --------------------------------------------------------------------------------------


def _refereeing(**changed: Any) -> Callable[[BinaryIO, BinaryIO], None]:
    """Return a referee that holds every needle, but for a change to its answer."""

    def trials(given: BinaryIO, answer: BinaryIO) -> None:
        total = int(packing.read(given, {})["trials"].sum())
        sound = {"ended": np.zeros(total, np.int64), "motion": np.zeros((total, 3)), "engine": "none"}
        packing.write(answer, sound | changed, {})

    return trials


unknown_end = _refereeing(ended=np.array([0, 4]))
nan_motion = _refereeing(motion=np.full((2, 3), np.nan))
too_few_ends = _refereeing(ended=np.zeros(1, np.int64))
nameless = _refereeing(engine="")
