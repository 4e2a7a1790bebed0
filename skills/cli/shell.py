"""What all commands share: what is printed where, how a refusal is told, how the service is found."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer
from rich.console import Console
from rich.table import Table

from skills.errors import BadInput, SkillsError

if TYPE_CHECKING:
    from skills.client import Client

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, digests stay whole
err = Console(stderr=True, highlight=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print the service's JSON.")]
Surgeon = Annotated[str, typer.Argument(help="The surgeon's pseudonym.")]
Suture = Annotated[str, typer.Argument(help="The suture type, such as simple-running.")]
Triple = tuple[float, float, float]

P = ParamSpec("P")


def refusing(command: Callable[P, None]) -> Callable[P, None]:
    """Say in one sentence what was refused, and exit with 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except SkillsError as error:
            err.print(f"{type(error).__name__}: {error}", style="red", markup=False, soft_wrap=True)
            raise typer.Exit(1) from error

    return run


@contextmanager
def service(*, works: bool = False) -> Iterator["Client"]:
    """Connect to the service, or to the application in this process."""
    from skills.connection import connect
    from skills.settings import settings

    with connect(settings(), works=works) as client:
        yield client


def show(answer: Any, as_json: bool, columns: Sequence[str]) -> None:
    """Print an answer: a table of some of its fields, or all of it as JSON."""
    if as_json:
        out.print_json(json.dumps(answer))
        return
    rows = answer if isinstance(answer, list) else [answer]
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*("" if row.get(name) is None else str(row[name]) for name in columns))
    out.print(table)


def finished(client: "Client", job: dict[str, Any]) -> dict[str, Any]:
    """Wait for a job, with something to look at."""
    with err.status(f"{job['kind']} {job['id']} ..."):
        return client.wait(job)


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
