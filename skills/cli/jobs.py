"""Commands of jobs."""

from typing import Annotated, Literal

import typer

from skills.cli.commands import AsJson, command
from skills.cli.connecting import MANY, finished, service
from skills.cli.output import show

commands = typer.Typer()
jobs = typer.Typer(no_args_is_help=True, help="Trainings, playbacks and other long work.")
commands.add_typer(jobs, name="job")

JobId = Annotated[str, typer.Argument(help="The job's id.")]
COLUMNS = ("id", "kind", "state", "progress", "created_at", "error")


@command(jobs, "list")
def job_list(
    state: Annotated[
        Literal["queued", "running", "succeeded", "failed", "cancelled"] | None,
        typer.Option(help="Only jobs in this state."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, the newest first."""
    with service() as client:
        show(client.jobs(state), as_json, COLUMNS)


@command(jobs, "show")
def job_show(job: JobId, as_json: AsJson = False) -> None:
    """Show a job."""
    with service() as client:
        show(client.job(job), as_json, COLUMNS)


@command(jobs, "wait")
def job_wait(
    job: JobId,
    timeout_s: Annotated[float, typer.Option(help="Longest waiting time in seconds.")] = 600.0,
    as_json: AsJson = False,
) -> None:
    """Wait until a job has ended; exit code 1 if it did not succeed."""
    with service(workers=MANY) as client:
        show(finished(client, client.job(job), timeout_s), as_json, COLUMNS)


@command(jobs, "cancel")
def job_cancel(job: JobId, as_json: AsJson = False) -> None:
    """Cancel a job that has not ended."""
    with service() as client:
        show(client.cancel(job), as_json, COLUMNS)
