"""Commands of jobs."""

from typing import Annotated, Literal

import typer

from skills.cli.commands import command
from skills.cli.connecting import MANY, finished, service
from skills.cli.output import Answer, table

commands = typer.Typer()
jobs = typer.Typer(no_args_is_help=True, help="Trainings, playbacks and other long work.")
commands.add_typer(jobs, name="job")

JobId = Annotated[str, typer.Argument(help="The job's id.")]
COLUMNS = ("id", "kind", "state", "progress", "created_at", "error")


@command(jobs, "list")
def job_list(state: Literal["queued", "running", "succeeded", "failed", "cancelled"] | None = None) -> Answer:
    """List jobs, the newest first.

    Args:
        state: Only jobs in this state.
    """
    with service() as client:
        return table(client.jobs(state), COLUMNS)


@command(jobs, "show")
def job_show(job: JobId) -> Answer:
    """Show a job."""
    with service() as client:
        return table(client.job(job), COLUMNS)


@command(jobs, "wait")
def job_wait(job: JobId, timeout_s: float = 600.0) -> Answer:
    """Wait until a job has ended; exit code 1 if it did not succeed.

    Args:
        timeout_s: Longest waiting time in seconds.
    """
    with service(workers=MANY) as client:
        return table(finished(client, client.job(job), timeout_s), COLUMNS)


@command(jobs, "cancel")
def job_cancel(job: JobId) -> Answer:
    """Cancel a job that has not ended."""
    with service() as client:
        return table(client.cancel(job), COLUMNS)
