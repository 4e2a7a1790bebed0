"""What is done to a surgeon for good."""

from typing import Annotated

import typer

from skills.cli.shell import Surgeon, refusing, service

commands = typer.Typer()


@commands.command()
@refusing
def erase(surgeon: Surgeon, yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Erase a surgeon, and everything derived from them, for good."""
    if not yes:
        typer.confirm(f"Erase '{surgeon}', all recordings, policies and plans, for good?", abort=True)
    with service() as client:
        client.erase_surgeon(surgeon)
