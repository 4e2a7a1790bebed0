"""The shapes of demonstrations and how far they are apart: what the atlas would otherwise measure again."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "measured_shapes",
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("measured", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_measured_shapes_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("demonstration_row", name="pk_measured_shapes"),
    )


def downgrade() -> None:
    """Drop them: whoever needs them measures them again."""
    op.drop_table("measured_shapes")
