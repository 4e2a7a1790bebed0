"""What all commands share: what is printed where, how a refusal is told, how the service is found.

What a command answers goes to stdout: a table for people, or with `--json` one JSON document and nothing else. Progress
and refusals go to stderr, a refusal with `--json` as the problem that the service would send.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import reduce, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer
from rich.console import Console
from rich.table import Table

from skills.cli.completing import surgeons, sutures
from skills.errors import BadInput, SkillsError

if TYPE_CHECKING:
    from skills.api.schemas.given import Job
    from skills.client import Client, Progress

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, digests stay whole
err = Console(stderr=True, highlight=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; a refusal too, on stderr.")]
Surgeon = Annotated[str, typer.Argument(help="The surgeon's pseudonym.", autocompletion=surgeons)]
Suture = Annotated[str, typer.Argument(help="The suture type, such as simple-running.", autocompletion=sutures)]
OfSurgeon = Annotated[str | None, typer.Option("--surgeon", help="Of this surgeon only.", autocompletion=surgeons)]
OfSuture = Annotated[str | None, typer.Option("--suture", help="Of this suture type only.", autocompletion=sutures)]
WAIT_S = 3600.0  # ours: a training takes seconds, one of thousands of states an hour at the most
Triple = tuple[float, float, float]

P = ParamSpec("P")


def refusing(command: Callable[P, None]) -> Callable[P, None]:
    """Say in one sentence, or as JSON, what was refused, and exit with 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except SkillsError as error:
            if kwargs.get("as_json"):
                print(json.dumps(_problem(error), default=str), file=sys.stderr)
            else:
                err.print(f"{type(error).__name__}: {error}", style="red", markup=False, soft_wrap=True)
            raise typer.Exit(1) from error

    return run


def _problem(error: SkillsError) -> dict[str, Any]:
    """Write a refusal as RFC 9457 does: the service's own, or one of this command in the same form."""
    from skills.api.problems import kind_of
    from skills.client import Problem

    if isinstance(error, Problem):
        return error.body
    return {"type": f"urn:suture-skills:{kind_of(error)}", "title": "Refused", "detail": str(error), **error.numbers}


@contextmanager
def service(*, works: bool = False) -> Iterator["Client"]:
    """Connect to the service, or to the application in this process."""
    from skills.connection import connect
    from skills.settings import settings

    with connect(settings(), works=works) as client:
        yield client


def show(answer: Any, as_json: bool, columns: Sequence[str]) -> None:
    """Print an answer: a table of some of its fields, named as `report.path_states`, or all of it as JSON."""
    if as_json:
        print_json(answer)
        return
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name.rpartition(".")[2], overflow="fold")
    for row in answer if isinstance(answer, list) else [answer]:
        table.add_row(*(cell(reduce(_field, name.split("."), row)) for name in columns))
    out.print(table)


def print_json(answer: Any) -> None:
    """Print an answer, of models or of plain values, as one JSON document."""
    out.print_json(json.dumps(answer, default=_plain))


def _field(of: Any, name: str) -> Any:
    return of.get(name) if isinstance(of, Mapping) else getattr(of, name)


def cell(value: Any) -> str:
    """Write a value for people."""
    if value is None:
        return ""
    return f"{value:%Y-%m-%d %H:%M:%SZ}" if isinstance(value, datetime) else str(value)


def _plain(model: Any) -> Any:
    """Write a model of an answer, or a path, as JSON has it."""
    return str(model) if isinstance(model, Path) else model.model_dump(mode="json", by_alias=True)


def finished(client: "Client", job: "Job", timeout_s: float = WAIT_S) -> "Job":
    """Wait for a job, with something to look at."""
    with err.status(f"{job.kind} {job.id} ...") as status:

        def tell(seen: "Job") -> None:
            status.update(f"{seen.kind} {seen.id} {seen.state} {seen.progress:.0%}")

        return client.wait(job, timeout_s, progress=tell)


def result_of(job: "Job") -> dict[str, Any]:
    """Give what came of a job that succeeded."""
    assert job.result is not None, job
    return job.result


@contextmanager
def bar(doing: str) -> Iterator["Progress"]:
    """Show how many bytes have gone, of how many."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(doing, total=None)
        yield lambda went, total: progress.update(task, completed=went, total=total)


def triple(text: str) -> Triple:
    """Read x,y,z."""
    x, y, z = numbers(text, 3)
    return x, y, z


def numbers(text: str, count: int) -> list[float]:
    """Read so many numbers with commas between them."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count:
        raise BadInput(f"Write {count} numbers with commas between them, not {text!r}.")
    return found
