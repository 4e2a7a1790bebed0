"""`skills`: the command line, for the installation itself and for the calls of the typed client.

Commands print tables for people, or one JSON document with `--json`; the exit code is 0 only on success. Slow imports
are made inside the commands, so that `skills --help` is fast.
"""

import sys
from functools import partial
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from skills.cli import (
    arms,
    calibrations,
    comparison,
    datasets,
    demos,
    jobs,
    keys,
    live,
    operation,
    people,
    plans,
    policies,
    recordings,
    report,
    trials,
    tries,
)
from skills.cli.commands import print_error
from skills.cli.output import err, out
from skills.remedies import did_you_mean


class Commands(TyperGroup):
    """The command group. Usage errors are printed like all other errors: the fault, then the remedy."""

    def main(self, *args: Any, standalone_mode: bool = True, **options: Any) -> Any:
        """Run a command; exit with 2 after a usage error, with 1 if a confirmation is declined."""
        # not in standalone mode, in which Typer prints errors in its own form
        run = partial(super().main, *args, **options | {"standalone_mode": False})
        if not standalone_mode:
            return run()
        try:
            sys.exit(run() or 0)
        except typer.Abort:
            err.print()
            print_error("Nothing was done: it was not confirmed.", ["Answer y, or give --yes."])
            sys.exit(1)
        except typer.TyperException as error:
            wrong, advice = _describe(error)
            print_error(wrong, advice)
            sys.exit(error.exit_code)


def _describe(error: typer.TyperException) -> tuple[str, list[str]]:
    """Return a usage error as the fault and the remedies, with the most similar option if there is one."""
    options = getattr(error, "possibilities", None)  # of an unknown option
    fault = error.message if options else error.format_message()
    # the words of pydantic, with which Typer checks numbers
    fault = (
        fault.replace("Value error, ", "").replace("Input should be", "it must be").partition(", unable to parse")[0]
    )
    advice = did_you_mean(getattr(error, "option_name", ""), options) if options else []
    context = getattr(error, "ctx", None)
    path = "skills" if context is None else " ".join(["skills", *context.command_path.split()[1:]])
    return " ".join(fault.split()), [*advice, f"See the help: {path} --help"]


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Suture styles: learn, certify, serve and check. Research use only.",
)
for commands in (  # the order of the commands in `skills --help`
    *(operation, keys, tries, recordings, demos, trials, datasets, jobs, policies, plans, arms, live),
    *(comparison, calibrations, report, people),
):
    app.add_typer(commands.commands)


def _print_version(asked: bool) -> None:
    if asked:
        from skills import __version__

        out.print(__version__, highlight=False)
        raise typer.Exit


@app.callback()
def skills(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Suture styles: learn, certify, serve and check. Research use only."""
