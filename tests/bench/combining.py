"""Ways of combining several demonstrations, compared by their distance to a left-out demonstration.

Two sets: the cohort of known truth, with tempo and tremor, and the sample recordings' surgeons, each of whose hand-offs
is repeated with day-to-day differences; and the five hand-offs of one sample unchanged. With an outlier, one of the
combined demonstrations, the newest as likely as any other, is a hand-off of a quite different shape.

And real surgeons: with `SKILLS_TEST_JIGSAWS`, every hand-off that is proposed in a trial of two tasks is left out, and
five of the surgeon's other trials, of the same instrument, are combined. The rivals are the straight line from start to
goal, and the corridor of five hand-offs of other surgeons.
"""

import io
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from skills.comparison.combining import COMBININGS, combine, laid, side_by_side
from skills.comparison.distances import placed
from skills.demonstration.demonstration import Demo, cut_demo
from skills.formats import read_recording
from skills.gridworld.grid import choose_grid, discretize
from skills.learning.evaluation import dtw
from skills.seeds.recordings import sample_recordings
from tests.bench.recognition import by_task
from tests.comparison.cohort import HUMPS, cohort, demo_of

FIRST_SEED = 1000  # none of the seeds on which `AGREEING` was chosen
TREMOR_MM = 0.2
OUTLIER_MM = 15.0  # size of an outlier's humps; a surgeon's own are 5 mm
RESAMPLES = 2000
NEWEST = "newest alone"
METHODS = [NEWEST, *COMBININGS]
RIVALS = ["corridor of other surgeons", "straight line"]
COMBINED = 5  # hand-offs


@dataclass(frozen=True, eq=False)
class Errors:
    """Mean distance to the left-out demonstration, mm per state: by surgeon and method, also after the grid, (S, M)."""

    ways_mm: np.ndarray
    grids_mm: np.ndarray

    def of(self, method: str) -> tuple[np.ndarray, np.ndarray]:
        column = METHODS.index(method)
        return self.ways_mm[:, column], self.grids_mm[:, column]


def combining(table: Table) -> None:
    """Print for every set the distance of each method's path to the left-out demonstration."""
    sets: dict[str, Callable[[], list[list[Demo]]]] = {
        "cohort, days differ by 1 mm": lambda: cohorts(1.0),
        "cohort, days differ by 3 mm": lambda: cohorts(3.0),
        "samples done again": samples_again,
        "kestrel's five hand-offs": lambda: [kestrels_five()],
    }
    for name, surgeons in sets.items():
        for outlier in (False, True):
            errors = leave_one_out(surgeons(), outlier)
            table.add_row(f"[bold]{name}{', one outlier' if outlier else ''}", "mm at a state", "after the grid")
            for method in METHODS:
                ways, grids = errors.of(method)
                gained = "" if method == NEWEST else f"; gained {interval(errors.of(NEWEST)[0] - ways)}"
                table.add_row(f"  {method}", interval(ways), interval(grids) + gained)
    for name, (count, rows) in of_real_surgeons().items() if os.environ.get("SKILLS_TEST_JIGSAWS") else ():
        table.add_row(f"[bold]{name}: {count} hand-offs of {len(rows)} surgeons", "mm at a state", "less than straight")
        for k, method in enumerate(METHODS + RIVALS):
            table.add_row(f"  {method}", interval(rows[:, k]), interval(rows[:, -1] - rows[:, k]))


def of_real_surgeons() -> dict[str, tuple[int, np.ndarray]]:
    """Return, by task and instrument, how many hand-offs were left out, and each surgeon's mean distances, (S, M)."""
    rng, found = np.random.default_rng(FIRST_SEED), {}
    for task, every in by_task().items():
        for arm in sorted({one.arm for one in every}):
            some, means, count = [one for one in every if one.arm == arm], [], 0
            for user in sorted({one.user for one in some}):
                errors = []
                for held in (one for one in some if one.user == user):
                    own = [one.demo for one in some if one.user == user and one.trial != held.trial]
                    others = [one.demo for one in some if one.user != user]
                    if len(own) < COMBINED:
                        continue
                    mine, theirs = ([pool[k] for k in drawn(rng, len(pool))] for pool in (own, others))
                    wanted, ways = _paths(held.demo, mine)
                    ways.append(_paths(held.demo, theirs)[1][METHODS.index("corridor")])
                    ways.append(np.linspace(*wanted[[0, -1]], len(wanted)))
                    errors.append([_apart(way, wanted) for way in ways])
                count += len(errors)
                means += [np.mean(errors, axis=0)] if errors else []
            found[f"{task}, {arm}"] = count, np.array(means)
    return found


def drawn(rng: np.random.Generator, count: int) -> list[int]:
    """Draw some of these, in their order."""
    return sorted(rng.choice(count, COMBINED, replace=False).tolist())


def leave_one_out(surgeons: list[list[Demo]], outlier: bool) -> Errors:
    """Combine all demonstrations but one, for each one of each surgeon."""
    rng = np.random.default_rng(FIRST_SEED)
    rows = [
        np.mean([_distances(held, rest) for held, rest in _left_out(demos, outlier, rng)], axis=0) for demos in surgeons
    ]
    ways_mm, grids_mm = np.moveaxis(np.array(rows), 2, 0)
    return Errors(ways_mm, grids_mm)


def _left_out(demos: list[Demo], outlier: bool, rng: np.random.Generator) -> Iterator[tuple[Demo, list[Demo]]]:
    for held in range(len(demos)):
        rest = [demo for number, demo in enumerate(demos) if number != held]
        if outlier:
            rest[rng.integers(len(rest))] = stranger(rng)
        yield demos[held], rest


def _distances(held: Demo, rest: list[Demo]) -> list[tuple[float, float]]:
    """Measure each method's path, and its grid path, against the left-out demonstration, aligned with it: (M, 2)."""
    wanted, ways = _paths(held, rest)
    grids = [discretize(way, choose_grid(way, "fit")).tip_mm for way in ways]
    return [(_apart(way, wanted), _apart(grid, wanted)) for way, grid in zip(ways, grids, strict=True)]


def _paths(held: Demo, rest: list[Demo]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the left-out demonstration, and each method's path between its start and goal."""
    (wanted, *_, newest), moved = side_by_side([held, *rest], 0)
    ways = [newest, *(combine(rest, how).tip_mm for how in COMBININGS)]
    if moved:
        ways = [laid(placed(way, scaled=True), *wanted[[0, -1]]) for way in ways]
    return wanted, ways


def _apart(way_mm: np.ndarray, wanted_mm: np.ndarray) -> float:
    return dtw(way_mm, wanted_mm).total_mm / len(wanted_mm)


def interval(values: np.ndarray) -> str:
    """Format a mean over surgeons with its 95 % interval by resampling surgeons; one surgeon has no interval."""
    if len(values) == 1:
        return f"{values[0]:.2f}"
    drawn = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{values.mean():.2f} ({low:.2f} to {high:.2f})"


# ---- demonstrations ----------------------------------------------------------------------------------------------


def cohorts(day_mm: float, surgeons: int = 24, each: int = 6) -> list[list[Demo]]:
    """Draw surgeons with a number of demonstrations each, with tremor and a different tempo each time."""
    drawn = cohort(FIRST_SEED, surgeons, each, day=day_mm)
    rng = np.random.default_rng(FIRST_SEED)
    return [
        [with_tempo_and_tremor(drawn.demos[k], rng) for k in np.flatnonzero(drawn.surgeons == surgeon)]
        for surgeon in range(surgeons)
    ]


def samples_again(day_mm: float = 1.5, each: int = 6) -> list[list[Demo]]:
    """Repeat the hand-off of each sample surgeon with day-to-day differences, rotated and at other places."""
    rng = np.random.default_rng(FIRST_SEED)
    found = []
    for sample in sample_recordings():
        if len(sample.segments) == 1:
            (demo,) = _cut(sample)
            found.append([_another_day(demo, day_mm, rng) for _ in range(each)])
    return found


def kestrels_five() -> list[Demo]:
    """Cut the five hand-offs of one recording."""
    (sample,) = (one for one in sample_recordings() if len(one.segments) > 1)
    return list(_cut(sample))


def stranger(rng: np.random.Generator) -> Demo:
    """Draw a hand-off that belongs to no surgeon."""
    return demo_of(rng.normal(0.0, OUTLIER_MM, (HUMPS, 2)), rng.uniform(-np.pi, np.pi), rng.normal(0.0, 20.0, 3), 3.0)


def with_tempo_and_tremor(demo: Demo, rng: np.random.Generator) -> Demo:
    """Vary the tempo along the path, and add tremor at 8 to 12 Hz."""
    share = demo.stamps_s / demo.stamps_s[-1]
    stamps_s = demo.stamps_s[-1] * (share + rng.uniform(-0.6, 0.6) * np.sin(2 * np.pi * share) / (2 * np.pi))
    rates_hz, phases = rng.uniform(8.0, 12.0, 3), rng.uniform(0.0, 2 * np.pi, 3)
    tremor_mm = TREMOR_MM * np.sin(2 * np.pi * rates_hz * stamps_s[:, None] + phases)
    return replace(demo, stamps_s=stamps_s, tip_mm=demo.tip_mm + tremor_mm)


def _another_day(demo: Demo, day_mm: float, rng: np.random.Generator) -> Demo:
    along_mm = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(demo.tip_mm, axis=0), axis=1)))
    waves = np.sin(np.pi * np.outer(along_mm / along_mm[-1], np.arange(1, HUMPS + 1)))
    cosine, sine = np.cos(angle := rng.uniform(-np.pi, np.pi)), np.sin(angle)
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    tip_mm = (demo.tip_mm + waves @ rng.normal(0.0, day_mm, (HUMPS, 3))) @ turn + rng.normal(0.0, 20.0, 3)
    return with_tempo_and_tremor(replace(demo, tip_mm=tip_mm, pauses=(), partner=None), rng)


def _cut(sample) -> Iterator[Demo]:
    recording = read_recording(io.BytesIO(sample.data))
    for start_s, end_s in sample.segments:
        yield cut_demo(recording, start_s=start_s, end_s=end_s)
