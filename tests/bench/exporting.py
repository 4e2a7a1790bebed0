"""Time and memory of an export of a LeRobot dataset, in a fresh process, beside pyarrow writing the same tables."""

import io
import json
import subprocess
import sys
import tempfile
import zipfile
from contextlib import closing

import pyarrow.parquet as pq
from rich.table import Table
from sqlalchemy import func, select

from skills.db.models import StoredRecording
from skills.db.session import Database
from tests.bench.million import HEX, copy
from tests.bench.timing import best_s
from tests.library import cases, exports

FRAMES = 60  # of an episode, those of a hand-off of `exports.session_of`
SMALL, LARGE = (5, 100), (100, 100)
VERSIONS = ("v2.1", "v3.0")
MOST_S, MOST_MIB = 1.0, 256.0  # of the small and of the large export
# Nothing of the tests is imported there, for it would count.
WORKER = """
import json, sys, time
from pathlib import Path
from skills.db.session import Database
from skills.jobs.attempts import Work
from skills.library.perform import perform_job
from skills.settings import Settings

def peak_mib():
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) / 1024

url, row, attempt = sys.argv[1], *map(int, sys.argv[2:])
database = Database(url)
before_mib, began = peak_mib(), time.perf_counter()
assert Work(database, Settings(database_url=url), perform_job).try_once(row, attempt, 0)
print(json.dumps([time.perf_counter() - began, before_mib, peak_mib()]))
"""


def exporting(table: Table) -> None:
    """Export 30,000 frames and 10,000 episodes of two arms, in both versions."""
    for recordings, each in (SMALL, LARGE):
        episodes = recordings * each
        with tempfile.TemporaryDirectory(prefix="skills-exporting-") as folder:
            url = f"sqlite:///{folder}/skills.sqlite"
            with closing(Database(url)) as database:
                database.migrate()
                fill(database, recordings, each)
                for version in VERSIONS:
                    dataset, seconds, before_mib, after_mib = in_fresh_process(database, version)
                    name = f"export of {episodes} episodes, {episodes * FRAMES} frames, {version}"
                    memory = f"{after_mib:.0f} MiB, {before_mib:.0f} before the export"
                    if (recordings, each) == SMALL:
                        memory += f"; {seconds / MOST_S:.2f} of the {MOST_S:.0f} s that it may take"
                    else:
                        memory += f"; {after_mib / MOST_MIB:.2f} of the {MOST_MIB:.0f} MiB that it may take"
                    table.add_row(name, f"{seconds:.2f} s", memory)
                    bare_s = written_by_pyarrow_s(exports.zip_of(database, dataset))
                    table.add_row("  pyarrow alone", f"{bare_s:.2f} s", f"{seconds / bare_s:.1f} x for ours")


def fill(database: Database, recordings: int, each: int) -> None:
    """Store recordings of two arms; all hand-offs but the first of each are copies of its row at their own time."""
    cases.add_surgeon(database)
    sha256 = HEX[database.engine.dialect.name]
    for number in range(recordings):
        recording = exports.session_of(*[(0.01 * number, 0.0, 0.0)] * each)
        last_s = exports.PASS_S - 1 / cases.RATE_HZ
        exports.add(database, recording, start_s=0.0, end_s=last_s)
        with database.writing() as session:
            copy(
                session,
                "demonstrations",
                each - 1,
                recording_row=str(session.scalar(select(func.max(StoredRecording.row)))),
                sha256=sha256.format(f"n + {number * each}"),
                start_s=f"n * {exports.PASS_S}",
                end_s=f"n * {exports.PASS_S} + {last_s}",
            )


def in_fresh_process(database: Database, version: str) -> tuple[str, float, float, float]:
    """Export as a worker does; return the digest, seconds of wall time, and the peak in MiB before and after."""
    job = exports.ask(database, version=version)
    command = [sys.executable, "-c", WORKER, database.url, str(job.row), str(job.attempt)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    seconds, before_mib, after_mib = json.loads(done.stdout)
    return exports.dataset_of(database, job), seconds, before_mib, after_mib


def written_by_pyarrow_s(data: bytes) -> float:
    """Return the time in which pyarrow writes the tables of a dataset again, each as a file in memory."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [name for name in archive.namelist() if name.startswith("data/")]
        tables = [pq.read_table(io.BytesIO(archive.read(name))) for name in names]
    return best_s(lambda: [pq.write_table(one, io.BytesIO()) for one in tables], 1)
