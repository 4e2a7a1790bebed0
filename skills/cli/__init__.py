"""`skills`: the command line, for the installation itself and for the calls of the typed client.

Commands print tables for people, or one JSON document with `--json`; the exit code is 0 only on success. Slow imports
are made inside the commands, so that `skills --help` is fast.
"""

import re
import sys
from collections.abc import Sequence
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

CHOICES = re.compile(r"'([^']*)' is not one of (.+?)\.?$")


class Commands(TyperGroup):
    """The command group. Usage errors are printed like all other errors: the fault, then the remedy."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run a command; exit with 2 after a usage error, with 1 if a confirmation is declined."""
        # not in standalone mode, in which Typer prints errors in its own form
        run = partial(super().main, args, prog_name, complete_var, False, windows_expand_args, **extra)
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
    """Return a usage error as the fault and the remedies, with the most similar name if there is one."""
    said = " ".join(error.format_message().split()).replace("Value error, ", "")
    said = said.partition(", unable to parse")[0].replace("Input should be", "it must be")
    wrong, _, suggested = said.partition(" Did you mean ")
    wrong, _, options = wrong.partition(" (Possible options: ")
    advice = [f"Did you mean {suggested}"] if suggested else []
    if options:
        advice += did_you_mean(wrong.rpartition(" ")[2], options.rstrip(")").split(", "))
    if (choices := CHOICES.search(wrong)) is not None:
        advice += did_you_mean(choices[1], re.findall(r"'([^']*)'", choices[2]))
    context = getattr(error, "ctx", None)
    path = "skills" if context is None else " ".join(["skills", *context.command_path.split()[1:]])
    return wrong, [*advice, f"See the help: {path} --help"]


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Suture styles: learn, certify, serve and check. Research use only.",
)
for commands in (  # the order of the commands in `skills --help`
    *(operation, keys, tries, recordings, demos, trials, datasets, jobs, policies, plans, arms),
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
