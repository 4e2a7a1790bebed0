"""What an erasure leaves: intervals of recordings that others are in too, and the numbers of erased versions."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TABLES = INTERVALS, NUMBERS = "erased_intervals", "used_numbers"
CHANGES = (("add", "INSERT", "NEW"), ("change", "UPDATE", "OLD"), ("remove", "DELETE", "OLD"))


def upgrade() -> None:
    op.create_table(
        INTERVALS,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=True),
        sa.Column("start_s", sa.Double(), nullable=True),
        sa.Column("end_s", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_erased_intervals_recording_row", ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_erased_intervals_surgeon_row"),
        sa.PrimaryKeyConstraint("row", name="pk_erased_intervals"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_erased_intervals_recording_row", INTERVALS, ["recording_row"])
    op.create_index("ix_erased_intervals_surgeon_row", INTERVALS, ["surgeon_row"])
    op.create_table(
        NUMBERS,
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.Column("suture", sa.String(length=64), nullable=False),
        sa.Column("last", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["surgeon_row"], ["surgeons.row"], name="fk_used_numbers_surgeon_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_used_numbers"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_used_numbers_surgeon_row", NUMBERS, ["surgeon_row"])
    for table in TABLES:
        if op.get_bind().dialect.name == "sqlite":
            _on_sqlite(table)
        else:
            _on_postgresql(table)


def _on_sqlite(table: str) -> None:
    op.execute(
        f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
    )
    for change, statement, row in CHANGES:
        op.execute(
            f"CREATE TRIGGER {table}_noted_{change} AFTER {statement} ON {table} "  # noqa: S608 - ours
            f"BEGIN INSERT INTO history_notes VALUES ('{table}', '{change}', {row}.row, NULL); END"
        )


def _on_postgresql(table: str) -> None:
    op.execute(
        f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
    )
    op.execute(
        f"CREATE FUNCTION skills_note_{table}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
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
            f"CREATE TRIGGER {table}_noted_{change} AFTER {statement} ON {table} "
            f"FOR EACH ROW EXECUTE FUNCTION skills_note_{table}()"
        )


def downgrade() -> None:
    """Forget both: the older version exports what the erased surgeons refused, and uses their numbers again."""
    for table in TABLES:
        op.drop_table(table)
        if op.get_bind().dialect.name != "sqlite":
            op.execute(f"DROP FUNCTION skills_note_{table}()")
