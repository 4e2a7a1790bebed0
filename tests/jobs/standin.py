"""A worker with a stand-in for the library: a job's kind is its behaviour, and a journal records its steps."""

import os
import time
from pathlib import Path

from sqlalchemy import update

from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import BadInput
from skills.jobs.worker import run_worker
from skills.settings import Settings


def perform(database: Database, row: int, attempt: int, settings: Settings) -> None:
    with database.reading() as session:
        job = session.get_one(Job, row)
    journal = Path(job.request["journal"])
    note(journal, "begins", row)
    if job.kind == "refused":
        raise BadInput("The goal lies outside the grid; ask for another one.")
    if job.kind == "broken":
        raise RuntimeError("no such file: /srv/secret/surgeon-7.mcap")
    time.sleep(job.request.get("seconds", 0.0))
    while "held_by" in job.request and Path(job.request["held_by"]).exists():
        time.sleep(0.02)
    with database.writing() as session:
        mine = (Job.row == row, Job.state == "running", Job.attempt == attempt)
        ended = {"state": "succeeded", "result": {"by": os.getpid()}}
        wrote = session.execute(update(Job).where(*mine).values(**ended).returning(Job.row)).first() is not None
    note(journal, "wrote" if wrote else "came-late", row)


def note(journal: Path, word: str, row: int) -> None:
    with journal.open("a") as file:
        file.write(f"{word} {row} {os.getpid()}\n")


def main() -> None:
    run_worker(Settings(), perform=perform)
