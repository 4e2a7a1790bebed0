"""Whose motion a recording holds, as named at its upload: erasing a surgeon then finds it without a demonstration."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "recording_surgeons",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_recording_surgeons_recording_row", ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_recording_surgeons_surgeon_row"),
        sa.PrimaryKeyConstraint("recording_row", "surgeon_row", name="pk_recording_surgeons"),
    )
    op.create_index("ix_recording_surgeons_surgeon_row", "recording_surgeons", ["surgeon_row"])


def downgrade() -> None:
    """Forget whose they are: the older version erases recordings by their demonstrations alone."""
    op.drop_table("recording_surgeons")
