"""Commands of surgeons and suture types."""

import typer

from skills.cli.commands import Surgeon, Suture, command
from skills.cli.connecting import service
from skills.cli.output import Answer, table, text
from skills.errors import BadInput
from skills.keywords import SurgeonKeywords, SutureTypeKeywords

commands = typer.Typer()
surgeons = typer.Typer(no_args_is_help=True, help="Surgeons, by pseudonym; never by name.")
sutures = typer.Typer(no_args_is_help=True, help="The catalogue of suture types.")
commands.add_typer(surgeons, name="surgeon")
commands.add_typer(sutures, name="suture")

COLUMNS = ("surgeon", "skill_level", "handedness", "protocol", "created_at")


@command(surgeons, "put")
def surgeon_put(
    surgeon: str, about: SurgeonKeywords, consent: list[str] | None = None, until: str | None = None
) -> Answer:
    """Create or replace a surgeon; options that are left out are cleared.

    Args:
        surgeon: A pseudonym: lower-case letters, digits, - and _.
        consent: A use that the surgeon agreed to: training, export or atlas; repeatable.
        until: The last day of the consent, such as 2030-12-31.
    """
    if until and not consent:
        raise BadInput("--until is the last day of a consent.", "Name its uses with --consent.")
    if consent:
        about["consent"] = {"uses": consent, "until": until}
    with service() as client:
        return table(client.put_surgeon(surgeon, **about), COLUMNS)


@command(surgeons, "list")
def surgeon_list() -> Answer:
    """List the surgeons."""
    with service() as client:
        return table(client.surgeons(), COLUMNS)


@command(surgeons, "show")
def surgeon_show(surgeon: Surgeon) -> Answer:
    """Show a surgeon."""
    with service() as client:
        return table(client.surgeon(surgeon), (*COLUMNS, "consent"))


@command(sutures, "put")
def suture_put(suture: Suture, about: SutureTypeKeywords) -> Answer:
    """Create or replace a suture type; options that are left out are cleared."""
    with service() as client:
        return table(client.put_suture_type(suture, **about), ("suture", "name", "family"))


@command(sutures, "list")
def suture_list() -> Answer:
    """List the suture types."""
    with service() as client:
        return table(client.suture_types(), ("suture", "name", "family"))


@command(commands)
def erase(surgeon: Surgeon, yes: bool = False) -> Answer:
    """Erase a surgeon and everything derived from their data, permanently.

    Args:
        yes: Do not ask for confirmation.
    """
    if not yes:
        typer.confirm(f"Erase '{surgeon}', all recordings, policies and plans, permanently?", abort=True, err=True)
    with service() as client:
        client.erase_surgeon(surgeon)
    return text(
        {"surgeon": surgeon, "erased": True},
        f"'{surgeon}' and everything derived from them is erased.",
        "Not reached: recordings that were uploaded without --surgeon and from which nothing was cut, since their "
        "surgeon is unknown (`skills recording delete`), and older backups.",
    )
