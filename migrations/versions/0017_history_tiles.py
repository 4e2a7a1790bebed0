"""The inner hashes of the history's tree in tiles, filled from the leaves after this migration."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "history_tiles",
        sa.Column("level", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("root", sa.LargeBinary(), nullable=False),
        sa.Column("hashes", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("level", "number", name="pk_history_tiles"),
    )
    for name, statement in (("append_only", "UPDATE"), ("kept", "DELETE")):
        if op.get_bind().dialect.name == "sqlite":
            op.execute(
                f"CREATE TRIGGER history_tiles_{name} BEFORE {statement} ON history_tiles "
                "BEGIN SELECT RAISE(ABORT, 'history_tiles is append-only'); END"
            )
        else:
            op.execute(
                f"CREATE TRIGGER history_tiles_{name} BEFORE {statement} ON history_tiles "
                "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
            )


def downgrade() -> None:
    op.drop_table("history_tiles")
