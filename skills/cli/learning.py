"""Training, and jobs of every kind."""

import time
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.shell import (
    AsJson,
    OfSurgeon,
    OfSuture,
    Surgeon,
    Suture,
    err,
    finished,
    out,
    print_json,
    refusing,
    result_of,
    service,
    show,
)

if TYPE_CHECKING:
    from skills.api.schemas.given import Retraining
    from skills.client import Client

WATCH_S = 0.3
ABOUT = ("id", "kind", "state", "progress", "created_at", "error")

commands = typer.Typer()
jobs = typer.Typer(no_args_is_help=True, help="Trainings, playbacks and other long work.")
commands.add_typer(jobs, name="job")

JobId = Annotated[str, typer.Argument(help="The job's id.")]


@commands.command()
@refusing
def train(
    surgeon: Surgeon,
    suture: Suture,
    release: Annotated[bool, typer.Option(help="Release the version if it passes the gate.")] = False,
    seed: int = 0,
    as_json: AsJson = False,
) -> None:
    """Learn a style from its newest demonstration, and wait for it."""
    with service(works=True) as client:
        job = finished(client, client.train(surgeon, suture, seed=seed, release=release))
    show(job if as_json else result_of(job), as_json, ("policy_version", "sha256", "releasable", "released"))


@commands.command()
@refusing
def retrain(
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    only_stale: Annotated[bool, typer.Option("--only-stale", help="Only what has newer input or settings.")] = False,
    release: Annotated[bool, typer.Option(help="Release what passes the gate and is not worse.")] = False,
    as_json: AsJson = False,
) -> None:
    """Learn many styles again, and wait for them; exit code 1 where one of them failed."""
    with service(works=True) as client:
        job = client.retrain(surgeon=surgeon, suture=suture, only_stale=only_stale, release=release)
        ended = _watched(client, job.id)
        styles = client.retrained(job.id)
    if as_json:
        print_json(ended.model_copy(update={"items": styles, "next": None}))
    else:
        out.print(", ".join(f"{number} {state}" for state, number in ended.styles if number) or "no styles")
        if wanting := [style for style in styles if style.state != "done"]:
            show(wanting, False, ("surgeon", "suture", "state", "reason"))
    if ended.state != "succeeded":
        raise typer.Exit(1)


def _watched(client: "Client", job: str) -> "Retraining":
    """Wait for a batch to end, with a bar that moves by styles; nothing but its end ends the wait."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("styles"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        batch = client.retraining(job)
        total = sum(number for _, number in batch.styles)
        task = progress.add_task("styles", total=total)
        while batch.state in ("queued", "running"):
            time.sleep(WATCH_S)
            batch = client.retraining(job)
            progress.update(task, completed=total - batch.styles.queued)
    return batch


@jobs.command("list")
@refusing
def job_list(
    state: Annotated[
        Literal["queued", "running", "succeeded", "failed", "cancelled"] | None, typer.Option(help="Of this state.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, the newest first."""
    with service() as client:
        show(client.jobs(state), as_json, ABOUT)


@jobs.command("show")
@refusing
def job_show(job: JobId, as_json: AsJson = False) -> None:
    """Show a job."""
    with service() as client:
        show(client.job(job), as_json, ABOUT)


@jobs.command("wait")
@refusing
def job_wait(
    job: JobId, timeout_s: Annotated[float, typer.Option(help="For how long.")] = 600.0, as_json: AsJson = False
) -> None:
    """Wait until a job has ended; exit code 1 where it did not succeed."""
    with service(works=True) as client:
        show(finished(client, client.job(job), timeout_s), as_json, ABOUT)


@jobs.command("cancel")
@refusing
def job_cancel(job: JobId, as_json: AsJson = False) -> None:
    """Cancel a job that has not ended."""
    with service() as client:
        show(client.cancel(job), as_json, ABOUT)
