"""The history of all changes: its leaves and checkpoints, and the triggers that note which rows a transaction changed.

The notes are read before the commit. PostgreSQL keeps them in settings of the transaction, of some 16 kB each, on the
connections of the service, which have the setting "skills.noting"; on others, as of `psql`, nothing is noted.
"""

import sqlalchemy as sa
from alembic import op

from skills.migrations.noting import CHANGES, note_changes

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
# The key of each logged table.
LOGGED = {
    "surgeons": ("row",),
    "erasures": ("row",),
    "suture_types": ("slug",),
    "recordings": ("row",),
    "recording_uploads": ("recording_row", "actor"),
    "recording_surgeons": ("recording_row", "surgeon_row"),
    "demonstrations": ("row",),
    "demonstration_outcomes": ("row",),
    "reward_maps": ("row",),
    "policy_versions": ("row",),
    "policy_demonstrations": ("policy_row", "demonstration_row"),
    "pose_styles": ("row",),
    "releases": ("row",),
    "plans": ("row",),
    "playbacks": ("row",),
    "playback_pictures": ("row",),
    "calibrations": ("row",),
    "jobs": ("row",),
    "dataset_demonstrations": ("job_row", "demonstration_row"),
    "datasets": ("row",),
    "keys": ("row",),
    "key_surgeons": ("key_row", "surgeon_row"),
    "events": ("row",),
    "measured_shapes": ("demonstration_row",),
    "parsed_recordings": ("recording_row",),
}
# The logged columns of the tables whose rows may change: the notes name those that a change has changed.
CHANGING = {
    "surgeons": "row slug subject skill_level handedness protocol consent created_at",
    "suture_types": "slug name also_called family description",
    "demonstrations": "withdrawn_at",
    "releases": "withdrawn_at",
    "jobs": "row id kind identity state request result error surgeon_row plan asked_by created_at ended_at",
    "keys": "row id digest owner role restricted created_at created_by expires_at revoked_at",
    "measured_shapes": "demonstration_row version measured",
    "parsed_recordings": "recording_row version reading sha256",
    "recording_uploads": "recording_row actor",
    "recording_surgeons": "recording_row surgeon_row",
    "key_surgeons": "key_row surgeon_row",
}
UNCHANGEABLE = "row, table_name, entry, seal"


def upgrade() -> None:
    op.create_table(
        "history",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=True),
        sa.Column("table_name", sa.String(length=64), nullable=False),
        sa.Column("key", sa.String(length=300), nullable=True),
        sa.Column("entry", sa.String(length=1000), nullable=False),
        sa.Column("seal", sa.LargeBinary(), nullable=False),
        sa.Column("salt", sa.LargeBinary(), nullable=True),
        sa.Column("digests", sa.JSON(), nullable=True),
        sa.PrimaryKeyConstraint("row", name="pk_history"),
        sa.UniqueConstraint("number", name="uq_history_number"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_history_key", "history", ["table_name", "key"])
    unsigned = sa.text("number IS NULL")
    op.create_index("ix_history_unsigned", "history", ["row"], sqlite_where=unsigned, postgresql_where=unsigned)
    op.create_table(
        "history_checkpoints",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("note", sa.String(length=1000), nullable=False),
        sa.Column("subtrees", sa.LargeBinary(), nullable=False),
        sa.Column("signed_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_history_checkpoints"),
        sqlite_autoincrement=True,
    )
    if op.get_bind().dialect.name == "sqlite":
        _on_sqlite()
    else:
        _on_postgresql()
    for table, keys in LOGGED.items():
        changing = CHANGING.get(table, "")
        note_changes(table, keys, changing, changing if table == "jobs" else "")  # the progress of jobs is not logged


def _on_sqlite() -> None:
    op.execute("CREATE TABLE history_notes (table_name TEXT, change TEXT, key TEXT, changed TEXT)")
    for table, what in (("history", f"UPDATE OF {UNCHANGEABLE}"), ("history_checkpoints", "UPDATE")):
        for name, statement in (("append_only", what), ("kept", "DELETE")):
            op.execute(
                f"CREATE TRIGGER {table}_{name} BEFORE {statement} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
            )


def _on_postgresql() -> None:
    op.execute(
        "CREATE FUNCTION skills_note(noted json) RETURNS void LANGUAGE plpgsql AS $$ "
        "DECLARE part text := current_setting('skills.noting'); "
        "so_far text := current_setting('skills.notes' || part, true); BEGIN "
        "IF octet_length(so_far) > 16000 THEN "
        "part := part::int + 1; so_far := ''; PERFORM set_config('skills.noting', part, true); "
        "END IF; "
        "PERFORM set_config('skills.notes' || part, concat(so_far, noted, chr(10)), true); END $$"
    )
    for table, what in (("history", f"UPDATE OF {UNCHANGEABLE}"), ("history_checkpoints", "UPDATE")):
        for name, statement in (("append_only", what), ("kept", "DELETE")):
            op.execute(
                f"CREATE TRIGGER {table}_{name} BEFORE {statement} ON {table} "
                "FOR EACH ROW EXECUTE FUNCTION skills_append_only()"
            )


def downgrade() -> None:
    """Drop the history: the older version would not go on with it."""
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    for table in LOGGED:
        for change, _ in CHANGES:
            op.execute(f"DROP TRIGGER {table}_noted_{change}" + ("" if on_sqlite else f" ON {table}"))
        if not on_sqlite:
            op.execute(f"DROP FUNCTION skills_note_{table}()")
    op.drop_table("history_checkpoints")
    op.drop_table("history")
    if not on_sqlite:
        op.execute("DROP FUNCTION skills_note(json)")
    else:
        op.drop_table("history_notes")
