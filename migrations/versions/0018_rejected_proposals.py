"""Decisions on proposed hand-offs: each rejection, and each time that a rejected proposal is opened again."""

import sqlalchemy as sa
from alembic import op

from skills.migrations.noting import note_changes

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLE = "proposal_marks"


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
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            f"CREATE TRIGGER {TABLE}_append_only BEFORE UPDATE ON {TABLE} "
            f"BEGIN SELECT RAISE(ABORT, '{TABLE} is append-only'); END"
        )
    else:
        op.execute(
            f"CREATE TRIGGER {TABLE}_append_only BEFORE UPDATE ON {TABLE} "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )
    note_changes(TABLE, ("row",))


def downgrade() -> None:
    """Forget the decisions: rejected proposals are open again."""
    op.drop_table(TABLE)
    if op.get_bind().dialect.name != "sqlite":
        op.execute(f"DROP FUNCTION skills_note_{TABLE}()")
