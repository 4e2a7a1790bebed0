"""Shared parts of all commands: output, errors, options, completion, and the connection to the service.

Results go to stdout: a table for people, or with `--json` one JSON document and nothing else. Progress and errors go to
stderr; with `--json` an error is the problem document that the service would send.

Completion proposes the existing surgeons and suture types. A shell waits for it at every press of Tab, so it has a
short timeout and ignores all errors.
"""

import atexit
import errno
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from datetime import datetime
from functools import reduce, wraps
from pathlib import Path
from threading import Thread
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec

import typer
from rich.console import Console
from rich.table import Table
from typer.models import ArgumentInfo, OptionInfo

from skills.errors import BadInput, SkillsError
from skills.remedies import Door

LIMIT_S = 1.5  # timeout of completion, ours: longer than a warm response takes, shorter than a user waits
MOST = 200


def complete_surgeons(incomplete: str) -> list[str]:
    """Return the surgeons that complete an input."""
    return _in_time(_surgeons, incomplete)


def complete_sutures(incomplete: str) -> list[str]:
    """Return the suture types that complete an input."""
    return _in_time(_sutures, incomplete)


def _in_time(find: Callable[[], list[str]], incomplete: str) -> list[str]:
    found: list[str] = []

    def look() -> None:
        with suppress(Exception):
            found.extend(name for name in find() if name.startswith(incomplete))

    # a daemon, so that a look-up that hangs does not keep the process alive
    thread = Thread(target=look, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    atexit.register(_end_without, thread)
    return list(found)


def _end_without(thread: Thread) -> None:
    """End the process at once if a thread still runs: the interpreter's end kills it, within a library by abort()."""
    if thread.is_alive():
        sys.stdout.flush()
        os._exit(0)


def _surgeons() -> list[str]:
    return _asked("/surgeons", "surgeon") or _stored("list_surgeons")


def _sutures() -> list[str]:
    return _asked("/suture-types", "suture") or _stored("list_suture_types")


def _asked(path: str, field: str) -> list[str]:
    """Return names from the service, if one is configured."""
    from skills.settings import settings

    if not settings().server:
        return []
    from skills.client import Client, Retrying

    with Client(str(settings().server), timeout_s=LIMIT_S, retrying=Retrying(attempts=1)) as client:
        return [one[field] for one in client.get_json(path, limit=MOST)["items"]]


def _stored(listing: str) -> list[str]:
    """Return names from the database, if it exists and no service is configured."""
    from pathlib import Path

    from skills.settings import settings

    url = settings().database_url
    file = url.removeprefix("sqlite:///")
    if settings().server or (file != url and not Path(file).is_file()):
        return []
    from skills.db.session import Database
    from skills.library.people import surgeons, suture_types

    of = surgeons if listing == "list_surgeons" else suture_types
    with closing(Database(url, patience_ms=int(LIMIT_S * 1000))) as database, database.reading() as session:
        return [row.slug for row in getattr(of, listing)(session, MOST, None)]


if TYPE_CHECKING:
    from skills.client import Client, Progress
    from skills.schemas.operation import Job
    from skills.settings import Settings
    from skills.transparency.signing_keys import PublicKey

out = Console(highlight=False, width=None if sys.stdout.isatty() else 160)  # in a pipe, wide enough not to wrap digests
err = Console(stderr=True, highlight=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; errors too, on stderr.")]
Surgeon = Annotated[str, typer.Argument(help="The surgeon's pseudonym.", autocompletion=complete_surgeons)]
Suture = Annotated[
    str, typer.Argument(help="The suture type, such as simple-running.", autocompletion=complete_sutures)
]
OfSurgeon = Annotated[
    str | None, typer.Option("--surgeon", help="Only of this surgeon.", autocompletion=complete_surgeons)
]
OfSuture = Annotated[
    str | None, typer.Option("--suture", help="Only of this suture type.", autocompletion=complete_sutures)
]
WAIT_S = 3600.0  # ours: a training takes seconds, with thousands of states at most an hour
Triple = tuple[float, float, float]

PARTS = re.compile(r"(?<=[.!?]) (?=[A-Z`'])|; |\n")  # separates the fault from the remedy
RENAMED = {  # arguments of the client for which a command has another name
    "suture_points": "point",
    "start_mm": "start",
    "demos": "demo",
    "surgeons": "surgeon",
    "sutures": "suture",
    "arms": "arm",
    "psm_m.base": "base",
    "psm_m.approach": "approach",
    "learner.": "setting",
}

P = ParamSpec("P")


def refusing(command: Callable[P, None]) -> Callable[P, None]:
    """Decorate a command: an error is printed in one sentence, or as JSON, and the exit code is 1."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except SkillsError as error:
            _refuse(error, run, bool(kwargs.get("as_json")))
        except OSError as error:  # a path from the command line cannot be read or written
            where = "The file" if error.filename is None else str(error.filename)
            refused = BadInput(f"{where}: {error.strerror or error}.", *about_path(error))
            _refuse(refused, run, bool(kwargs.get("as_json")))

    return run


def _refuse(error: SkillsError, command: Callable[..., None], as_json: bool) -> NoReturn:
    """Print an error, the fault on one line and each remedy on one line; exit with 1."""
    wrong, advice = _in_commands(error, command)
    if as_json:
        print(json.dumps(_problem(error, " ".join([wrong, *advice])), default=str), file=sys.stderr)
    else:
        tell(wrong, advice)
    raise typer.Exit(1) from error


def tell(wrong: str, advice: Sequence[str]) -> None:
    """Print the fault in red on a line of its own, and the remedies below it."""
    err.print(wrong, style="red", markup=False, soft_wrap=True)
    for line in advice:
        err.print(line, markup=False, soft_wrap=True)


def first_sentence(error: SkillsError) -> str:
    """Return the fault without its remedies."""
    return PARTS.split(error.message, maxsplit=1)[0]


def _in_commands(error: SkillsError, command: Callable[..., None]) -> tuple[str, list[str]]:
    """Return the fault and the remedies in the words of the command line.

    A message is "fault; remedy", or sentences of which the first is the fault.
    """
    from skills.client import Problem

    if isinstance(error, Problem) and error.refused:
        wrong, *more = [one.sentence(_option(one.path, command)) for one in error.refused]
        return wrong, [*more, *error.advice(Door.COMMAND), f"See the help: {_path(command)} --help"]
    wrong, *more = PARTS.split(error.message, maxsplit=1)
    mended = [one[:1].upper() + one[1:] for one in more]
    return wrong + ("" if wrong.endswith((".", "?", "!", ":")) else "."), [*mended, *error.advice(Door.COMMAND)]


def _path(command: Callable[..., None]) -> str:
    """Return the words that are typed for a command."""
    from skills.cli import app

    def find(group: typer.Typer) -> list[str] | None:
        for one in group.registered_commands:
            if one.callback is command:
                return [one.name or str(getattr(command, "__name__", ""))]
        for part in group.registered_groups:
            found = None if part.typer_instance is None else find(part.typer_instance)
            if found is not None:
                return [*([str(part.name)] if part.name else []), *found]
        return None

    return " ".join(["skills", *(find(app) or [])])


def _option(path: Sequence[str], command: Callable[..., None]) -> str | None:
    """Return the name that a command has for an argument of the client; None if the names are equal."""
    name = next((option for given, option in RENAMED.items() if ".".join(path).startswith(given)), [*path, ""][0])
    found = inspect.signature(command).parameters.get(name)
    if found is None:
        return None
    about = getattr(found.annotation, "__metadata__", ())
    if any(isinstance(one, ArgumentInfo) for one in about):
        return name.upper()
    declared = [one.param_decls for one in about if isinstance(one, OptionInfo) and one.param_decls]
    return str(declared[0][0]) if declared else f"--{name.replace('_', '-')}"


def about_path(error: OSError) -> list[str]:
    """Return advice about a path that cannot be used."""
    if isinstance(error, PermissionError):
        return ["Name a path that you may read and write, or change its permissions with chmod."]
    if isinstance(error, FileNotFoundError):
        return ["Check the spelling; a folder to write to must exist."]
    if isinstance(error, IsADirectoryError | NotADirectoryError | FileExistsError):
        return ["Name a file where a file is meant, and a folder where a folder is."]
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ["The disk is full; make room, or name a path on another disk."]
    return []


@contextmanager
def files() -> Iterator[None]:
    """Convert an OSError about a path from the command line into a `SkillsError` with advice."""
    try:
        yield
    except OSError as error:
        raise SkillsError(f"{error.filename or 'The file'}: {error.strerror}.", *about_path(error)) from error


KEY = "The public key of the service that signed it, or a file with the key, as `skills public-key` prints it."


def read_key(key: str) -> "PublicKey":
    """Read a public key from the text of an option, or from the file that it names."""
    from skills.transparency.signing_keys import PublicKey

    with files():
        return PublicKey.read(key if key.count("+") >= 2 and not Path(key).exists() else Path(key).read_text())


def _problem(error: SkillsError, detail: str) -> dict[str, Any]:
    """Return the problem document (RFC 9457) of an error: the service's own, or one for an error of this command."""
    from skills.api.problems import kind_of
    from skills.client import Problem

    if isinstance(error, Problem):
        return error.body | {"detail": detail}
    return {"type": f"urn:suture-skills:{kind_of(error)}", "title": "Refused", "detail": detail, **error.numbers}


@contextmanager
def service(*, workers: int = 0) -> Iterator["Client"]:
    """Connect to the service, or to the application in this process with up to a number of workers (`connect`)."""
    from skills.settings import settings

    with connect(settings(), workers=workers) as client:
        yield client


@contextmanager
def connect(settings: "Settings", *, workers: int = 0) -> Iterator["Client"]:
    """Connect to the service at SKILLS_SERVER, or else to the application in this process.

    In-process, jobs need a worker. While the connection is open as many run as the settings say, but not more than
    `workers`: a further one does nothing for a single job, and takes processor time from the first.
    """
    from skills.client import Client

    if settings.server:
        shown = "" if settings.api_key is None else settings.api_key.get_secret_value()
        with Client(settings.server, api_key=shown) as client:
            yield client
        return
    from starlette.testclient import TestClient

    from skills.api.app import create_app
    from skills.library.operation.erasure_list import keep_up_erasures
    from skills.serving import working

    app = create_app(settings)
    # no check of a key is needed: the caller has access to the database anyway
    key = {"X-API-Key": app.state.access.own_key}
    in_process = TestClient(app, base_url="http://localhost", headers=key)
    crew = settings.model_copy(update={"workers": min(workers, settings.workers)})
    with in_process as http, working(crew) if workers else nullcontext():
        try:
            yield Client(http)
        finally:
            if settings.erasures_file is not None:
                keep_up_erasures(app.state.database, settings.erasures_file)


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


def finished(client: "Client", job: "Job", timeout_s: float = WAIT_S) -> "Job":
    """Wait for a job, with a status line on stderr."""
    with in_progress(job) as going:
        return client.wait(job, timeout_s, progress=going)


@contextmanager
def in_progress(job: "Job") -> "Iterator[Callable[[Job], None]]":
    """Show a status line of a job on stderr, and yield its callback: the kind, the state, and the time left."""
    with err.status(f"{job.kind}: waits for a worker") as status:
        began_s = monotonic()

        def tell(seen: "Job") -> None:
            if seen.state == "queued":
                return
            done, went_s = seen.progress, monotonic() - began_s
            left = f", about {went_s / done - went_s:.0f} s left" if 0 < done < 1 else ""
            status.update(f"{seen.kind}: {seen.state}, {done:.0%} done{left}")

        yield tell


def result_of(job: "Job") -> dict[str, Any]:
    """Return the result of a job that succeeded."""
    assert job.result is not None, job
    return job.result


@contextmanager
def bar(doing: str) -> Iterator["Progress"]:
    """Show a progress bar of bytes, and yield its callback."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(doing, total=None)
        yield lambda went, total: progress.update(task, completed=went, total=total)


def triple(text: str) -> Triple:
    """Parse x,y,z."""
    x, y, z = numbers(text, 3)
    return x, y, z


def numbers(text: str, count: int) -> list[float]:
    """Parse a number of values separated by commas.

    Raises:
        BadInput: The text does not have so many numbers.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count:
        raise BadInput(f"{text!r} is not {count} numbers separated by commas.", "Example: 1,2.5,-3")
    return found
