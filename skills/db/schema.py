"""Which revision the tables are at, and the way up to another.

Alembic makes the way, and is loaded for that alone: to see that tables are up to date, as every start does, needs none
of it. A migration is in a file named after its revision, "0001_what_it_does.py", and they follow each other by number.
"""

from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from sqlalchemy import Connection, inspect, text

from skills.errors import Conflict

if TYPE_CHECKING:
    from alembic.config import Config

MIGRATIONS = resources.files("skills") / "migrations"
AT = "alembic_version"  # Alembic's own table of one row


def alembic_config() -> "Config":
    """Tell Alembic where our migrations are."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config


@cache
def revisions() -> tuple[str, ...]:
    """List the revisions that this version knows, the newest first."""
    files = (file.name for file in (MIGRATIONS / "versions").iterdir() if file.name.endswith(".py"))
    return tuple(sorted((name.partition("_")[0] for name in files), reverse=True))


def revision_of(connection: Connection) -> str | None:
    """Read the revision that the tables are at; None where there are none."""
    if not inspect(connection).has_table(AT):
        return None
    revision: str | None = connection.scalar(text(f"SELECT version_num FROM {AT}"))  # noqa: S608 - a name of ours
    return revision


def refuse_other_tables(connection: Connection) -> None:
    """Refuse tables that are not of this version.

    Raises:
        Conflict: They are older, newer, or not there.
    """
    current = revision_of(connection)
    _refuse_newer(current)
    if current != revisions()[0]:
        raise Conflict("The database has no tables of this version yet; run `skills migrate`.")


def upgrade(connection: Connection, to: str = "head") -> None:
    """Bring the tables to a revision, within the caller's transaction.

    Raises:
        Conflict: They are of a newer version of the code.
    """
    current = revision_of(connection)
    _refuse_newer(current)
    if to == "head" and current == revisions()[0]:
        return
    from alembic import command

    config = alembic_config()
    config.attributes["connection"] = connection
    command.upgrade(config, to)


def _refuse_newer(current: str | None) -> None:
    if current is not None and current not in revisions():
        raise Conflict("This database was written by a newer version; update the code, nothing was changed.")
