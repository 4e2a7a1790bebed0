"""`skills`: the installation's own commands, and the typed client's, from a shell.

Tables for people, `--json` for programs; exit code 0 only on success. What is heavy is imported where it is used, so
that `skills --help` is quick.
"""

import typer

from skills.cli import atlas, installation, keys, learning, paper, plans, policies, recordings, scoring, surgeons

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Suture styles: learn, certify, serve and check. Research use only.",
)
for part in (installation, keys, recordings, learning, policies, plans, atlas, scoring, paper, surgeons):
    app.add_typer(part.commands)
