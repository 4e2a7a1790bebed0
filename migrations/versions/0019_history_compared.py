"""An index by which a kept head is found; the history of sign-ins; each worker's last verification of the history."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

TABLE = "sign_ins"
CHANGED = ("digest", "key_row", "created_at")  # the time of the last use is not logged
CHANGES = (("add", "INSERT", "NEW"), ("change", f"UPDATE OF {', '.join(CHANGED)}", "OLD"), ("remove", "DELETE", "OLD"))


def upgrade() -> None:
    op.create_index("ix_history_checkpoints_size", "history_checkpoints", ["size"])
    op.add_column("executors", sa.Column("verified_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("executors", sa.Column("found", sa.Integer(), nullable=True))
    op.execute(f"DELETE FROM {TABLE}")  # noqa: S608 - ours; none of them is in the history: sign in again
    if op.get_bind().dialect.name == "sqlite":
        _on_sqlite()
    else:
        _on_postgresql()


def _on_sqlite() -> None:
    for change, statement, row in CHANGES:
        changed = " || ".join(f"iif(NEW.{name} IS NOT OLD.{name}, '{name} ', '')" for name in CHANGED)
        op.execute(
            f"CREATE TRIGGER {TABLE}_noted_{change} AFTER {statement} ON {TABLE} "  # noqa: S608 - ours
            f"BEGIN INSERT INTO history_notes VALUES ('{TABLE}', '{change}', {row}.digest, "
            f"{changed if change == 'change' else 'NULL'}); END"
        )


def _on_postgresql() -> None:
    differs = "CASE WHEN NEW.{0}::text IS DISTINCT FROM OLD.{0}::text THEN '{0} ' END"
    changed = ", ".join(differs.format(name) for name in CHANGED)
    op.execute(
        f"CREATE FUNCTION skills_note_{TABLE}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        "IF coalesce(current_setting('skills.noting', true), '') = '' THEN NULL; "
        "ELSIF TG_OP = 'INSERT' THEN "
        "PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'add', NEW.digest, NULL)); "
        "ELSIF TG_OP = 'DELETE' THEN "
        "PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'remove', OLD.digest, NULL)); "
        "ELSE "
        f"PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'change', OLD.digest, concat({changed}))); "
        "END IF; RETURN NULL; END $$"
    )
    for change, statement, _ in CHANGES:
        op.execute(
            f"CREATE TRIGGER {TABLE}_noted_{change} AFTER {statement} ON {TABLE} "
            f"FOR EACH ROW EXECUTE FUNCTION skills_note_{TABLE}()"
        )


def downgrade() -> None:
    """Remove them: sign-ins are not in the older version's history."""
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    for change, *_ in CHANGES:
        op.execute(f"DROP TRIGGER {TABLE}_noted_{change}" + ("" if on_sqlite else f" ON {TABLE}"))
    if not on_sqlite:
        op.execute(f"DROP FUNCTION skills_note_{TABLE}()")
    op.drop_column("executors", "found")
    op.drop_column("executors", "verified_at")
    op.drop_index("ix_history_checkpoints_size", "history_checkpoints")
