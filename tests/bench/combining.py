"""Which way of combining several demonstrations is nearest to one that it has not seen, leaving each out once.

Two sets: the cohort whose truth is known, with tempo and tremor, and the sample recordings' surgeons, each of whose
hand-offs is done again with a day's differences; and the five hand-offs of one sample as they are. With an outlier, one
of the demonstrations that are combined, the newest as likely as another, is a hand-off of quite another shape.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table

from skills.recordings import read_recording
from skills.seeds.recordings import sample_recordings
from skills.style.combining import COMBININGS, combine, side_by_side
from skills.style.comparing.shapes import placed
from skills.style.demo import Demo, cut_demo
from skills.style.elsewhere import laid
from skills.style.evaluation import dtw
from skills.style.grid import choose_grid, discretize
from tests.style.comparing.cohort import HUMPS, cohort, demo_of

FIRST_SEED = 1000  # not one of those on which `AGREEING` was chosen
TREMOR_MM = 0.2
OUTLIER_MM = 15.0  # size of an outlier's humps; a surgeon's own have 5
RESAMPLES = 2000
NEWEST = "newest alone"
METHODS = [NEWEST, *COMBININGS]


@dataclass(frozen=True, eq=False)
class Errors:
    """Mean distance at a state to the one left out, mm: of each surgeon by each method, and after the grid, (S, M)."""

    ways_mm: np.ndarray
    grids_mm: np.ndarray

    def of(self, method: str) -> tuple[np.ndarray, np.ndarray]:
        column = METHODS.index(method)
        return self.ways_mm[:, column], self.grids_mm[:, column]


def combining(table: Table) -> None:
    """Print of every set how far each method's way is from the demonstration left out."""
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
    """Measure each method's way, and it in its grid, from the one left out, laid where that one is: (M, 2)."""
    (wanted, *_, newest), moved = side_by_side([held, *rest], 0)
    ways = [newest, *(combine(rest, how()).tip_mm for how in COMBININGS.values())]
    if moved:
        ways = [laid(placed(way, scaled=True), *wanted[[0, -1]]) for way in ways]
    grids = [discretize(way, choose_grid(way, "fit")).tip_mm for way in ways]
    return [(_apart(way, wanted), _apart(grid, wanted)) for way, grid in zip(ways, grids, strict=True)]


def _apart(way_mm: np.ndarray, wanted_mm: np.ndarray) -> float:
    return dtw(way_mm, wanted_mm).total_mm / len(wanted_mm)


def interval(values: np.ndarray) -> str:
    """Write a mean over surgeons and between what it lies at 95 %, drawing surgeons anew; one has no interval."""
    if len(values) == 1:
        return f"{values[0]:.2f}"
    drawn = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{values.mean():.2f} ({low:.2f} to {high:.2f})"


# ---- demonstrations ----------------------------------------------------------------------------------------------


def cohorts(day_mm: float, surgeons: int = 24, each: int = 6) -> list[list[Demo]]:
    """Draw surgeons, so many demonstrations of each, with tremor and another tempo each time."""
    drawn = cohort(FIRST_SEED, surgeons, each, day=day_mm)
    rng = np.random.default_rng(FIRST_SEED)
    return [
        [with_tempo_and_tremor(drawn.demos[k], rng) for k in np.flatnonzero(drawn.surgeons == surgeon)]
        for surgeon in range(surgeons)
    ]


def samples_again(day_mm: float = 1.5, each: int = 6) -> list[list[Demo]]:
    """Take the hand-off of each sample surgeon, do it again with a day's differences, turned and at other places."""
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
    """Draw a hand-off that is nobody's."""
    return demo_of(rng.normal(0.0, OUTLIER_MM, (HUMPS, 2)), rng.uniform(-np.pi, np.pi), rng.normal(0.0, 20.0, 3), 3.0)


def with_tempo_and_tremor(demo: Demo, rng: np.random.Generator) -> Demo:
    """Hurry and linger on the way, and tremble at 8 to 12 Hz."""
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
