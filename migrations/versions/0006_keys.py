"""Keys, the surgeons that they are restricted to, who is signed in with them; and who sent which recording."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
MOMENT = sa.DateTime(timezone=True)
ROLES = "role IN ('reader', 'uploader', 'trainer', 'releaser', 'admin')"


def upgrade() -> None:
    uploads = op.create_table(
        "recording_uploads",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_recording_uploads_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("recording_row", "actor", name="pk_recording_uploads"),
    )
    assert uploads is not None
    recordings = sa.table("recordings", sa.column("row"), sa.column("sha256"))
    events = sa.table("events", *map(sa.column, ("actor", "action", "object_kind", "object_id")))
    added = (events.c.action == "add") & (events.c.object_kind == "recording")
    sent = sa.select(recordings.c.row, events.c.actor).where(added, events.c.object_id == recordings.c.sha256)
    op.execute(uploads.insert().from_select(["recording_row", "actor"], sent.distinct()))
    op.create_table(
        "keys",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("owner", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=10), nullable=False),
        sa.Column("restricted", sa.Boolean(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("created_by", sa.String(length=200), nullable=False),
        sa.Column("expires_at", MOMENT, nullable=True),
        sa.Column("revoked_at", MOMENT, nullable=True),
        sa.CheckConstraint(ROLES, name="ck_keys_role"),
        sa.PrimaryKeyConstraint("row", name="pk_keys"),
        sa.UniqueConstraint("id", name="uq_keys_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "key_surgeons",
        sa.Column("key_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(["key_row"], ["keys.row"], name="fk_key_surgeons_key_row"),
        sa.ForeignKeyConstraint(
            ["surgeon_row"], ["surgeons.row"], name="fk_key_surgeons_surgeon_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("key_row", "surgeon_row", name="pk_key_surgeons"),
    )
    op.create_table(
        "sign_ins",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("key_row", ROW, nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("used_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["key_row"], ["keys.row"], name="fk_sign_ins_key_row"),
        sa.PrimaryKeyConstraint("digest", name="pk_sign_ins"),
    )


def downgrade() -> None:
    """Take keys away: the older version knows none, and listens on loopback only."""
    for table in ("sign_ins", "key_surgeons", "keys", "recording_uploads"):
        op.drop_table(table)
