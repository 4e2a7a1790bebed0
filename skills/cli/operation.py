"""Commands on the installation itself: serve, worker, migrate, seed, backup, restore, erasures, verify, doctor."""

import gc
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from skills.cli.commands import KEY, command, read_key
from skills.cli.connecting import installation, service
from skills.cli.output import Answer, err, outcome, say, status_line, table, warn
from skills.errors import BadInput, NotReady, SkillsError

if TYPE_CHECKING:
    from skills.library.operation.erasure_list import Erasures
    from skills.library.operation.inspection import Checked

commands = typer.Typer()
_ENDED = {
    "surgeons_erased": "surgeons erased",
    "demos_erased": "demonstrations erased",
    "recordings_deleted": "recordings deleted",
    "demos_withdrawn": "demonstrations withdrawn",
    "styles_stopped": "styles no longer served",
    "keys_revoked": "keys revoked",
    "consents_narrowed": "consents narrowed",
    "demos_marked": "demonstrations marked",
}
_LISTED = {
    "recordings": "recordings deleted",
    "withdrawn": "demonstrations withdrawn",
    "releases": "policies no longer served",
    "keys": "keys revoked",
    "failed": "demonstrations marked recovery or failure",
}


_NO_LIST = (
    "NO LIST OF ERASURES: surgeons who were erased after {since} ARE BACK, policies that were withdrawn or superseded "
    "since ARE SERVED, demonstrations that were marked failure since ARE LEARNT FROM, revoked keys ARE VALID and "
    "withdrawn consent IS IN FORCE. Use --erasures, or erase, withdraw, mark and revoke all of this again before you "
    "use this database."
)
Lists = Annotated[
    list[str] | None,
    typer.Option(
        "--erasures",
        help="A list that `skills erasures` wrote, or the URL of the database that is replaced; repeatable. By default "
        "the file of SKILLS_ERASURES_FILE.",
    ),
]


@command(commands)
def serve(
    host: str | None = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    samples: Annotated[bool, typer.Option()] = False,
) -> None:
    """Start the service and its workers; stop both with Ctrl-C.

    Args:
        host: The address to listen on; SKILLS_HOST by default.
        port: The port to listen on; SKILLS_PORT by default.
        samples: Load the sample surgeons and train them first.
    """
    from skills.settings import settings

    given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
    wanted = settings().model_copy(update=given)
    wanted.check_address()  # before anything is imported or changed
    gc.disable()  # imports create no garbage, and looking for it takes a fifth of the start
    if Path(sys.argv[0]).name in ("skills", "__main__.py") and "skills.serving" not in sys.modules:
        _begin_again()
    from skills.serving import serve as run

    run(wanted, samples=samples)


def _begin_again() -> NoReturn:
    """Replace this process's image by one that has no secret until it has forked the reader's (`skills.serving`)."""
    from skills.sandbox import environment

    given = os.memfd_create("given", 0)
    with os.fdopen(given, "w", closefd=False) as file:
        json.dump([dict(os.environ), sys.argv], file)
    os.lseek(given, 0, os.SEEK_SET)
    begin = (
        f"import gc; gc.disable(); from skills.serving import begin; begin({given}); from skills.cli import app; app()"
    )
    os.execve(sys.executable, [sys.executable, "-P", "-c", begin], environment())  # noqa: S606 - our own module


@command(commands)
def worker() -> None:
    """Run jobs in this process, in addition to the workers that a service started."""
    gc.disable()  # as in `serve`, until the worker runs
    from skills import logs
    from skills.jobs.worker import run_worker
    from skills.settings import settings

    logs.configure(settings().log_level, as_json=settings().log_format == "json")
    run_worker(settings())


@command(commands)
def migrate() -> Answer:
    """Migrate the database to this version; an empty one gets its tables and the catalogue."""
    from skills.serving import prepare
    from skills.settings import settings

    migrated = prepare(settings())
    did = "The database was migrated" if migrated else "Nothing was to be migrated: the database is up to date"
    return outcome(f"{did}.", up_to_date=True, migrated=migrated)


@command(commands)
def seed(to: Annotated[Path | None, typer.Option("--files", file_okay=False)] = None) -> Answer:
    """Load the synthetic sample surgeons and their recordings.

    Args:
        to: Only write the recordings as files, into this folder.
    """
    from skills.samples import load_samples, write_samples

    if to is not None:
        written = write_samples(to)
        return table([{"file": str(file), "surgeon": surgeon} for file, surgeon in written], ("file", "surgeon"))
    with service() as client, err.status("loading"):
        errors: list[str] = []
        stored = list(load_samples(client, errors))
    refused = SkillsError(f"Some samples are not loaded. {' '.join(dict.fromkeys(errors))}") if errors else None
    return replace(table(stored, ("surgeon", "suture", "id", "report.path_states")), refused=refused)


@command(commands)
def backup(to: Annotated[Path, typer.Argument(dir_okay=False)]) -> Answer:
    """Write everything that is stored into one file, while the service goes on working.

    Args:
        to: A new file.
    """
    from skills.library.operation.backup import back_up

    with installation() as database, status_line("backing up") as update:
        manifest = back_up(database, to, update)
    rows, size, taken = sum(table.rows for table in manifest.tables), to.stat().st_size, manifest.created_at
    sentence = f"{to}: {rows} rows, {size / 1e6:.1f} MB, the state of {taken}."
    return outcome(sentence, file=to, size_bytes=size, rows=rows, created_at=taken)


@command(commands)
def restore(
    source: Annotated[Path, typer.Argument(dir_okay=False)], erasures: Lists = None, check: bool = False
) -> Answer:
    """Fill an empty database from a backup, and repeat everything that was ended since the backup.

    That is, erasures, withdrawals, revoked keys and narrowed consents, from the lists of --erasures.

    Args:
        source: A file that `skills backup` wrote.
        check: Only check the backup; write nothing.
    """
    from skills.jobs import refuse_left_over
    from skills.library.operation import backup as library
    from skills.settings import settings

    if check:
        manifest = library.check_backup(source)
        rows, taken = sum(table.rows for table in manifest.tables), manifest.created_at
        return outcome(f"{source} is whole: {rows} rows of {taken}.", whole=True, rows=rows, created_at=taken)
    refuse_left_over(settings())
    sources, listed = _listed_in(erasures)
    with installation() as database, status_line("restoring") as update:
        done = library.restore(database, source, listed, update)
    rows, taken = sum(table.rows for table in done.manifest.tables), done.manifest.created_at
    ended = {name: count for name, count in vars(done).items() if name != "manifest"}
    sentence = f"Restored {rows} rows, the state of {taken}.{_again(sources, ended)}"
    return _ended(sentence, sources, taken, rows=rows, created_at=taken, **ended)


@command(commands, "accept-rollback")
def accept_rollback(erasures: Lists = None) -> Answer:
    """Go on with a database that was put back to an older copy of itself, and repeat what was ended since.

    A service refuses such a database until this command is given; the event is logged, and the saved heads of its
    history are set aside. Restore the right copy instead where there is one.
    """
    from skills.jobs import refuse_left_over
    from skills.library.operation import backup as library
    from skills.settings import settings

    sources, listed = _listed_in(erasures)
    with installation() as database, status_line("accepting"):
        try:
            database.compare_history()
        except NotReady:  # otherwise there is nothing to accept, as the next call says
            refuse_left_over(settings())
        ended = library.accept_rollback(database, listed)
    sentence = f"The database is accepted as it is.{_again(sources, ended)}"
    return _ended(sentence, sources, "it was copied", **ended)


def _ended(sentence: str, sources: list[str], since: str, **facts: Any) -> Answer:
    """Return the answer of a restored or accepted database, and warn if no list of erasures was applied."""
    if not sources:
        warn(_NO_LIST.format(since=since))
    return outcome(sentence, **facts)


def _listed_in(given: list[str] | None) -> tuple[list[str], "Erasures"]:
    """Return the lists of erasures to apply, by default the file of the settings, and their union."""
    from skills.library.operation.erasure_list import NOTHING, read_erasures
    from skills.settings import settings

    kept, listed = settings().erasures_file, NOTHING
    sources = given or ([str(kept)] if kept is not None and kept.exists() else [])
    for one in sources:
        listed |= read_erasures(one)
    return sources, listed


def _again(sources: list[str], ended: dict[str, int]) -> str:
    """Return sentences on what the lists of erasures have ended again."""
    if not sources:
        return ""
    counts = ", ".join(f"{count} {_ENDED[name]}" for name, count in ended.items())
    sentence = f"\nApplied again, from {', '.join(map(_without_password, sources))}: {counts}."
    if ended["styles_stopped"]:
        sentence += "\nRelease a version of each style that is to be served: `skills policy release`."
    return sentence


@command(commands)
def erasures(to: Path) -> Answer:
    """Write the digests of everything that a restored backup must not bring back, for `skills restore --erasures`.

    Args:
        to: The list; it grows with each erasure. Keep it apart from the backups.
    """
    from skills.library.operation.erasure_list import keep_erasures

    with installation() as database:
        listed = keep_erasures(database, to)
    surgeons, demos = len(listed.surgeons), len(listed.demos)
    others = {kind: len(names) for kind, names in listed.ended.items() if kind != "demonstrations"}
    others["failed"] = sum(outcome != "success" for _, outcome in listed.outcomes.values())
    more = ", ".join(f"{count} {_LISTED[kind]}" for kind, count in others.items())
    sentence = f"{to}: {surgeons} surgeons and {demos} demonstrations erased, {more}."
    return outcome(sentence, file=to, surgeons=surgeons, demos=demos, **others)


@command(commands)
def verify(
    bag: Annotated[Path | None, typer.Argument()] = None,
    decode_all: bool = False,
    head: Annotated[Path | None, typer.Option(dir_okay=False)] = None,
    key: Annotated[str | None, typer.Option(help=KEY)] = None,
    relearn: bool = False,
    limit: Annotated[int | None, typer.Option(min=1)] = None,
) -> Answer:
    """Check every digest, reference and leaf of the history of this installation, or one replay bag.

    The exit code is 1 if anything is wrong.

    Args:
        bag: A bag for replay; by default the whole installation is verified.
        decode_all: Decode every recording again, and not only the newest.
        head: A file of signed checkpoints that was kept elsewhere, by default the file of SKILLS_CHECKPOINTS or beside
            the signing key: the history must continue each of them.
        relearn: Cut and learn every policy again, from its recordings, settings and seed.
        limit: Of --relearn: at most this number of policies, drawn at random.
    """
    if key is not None and bag is None:
        raise BadInput("--key is about a replay bag.", "Name the bag, or leave out --key.")
    if limit is not None and not relearn:
        raise BadInput("--limit is about --relearn.", "Add --relearn, or leave out --limit.")
    if bag is not None:
        if decode_all or head is not None or relearn:
            raise BadInput(
                "--decode-all, --head and --relearn are about the installation, not about a bag.", "Leave out the bag."
            )
        from skills.formats.verify import verify_bag

        with bag.open("rb") as file:
            lines = verify_bag(file, None if key is None else read_key(key))
        return outcome("\n".join(lines), whole=True, checked=lines)
    from skills.library.operation.inspection import inspect_installation
    from skills.library.recordings.recordings import confined_reader
    from skills.settings import settings
    from skills.transparency.notes import read_notes

    found: dict[str, Checked] = {}
    with installation() as database, confined_reader(settings()) as reader, status_line("verifying") as update:
        heads = None if head is None else read_notes(head.read_text())
        for part in inspect_installation(
            database,
            reader.parse,
            decode_all=decode_all,
            heads=heads,
            relearn=settings() if relearn else None,
            limit=limit,
        ):
            found[part.what] = part
            update(f"{part.what} {part.count or ''}{'' if part.of is None else f' of {part.of}'}")
    wrong = [one for part in found.values() for one in part.wrong]
    left_out = [one for part in found.values() for one in part.left_out]
    counts = {
        part.what: {"checked": part.count, "wrong": len(part.wrong), "left_out": len(part.left_out)}
        for part in found.values()
    }
    lists = {"wrong": wrong, "left_out": left_out}
    named = {name: [{"what": what, "why": why} for what, why in some] for name, some in lists.items()}

    def show() -> None:
        say(*(f"{part.what:23} {part.count:>10} {state_of(part)}" for part in found.values()))
        say(*(f"{what}: {why}" for what, why in left_out))
        warn(*(f"{what}: {why}" for what, why in wrong))

    return Answer({"checked": counts} | named, show, exit_code=1 if wrong else 0)


def state_of(part: "Checked") -> str:
    """Return the result of a part in words; nothing is called whole that was left out."""
    if part.wrong:
        return f"{len(part.wrong)} WRONG"
    if not part.left_out:
        return "whole"
    return f"{part.count - len(part.left_out)} whole, {len(part.left_out)} not compared"


@command(commands, "public-key")
def public_key(to: Annotated[Path | None, typer.Argument(dir_okay=False)] = None) -> Answer:
    """Print the public key of the service, which verifies bags, policies, cards and the history offline.

    Args:
        to: A file to write it to as well.
    """
    with service() as client:
        key = client.checkpoint().verifier
    if to is not None:
        to.write_text(f"{key}\n")
    return outcome(key, key=key)


@command(commands)
def doctor() -> Answer:
    """Check what this installation needs to work, and which layers contain its readers; exit code 1 if a check fails.

    A layer of containment that is missing fails only with SKILLS_CONTAINMENT=required. With SKILLS_SERVER the service
    there is asked, and nothing here is checked.
    """
    from skills.jobs.readiness import refuse_unready
    from skills.sandbox.containment import LAYERS
    from skills.sandbox.forked import layers_held
    from skills.settings import settings

    held: tuple[str, ...] | None
    if settings().server:
        checks, held, without = *_there(f"service at {settings().server}"), "missing"
    else:
        try:
            state, remark = "ok", f"live workers: {refuse_unready(settings())}"
        except SkillsError as error:
            state, remark = "failed", str(error)
        checks = [{"check": "databases and workers", "state": state, "remark": remark}]
        held, without = layers_held(), "failed" if settings().containment == "required" else "missing"
    for name, needs in LAYERS.items():
        if held is None:
            break
        state, remark = ("ok", "") if name in held else (without, f"needs {needs}")
        checks.append({"check": f"containment: {name}", "state": state, "remark": remark})
    failed = any(one["state"] == "failed" for one in checks)
    return table(checks, ("check", "state", "remark"), exit_code=1 if failed else 0)


def _there(name: str) -> tuple[list[dict[str, str]], tuple[str, ...] | None]:
    """Return the check of the service at SKILLS_SERVER, and the layers that hold there; None if it does not answer."""
    try:
        with service() as client:
            ready = client.ready()
    except SkillsError as error:
        return [{"check": name, "state": "failed", "remark": str(error)}], None
    said = [{"check": name, "state": "ok", "remark": f"live workers: {ready.workers}"}]
    return said, tuple(layer for layer, holds in ready.containment.items() if holds)


def _without_password(source: str) -> str:
    """Return the name of a file, or the URL of a database without its password."""
    from skills.db.engines import parse_url

    return parse_url(source).render_as_string(hide_password=True) if "://" in source else source
