"""Decisions on proposed hand-offs: each rejection, and each time that a rejected proposal is opened again."""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLE = "proposal_marks"
CHANGES = (("add", "INSERT", "NEW"), ("change", "UPDATE", "OLD"), ("remove", "DELETE", "OLD"))


def upgrade() -> None:
    op.create_table(
        TABLE,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=200), nullable=False),
        sa.Column("note", sa.String(length=200), nullable=True),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint("state IN ('open', 'rejected')", name="ck_proposal_marks_state"),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_proposal_marks_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_proposal_marks"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_proposal_marks_newest", TABLE, ["recording_row", "number", "row"])
    if op.get_bind().dialect.name == "sqlite":
        _on_sqlite()
    else:
        _on_postgresql()


def _on_sqlite() -> None:
    op.execute(
        f"CREATE TRIGGER {TABLE}_append_only BEFORE UPDATE ON {TABLE} "
        f"BEGIN SELECT RAISE(ABORT, '{TABLE} is append-only'); END"
    )
    for change, statement, row in CHANGES:
        op.execute(
            f"CREATE TRIGGER {TABLE}_noted_{change} AFTER {statement} ON {TABLE} "  # noqa: S608 - ours
            f"BEGIN INSERT INTO history_notes VALUES ('{TABLE}', '{change}', {row}.row, NULL); END"
        )


def _on_postgresql() -> None:
    op.execute(
        f"CREATE TRIGGER {TABLE}_append_only BEFORE UPDATE ON {TABLE} "
        "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
    )
    op.execute(
        f"CREATE FUNCTION skills_note_{TABLE}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        "IF coalesce(current_setting('skills.noting', true), '') = '' THEN NULL; "
        "ELSIF TG_OP = 'INSERT' THEN "
        "PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'add', NEW.row::text, NULL)); "
        "ELSIF TG_OP = 'DELETE' THEN "
        "PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'remove', OLD.row::text, NULL)); "
        "ELSE "
        "PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'change', OLD.row::text, NULL)); "
        "END IF; RETURN NULL; END $$"
    )
    for change, statement, _ in CHANGES:
        op.execute(
            f"CREATE TRIGGER {TABLE}_noted_{change} AFTER {statement} ON {TABLE} "
            f"FOR EACH ROW EXECUTE FUNCTION skills_note_{TABLE}()"
        )


def downgrade() -> None:
    """Forget the decisions: rejected proposals are open again."""
    op.drop_table(TABLE)
    if op.get_bind().dialect.name != "sqlite":
        op.execute(f"DROP FUNCTION skills_note_{TABLE}()")
