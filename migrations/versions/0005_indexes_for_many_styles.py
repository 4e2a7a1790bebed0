"""What is asked of thousands of styles is answered by an index, in the order in which it is asked for."""

from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

NEW = {
    "ix_demonstrations_surgeon": ("demonstrations", ["surgeon_row", "row"]),
    "ix_jobs_identity": ("jobs", ["identity", "row"]),
    "ix_jobs_kind": ("jobs", ["kind", "state"]),
    "ix_retraining_styles_job": ("retraining_styles", ["job_row", "row"]),
}
ORDERED = {
    "ix_demonstrations_suture": ("demonstrations", ["suture"]),
    "ix_jobs_state": ("jobs", ["state"]),
    "ix_retraining_styles_state": ("retraining_styles", ["job_row", "state"]),
}


def upgrade() -> None:
    for name, (table, columns) in NEW.items():
        op.create_index(name, table, columns)
    for name, (table, columns) in ORDERED.items():
        op.drop_index(name, table)
        op.create_index(name, table, [*columns, "row"])


def downgrade() -> None:
    for name, (table, columns) in ORDERED.items():
        op.drop_index(name, table)
        op.create_index(name, table, columns)
    for name, (table, _) in NEW.items():
        op.drop_index(name, table)
