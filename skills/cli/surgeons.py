"""Surgeons, by pseudonym, and suture types."""

from typing import Annotated, Literal

import typer

from skills.cli.shell import AsJson, Surgeon, out, print_json, refusing, service, show

commands = typer.Typer()
surgeons = typer.Typer(no_args_is_help=True, help="Surgeons, by pseudonym; never by name.")
sutures = typer.Typer(no_args_is_help=True, help="The catalogue of suture types.")
commands.add_typer(surgeons, name="surgeon")
commands.add_typer(sutures, name="suture")

ABOUT = ("surgeon", "skill_level", "handedness", "protocol", "created_at")


@surgeons.command("put")
@refusing
def surgeon_put(
    surgeon: Annotated[str, typer.Argument(help="A pseudonym: lower-case letters, digits, - and _.")],
    skill_level: Annotated[Literal["novice", "intermediate", "expert"] | None, typer.Option()] = None,
    handedness: Annotated[Literal["right", "left", "ambidextrous"] | None, typer.Option()] = None,
    protocol: Annotated[str | None, typer.Option(help="The study's, such as an ethics number.")] = None,
    consent: Annotated[
        list[str] | None, typer.Option(help="A use they agreed to: training, export or atlas; once for each.")
    ] = None,
    until: Annotated[str | None, typer.Option(help="The last day of their consent, as 2030-12-31.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a surgeon whole: what is left out is taken out."""
    agreed = {"uses": consent, "until": until} if consent else None
    with service() as client:
        written = client.put_surgeon(
            surgeon, skill_level=skill_level, handedness=handedness, protocol=protocol, consent=agreed
        )
    show(written, as_json, ABOUT)


@surgeons.command("list")
@refusing
def surgeon_list(as_json: AsJson = False) -> None:
    """List the surgeons."""
    with service() as client:
        show(client.surgeons(), as_json, ABOUT)


@surgeons.command("show")
@refusing
def surgeon_show(surgeon: Surgeon, as_json: AsJson = False) -> None:
    """Show a surgeon."""
    with service() as client:
        show(client.surgeon(surgeon), as_json, (*ABOUT, "consent"))


@sutures.command("list")
@refusing
def suture_list(as_json: AsJson = False) -> None:
    """List the suture types."""
    with service() as client:
        show(client.suture_types(), as_json, ("suture", "name", "family"))


@commands.command()
@refusing
def erase(
    surgeon: Surgeon, yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False, as_json: AsJson = False
) -> None:
    """Erase a surgeon, and everything derived from them, for good."""
    if not yes:
        typer.confirm(f"Erase '{surgeon}', all recordings, policies and plans, for good?", abort=True, err=True)
    with service() as client:
        client.erase_surgeon(surgeon)
    if as_json:
        print_json({"surgeon": surgeon, "erased": True})
    else:
        out.print(f"'{surgeon}' and everything derived from them is erased.")
