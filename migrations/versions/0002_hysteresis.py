"""The hysteresis that a demonstration was put into its grid with, in cells; all older ones have none."""

from collections.abc import Iterator
from contextlib import contextmanager

import sqlalchemy as sa
from alembic import op

from skills.errors import Conflict

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with guarded_again():
        op.add_column("demonstrations", sa.Column("hysteresis", sa.Double(), nullable=False, server_default="0"))


def downgrade() -> None:
    if op.get_bind().scalar(sa.text("SELECT count(*) FROM demonstrations WHERE hysteresis <> 0")):
        raise Conflict("The older version cannot read demonstrations with hysteresis; erase them first.")
    with guarded_again():
        op.drop_column("demonstrations", "hysteresis")


@contextmanager
def guarded_again() -> Iterator[None]:
    """Change the columns of demonstrations, and forbid to update any that there are then, but for the withdrawal.

    SQLite's trigger names the columns that it guards; PostgreSQL's compares whole rows, and stays.
    """
    if op.get_bind().dialect.name != "sqlite":
        yield
        return
    op.execute("DROP TRIGGER demonstrations_append_only")
    yield
    columns = [c["name"] for c in sa.inspect(op.get_bind()).get_columns("demonstrations")]
    op.execute(
        f"CREATE TRIGGER demonstrations_append_only BEFORE UPDATE OF "
        f"{', '.join(c for c in columns if c != 'withdrawn_at')} ON demonstrations  "
        f"BEGIN SELECT RAISE(ABORT, 'demonstrations is append-only'); END"
    )
