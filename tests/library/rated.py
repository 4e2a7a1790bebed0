"""A cohort of rated trials in the layout of JIGSAWS, entirely synthetic, of known truth.

Every surgeon has a skill from 0 to 1. The lower it is, the more both instruments stop, sway, turn and grip, and the
more time they take; the ratings follow the skill within a point or two. Nothing is taken from the data set.
"""

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
    """Return one trial: its 76 columns, and the gestures of a hand-off by the right instrument.

    Both instruments move from place to place and close their jaws; the masters make the same motions twice as large.
    """
    clumsy = float(np.clip(1.0 - skill, 0.0, 1.0))
    moving = round(max(4.0, 6.0 + 1.5 * clumsy + rng.normal(0.0, 1.0)) * RATE_HZ)
    rest = round(REST_S * RATE_HZ)
    arms = [instrument(side, clumsy, moving, rest, rng) for side in range(2)]
    gestures = f"1 {rest} G1 \n{rest + 1} {rest + moving // 2} G6 \n{rest + moving // 2 + 1} {rest + moving} G4 \n"
    masters = [np.hstack([2.0 * one[:, :3], one[:, 3:]]) for one in arms]
    return np.hstack([*masters, *arms[::-1]]), gestures


def instrument(side: int, clumsy: float, moving: int, rest: int, rng: np.random.Generator) -> np.ndarray:
    """Return the 19 columns of one instrument: strokes between places, with a sway, a turn and grips."""
    strokes = max(2, round(4.0 * np.exp(0.8 * clumsy) + rng.normal(0.0, 0.4)))
    places = rng.normal(0.0, 0.015, (strokes + 1, 3))
    lengths = np.full(strokes, moving // strokes)
    lengths[-1] += moving - lengths.sum()
    way = np.concatenate(
        [a + (b - a) * stroke(n)[:, None] for a, b, n in zip(places[:-1], places[1:], lengths, strict=True)]
    )
    tip = np.concatenate([np.tile(places[0], (rest, 1)), way, np.tile(places[-1], (rest, 1))])
    seconds = np.arange(len(tip)) / RATE_HZ
    sway_m = 0.001 * np.exp(clumsy + rng.normal(0.0, 0.1))
    tip = tip + sway_m * np.sin(2 * np.pi * (1.2 + 0.3 * side) * seconds)[:, None] + np.array([0.04 * side, 0.05, -0.1])
    turns = turning(0.3 * side + 0.25 * np.exp(clumsy) * np.sin(2 * np.pi * seconds / 3.0))
    grips = max(1, round(2.0 * np.exp(0.9 * clumsy) + rng.normal(0.0, 0.3)))
    jaw = np.where(np.sin(2 * np.pi * grips * seconds / seconds[-1]) > 0, 0.6, -0.3)
    return np.hstack([tip, turns.reshape(-1, 9), np.zeros((len(tip), 6)), jaw[:, None]])


def stroke(samples: int) -> np.ndarray:
    """Return the way from 0 to 1 in a minimum-jerk stroke, from rest to rest."""
    u = np.arange(1, samples + 1) / samples
    return np.asarray(10 * u**3 - 15 * u**4 + 6 * u**5)
