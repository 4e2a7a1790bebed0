"""Nearest neighbours among 100,000 demonstrations: variations of real shapes, in the index and from the database.

The shapes are those of the recorded hand-offs of JIGSAWS, where `SKILLS_TEST_JIGSAWS` names its folder, else of the
synthetic cohort. Each is varied like a surgeon from session to session: in size by up to a fifth, and by three humps
along each axis, of 1 mm; and of 2 mm, which leaves fewer near ones.
"""

import os
import tempfile
from pathlib import Path

import numpy as np
from rich.table import Table
from sqlalchemy import insert, select

from skills.comparison.distances import STATES, VERSION, Measured, distances, in_lengths, shape_of
from skills.comparison.nearest import ShapeIndex
from skills.comparison.recognition import NUMBERS
from skills.db import now
from skills.db.models import Demonstration, MeasuredShape, StoredRecording, Surgeon
from skills.db.packed import pack
from skills.db.session import Database
from skills.library.comparison.neighbours import nearest_to
from skills.packing import sha256
from skills.schemas.recordings import TableIn
from tests import backends
from tests.bench import recognition
from tests.bench.atlas import SAME, timed
from tests.comparison.cohort import cohort
from tests.library import cases, cohorts

MANY, NEIGHBOURS, QUERIES = 100_000, 10, 100
COMPARED = 5  # queries compared with all pairs
SURGEONS, AT_ONCE = 40, 5000
QUERY_MS, MORE_S, MEMORY_MIB = 200.0, 1.0, 500.0  # the required ones
LEAST_MM = 5.0  # from start to goal


def neighbours(table: Table) -> None:
    """Measure the index alone, and through the library on SQLite."""
    real = shapes()
    for spread_mm in (1.0, 2.0):
        of_index(table, real, spread_mm)
    of_library(table, real)


def shapes() -> np.ndarray:
    """Return the shapes to be varied, (N, STATES, 3)."""
    if os.environ.get("SKILLS_TEST_JIGSAWS"):
        demos = [one.demo for some in recognition.by_task().values() for one in some]
    else:
        demos = list(cohort(1).demos)
    found = np.array([shape_of(demo) for demo in demos])
    return found[found[:, -1, 0] > LEAST_MM]


def varied(real: np.ndarray, rng: np.random.Generator, spread_mm: float) -> np.ndarray:
    """Draw a variation of one of the shapes."""
    phase = np.pi * np.arange(1, 4)[:, None] * np.linspace(0.0, 1.0, STATES)
    one = real[rng.integers(len(real))] * rng.uniform(0.8, 1.2)
    return one + np.sin(phase).T @ rng.normal(0.0, spread_mm, (3, 3))


def of_index(table: Table, real: np.ndarray, spread_mm: float) -> None:
    rng, before = np.random.default_rng(0), resident_mib()
    index = ShapeIndex()
    for row in range(MANY):
        index.add(row, varied(real, rng, spread_mm))
    more = resident_mib() - before
    for scaled in (False, True):
        asked = [varied(real, rng, spread_mm) for _ in range(QUERIES)]
        asked = [in_lengths(one) if scaled else one for one in asked]
        index.nearest(asked[0], NEIGHBOURS, scaled=scaled)
        walls, processors = [], []
        for one in asked:
            spent, _ = timed(lambda one=one, scaled=scaled: index.nearest(one, NEIGHBOURS, scaled=scaled))
            walls.append(1e3 * spent.wall_s)
            processors.append(1e3 * spent.processor_s)
        name = f"{MANY} shapes{', scaled' if scaled else ''}, humps of {spread_mm:g} mm: {NEIGHBOURS} nearest"
        table.add_row(name, *quantiles(walls, processors))
    held = np.array([index.shape_of(row) for row in range(MANY)])
    for one in [varied(real, rng, spread_mm) for _ in range(COMPARED)]:
        rows, totals = index.nearest(one, NEIGHBOURS)
        everything = distances([one], held)[0]
        first = np.argsort(everything, kind="stable")[:NEIGHBOURS]
        assert (index.rows[first] == rows).all() and (totals == everything[first]).all()
    table.add_row("", "equal", f"to all pairs, of {COMPARED}, to the last bit; index {more:.0f} MiB of {MEMORY_MIB:g}")


def of_library(table: Table, real: np.ndarray) -> None:
    with tempfile.TemporaryDirectory(prefix="skills-neighbours-") as folder:
        database = Database(backends.fresh("sqlite", Path(folder)))
        names = fill(database, real)
        before = resident_mib()
        spent, _ = timed(lambda: nearest_to(database, names[0], NEIGHBOURS))
        table.add_row(
            f"{MANY} demonstrations: the first request", str(spent), f"{resident_mib() - before:.0f} MiB more"
        )
        walls, processors = [], []
        for name in names[1 : QUERIES + 1]:
            spent, _ = timed(lambda name=name: nearest_to(database, name, NEIGHBOURS))
            walls.append(1e3 * spent.wall_s)
            processors.append(1e3 * spent.processor_s)
        table.add_row("every other request", *quantiles(walls, processors))
        cases.add_demo(database, cohorts.hand_off(cohort(2), 0), cohorts.name(0), grid="fit")
        spent, _ = timed(lambda: nearest_to(database, names[0], NEIGHBOURS))
        table.add_row("with one more", str(spent), spent.share_of(MORE_S))
        with database.writing() as session:
            cases.agree(session, {"uses": [], "until": None}, cohorts.name(1))
        spent, found = timed(lambda: nearest_to(database, names[0], NEIGHBOURS))
        table.add_row("after a consent ended", str(spent), f"{found.searched + 1} left")
        database.close()


def fill(database: Database, real: np.ndarray) -> list[str]:
    """Store demonstrations that have nothing but their measured shape; return the digests."""
    for surgeon in range(SURGEONS):
        cases.add_surgeon(database, cohorts.name(surgeon))
    stored = cases.add_demo(database, surgeon=cohorts.name(0))
    rng, nothing = np.random.default_rng(1), (np.empty(0, np.int64), np.empty(0), np.empty(0))
    with database.reading() as session:
        model = session.get_one(Demonstration, stored.row)
        demo, path, about = pack(model.demo), pack(model.path), model.recording.about
        surgeons = [row for (row,) in session.execute(select(Surgeon.row).order_by(Surgeon.slug))]
    names = [sha256(f"{one}".encode()) for one in range(MANY)]
    for at in range(0, MANY, AT_ONCE):
        some, first = names[at : at + AT_ONCE], stored.row + 1 + at
        shared = {"reading": TableIn(), "about": about, "integrity": "full", "created_at": now()}
        recordings = [
            {"row": first + k, "sha256": name, "size_bytes": 0, "media_type": "text/csv", "format": "table", **shared}
            for k, name in enumerate(some)
        ]
        same = {name: getattr(model, name) for name in SAME}
        demos = [
            {
                "row": first + k,
                "sha256": name,
                "recording_row": first + k,
                "surgeon_row": surgeons[(at + k) % SURGEONS],
                "suture": cases.SUTURE,
                "session": None,
                "demo": demo,
                "path": path,
                "created_at": now(),
                **same,
            }
            for k, name in enumerate(some)
        ]
        measured = [
            {
                "demonstration_row": first + k,
                "version": VERSION,
                "measured": pack(Measured(varied(real, rng, 1.0), *nothing, np.full(NUMBERS, np.nan))),
            }
            for k in range(len(some))
        ]
        with database.writing() as session:
            session.execute(insert(StoredRecording), recordings)
            session.execute(insert(Demonstration), demos)
            session.execute(insert(MeasuredShape), measured)
    return names


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def quantiles(walls_ms: list[float], processors_ms: list[float]) -> tuple[str, str]:
    """Return the median and the 99th percentile, and the latter in proportion."""
    (median, late), (work, late_work) = (np.quantile(some, [0.5, 0.99]) for some in (walls_ms, processors_ms))
    return (
        f"{median:.0f} ms, p99 {late:.0f}",
        f"{late / QUERY_MS:.2f} of the {QUERY_MS:g} ms it may take; processor {work:.0f} ms, p99 {late_work:.0f}",
    )
