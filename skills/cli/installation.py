"""The commands that act on this installation."""

import gc
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from skills.cli.shell import AsJson, err, out, print_json, refusing, service, show
from skills.errors import SkillsError

commands = typer.Typer()


@commands.command()
@refusing
def serve(
    samples: Annotated[bool, typer.Option(help="Load the sample surgeons and train them first.")] = False,
) -> None:
    """Start the service and its worker; stop both with Ctrl-C."""
    from skills.settings import settings

    settings().check_address()  # before anything is touched
    gc.disable()  # nothing that is imported is garbage, and to look for some takes a fifth of the start
    from skills.serving import serve as run

    run(settings(), samples=samples)


@commands.command()
@refusing
def worker() -> None:
    """Work on jobs in this process, beside those that a service has started."""
    from skills import logs
    from skills.jobs.worker import run_worker
    from skills.settings import settings

    logs.configure(settings().log_level, as_json=settings().log_format == "json")
    run_worker(settings())


@commands.command()
@refusing
def migrate(as_json: AsJson = False) -> None:
    """Bring the database to this version; an empty one gets its tables and the catalogue."""
    from skills.serving import prepare
    from skills.settings import settings

    prepare(settings())
    _say("The database is up to date.", as_json, up_to_date=True)


@commands.command()
@refusing
def seed(as_json: AsJson = False) -> None:
    """Load the synthetic sample surgeons and their recordings."""
    from skills.samples import load_samples

    with service() as client, err.status("loading"):
        show(list(load_samples(client)), as_json, ("surgeon", "suture", "id", "report.path_states"))


@commands.command()
@refusing
def backup(to: Annotated[Path, typer.Argument(help="A new file.", dir_okay=False)], as_json: AsJson = False) -> None:
    """Write all that is stored into one file, while the service goes on working."""
    from skills.db.session import Database
    from skills.library.backup import back_up
    from skills.settings import settings

    with closing(Database(settings().database_url)) as database, _telling("backing up") as told, _files():
        manifest = back_up(database, to, told)
    rows, size, taken = sum(table.rows for table in manifest.tables), to.stat().st_size, manifest.created_at
    sentence = f"{to}: {rows} rows, {size / 1e6:.1f} MB, the state of {taken}."
    _say(sentence, as_json, file=to, size_bytes=size, rows=rows, created_at=taken)


@commands.command()
@refusing
def restore(
    source: Annotated[Path, typer.Argument(help="A file that `skills backup` wrote.", dir_okay=False)],
    erasures: Annotated[
        list[str] | None,
        typer.Option(help="A list that `skills erasures` wrote, or the URL of the database that is replaced."),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Only check the backup; nothing is written.")] = False,
    as_json: AsJson = False,
) -> None:
    """Fill an empty database from a backup, and erase again who was erased since."""
    from skills.db.session import Database
    from skills.jobs.readiness import refuse_left_over
    from skills.library import backup as library
    from skills.settings import settings

    with _files():
        if check:
            manifest = library.check_backup(source)
            rows, taken = sum(table.rows for table in manifest.tables), manifest.created_at
            _say(f"{source} is whole: {rows} rows of {taken}.", as_json, whole=True, rows=rows, created_at=taken)
            return
        refuse_left_over(settings())
        listed = library.NOTHING
        for one in erasures or ():
            listed |= library.read_erasures(one)
        with closing(Database(settings().database_url)) as database, _telling("restoring") as told:
            done = library.restore(database, source, listed, told)
    rows, taken = sum(table.rows for table in done.manifest.tables), done.manifest.created_at
    sentence = f"Restored {rows} rows, the state of {taken}; what was withdrawn since then stands again."
    if erasures:
        sentence += f"\nErased again: {done.surgeons_erased} surgeons, {done.demos_erased} demonstrations."
    erased = {"surgeons_erased": done.surgeons_erased, "demos_erased": done.demos_erased}
    _say(sentence, as_json, rows=rows, created_at=taken, **erased)
    if not erasures:
        err.print(
            f"NO LIST OF ERASURES WAS GIVEN: whoever was erased after {taken} IS BACK. Erase them again before this "
            "database is used, or restore into an empty one with --erasures.",
            style="red",
        )


@commands.command()
@refusing
def erasures(
    to: Annotated[Path, typer.Argument(help="The list; it grows, and is kept apart from the backups.")],
    as_json: AsJson = False,
) -> None:
    """Write the list of who and what was erased, as digests, for `skills restore --erasures`."""
    from skills.db.session import Database
    from skills.library.backup import keep_erasures
    from skills.settings import settings

    with closing(Database(settings().database_url)) as database, _files():
        listed = keep_erasures(database, to)
    surgeons, demos = len(listed.surgeons), len(listed.demos)
    _say(f"{to}: {surgeons} surgeons, {demos} demonstrations.", as_json, file=to, surgeons=surgeons, demos=demos)


@commands.command()
@refusing
def verify(
    bag: Annotated[Path | None, typer.Argument(help="A bag for replay; left out, all of this installation.")] = None,
    as_json: AsJson = False,
) -> None:
    """Check every digest of this installation and what rests on what, or one bag; exit code 1 if anything is wrong."""
    if bag is not None:
        from skills.recordings.replay_check import verify_bag

        lines = list(verify_bag(bag))
        _say("\n".join(lines), as_json, whole=True, checked=lines)
        return
    from skills.db.session import Database
    from skills.library.inspection import Checked, inspect_installation
    from skills.settings import settings

    found: dict[str, Checked] = {}
    with closing(Database(settings().database_url)) as database, _telling("verifying") as told:
        for part in inspect_installation(database):
            found[part.what] = part
            told(f"{part.what} {part.count or ''}")
    wrong = [one for part in found.values() for one in part.wrong]
    if as_json:
        counts = {part.what: {"checked": part.count, "wrong": len(part.wrong)} for part in found.values()}
        print_json({"checked": counts, "wrong": [{"what": what, "why": why} for what, why in wrong]})
    else:
        for part in found.values():
            out.print(f"{part.what:20} {part.count:>10} {f'{len(part.wrong)} WRONG' if part.wrong else 'whole'}")
        for what, why in wrong:
            err.print(f"{what}: {why}", style="red", markup=False, soft_wrap=True)
    if wrong:
        raise typer.Exit(1)


def _say(sentence: str, as_json: bool, **facts: Any) -> None:
    """Say what was done, to people or to programs."""
    if as_json:
        print_json(facts)
    else:
        out.print(sentence, markup=False, soft_wrap=True)


@contextmanager
def _telling(doing: str) -> Iterator[Callable[[str], None]]:
    """Show what is worked on."""
    with err.status(doing) as status:
        yield lambda what: status.update(f"{doing} {what}")


@contextmanager
def _files() -> Iterator[None]:
    """Say what is wrong with a file that is named on the command line."""
    try:
        yield
    except OSError as error:
        raise SkillsError(f"{error.filename or 'The file'}: {error.strerror or type(error).__name__}.") from error
