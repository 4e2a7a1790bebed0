"""A cohort of known truth: surgeons with individual styles, who record in sessions that also differ.

A hand-off is a minimum-jerk path with humps: mostly of the surgeon, less of the session, least of the single motion.
Every session has another place, is rotated about the base's z axis, and has another speed.
"""

from dataclasses import dataclass

import numpy as np

from skills.demonstration.demonstration import Demo

RATE_HZ = 100.0
HUMPS = 3  # sines along the path, each with an amplitude along two axes
WAY_MM = np.array([40.0, 5.0, 10.0])


@dataclass(frozen=True, eq=False)
class Cohort:
    """Demonstrations, with the surgeon and the session of each."""

    demos: tuple[Demo, ...]
    surgeons: np.ndarray
    sessions: np.ndarray


def cohort(seed: int, surgeons: int = 8, sessions: int = 5, *, own: float = 5.0, day: float = 1.0) -> Cohort:
    """Draw a cohort with one demonstration per session; `own` and `day` are hump sizes, mm, of surgeon and session."""
    rng = np.random.default_rng(seed)
    demos, whose, when = [], [], []
    for surgeon in range(surgeons):
        style_mm = rng.normal(0.0, own, (HUMPS, 2))
        for session in range(sessions):
            humps_mm = style_mm + rng.normal(0.0, day, (HUMPS, 2)) + rng.normal(0.0, 0.3, (HUMPS, 2))
            demos.append(demo_of(humps_mm, rng.uniform(-np.pi, np.pi), rng.normal(0.0, 20.0, 3), rng.uniform(2.0, 4.0)))
            whose.append(surgeon)
            when.append(surgeon * sessions + session)
    return Cohort(tuple(demos), np.array(whose), np.array(when))


def demo_of(humps_mm: np.ndarray, turn_rad: float, place_mm: np.ndarray, duration_s: float) -> Demo:
    stamps_s = np.arange(0.0, duration_s, 1.0 / RATE_HZ)
    u = stamps_s / stamps_s[-1]
    way = 10 * u**3 - 15 * u**4 + 6 * u**5
    tip_mm = way[:, None] * WAY_MM
    for number, (sideways, upwards) in enumerate(humps_mm, start=1):
        tip_mm = tip_mm + np.sin(np.pi * number * way)[:, None] * np.array([0.0, sideways, upwards])
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    turned = tip_mm @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Demo("PSM2", "/PSM2/setpoint_cp", "PSM2_base", 0.0, float(stamps_s[-1]), stamps_s, turned + place_mm)
