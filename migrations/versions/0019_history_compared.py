"""An index by which a kept head is found; the history of sign-ins; each worker's last verification of the history."""

import sqlalchemy as sa
from alembic import op

from skills.migrations.noting import CHANGES, note_changes

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

TABLE = "sign_ins"
CHANGED = "digest key_row created_at"  # the time of the last use is not logged


def upgrade() -> None:
    op.create_index("ix_history_checkpoints_size", "history_checkpoints", ["size"])
    op.add_column("executors", sa.Column("verified_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("executors", sa.Column("found", sa.Integer(), nullable=True))
    op.execute(f"DELETE FROM {TABLE}")  # noqa: S608 - ours; none of them is in the history: sign in again
    note_changes(TABLE, ("digest",), CHANGED, CHANGED)


def downgrade() -> None:
    """Remove them: sign-ins are not in the older version's history."""
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    for change, _ in CHANGES:
        op.execute(f"DROP TRIGGER {TABLE}_noted_{change}" + ("" if on_sqlite else f" ON {TABLE}"))
    if not on_sqlite:
        op.execute(f"DROP FUNCTION skills_note_{TABLE}()")
    op.drop_column("executors", "found")
    op.drop_column("executors", "verified_at")
    op.drop_index("ix_history_checkpoints_size", "history_checkpoints")
