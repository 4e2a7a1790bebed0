"""The content of recordings as it was read from their bytes: a cache, so that they are not decoded at every use."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "parsed_recordings",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("reading", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_parsed_recordings_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("recording_row", name="pk_parsed_recordings"),
    )
    op.create_table(
        "parsed_chunks",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"],
            ["parsed_recordings.recording_row"],
            name="fk_parsed_chunks_recording_row",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("recording_row", "number", name="pk_parsed_chunks"),
    )


def downgrade() -> None:
    """Drop them: the older version decodes the recordings at every use."""
    op.drop_table("parsed_chunks")
    op.drop_table("parsed_recordings")
