"""Pose styles of policy versions: the poses of their demonstrations' hands, and the certificate of the tube."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    op.create_table(
        "pose_styles",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("poses", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_pose_styles_policy_row"),
        sa.PrimaryKeyConstraint("row", name="pk_pose_styles"),
        sa.UniqueConstraint("policy_row", name="uq_pose_styles_policy_row"),
        sqlite_autoincrement=True,
    )
    if op.get_bind().dialect.name == "sqlite":
        op.execute(
            "CREATE TRIGGER pose_styles_append_only BEFORE UPDATE ON pose_styles "
            "BEGIN SELECT RAISE(ABORT, 'pose_styles is append-only'); END"
        )
    else:
        op.execute(
            "CREATE TRIGGER pose_styles_append_only BEFORE UPDATE ON pose_styles "
            "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
        )


def downgrade() -> None:
    """Drop them, because the older version could not erase them; a training with another seed makes new ones."""
    op.drop_table("pose_styles")
