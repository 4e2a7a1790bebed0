"""Output of commands: tables for people or one JSON document on stdout, progress and errors on stderr."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import reduce
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from skills.errors import SkillsError

if TYPE_CHECKING:
    from skills.client import Progress
    from skills.schemas.operation import Job

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, wide enough not to wrap digests
err = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class Answer:
    """The result of a command: with `--json` one document, and otherwise what people are shown."""

    document: Any
    show: Callable[[], None]
    exit_code: int = 0
    refused: SkillsError | None = None  # printed after the result, as the error of the command


def text(document: Any, *sentences: str, exit_code: int = 0) -> Answer:
    """Return an answer that is shown as sentences."""
    return Answer(document, lambda: say(*sentences), exit_code)


def outcome(sentence: str, **facts: Any) -> Answer:
    """Return an answer of facts that are shown as a sentence."""
    return text(facts, sentence)


def written(file: Path, sentence: str | None = None) -> Answer:
    """Return the answer that a file was written, and its size."""
    size = file.stat().st_size
    return outcome(sentence or f"{file}: {size / 1e6:.1f} MB.", file=file, size_bytes=size)


def table(document: Any, columns: Sequence[str], *sentences: str, rows: Any = None, exit_code: int = 0) -> Answer:
    """Return an answer that is shown as a table.

    Args:
        document: A result, or a list of them.
        columns: Paths of the fields to show, such as `report.path_states`.
        *sentences: Sentences below the table.
        rows: The results as they are shown; default: the document.
        exit_code: The exit code of the command.
    """

    def show() -> None:
        show_table(document if rows is None else rows, columns)
        say(*sentences)

    return Answer(document, show, exit_code)


def say(*sentences: str) -> None:
    """Print sentences for people, each on a line of its own; nothing in them is markup."""
    for sentence in sentences:
        out.print(sentence, markup=False, soft_wrap=True)


def warn(*sentences: str, style: str = "red") -> None:
    """Print sentences on stderr."""
    for sentence in sentences:
        err.print(sentence, style=style, markup=False, soft_wrap=True)


def show_table(rows: Any, columns: Sequence[str]) -> None:
    """Print some fields of a result, or of a list of them, by paths such as `report.path_states`, as a table."""
    listed = rows if isinstance(rows, list) else [rows]
    cells = [[reduce(_field, name.split("."), row) for name in columns] for row in listed]
    show_cells([name.rpartition(".")[2] for name in columns], cells)


def show_cells(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print rows of cells as a table; a row may be shorter than the columns."""
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*map(cell, row))
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


def typed(value: object) -> str:
    """Return a value as it is typed for an option, with all of its digits."""
    return str(value).removesuffix(".0") if isinstance(value, float) else str(value)


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
