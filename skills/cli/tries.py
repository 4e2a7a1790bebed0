"""`skills try`: from a bag to a verdict.

The command stores the recording, sends the request of `POST /tries`, and prints each step of the job. It asks at a
terminal for the answers that the request leaves open; elsewhere it prints the command that gives each of them. A remedy
is such a command too.

Exit codes: 0 with a verdict of a feasible plan, 1 if a step was refused or the plan is not feasible, 2 for a wrong
option, 3 if a question is open.
"""

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.table import Table
from rich.text import Text

from skills.cli.commands import AsJson, command, on_terminal, parse_tissue
from skills.cli.completion import complete_surgeons, complete_sutures
from skills.cli.connecting import WAIT_S, connect
from skills.cli.output import job_status, out, print_json, say, typed
from skills.cli.plans import Approach, Base, arm_errors_of, psm_m_of
from skills.cli.uploading import OneEpisode, RecordingPath, Tool, ready_one
from skills.errors import BadInput
from skills.keywords import TableKeywords, TryKeywords
from skills.remedies import Door, Remedy, read_remedies

if TYPE_CHECKING:
    from skills.client import Client
    from skills.schemas.operation import Job
    from skills.schemas.tries import TryStep
    from skills.settings import Settings

commands = typer.Typer()

OPEN = 3  # the exit code if a question is open
ANSWERS = {
    "propose": "--segment N or whole",
    "tissue": "--tissue-mm MM or none",
    "errors": "--errors calibrated, uncalibrated or FILE",
    "release": "--release or --no-release",
}


@command(commands, "try")
def try_bag(
    context: typer.Context,
    path: RecordingPath,
    options: TryKeywords,
    table: TableKeywords,
    surgeon: Annotated[str, typer.Option(autocompletion=complete_surgeons)] = "surgeon-1",
    suture: Annotated[str, typer.Option(autocompletion=complete_sutures)] = "simple-running",
    errors: str | None = None,
    approach: Approach = None,
    base: Base = None,
    folder: Path | None = None,
    episode: OneEpisode = None,
    tool: Tool = None,
    as_json: AsJson = False,
) -> None:
    """Take a bag to a verdict: read, cut, learn, certify, plan where it was demonstrated, play, release if wanted.

    Exit code 0 with the verdict of a feasible plan, 1 if it is not feasible or a step was refused, 3 if a question is
    open.

    Args:
        surgeon: The surgeon's pseudonym; a new one is added.
        suture: The suture type.
        errors: Errors of the arms: calibrated, uncalibrated, or a JSON file (docs/errors.md); asked.
        folder: Keep everything in this folder; without it a temporary one is used, and deleted.
    """
    from skills.samples import make_known

    options |= {"errors": arm_errors_of(errors), "psm_m": psm_m_of(approach, base)}
    printer = _StepPrinter(context, as_json)
    with _installation(folder, printer) as settings, connect(settings, workers=1) as client:
        make_known(client, surgeon)
        with ready_one(path, table, episode, tool) as (file, progress):
            stored = client.add_recording(file, surgeon=surgeon, progress=progress, **table)
        while True:
            job = _tried(client, printer, client.try_recording(stored.sha256, surgeon, suture, **options))
            answers = printer.ask(job) if on_terminal() and not as_json else TryKeywords()
            if not answers:
                break
            options |= answers
        code = _exit_code(client, job)
    if as_json:
        print_json(job)
    raise typer.Exit(code)


@contextmanager
def _installation(folder: Path | None, printer: "_StepPrinter") -> "Iterator[Settings]":
    """Yield the settings with the database of a folder, of the configured installation, or of a temporary folder."""
    from skills.settings import settings

    here = settings()
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        url = f"sqlite:///{(folder / 'skills.sqlite').absolute()}"
        yield here.model_copy(update={"server": None, "database_url": url})
        printer.note(f"Kept in {folder}. See it: SKILLS_DATABASE_URL={shlex.quote(url)} skills serve")
        return
    if here.server or "database_url" in here.model_fields_set:
        yield here
        return
    with TemporaryDirectory(prefix="skills-try-") as made:
        printer.note(f"Everything goes to {made}, which is deleted at the end; --folder FOLDER keeps it.")
        # the signing key lies outside the folder of the database
        (Path(made) / "database").mkdir()
        own = {"database_url": f"sqlite:///{made}/database/skills.sqlite", "signing_key": Path(made) / "signing.key"}
        # the film of a database that is deleted need not be finished, so its worker does not warn about it
        yield here.model_copy(update={**own, "log_level": "error"})


def _tried(client: "Client", printer: "_StepPrinter", job: "Job") -> "Job":
    """Wait for a try, and print each step as it is done; return the job, also one that ended with a refused step."""
    from skills.client import JobFailed

    with job_status(job) as update:

        def progress(seen: "Job") -> None:
            printer.print_steps(seen)
            update(seen)

        try:
            return client.wait(job, WAIT_S, progress=progress)
        except JobFailed as failed:
            # the last step says why, unless the job failed otherwise, was cancelled, or goes on
            if failed.job.result and _steps(failed.job)[-1].text in (failed.job.error or ""):
                return failed.job
            raise


def _exit_code(client: "Client", job: "Job") -> int:
    """Return the exit code of a try that has ended."""
    steps = {one.name: one for one in _steps(job)}
    if any(one.state == "asks" for one in steps.values()):
        return OPEN
    verdict = steps.get("verdict")
    if job.state != "succeeded" or verdict is None or verdict.id is None:
        return 1
    return 0 if client.playback(verdict.id).feasible else 1


def _steps(job: "Job") -> "tuple[TryStep, ...]":
    from skills.schemas.results import TryResult

    return TryResult.of(job).steps


class _StepPrinter:
    """Prints the steps of a try, its questions, and the commands that answer them or apply a remedy."""

    def __init__(self, context: typer.Context, as_json: bool) -> None:
        self._context, self._silent = context, as_json
        self._answers = TryKeywords()
        self._printed: set[str] = set()

    def note(self, text: str) -> None:
        """Print a line about the command itself."""
        if not self._silent:
            say(text)

    def print_steps(self, job: "Job") -> None:
        """Print the steps of a job that were not printed yet."""
        if self._silent:
            return
        steps = _steps(job)
        for step in steps:
            key = step.model_dump_json()
            if key not in self._printed:
                self._printed.add(key)
                self._print(step)
        questions = [step.name for step in steps if step.state == "asks"]
        if job.state == "succeeded" and len(questions) > 1 and not on_terminal():
            say(f"Open: {', '.join(ANSWERS[name] for name in questions)}.")

    def _print(self, step: "TryStep") -> None:
        line = Table.grid(padding=(0, 1))
        line.add_column(min_width=8, no_wrap=True)
        line.add_row(step.name, Text(step.text, style="red" if step.state == "refused" else ""))
        out.print(line)
        for remedy in read_remedies(step.remedies):
            self._indent(remedy.words(Door.COMMAND) if isinstance(remedy, Remedy) else remedy)
        if step.state != "asks" or not on_terminal():
            for choice in step.choices:
                self._indent(f"{choice.words}:")
                self._indent(f"  {self._command(choice.change)}")

    def ask(self, job: "Job") -> TryKeywords:
        """Ask a user the open questions of a job; nothing if there are none."""
        answers = TryKeywords()
        for step in _steps(job):
            if step.state == "asks":
                answers |= self._answer(step)
        self._answers |= answers
        return answers

    def _answer(self, step: "TryStep") -> TryKeywords:
        if step.name == "release":
            return {"release": typer.confirm(step.text, err=True)}
        if step.name == "tissue":
            return {"tissue_mm": parse_tissue(typer.prompt("A height in mm, or none", err=True).strip())}
        for number, choice in enumerate(step.choices, 1):
            self._indent(f"{number}: {choice.words}")
        number = typer.prompt("Which one? A number", type=int, err=True)
        if not 1 <= number <= len(step.choices):
            raise BadInput(f"There is no choice {number}.", f"Answer 1 to {len(step.choices)}.")
        return cast(TryKeywords, step.choices[number - 1].change)

    def _indent(self, text: str) -> None:
        say(f"         {text}")

    def _command(self, change: Mapping[str, object]) -> str:
        """Return this command with other answers: as it was typed, without what the change replaces."""
        changed = {**self._answers, **change}
        words = ["skills", "try", str(self._context.params["path"])]
        for option in self._context.command.params:
            name = option.name or ""
            value = self._context.params.get(name)
            if name not in ("path", "as_json", *changed) and value not in (None, (), [], option.default):
                words += _as_options(name, value)
        for name, value in changed.items():
            words += _as_options(name, value)
        return shlex.join(words)


def _as_options(name: str, value: object) -> list[str]:
    """Return the words that give a parameter a value."""
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{option}" if value else f"--no-{option}"]
    values = value if isinstance(value, list | tuple) else [value]
    return [f"--{option}={typed(one)}" for one in values]
