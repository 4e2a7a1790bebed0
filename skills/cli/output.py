"""Output of commands: tables for people or one JSON document on stdout, progress and errors on stderr."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import reduce
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from skills.client import Progress
    from skills.schemas.given import Job

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, wide enough not to wrap digests
err = Console(stderr=True, highlight=False)


def say(*sentences: str) -> None:
    """Print sentences for people, each on a line of its own; nothing in them is markup."""
    for sentence in sentences:
        out.print(sentence, markup=False, soft_wrap=True)


def warn(*sentences: str, style: str = "red") -> None:
    """Print sentences on stderr."""
    for sentence in sentences:
        err.print(sentence, style=style, markup=False, soft_wrap=True)


def say_or_json(sentence: str, as_json: bool, **facts: Any) -> None:
    """Print the outcome of a command: the sentence, or the facts as JSON."""
    if as_json:
        print_json(facts)
    else:
        say(sentence)


def say_written(file: Path, as_json: bool, sentence: str | None = None) -> None:
    """Print that a file was written, and its size."""
    size = file.stat().st_size
    say_or_json(sentence or f"{file}: {size / 1e6:.1f} MB.", as_json, file=file, size_bytes=size)


def show(answer: Any, as_json: bool, columns: Sequence[str]) -> None:
    """Print a result: a table of some of its fields, by paths such as `report.path_states`, or all of it as JSON."""
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
    """Print a result, of models or of plain values, as one JSON document."""
    out.print_json(json.dumps(answer, default=_plain))


def _field(of: Any, name: str) -> Any:
    return of.get(name) if isinstance(of, Mapping) else getattr(of, name)


def cell(value: Any) -> str:
    """Return a value as the text of a table cell."""
    if value is None:
        return ""
    if isinstance(value, float):
        return str(round(value, 6))
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    return f"{value:%Y-%m-%d %H:%M:%SZ}" if isinstance(value, datetime) else str(value)


def _plain(model: Any) -> Any:
    """Return a model or a path as plain JSON data."""
    return str(model) if isinstance(model, Path) else model.model_dump(mode="json", by_alias=True)


@contextmanager
def job_status(job: "Job") -> "Iterator[Callable[[Job], None]]":
    """Show a status line of a job on stderr, and yield its callback: the kind, the state, and the time left."""
    with err.status(f"{job.kind}: waits for a worker") as status:
        began_s = monotonic()

        def update(seen: "Job") -> None:
            if seen.state == "queued":
                return
            done, went_s = seen.progress, monotonic() - began_s
            left = f", about {went_s / done - went_s:.0f} s left" if 0 < done < 1 else ""
            status.update(f"{seen.kind}: {seen.state}, {done:.0%} done{left}")

        yield update


@contextmanager
def status_line(doing: str) -> Iterator[Callable[[str], None]]:
    """Show a status line on stderr, and yield a callback that updates it."""
    with err.status(doing) as status:
        yield lambda what: status.update(f"{doing} {what}")


@contextmanager
def bar(doing: str) -> Iterator["Progress"]:
    """Show a progress bar of bytes, and yield its callback."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(doing, total=None)
        yield lambda went, total: progress.update(task, completed=went, total=total)
