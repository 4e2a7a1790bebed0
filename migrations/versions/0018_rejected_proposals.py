"""Decisions on proposed hand-offs, and what an erasure leaves: intervals of shared recordings, and used numbers."""

import sqlalchemy as sa
from alembic import op

from skills.migrations.noting import note_changes

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLES = TABLE, INTERVALS, NUMBERS = "proposal_marks", "erased_intervals", "used_numbers"


def upgrade() -> None:
    op.create_table(
        TABLE,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=200), nullable=False),
        sa.Column("note", sa.String(length=200), nullable=True),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint("state IN ('open', 'rejected')", name="ck_proposal_marks_state"),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_proposal_marks_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_proposal_marks"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_proposal_marks_newest", TABLE, ["recording_row", "number", "row"])
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
    """Forget the decisions: rejected proposals are open again."""
    for table in TABLES:
        op.drop_table(table)
        if op.get_bind().dialect.name != "sqlite":
            op.execute(f"DROP FUNCTION skills_note_{table}()")
