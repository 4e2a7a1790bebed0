"""What an erasure leaves: intervals of recordings that others are in too, and the numbers of erased versions."""

import sqlalchemy as sa
from alembic import op

from skills.migrations.noting import note_changes

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLES = INTERVALS, NUMBERS = "erased_intervals", "used_numbers"


def upgrade() -> None:
    op.create_table(
        INTERVALS,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=True),
        sa.Column("start_s", sa.Double(), nullable=True),
        sa.Column("end_s", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_erased_intervals_recording_row", ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_erased_intervals_surgeon_row"),
        sa.PrimaryKeyConstraint("row", name="pk_erased_intervals"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_erased_intervals_recording_row", INTERVALS, ["recording_row"])
    op.create_index("ix_erased_intervals_surgeon_row", INTERVALS, ["surgeon_row"])
    op.create_table(
        NUMBERS,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.Column("suture", sa.String(length=64), nullable=False),
        sa.Column("last", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surgeon_row"], ["surgeons.row"], name="fk_used_numbers_surgeon_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_used_numbers"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_used_numbers_surgeon_row", NUMBERS, ["surgeon_row"])
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    refuse = "BEGIN SELECT RAISE(ABORT, '{0} is append-only'); END"
    does = refuse if on_sqlite else "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
    for table in TABLES:
        op.execute(f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} {does.format(table)}")
        note_changes(table, ("row",))


def downgrade() -> None:
    """Forget both: the older version exports what the erased surgeons refused, and uses their numbers again."""
    for table in TABLES:
        op.drop_table(table)
        if op.get_bind().dialect.name != "sqlite":
            op.execute(f"DROP FUNCTION skills_note_{table}()")
