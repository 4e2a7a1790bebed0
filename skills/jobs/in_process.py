"""Jobs in the process that requests them, for one command.

A worker process with its job engine would take seconds to start, for a job that takes one.
"""

from contextlib import closing, suppress
from queue import Empty

from sqlalchemy import select

from skills.db.service_tables import Job
from skills.db.session import Database
from skills.errors import SkillsError
from skills.jobs import Engine
from skills.jobs.attempts import Work
from skills.jobs.readiness import live_workers
from skills.library.operation.jobs import ACTIVE, BATCH, PART, PICTURES
from skills.settings import Settings

LOOK_S = 0.5  # between two looks for jobs that this process did not request


class InProcess(Engine):
    """Performs the jobs of an installation one after the other, the newest first, where it has no live worker.

    Parts of batches, and pictures that the command does not ask for, are left to workers, which find them when there
    are some. A worker that starts meanwhile may perform a job too: of two attempts the first that ends is stored.
    """

    def __init__(self, settings: Settings) -> None:
        self._requested: list[int] = []
        super().__init__(settings)

    def submit(self, row: int, attempt: int, kind: str) -> None:
        """Perform a job, and look for others."""
        self._requested.append(row)
        self._calls.put(lambda _: None)

    def cancel(self, row: int, attempt: int) -> None:
        """Do nothing: each step of a job that stores something asks whether the job still stands."""

    def _run(self) -> None:
        from skills.library.perform import perform_job  # here: it takes a second, while the command reads its input

        with closing(Database.of(self._settings)) as database:
            work = Work(database, self._settings, perform_job)
            while self._wait():
                with suppress(SkillsError):  # not migrated yet, or busy: looked at again
                    if (newest := self._newest(database)) is not None:
                        work.carry_out(*newest)

    def _newest(self, database: Database) -> tuple[int, int] | None:
        """Return the row and the attempt of the newest job to perform here, if there is one."""
        mine = Job.state.in_(ACTIVE), Job.kind.not_in((BATCH, PART, PICTURES)) | Job.row.in_(self._requested)
        with database.reading() as session:
            newest = session.execute(select(Job.row, Job.attempt).where(*mine).order_by(Job.row.desc())).first()
        return (
            None if newest is None or live_workers(database, self._settings.lease_s) else (newest.row, newest.attempt)
        )

    def _wait(self) -> bool:
        """Wait for a request, or for the next look; return whether to go on."""
        try:
            return self._calls.get(timeout=LOOK_S) is not None
        except Empty:
            return True
