"""What became of demonstrations: success, recovery or failure, each mark with its reason; the newest one counts."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "demonstration_outcomes",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("outcome", sa.String(length=200), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=True),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint("outcome IN ('success', 'recovery', 'failure')", name="ck_demonstration_outcomes_outcome"),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_demonstration_outcomes_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_demonstration_outcomes"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_demonstration_outcomes_newest", "demonstration_outcomes", ["demonstration_row", "row"])
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            "CREATE TRIGGER demonstration_outcomes_append_only BEFORE UPDATE ON demonstration_outcomes "
            "BEGIN SELECT RAISE(ABORT, 'demonstration_outcomes is append-only'); END"
        )
    else:
        op.execute(
            "CREATE TRIGGER demonstration_outcomes_append_only BEFORE UPDATE ON demonstration_outcomes "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )


def downgrade() -> None:
    """Forget the marks: the older version would learn from failures, so it is not done while there are any."""
    failed = "SELECT count(*) FROM demonstration_outcomes WHERE outcome <> 'success'"
    if op.get_bind().execute(sa.text(failed)).scalar():
        raise RuntimeError("Demonstrations are marked recovery or failure, which the older version would learn from.")
    op.drop_table("demonstration_outcomes")
