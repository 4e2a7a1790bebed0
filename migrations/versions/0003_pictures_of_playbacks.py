"""The pictures of a playback, drawn after its verdict; all older ones have none until somebody asks for them."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "playback_pictures",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("playback_row", ROW, nullable=False),
        sa.Column("drawn", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["playback_row"], ["playbacks.row"], name="fk_playback_pictures_playback_row"),
        sa.PrimaryKeyConstraint("row", name="pk_playback_pictures"),
        sa.UniqueConstraint("playback_row", name="uq_playback_pictures_playback_row"),
        sqlite_autoincrement=True,
    )
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            "CREATE TRIGGER playback_pictures_append_only BEFORE UPDATE ON playback_pictures "
            "BEGIN SELECT RAISE(ABORT, 'playback_pictures is append-only'); END"
        )
    else:
        op.execute(
            "CREATE TRIGGER playback_pictures_append_only BEFORE UPDATE ON playback_pictures "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )


def downgrade() -> None:
    op.drop_table("playback_pictures")
