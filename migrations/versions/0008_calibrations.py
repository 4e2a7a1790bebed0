"""Models of skill that a laboratory has calibrated on rated trials of its own."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "calibrations",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("about", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_calibrations"),
        sqlite_autoincrement=True,
    )
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            "CREATE TRIGGER calibrations_append_only BEFORE UPDATE ON calibrations "
            "BEGIN SELECT RAISE(ABORT, 'calibrations is append-only'); END"
        )
    else:
        op.execute(
            "CREATE TRIGGER calibrations_append_only BEFORE UPDATE ON calibrations "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )


def downgrade() -> None:
    op.drop_table("calibrations")
