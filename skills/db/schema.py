"""Which revision the tables are at, and the way up to another."""

from functools import cache
from importlib import resources

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from skills.errors import Conflict


def alembic_config() -> Config:
    """Tell Alembic where our migrations are."""
    config = Config()
    config.set_main_option("script_location", str(resources.files("skills") / "migrations"))
    return config


@cache
def revisions() -> tuple[str, ...]:
    """List the revisions that this version knows, the newest first."""
    return tuple(script.revision for script in ScriptDirectory.from_config(alembic_config()).walk_revisions())


def revision_of(connection: Connection) -> str | None:
    """Read the revision that the tables are at; None where there are none."""
    return MigrationContext.configure(connection).get_current_revision()


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
    _refuse_newer(revision_of(connection))
    config = alembic_config()
    config.attributes["connection"] = connection
    command.upgrade(config, to)


def _refuse_newer(current: str | None) -> None:
    if current is not None and current not in revisions():
        raise Conflict("This database was written by a newer version; update the code, nothing was changed.")
