"""Datasets: the demonstrations of each export, and the exported zip in chunks."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLES = ("dataset_demonstrations", "datasets", "dataset_chunks")


def upgrade() -> None:
    op.create_table(
        "dataset_demonstrations",
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("split", sa.String(length=10), nullable=False),
        sa.Column("whole", sa.Boolean(), nullable=False),
        sa.CheckConstraint(
            "split IN ('train', 'val', 'test', 'recovery', 'failure')", name="ck_dataset_demonstrations_split"
        ),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_dataset_demonstrations_job_row"),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_dataset_demonstrations_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("job_row", "demonstration_row", name="pk_dataset_demonstrations"),
    )
    op.create_index("ix_dataset_demonstrations_demonstration_row", "dataset_demonstrations", ["demonstration_row"])
    op.create_table(
        "datasets",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_datasets_job_row"),
        sa.PrimaryKeyConstraint("row", name="pk_datasets"),
        sa.UniqueConstraint("sha256", name="uq_datasets_sha256"),
        sa.UniqueConstraint("job_row", name="uq_datasets_job_row"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "dataset_chunks",
        sa.Column("dataset_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["dataset_row"], ["datasets.row"], name="fk_dataset_chunks_dataset_row"),
        sa.PrimaryKeyConstraint("dataset_row", "number", name="pk_dataset_chunks"),
    )
    for table in TABLES:
        if op.get_bind().dialect.name == "sqlite":
            op.execute(
                f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
            )
        else:
            op.execute(
                f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} "
                "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
            )


def downgrade() -> None:
    """Forget the datasets with their jobs, which the older version could neither perform nor erase."""
    for table in reversed(TABLES):
        op.drop_table(table)
    op.execute("DELETE FROM jobs WHERE kind = 'dataset'")
