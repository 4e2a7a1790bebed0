"""Training, and jobs of every kind."""

import json
import time
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
from skills.errors import BadInput

if TYPE_CHECKING:
    from skills.api.schemas.given import Retraining
    from skills.client import Client

WATCH_S = 0.3
ABOUT = ("id", "kind", "state", "progress", "created_at", "error")

commands = typer.Typer()
jobs = typer.Typer(no_args_is_help=True, help="Trainings, playbacks and other long work.")
commands.add_typer(jobs, name="job")

JobId = Annotated[str, typer.Argument(help="The job's id.")]
Kind = Annotated[str | None, typer.Option("--learner", help="Of this kind, such as value-iteration or dqn.")]
Chosen = Annotated[list[str] | None, typer.Option("--setting", help="Of that learner, as steps=100000; repeatable.")]


@commands.command()
@refusing
def train(
    surgeon: Surgeon,
    suture: Suture,
    demo: Annotated[list[str] | None, typer.Option(help="Learn from this demonstration; may be given again.")] = None,
    combine: Annotated[
        Literal["medoid", "barycentre", "corridor"] | None,
        typer.Option(help="How several become one way to follow; as a corridor, if left out."),
    ] = None,
    release: Annotated[bool, typer.Option(help="Release the version if it passes the gate.")] = False,
    seed: int = 0,
    learner: Kind = None,
    setting: Chosen = None,
    as_json: AsJson = False,
) -> None:
    """Learn a style from its newest demonstration, or from those that are named, and wait for it."""
    chosen = _learner(learner, setting or [])
    with service(works=True) as client:
        asked = client.train(
            surgeon, suture, demos=demo or None, combine=combine, learner=chosen, seed=seed, release=release
        )
        job = finished(client, asked)
    show(job if as_json else result_of(job), as_json, ("policy_version", "sha256", "releasable", "released"))


@commands.command()
@refusing
def retrain(
    surgeon: OfSurgeon = None,
    suture: OfSuture = None,
    only_stale: Annotated[bool, typer.Option("--only-stale", help="Only what has newer input or settings.")] = False,
    release: Annotated[bool, typer.Option(help="Release what passes the gate and is not worse.")] = False,
    learner: Kind = None,
    setting: Chosen = None,
    as_json: AsJson = False,
) -> None:
    """Learn many styles again, and wait for them; exit code 1 where one of them failed."""
    chosen = _learner(learner, setting or [])
    with service(works=True) as client:
        job = client.retrain(surgeon=surgeon, suture=suture, only_stale=only_stale, learner=chosen, release=release)
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


def _learner(kind: str | None, settings: list[str]) -> dict[str, Any] | None:
    """Write the learner that was asked for as the service takes it; None: its default one."""
    if kind is None:
        if settings:
            raise BadInput("Name the learner that the settings are of: --learner dqn --setting steps=100000.")
        return None
    learner: dict[str, Any] = {"kind": kind}
    for setting in settings:
        name, _, value = setting.partition("=")
        try:
            learner[name] = json.loads(value)
        except ValueError:
            raise BadInput(f"Write a setting as name=number, not {setting!r}.") from None
    return learner


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
