"""A cohort of rated trials in the layout of JIGSAWS, entirely synthetic, of known truth.

Every surgeon has a skill from 0 to 1. The lower it is, the more a hand-off hesitates, swerves and turns, and the more
time it takes; the ratings follow the skill within a point or two. Nothing is taken from the data set.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skills.formats.jigsaws import RatedTrial, Skill, meta_line
from tests.formats.trials import RATE_HZ, text, turning

SURGEONS = "BCDEFGHI"
REST_S = 1.0


@dataclass(frozen=True)
class Surgeon:
    letter: str
    skill: float

    @property
    def level(self) -> Skill:
        return "novice" if self.skill < 0.35 else "intermediate" if self.skill < 0.65 else "expert"


def surgeons(count: int = 8) -> list[Surgeon]:
    return [Surgeon(SURGEONS[k], skill) for k, skill in enumerate(np.linspace(0.05, 0.95, count).tolist())]


def folder(root: Path, seed: int = 0, count: int = 8, trials: int = 5, task: str = "Suturing") -> Path:
    """Write trials of a number of surgeons, their gestures and their ratings; return the root."""
    rng = np.random.default_rng(seed)
    home, lines = root / task, []
    for inside in ("kinematics/AllGestures", "transcriptions"):
        (home / inside).mkdir(parents=True)
    for surgeon in surgeons(count):
        for number in range(1, trials + 1):
            name = f"{task}_{surgeon.letter}{number:03}"
            table, gestures = trial(surgeon.skill + rng.normal(0.0, 0.05), rng)
            (home / "kinematics/AllGestures" / f"{name}.txt").write_bytes(text(table))
            (home / "transcriptions" / f"{name}.txt").write_text(gestures)
            lines.append(meta_line(rated(name, surgeon, rng)))
    (home / f"meta_file_{task}.txt").write_text("".join(lines))
    return root


def rated(name: str, surgeon: Surgeon, rng: np.random.Generator) -> RatedTrial:
    """Rate a trial: six parts of one to five points, near four times the skill plus one."""
    parts = np.rint(1.0 + 4.0 * surgeon.skill + rng.normal(0.0, 0.4, 6)).clip(1, 5).astype(int).tolist()
    return RatedTrial(name, surgeon.level, sum(parts), tuple(parts))


def trial(skill: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return one trial: its 76 columns, and the gestures of its one hand-off, by the right instrument."""
    clumsy = float(np.clip(1.0 - skill, 0.0, 1.0))
    strokes = 1 + round(4 * clumsy + rng.normal(0.0, 0.4))
    seconds = float(np.clip(4.0 + 3.0 * clumsy + rng.normal(0.0, 1.2), 2.5, None))
    way = np.concatenate(list(strokes_of(max(1, strokes), seconds)))
    rest = round(REST_S * RATE_HZ)
    way = np.concatenate([np.zeros(rest), way, np.ones(rest)])
    swerve_m = 0.002 + 0.010 * clumsy
    tip = np.stack(
        [0.04 * way, swerve_m * np.sin(np.pi * way), 0.3 * swerve_m * np.sin(3 * np.pi * way)], axis=1
    ) + np.array([0.0, 0.05, -0.10])
    turns = turning(0.2 + (0.2 + 0.8 * clumsy) * way)
    first, last = rest + 1, rest + round(0.8 * (len(way) - 2 * rest))
    gestures = f"1 {first - 1} G1 \n{first} {last} G6 \n{last + 1} {len(way) - rest} G4 \n"
    still = np.hstack([np.tile([0.0, 0.05, -0.1], (len(way), 1)), np.tile(np.eye(3).ravel(), (len(way), 1))])
    return np.hstack([*(arm(still[:, :3], still[:, 3:]) for _ in range(3)), arm(tip, turns.reshape(-1, 9))]), gestures


def strokes_of(count: int, seconds: float) -> Iterator[np.ndarray]:
    """Divide the path from 0 to 1 into minimum-jerk strokes, each from rest to rest."""
    samples = round(seconds * RATE_HZ / count)
    u = np.arange(1, samples + 1) / samples
    for number in range(count):
        yield (number + 10 * u**3 - 15 * u**4 + 6 * u**5) / count


def arm(tip_m: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Write an arm's 19 columns; velocities are not used, and the gripper stays closed."""
    return np.hstack([tip_m, turns, np.zeros((len(tip_m), 6)), np.full((len(tip_m), 1), -0.5)])
