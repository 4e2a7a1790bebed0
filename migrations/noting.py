"""The triggers by which a logged table notes its changed rows, for the migrations.

A migration after the baseline that adds a logged column calls `note_changes` for its table again, and names the column
in `ADDED` of `skills.db.logged_rows` with the value that it gives to the rows that there are.
"""

from collections.abc import Sequence

from alembic import op

CHANGES = (("add", "INSERT"), ("change", "UPDATE"), ("remove", "DELETE"))


def note_changes(table: str, keys: Sequence[str], changing: str = "", only: str = "") -> None:
    """Let a table note its changed rows, by its primary key, in place of how it noted them before.

    Args:
        table: The name of the table.
        keys: The columns of its primary key.
        changing: The logged columns that may change: a note names those that a change has changed.
        only: The columns whose update is noted at all; without any, every update is.
    """
    if op.get_bind().dialect.name == "sqlite":
        _on_sqlite(table, keys, changing.split(), only)
    else:
        _on_postgresql(table, keys, changing.split(), only)


def _on_sqlite(table: str, keys: Sequence[str], changing: Sequence[str], only: str) -> None:
    for change, statement in CHANGES:
        row = "NEW" if change == "add" else "OLD"
        key = " || '/' || ".join(f"{row}.{name}" for name in keys)
        names = changing if change == "change" else ()
        changed = " || ".join(f"iif(NEW.{name} IS NOT OLD.{name}, '{name} ', '')" for name in names) or "NULL"
        op.execute(f"DROP TRIGGER IF EXISTS {table}_noted_{change}")
        op.execute(
            f"CREATE TRIGGER {table}_noted_{change} AFTER {_of(statement, only)} ON {table} "  # noqa: S608 - ours
            f"BEGIN INSERT INTO history_notes VALUES ('{table}', '{change}', {key}, {changed}); END"
        )


def _on_postgresql(table: str, keys: Sequence[str], changing: Sequence[str], only: str) -> None:
    new, old = (", ".join(f"{row}.{name}" for name in keys) for row in ("NEW", "OLD"))
    differs = "CASE WHEN NEW.{0}::text IS DISTINCT FROM OLD.{0}::text THEN '{0} ' END"
    changed = ", ".join(differs.format(name) for name in changing) or "NULL"
    op.execute(
        f"CREATE OR REPLACE FUNCTION skills_note_{table}() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        "IF coalesce(current_setting('skills.noting', true), '') = '' THEN NULL; "
        "ELSIF TG_OP = 'INSERT' THEN "
        f"PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'add', concat_ws('/', {new}), NULL)); "
        "ELSIF TG_OP = 'DELETE' THEN "
        f"PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'remove', concat_ws('/', {old}), NULL)); "
        "ELSE "
        f"PERFORM skills_note(json_build_array(TG_TABLE_NAME, 'change', concat_ws('/', {old}), "
        f"concat({changed}))); "
        "END IF; RETURN NULL; END $$"
    )
    for change, statement in CHANGES:
        op.execute(
            f"CREATE OR REPLACE TRIGGER {table}_noted_{change} AFTER {_of(statement, only)} ON {table} "
            f"FOR EACH ROW EXECUTE FUNCTION skills_note_{table}()"
        )


def _of(statement: str, only: str) -> str:
    return f"UPDATE OF {', '.join(only.split())}" if only and statement == "UPDATE" else statement
