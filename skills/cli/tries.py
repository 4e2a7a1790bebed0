"""`skills try`: from a bag to a verdict.

The command stores the recording, sends the request of `POST /tries`, and prints each step of the job. It asks at a
terminal for the answers that the request leaves open; elsewhere it prints the command that gives each of them. A remedy
is such a command too.

Exit codes: 0 with a verdict of a feasible plan, 1 if a step was refused or the plan is not feasible, 2 for a wrong
option, 3 if a question is open.
"""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from skills.cli.demos import on_terminal, part_of
from skills.cli.plans import psm_m_of, stated_errors_of
from skills.cli.recordings import (
    Columns,
    Decimal,
    Frame,
    Instrument,
    OneEpisode,
    RateHz,
    RecordingPath,
    TableArm,
    Tool,
    Units,
    ready_one,
)
from skills.cli.shell import (
    WAIT_S,
    AsJson,
    complete_surgeons,
    complete_sutures,
    connect,
    in_progress,
    out,
    print_json,
    refusing,
)
from skills.errors import BadInput
from skills.remedies import Door, Remedy, read_remedies

if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.operation import Job
    from skills.schemas.tries import TryStep
    from skills.settings import Settings

commands = typer.Typer()

OPEN = 3  # the exit code if a question is open
OPTIONS = {  # the options that apply a choice, by the fields of its change
    "segment": "--segment",
    "loss_mm": "--loss-mm",
    "cell_mm": "--cell-mm",
    "hysteresis": "--hysteresis",
    "tissue_mm": "--tissue",
    "errors": "--errors",
}


ANSWERS = {
    "propose": "--segment N or whole",
    "tissue": "--tissue MM or none",
    "errors": "--errors calibrated, uncalibrated or FILE",
    "release": "--release or --no-release",
}


@commands.command("try")
@refusing
def try_bag(
    context: typer.Context,
    path: RecordingPath,
    surgeon: Annotated[
        str, typer.Option(help="The surgeon's pseudonym; a new one is added.", autocompletion=complete_surgeons)
    ] = "surgeon-1",
    suture: Annotated[str, typer.Option(help="The suture type.", autocompletion=complete_sutures)] = "simple-running",
    segment: Annotated[
        str | None, typer.Option(help="The proposed hand-off, counted from 1, or whole; asked if there are several.")
    ] = None,
    tissue: Annotated[
        str | None, typer.Option(help="Height of level tissue in the arm's frame, mm, or none; asked.")
    ] = None,
    errors: Annotated[
        str | None,
        typer.Option(help="Errors of the arms: calibrated, uncalibrated, or a JSON file (docs/errors.md); asked."),
    ] = None,
    release: Annotated[
        bool | None, typer.Option("--release/--no-release", help="Release it if it passes the gate; asked.")
    ] = None,
    loss_mm: Annotated[
        float | None, typer.Option(help="Take the coarsest cells that lose at most this much, RMSE in 3-D; 2.6.")
    ] = None,
    cell_mm: Annotated[float | None, typer.Option(help="Length of a cell's edge, in place of the choice.")] = None,
    hysteresis: Annotated[float | None, typer.Option(help="Hysteresis in cells, in place of the choice.")] = None,
    approach: Annotated[str | None, typer.Option(help="PSM_M's approach direction, as x,y,z.")] = None,
    base: Annotated[
        str | None, typer.Option(help="PSM_M's base in the arm's frame, as x,y,z in mm and qx,qy,qz,qw.")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="Keep everything in this folder; without it a temporary one is used, and deleted."),
    ] = None,
    rate_hz: RateHz = None,
    frame: Frame = None,
    column: Columns = None,
    unit: Units = None,
    decimal: Decimal = None,
    table_arm: TableArm = None,
    instrument: Instrument = None,
    episode: OneEpisode = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> None:
    """Take a bag to a verdict: read, cut, learn, certify, release if wanted, plan where it was demonstrated, and play.

    Exit code 0 with the verdict of a feasible plan, 1 if it is not feasible or a step was refused, 3 if a question is
    open.
    """
    asked: dict[str, Any] = {
        "segment": None if segment is None else part_of(segment),
        "tissue_mm": None if tissue is None else _tissue(tissue),
        "errors": stated_errors_of(errors),
        "release": release,
        "loss_mm": loss_mm,
        "cell_mm": cell_mm,
        "hysteresis": hysteresis,
        "psm_m": psm_m_of(approach, base),
    }
    teller = _Parser(context, as_json)
    with _place(folder, teller) as settings, connect(settings, workers=1) as client:
        _ensure_surgeon(client, surgeon)
        table = column, rate_hz, frame, unit, decimal, table_arm, instrument
        with ready_one(path, episode, tool, *table) as (file, how):
            stored = client.add_recording(file, surgeon=surgeon, **how)
        while True:
            job = _tried(client, teller, client.try_recording(stored.sha256, surgeon, suture, **asked))
            answers = teller.ask(job) if on_terminal() and not as_json else {}
            if not answers:
                break
            asked |= answers
        code = _code(client, job)
    if as_json:
        print_json(job)
    raise typer.Exit(code)


@contextmanager
def _place(folder: Path | None, teller: "_Parser") -> "Iterator[Settings]":
    """Yield the settings with the database of a folder, of the configured installation, or of a temporary folder."""
    from skills.settings import settings

    here = settings()
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        url = f"sqlite:///{(folder / 'skills.sqlite').absolute()}"
        yield here.model_copy(update={"server": None, "database_url": url})
        teller.note(f"Kept in {folder}. See it: SKILLS_DATABASE_URL={shlex.quote(url)} skills serve")
        return
    if here.server or "database_url" in here.model_fields_set:
        yield here
        return
    with TemporaryDirectory(prefix="skills-try-") as made:
        teller.note(f"Everything goes to {made}, which is deleted at the end; --folder FOLDER keeps it.")
        # the signing key lies outside the folder of the database
        (Path(made) / "database").mkdir()
        own = {"database_url": f"sqlite:///{made}/database/skills.sqlite", "signing_key": Path(made) / "signing.key"}
        # the film of a database that is deleted need not be finished, so its worker does not warn about it
        yield here.model_copy(update={**own, "log_level": "error"})


def _ensure_surgeon(client: "Client", surgeon: str) -> None:
    """Add a surgeon that there is not; one that there is stays as it is."""
    from skills.client import Problem

    try:
        client.surgeon(surgeon)
    except Problem as problem:
        if problem.status != 404:
            raise
        client.put_surgeon(surgeon)


def _tried(client: "Client", teller: "_Parser", job: "Job") -> "Job":
    """Wait for a try, and print each step as it is done; return the job, also one that failed."""
    from skills.client import JobFailed

    with in_progress(job) as going:

        def tell(seen: "Job") -> None:
            teller.tell(seen)
            going(seen)

        try:
            return client.wait(job, WAIT_S, progress=tell)
        except JobFailed as failed:
            if not failed.job.result:  # it failed before its first step
                raise
            return failed.job


def _code(client: "Client", job: "Job") -> int:
    """Return the exit code of a try that has ended."""
    from skills.client import steps_of

    last = steps_of(job)[-1]
    if last.state == "asks":
        return OPEN
    if job.state != "succeeded" or last.name != "verdict" or last.id is None:
        return 1
    return 0 if client.playback(last.id).feasible else 1


def _tissue(text: str) -> float | str:
    """Parse --tissue: a height, or none.

    Raises:
        BadInput: It is neither.
    """
    if text == "none":
        return text
    try:
        return float(text)
    except ValueError:
        raise BadInput(f"--tissue {text!r} is neither a height in mm nor none.", "Example: --tissue=-165") from None


class _Parser:
    """Prints the steps of a try, its questions, and the commands that answer them or apply a remedy."""

    def __init__(self, context: typer.Context, as_json: bool) -> None:
        self._context, self._silent = context, as_json
        self._answers: dict[str, Any] = {}
        self._told: set[str] = set()

    def note(self, text: str) -> None:
        """Print a line about the command itself."""
        if not self._silent:
            out.print(text, markup=False, soft_wrap=True)

    def tell(self, job: "Job") -> None:
        """Print the steps of a job that were not printed yet."""
        from skills.client import steps_of

        for step in steps_of(job):
            key = step.model_dump_json()
            if self._silent or key in self._told:
                continue
            self._told.add(key)
            line = Table.grid(padding=(0, 1))
            line.add_column(min_width=8, no_wrap=True)
            line.add_row(step.name, Text(step.text, style="red" if step.state == "refused" else ""))
            out.print(line)
            for remedy in read_remedies(list(step.remedies)):
                self._indent(remedy.words(Door.COMMAND) if isinstance(remedy, Remedy) else remedy)
            if step.state != "asks" or not on_terminal():
                for choice in step.choices:
                    self._indent(f"{choice.words}:")
                    self._indent(f"  {self._command(choice.change)}")
        open_ones = [step.name for step in steps_of(job) if step.state == "asks"]
        if job.state == "succeeded" and len(open_ones) > 1 and not (self._silent or on_terminal()):
            out.print(f"Open: {', '.join(ANSWERS[name] for name in open_ones)}.", markup=False, soft_wrap=True)

    def ask(self, job: "Job") -> dict[str, Any]:
        """Ask a user the open questions of a job; nothing if there are none."""
        from skills.client import steps_of

        answers: dict[str, Any] = {}
        for step in steps_of(job):
            if step.state == "asks":
                answers |= self._answer(step)
        self._answers |= answers
        return answers

    def _answer(self, step: "TryStep") -> dict[str, Any]:
        if step.name == "release":
            return {"release": typer.confirm(step.text, err=True)}
        if step.name == "tissue":
            return {"tissue_mm": _tissue(typer.prompt("A height in mm, or none", err=True).strip())}
        for number, choice in enumerate(step.choices, 1):
            self._indent(f"{number}: {choice.words}")
        number = typer.prompt("Which one? A number", type=int, err=True)
        if not 1 <= number <= len(step.choices):
            raise BadInput(f"There is no choice {number}.", f"Answer 1 to {len(step.choices)}.")
        chosen: dict[str, Any] = step.choices[number - 1].change
        return chosen

    def _indent(self, text: str) -> None:
        out.print(f"         {text}", markup=False, soft_wrap=True)

    def _command(self, change: dict[str, Any]) -> str:
        """Return this command with other answers: as it was typed, without what the change replaces."""
        changed = self._answers | change
        replaced = {OPTIONS[field].lstrip("-").replace("-", "_") for field in changed if field in OPTIONS}
        words = ["skills", "try", str(self._context.params["path"])]
        for option in self._context.command.params:
            value, name = self._context.params.get(option.name or ""), option.name
            if (
                name is None
                or name in ("path", "as_json", *replaced)
                or value is None
                or value in ((), [], option.default)
            ):
                continue
            if name == "release":
                words += [] if "release" in changed else ["--release" if value else "--no-release"]
            else:
                several = (
                    value if isinstance(value, list | tuple) else [f"{value:g}" if isinstance(value, float) else value]
                )
                words += [f"--{name.replace('_', '-')}={one}" for one in several]
        for field, value in changed.items():
            if field == "release":
                words.append("--release" if value else "--no-release")
            elif field in OPTIONS:
                words.append(f"{OPTIONS[field]}={value:g}" if isinstance(value, float) else f"{OPTIONS[field]}={value}")
        return shlex.join(words)
