"""The styles of a batch, each with what became of it."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "retraining_styles",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("part_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("stale", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("tries", sa.Integer(), nullable=False),
        sa.Column("policy_row", ROW, nullable=True),
        sa.Column("reason", sa.String(length=2000), nullable=True),
        sa.Column("comparison", sa.JSON(), nullable=True),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("state IN ('queued', 'done', 'failed', 'cancelled')", name="ck_retraining_styles_state"),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_retraining_styles_job_row"),
        sa.ForeignKeyConstraint(["part_row"], ["jobs.row"], name="fk_retraining_styles_part_row"),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_retraining_styles_demonstration_row"
        ),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_retraining_styles_policy_row"),
        sa.PrimaryKeyConstraint("row", name="pk_retraining_styles"),
        sa.UniqueConstraint("job_row", "demonstration_row", name="uq_retraining_styles_demonstration"),
        sqlite_autoincrement=True,
    )
    for name, columns in (
        ("demonstration_row", ["demonstration_row"]),
        ("policy_row", ["policy_row"]),
        ("state", ["job_row", "state"]),
        ("part", ["part_row", "state"]),
    ):
        op.create_index(f"ix_retraining_styles_{name}", "retraining_styles", columns, unique=False)


def downgrade() -> None:
    """Take the table away; batches and their parts that have not ended are nothing that the older version can do."""
    op.execute(
        "UPDATE jobs SET state = 'cancelled', error = 'It was not done when the older version came back.' "
        "WHERE kind IN ('retraining', 'retraining-part') AND state IN ('queued', 'running')"
    )
    op.drop_table("retraining_styles")
