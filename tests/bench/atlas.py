"""The atlas of 1000 demonstrations of 100 states: from scratch, with one more, and unchanged."""

import os
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from rich.table import Table
from sqlalchemy import insert, select

from skills.api.responses import json_of
from skills.comparison.distances import THREADS, distances, shape_of
from skills.db import now
from skills.db.models import Demonstration, StoredRecording, Surgeon
from skills.db.packed import pack
from skills.db.session import Database
from skills.library.comparison.atlas import atlas_of
from skills.packing import sha256
from skills.schemas.recordings import TableIn
from tests import backends
from tests.comparison.cohort import Cohort, cohort
from tests.library import cases, cohorts

T = TypeVar("T")

SURGEONS, EACH = 20, 50
WARM = 2  # demonstrations, compared before the measurement so that the loop is compiled
WHOLE_S, MORE_S = 60.0, 1.0  # the required times, on two cores


def atlas(table: Table) -> None:
    """Measure the atlas on SQLite; after the time comes the processor time, which is independent of other load."""
    drawn = cohort(1, surgeons=SURGEONS, sessions=EACH)
    with tempfile.TemporaryDirectory(prefix="skills-atlas-") as folder:
        database = Database(backends.fresh("sqlite", Path(folder)))
        fill(database, drawn, WARM)
        atlas_of(database, cases.SUTURE)
        fill(database, drawn, len(drawn.demos))
        before = peak_mib()
        spent, found = timed(lambda: atlas_of(database, cases.SUTURE))
        how = f"{spent.share_of(WHOLE_S)}; {THREADS} threads of {cores()} cores"
        table.add_row(f"atlas of {len(found.demos)} demonstrations, whole", str(spent), how)
        cases.add_demo(database, cohorts.hand_off(cohort(2), 0), cohorts.name(0), grid="fit")
        spent, found = timed(lambda: atlas_of(database, cases.SUTURE))
        table.add_row(f"with one more, {len(found.demos)}", str(spent), spent.share_of(MORE_S))
        spent, found = timed(lambda: atlas_of(database, cases.SUTURE))
        written, said = timed(lambda: json_of(found))
        table.add_row("again", str(spent), f"its JSON {written}, {len(said) / 1e6:.1f} MB")
        table.add_row("memory", f"{peak_mib() - before:.0f} MiB", "more than before, at the most")
        pairs(table, drawn)
        database.close()


def pairs(table: Table, drawn: Cohort) -> None:
    """Measure one pair in the loop, and in the library that checks it."""
    from tslearn.metrics import dtw_path_from_metric

    shapes = [shape_of(demo) for demo in drawn.demos[:40]]
    theirs = [dtw_path_from_metric(shapes[0], one, metric="cityblock")[1] for one in shapes]  # compiles
    ours, found = timed(lambda: distances(shapes, shapes))
    np.testing.assert_allclose(found[0], theirs)
    others, _ = timed(lambda: [dtw_path_from_metric(shapes[0], one, metric="cityblock") for one in shapes])
    ours_us, theirs_us = ours.processor_s / found.size * 1e6, others.processor_s / len(shapes) * 1e6
    table.add_row("a pair", f"{ours_us:.0f} µs", f"tslearn {theirs_us:.0f} µs, {theirs_us / ours_us:.1f} times as long")


def fill(database: Database, drawn: Cohort, until: int) -> None:
    """Store the missing ones of a cohort's first demonstrations; without the reader, which is not measured."""
    for surgeon in range(SURGEONS):
        cases.add_surgeon(database, cohorts.name(surgeon))
    stored = cases.add_demo(database, surgeon=cohorts.name(0), session="model")
    with database.writing() as session:
        model = session.get_one(Demonstration, stored.row)
        there = {one for (one,) in session.execute(select(StoredRecording.sha256))}
        surgeons = dict(session.execute(select(Surgeon.slug, Surgeon.row)).all())
        for one in range(until):
            digest = sha256(f"{one}".encode())
            if digest in there:
                continue
            recording = {"sha256": digest, "size_bytes": 0, "media_type": "text/csv", "format": "table"}
            more = {"integrity": "full", "reading": TableIn(), "about": model.recording.about, "created_at": now()}
            row = session.execute(insert(StoredRecording).returning(StoredRecording.row), recording | more).scalar_one()
            session.execute(
                insert(Demonstration),
                {
                    "sha256": digest,
                    "recording_row": row,
                    "surgeon_row": surgeons[cohorts.name(int(drawn.surgeons[one]))],
                    "suture": cases.SUTURE,
                    "session": str(drawn.sessions[one]),
                    "demo": pack(drawn.demos[one]),
                    "path": pack(model.path),
                    "created_at": now(),
                    **{name: getattr(model, name) for name in SAME},
                },
            )


SAME = ("arm", "topic", "frame", "instrument", "start_s", "end_s", "hysteresis", "report", "segment")


@dataclass(frozen=True)
class Spent:
    """The wall time and processor time of some work."""

    wall_s: float
    processor_s: float

    def __str__(self) -> str:
        return f"{self.wall_s:.2f} s ({self.processor_s:.2f})"

    def share_of(self, most_s: float) -> str:
        return f"{self.wall_s / most_s:.2f} of the {most_s:g} s that it may take"


def timed(work: Callable[[], T]) -> tuple[Spent, T]:
    wall_s, processor_s = time.perf_counter(), time.process_time()
    found = work()
    return Spent(time.perf_counter() - wall_s, time.process_time() - processor_s), found


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def cores() -> int:
    return len(os.sched_getaffinity(0))
