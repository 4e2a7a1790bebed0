"""The commands that act on this installation."""

from typing import Annotated

import typer

from skills.cli.shell import out, refusing, service

commands = typer.Typer()


@commands.command()
@refusing
def serve(
    samples: Annotated[bool, typer.Option(help="Load the sample surgeons and train them first.")] = False,
) -> None:
    """Start the service and its worker; stop both with Ctrl-C."""
    from skills.settings import settings

    settings().check_address()  # before anything is touched
    from skills.serving import serve as run

    run(settings(), samples=samples)


@commands.command()
@refusing
def worker() -> None:
    """Work on jobs in this process, beside those that a service has started."""
    from skills.jobs.worker import run_worker
    from skills.settings import settings

    run_worker(settings())


@commands.command()
@refusing
def migrate() -> None:
    """Bring the database to this version; an empty one gets its tables and the catalogue."""
    from skills.serving import prepare
    from skills.settings import settings

    prepare(settings())
    out.print("The database is up to date.")


@commands.command()
@refusing
def seed() -> None:
    """Load the synthetic sample surgeons and their recordings."""
    from skills.samples import load_samples

    with service() as client:
        for demo in load_samples(client):
            out.print(f"{demo['surgeon']} {demo['suture']}: {demo['report']['path_states']} states")
