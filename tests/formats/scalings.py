"""Sound hand-offs of every format with their times, lengths or angles in another unit, and what becomes of each.

    python -m tests.formats.scalings [N] [SEED]    how many of N scaled files are taken silently and wrongly

Times are scaled by powers of ten from 1e-9 to 1e9. Lengths in m, cm, mm or inches are written as if they were in the
unit of the format, which is m, or in tables m or mm; angles in degrees as if they were in radians, in tables also the
reverse. Not among them are factors that no unit of a format explains: 2.54, or a jaw divided by 57.
"""

import io
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from skills.arithmetic import cos, sin
from skills.demonstration.demonstration import Demo, cut_demo
from skills.errors import SkillsError
from skills.formats import bag_writer, read_recording
from skills.formats.columns import quaternion_of_rpy
from skills.gridworld.grid import choose_grid, discretize
from skills.kinematics import INSERTION, POINTING_DOWN, inverse, matrix_of
from tests.formats import lerobots
from tests.formats.bags import START_NS
from tests.formats.others import zipped

IN_MM = {"m": 1000.0, "cm": 10.0, "mm": 1.0, "inch": 25.4}
DECADES = tuple(10.0**k for k in range(-9, 10) if k)
DEGREE = np.pi / 180


@dataclass(frozen=True)
class HandOff:
    """A hand-off as it was: times in s, tip in mm, roll, pitch and yaw, and a jaw in rad."""

    seconds: np.ndarray
    tip_mm: np.ndarray
    rpy_rad: np.ndarray
    jaw_rad: np.ndarray
    true_rpy_rad: np.ndarray  # for formats with quaternions, which have no unit
    base: bool  # whether it is in the base of the arm, or as a camera sees it

    @property
    def rotation_xyzw(self) -> np.ndarray:
        """Its orientations as quaternions."""
        return quaternion_of_rpy("drawn", self.true_rpy_rad)

    def scaled(self, time: float = 1.0, length: float = 1.0, angle: float = 1.0) -> "HandOff":
        """Return it with other numbers; a quaternion of scaled angles is that of the angles themselves."""
        return replace(
            self,
            seconds=time * self.seconds,
            tip_mm=length * self.tip_mm,
            rpy_rad=angle * self.rpy_rad,
            jaw_rad=angle * self.jaw_rad,
        )


def draw(rng: np.random.Generator, rate_hz: float, *, base: bool) -> HandOff:
    """Draw a hand-off of 3 to 7 s: one sweep of 25 to 70 mm with tremor, and a turn of the wrist after it."""
    last_s = rng.uniform(3, 7)
    seconds = np.arange(int(last_s * rate_hz)) / rate_hz
    moved = np.clip((seconds - 0.1 * last_s) / (min(rng.uniform(1.2, 3), 0.6 * last_s)), 0, 1)
    way = moved**3 * (10 - 15 * moved + 6 * moved**2)
    sweep = rng.normal(size=3)
    start = np.array([rng.uniform(-30, 30), rng.uniform(30, 60), rng.uniform(-150, -110)])
    start = start if base else np.array([rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(70, 140)])
    tip = start + rng.uniform(25, 70) * way[:, None] * sweep / np.linalg.norm(sweep)
    tip += 0.2 * sin(2 * np.pi * rng.uniform(8, 12) * seconds)[:, None] + rng.normal(0, 0.01, tip.shape)
    turned = np.clip((seconds - 0.7 * last_s) / (0.2 * last_s), 0, 1)
    rpy = np.array([np.pi - 0.3, 0.2, 1.2]) - turned[:, None] * [0.6, 0.2, 0.9] + rng.normal(0, 0.002, tip.shape)
    return HandOff(seconds, tip, rpy, 0.5 - 0.4 * cos(2 * np.pi * seconds / last_s), rpy, base)


# ---- the formats ---------------------------------------------------------------------------------------------------


Written = tuple[bytes, dict[str, Any]]


def table(rng: np.random.Generator, one: HandOff, *, length: str, turn: str) -> Written:
    """Write a table under our names, with these units of lengths and angles."""
    unit = str(rng.choice(["s", "ms", "us"]))
    per_s, per_rad = {"s": 1, "ms": 1e3, "us": 1e6}[unit], {"rad": 1.0, "deg": 1 / DEGREE}[turn]
    names = [f"t_{unit}", *(f"{axis}_{length}" for axis in "xyz")]
    names += [f"{angle}_{turn}" for angle in ("roll", "pitch", "yaw", "jaw")]
    columns = [per_s * one.seconds, one.tip_mm / IN_MM[length], per_rad * one.rpy_rad, per_rad * one.jaw_rad]
    return rows(names, np.column_stack(columns)), {} if one.base else {"frame": "ECM"}


def rows(names: list[str], values: np.ndarray) -> bytes:
    """Return a table as text."""
    lines = [",".join(map(repr, row)) for row in values.tolist()]
    return "\n".join([",".join(names), *lines, ""]).encode()


def joints(rng: np.random.Generator, one: HandOff, *, turn: str, angle: float) -> Written:
    """Write a table of joints; their angles are multiplied by a factor."""
    q = inverse(one.tip_mm, POINTING_DOWN)
    q[:, [0, 1, 3, 4, 5]] *= angle * (1.0 if turn == "rad" else 1 / DEGREE)
    q[:, INSERTION] /= 1000
    names = ["t_s", *(f"q{k}_{'m' if k == 3 else turn}" for k in range(1, 7))]
    return rows(names, np.column_stack([one.seconds, q])), {"instrument": "400006"}


def ee_csv(rng: np.random.Generator, one: HandOff) -> Written:
    """Write an ee_csv."""
    values = np.column_stack([one.tip_mm / 1000, one.rotation_xyzw, one.jaw_rad]).tolist()
    stamps = [f"{at:.0f}" for at in 1e9 * (1000 + one.seconds)]
    lines = [",".join([at, *map(repr, row)]) for at, row in zip(stamps, values, strict=True)]
    names = ["timestamp", *(f"psm1_pose.{part}" for part in lerobots.PARTS), "psm1_jaw"]
    return "\n".join([",".join(names), *lines, ""]).encode(), {"frame": "base" if one.base else "ECM"}


def bag(rng: np.random.Generator, one: HandOff, *, logged_s: np.ndarray, folder: bool) -> Written:
    """Write an MCAP file, or a zipped folder of it, whose messages were received as the hand-off went on."""
    topic, frame = ("/PSM1/local/measured_cp", "PSM1_base") if one.base else ("/PSM1/measured_cp", "ECM")
    said, turns = [], one.rotation_xyzw
    for k, (at_s, log_s) in enumerate(zip(one.seconds, logged_s, strict=True)):
        at_ns, log_ns = START_NS % 10**18 + round(at_s * 1e9), START_NS + round(log_s * 1e9) + int(rng.integers(10**6))
        pose = bag_writer.pose(topic, at_ns, frame, (one.tip_mm[k] / 1000).tolist(), turns[k].tolist())
        jaw = bag_writer.joint_state("/PSM1/jaw/measured_js", at_ns, [float(one.jaw_rad[k])])
        said += [replace(message, log_ns=log_ns) for message in (pose, jaw)]
    out = io.BytesIO()
    bag_writer.write_messages(said, out)
    return (zipped({"b/b.mcap": out.getvalue()}) if folder else out.getvalue()), {}


def lerobot(rng: np.random.Generator, one: HandOff, *, fps: float) -> Written:
    """Write an episode of LeRobot with its timestamps, in one of both precisions, beside a rate."""
    state = np.column_stack([one.tip_mm / 1000, one.rotation_xyzw, one.jaw_rad])
    seconds = one.seconds.astype(np.float32 if rng.random() < 0.5 else np.float64)
    columns = {"observation.state": state, "action": None, "timestamp": seconds}
    names = {"observation.state": [*(f"psm1_pose.{part}" for part in lerobots.PARTS), "psm1_jaw"]}
    files = lerobots.episode(lerobots.columns_of(len(state), **columns), names=names, fps=fps)
    return zipped(files), {"frame": "base" if one.base else "ECM"}


# ---- what becomes of them ------------------------------------------------------------------------------------------


def release(data: bytes, how: dict[str, Any]) -> Demo:
    """Read a file, cut all of it and put it in a grid, as for a style."""
    demo = cut_demo(read_recording(io.BytesIO(data), **how))
    discretize(demo.tip_mm, choose_grid(demo.tip_mm, "auto", 5.0))
    return demo


def is_right(one: HandOff, got: Demo, *, turns: bool) -> bool:
    """Return whether duration, way, turn and jaw agree with the hand-off within 1 %."""
    pairs = [
        (got.stamps_s[-1], one.seconds[-1]),
        (np.ptp(got.tip_mm, axis=0).max(), np.ptp(one.tip_mm, axis=0).max()),
    ]
    if turns:
        assert got.rotation_xyzw is not None and got.jaw_rad is not None
        pairs += [
            (spread(got.rotation_xyzw), spread(one.rotation_xyzw)),
            (np.ptp(got.jaw_rad), np.ptp(one.jaw_rad)),
        ]
    return all(abs(found - true) <= 0.01 * true for found, true in pairs)


def spread(rotation_xyzw: np.ndarray) -> float:
    """Return the greatest chord between the first orientation and any other."""
    turned = matrix_of(rotation_xyzw / np.linalg.norm(rotation_xyzw, axis=1, keepdims=True))
    return float(np.linalg.norm(turned - turned[0], axis=(1, 2)).max())


RATES = {
    "table": (30, 50, 100, 200),
    "joints": (30, 100),
    "ee_csv": (30,),
    "mcap": (100,),
    "zip": (50,),
    "lerobot": (30,),
}
KINDS = tuple(RATES)
QUANTITIES = ("time", "length", "angle")


def case(rng: np.random.Generator, kind: str, *, is_sound: bool = False) -> tuple[str, HandOff, Callable[[], Written]]:
    """Draw a hand-off, what is scaled of it and by how much, and the way to write it."""
    rate = float(rng.choice(RATES[kind]))
    one = draw(rng, rate, base=kind == "joints" or rng.random() < 0.6)
    what = str(rng.choice(["time", "angle"] if kind == "joints" else QUANTITIES))
    length = str(rng.choice(["m", "mm"] if kind == "table" else ["m"]))
    turn = str(rng.choice(["rad", "deg"] if kind in ("table", "joints") else ["rad"]))
    if what == "time":
        factor = float(rng.choice(DECADES))
    elif what == "length":
        factor = IN_MM[length] / IN_MM[str(rng.choice([unit for unit in IN_MM if unit != length]))]
    else:
        factor = 1 / DEGREE if turn == "rad" else DEGREE
    factor = 1.0 if is_sound else factor
    scaled = one if kind == "joints" and what == "angle" else one.scaled(**{what: factor})
    write: dict[str, Callable[..., Written]] = {
        "table": partial(table, length=length, turn=turn),
        "joints": partial(joints, turn=turn, angle=factor if what == "angle" else 1.0),
        "ee_csv": ee_csv,
        "mcap": partial(bag, logged_s=one.seconds, folder=False),
        "zip": partial(bag, logged_s=one.seconds, folder=True),
        "lerobot": partial(lerobot, fps=rate / factor if what == "time" and 0.3 < factor * rng.random() < 3 else rate),
    }
    return f"{kind}, {what} x {factor:.4g}", one, partial(write[kind], rng, scaled)


def outcomes(count: int, seed: int = 0, *, are_sound: bool = False) -> Iterator[tuple[str, str]]:
    """Yield for each scaled file what was scaled, and "refused", "right", "wrong" or "cannot be written"."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        name, one, write = case(rng, kind, is_sound=are_sound)
        try:
            data, how = write()
        except (OverflowError, ValueError, SkillsError, struct.error):
            yield name, "cannot be written"
            continue
        try:
            yield name, "right" if is_right(one, release(data, how), turns=kind != "joints") else "wrong"
        except SkillsError as refused:
            yield name, f"refused: {refused}" if are_sound else "refused"


if __name__ == "__main__":
    found = list(outcomes(*[int(argument) for argument in sys.argv[1:]] or [10_000]))
    print(Counter(what for _, what in found))
    for name, number in Counter(name for name, what in found if what == "wrong").most_common():
        print(number, "of", sum(one == name for one, _ in found), name)
