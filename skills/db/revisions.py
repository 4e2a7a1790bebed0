"""The revision of a database's tables, and the migrations that bring them to this version.

Alembic runs the migrations and is imported only for them: to check that tables are up to date, as every start does,
does not need it. A migration is in a file that begins with its revision, as 0001 does; revisions are ordered by
number.

Until a version is released the baseline migration is edited in place, and values are stored in other forms from one
commit to the next. So the baseline's revision then contains a digest of the package's sources, and a database of any
other sources is refused, untouched.
"""

import hashlib
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, inspect, text

from skills import __version__
from skills.errors import Conflict
from skills.remedies import Action, Remedy

if TYPE_CHECKING:
    from alembic.config import Config

MIGRATIONS = resources.files("skills") / "migrations"
PACKAGE = Path(__file__).parents[1]
AT = "alembic_version"  # Alembic's own table of one row


@cache
def baseline() -> str:
    """Return the revision of the baseline migration: with a digest of the package's Python files before a release."""
    if "dev" not in __version__:
        return "0001"
    folder = Path(str(MIGRATIONS))  # at the top of the repository, behind a link
    sources = {f"migrations/{file.relative_to(folder)}": file for file in folder.rglob("*.py")}
    sources |= {str(file.relative_to(PACKAGE)): file for file in PACKAGE.rglob("*.py")}
    hasher = hashlib.sha256()
    for name, file in sorted(sources.items()):
        hasher.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return f"0001.{hasher.hexdigest()[:12]}"


def alembic_config() -> "Config":
    """Return an Alembic configuration that points to our migrations."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config


@cache
def revisions() -> tuple[str, ...]:
    """Return the revisions that this version knows, newest first."""
    files = sorted(file.name for file in (MIGRATIONS / "versions").iterdir() if file.name.endswith(".py"))
    later = (name.partition("_")[0] for name in files[1:])
    return tuple(sorted((baseline(), *later), reverse=True))


def revision_of(connection: Connection) -> str | None:
    """Return the revision of the tables; None where there are none."""
    if not inspect(connection).has_table(AT):
        return None
    revision: str | None = connection.scalar(text(f"SELECT version_num FROM {AT}"))  # noqa: S608 - a name of ours
    return revision


def refuse_other_tables(connection: Connection) -> None:
    """Refuse a database whose tables are not of this version.

    Raises:
        Conflict: They are of another version, or missing.
    """
    current = revision_of(connection)
    refuse_unknown(current)
    if current != revisions()[0]:
        raise Conflict("The database has no tables of this version yet.", Remedy(Action.MIGRATE))


def upgrade(connection: Connection, to: str = "head") -> None:
    """Migrate the tables to a revision, within the caller's transaction.

    Raises:
        Conflict: They are of a version that this one does not know.
    """
    current = revision_of(connection)
    refuse_unknown(current)
    if to == "head" and current == revisions()[0]:
        return
    from alembic import command  # imported here: it is slow, and rarely needed

    config = alembic_config()
    config.attributes["connection"] = connection
    command.upgrade(config, to)


def refuse_unknown(revision: str | None) -> None:
    """Refuse a database of a version that this one does not know.

    Raises:
        Conflict: It is of a newer version, or of another commit before the release.
    """
    if revision is not None and revision not in revisions():
        raise Conflict(
            f"This database was made by another version of suture-skills (its tables are at {revision}, this version "
            f"needs {revisions()[0]}); nothing was changed.",
            "Use the version that made it; or name another database in SKILLS_DATABASE_URL, add the recordings to it "
            "again, which the version that made it downloads, and state the surgeons' consent anew.",
        )
