"""Policies that were learnt from several demonstrations: which ones beside the one that their row names."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "policy_demonstrations",
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_policy_demonstrations_policy_row"),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_policy_demonstrations_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("policy_row", "demonstration_row", name="pk_policy_demonstrations"),
    )
    op.create_index("ix_policy_demonstrations_demonstration_row", "policy_demonstrations", ["demonstration_row"])
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            "CREATE TRIGGER policy_demonstrations_append_only BEFORE UPDATE ON policy_demonstrations "
            "BEGIN SELECT RAISE(ABORT, 'policy_demonstrations is append-only'); END"
        )
    else:
        op.execute(
            "CREATE TRIGGER policy_demonstrations_append_only BEFORE UPDATE ON policy_demonstrations "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )


def downgrade() -> None:
    """Forget the others: the older version would take such a policy for one that was learnt from one demonstration.

    Its `skills verify` then says so, and a demonstration that was withdrawn would leave it released. So it is not done
    while there are any.
    """
    if op.get_bind().execute(sa.text("SELECT count(*) FROM policy_demonstrations")).scalar():
        raise RuntimeError("Policies rest on several demonstrations, which the older version does not know; keep this.")
    op.drop_table("policy_demonstrations")
