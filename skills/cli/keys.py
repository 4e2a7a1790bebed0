"""Commands of API keys, on the installation itself."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from skills.cli.commands import command
from skills.cli.connecting import installation
from skills.cli.output import Answer, say, table, warn

if TYPE_CHECKING:
    from skills.db.session import Database
    from skills.schemas.people import Key

commands = typer.Typer()
keys = typer.Typer(no_args_is_help=True, help="Keys: callers and their roles.")
commands.add_typer(keys, name="keys")

Role = Literal["reader", "uploader", "trainer", "releaser", "admin"]  # as in `skills.settings`, which is slow to import
COLUMNS = ("key", "owner", "role", "surgeons", "created_at", "expires_at", "state")


@command(keys)
def create(
    owner: str,
    role: Role = "reader",
    days: Annotated[int | None, typer.Option(min=1, max=3650)] = None,
    surgeon: list[str] | None = None,
) -> Answer:
    """Create a key, and print its secret, which is shown only this once.

    Args:
        owner: The owner's name, which events and releases record.
        role: Each role includes the rights of those before it.
        days: Validity in days; unlimited by default.
        surgeon: Restrict it to this surgeon; repeatable.
    """
    from skills.db import now
    from skills.library.people.keys import about_key, create_key
    from skills.schemas.people import NewKey

    with _database() as database, database.writing() as session:
        expires_at = None if days is None else now() + timedelta(days=days)
        key, secret = create_key(session, owner, role, "local", expires_at=expires_at, surgeons=surgeon)
        about = about_key(key)

    def show() -> None:
        say(secret)
        warn("It is not stored and cannot be shown again; keep it where only its owner can read it.", style="")

    return Answer(NewKey(**dict(about), secret=secret), show)


@command(keys, "list")
def list_all() -> Answer:
    """List all keys, including those that were revoked or have expired; secrets are not stored."""
    from skills.library.people.keys import about_key, list_keys

    with _database() as database, database.reading() as session:
        found = [about_key(key) for key in list_keys(session)]
    return table(found, COLUMNS, rows=[_with_surgeons(one) for one in found])


@command(keys)
def revoke(key: str) -> Answer:
    """Revoke a key: within a second every service of this installation refuses it.

    Args:
        key: Its id: the eight characters after skills_.
    """
    from skills.library.people.keys import about_key, revoke_key

    with _database() as database, database.ending() as session:
        about = about_key(revoke_key(session, key, "local"))
    return table(about, COLUMNS, rows=_with_surgeons(about))


@contextmanager
def _database() -> Iterator["Database"]:
    """Open the database of this installation, migrated, and update the file of erasures afterwards."""
    from skills.settings import settings

    with installation() as database:
        database.migrate()
        yield database
        if (file := settings().erasures_file) is not None:
            from skills.library.operation.erasure_list import keep_up_erasures

            keep_up_erasures(database, file)


def _with_surgeons(about: "Key") -> dict[str, object]:  # a row of a table
    surgeons = "all" if about.surgeons is None else ", ".join(about.surgeons) or "none any more"
    return about.model_dump(mode="json") | {"surgeons": surgeons}
