"""A minute of two arms that move smoothly, recorded in a camera's frame with joints, jaws, clutch and stages."""

import numpy as np

from skills.demonstration.recording import Joints, Label, Motion, Recording, Signal
from skills.kinematics import forward, instrument_of, matrix_of, quaternion_of

NAME = "400006"
START_NS = 1_750_000_000 * 1_000_000_000
# Where both remote centres stand in the camera's frame, and how they are turned about its z axis.
PLACES = {"PSM1": ((-70.0, 0.0, 60.0), 0.5), "PSM2": ((70.0, 0.0, 60.0), -0.5)}


def joints_at(arm: str, at_s: np.ndarray) -> np.ndarray:
    """Return joints, rad and mm, (T, 6)."""
    side = 1.0 if arm == "PSM1" else -1.0
    middle = np.array([0.25 * side, 0.05, instrument_of(NAME).cannula_mm + 90, 0.3 * side, 0.1, -0.1])
    sizes = np.array([0.12, 0.1, 18.0, 0.5, 0.3, 0.3])
    waves = [np.sin(2 * np.pi * hz * at_s + side * k) for k, hz in enumerate((0.11, 0.07, 0.05, 0.13, 0.09, 0.06))]
    return middle + sizes * np.stack(waves, axis=1)


def base_of(arm: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation of an arm's base in the camera's frame, (3, 3), and its position, mm, (3,)."""
    place, turn = PLACES[arm]
    return matrix_of(np.array([[0, 0, np.sin(turn / 2), np.cos(turn / 2)]]))[0], np.array(place)


def two_arms(duration_s: float = 60.0, rate_hz: float = 200.0) -> Recording:
    """Return the recording."""
    at_s = np.arange(round(duration_s * rate_hz)) / rate_hz
    stamps_ns = START_NS + np.round(at_s * 1e9).astype(np.int64)
    motions, joints, jaws = [], [], []
    for arm in PLACES:
        q = joints_at(arm, at_s)
        tip_mm, rotation = forward(q, NAME)
        base, place = base_of(arm)
        seen = quaternion_of(base @ rotation)
        motions.append(Motion(arm, f"/{arm}/measured_cp", "ECM", stamps_ns, tip_mm @ base.T + place, seen))
        joints.append(Joints(arm, f"/{arm}/measured_js", stamps_ns, q))
        opening = 0.45 + 0.4 * np.sin(2 * np.pi * at_s / 7 + len(jaws))
        jaws.append((arm, Signal(stamps_ns, opening, f"/{arm}/jaw/measured_js")))
    clutch = np.array([0.0, 12.0, 13.5, 40.0, 41.0])
    pressed = Signal(START_NS + (clutch * 1e9).astype(np.int64), np.array([0, 1, 0, 1, 0]), "/footpedals/clutch")
    third = round(duration_s * 1e9 / 3)
    names = ("grasping", "driving", "hand-off")
    labels = tuple(
        Label(name, "stage", START_NS + k * third, START_NS + (k + 1) * third) for k, name in enumerate(names)
    )
    tools = (("PSM1", f"LARGE_NEEDLE_DRIVER:{NAME}"), ("PSM2", f"LARGE_NEEDLE_DRIVER:{NAME}"))
    return Recording(
        "mcap", "full", tuple(motions), tuple(jaws), pressed, joints=tuple(joints), tools=tools, labels=labels
    )
