"""`skills keys`: who may ask this installation for what."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skills.cli.shell import AsJson, err, out, refusing, show

if TYPE_CHECKING:
    from skills.db.session import Database

commands = typer.Typer()
keys = typer.Typer(no_args_is_help=True, help="Keys: who may ask this installation for what.")
commands.add_typer(keys, name="keys")

Role = Literal["reader", "uploader", "trainer", "releaser", "admin"]  # the settings' own are slow to import
COLUMNS = ("key", "owner", "role", "surgeons", "created_at", "expires_at", "state")


@keys.command()
@refusing
def create(
    owner: Annotated[str, typer.Argument(help="Whose it is; events and releases bear this name.")],
    role: Annotated[Role, typer.Option(help="Each role may do what those before it may.")] = "reader",
    days: Annotated[
        int | None, typer.Option(min=1, max=3650, help="For how long it counts; left out, for ever.")
    ] = None,
    surgeon: Annotated[
        list[str] | None, typer.Option(help="Restrict it to this surgeon's things; may be given several times.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a key and show it, once."""
    from skills.db.base import now
    from skills.library.keys import about_key, create_key

    with _database() as database, database.writing() as session:
        expires_at = None if days is None else now() + timedelta(days=days)
        key, text = create_key(session, owner, role, "local", expires_at=expires_at, surgeons=surgeon)
        about = about_key(key)
    if as_json:
        out.print_json(json.dumps(about | {"secret": text}))
        return
    out.print(text, markup=False, soft_wrap=True)
    err.print("It is not stored and cannot be shown again; keep it where only its owner can read it.")


@keys.command("list")
@refusing
def list_all(as_json: AsJson = False) -> None:
    """List all keys, also those that do not count any more; no secret is known."""
    from skills.library.keys import about_key, list_keys

    with _database() as database, database.reading() as session:
        found = [about_key(key) for key in list_keys(session)]
    show(found if as_json else [_in_words(one) for one in found], as_json, COLUMNS)


@keys.command()
@refusing
def revoke(
    key: Annotated[str, typer.Argument(help="Its id: the eight characters after skills_.")], as_json: AsJson = False
) -> None:
    """Revoke a key: within a second no service of this installation lets it in."""
    from skills.library.keys import about_key, revoke_key

    with _database() as database, database.writing() as session:
        about = about_key(revoke_key(session, key, "local"))
    show(about if as_json else _in_words(about), as_json, COLUMNS)


@contextmanager
def _database() -> Iterator["Database"]:
    """Open the database of this installation, with its tables."""
    from skills.db.session import Database
    from skills.settings import settings

    with closing(Database(settings().database_url)) as database:
        database.migrate()
        yield database


def _in_words(about: dict[str, Any]) -> dict[str, Any]:
    surgeons = "all" if about["surgeons"] is None else ", ".join(about["surgeons"]) or "none any more"
    return about | {"surgeons": surgeons}
