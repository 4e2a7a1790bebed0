"""Indexes for every filter of a list; chunks may be stored before their recording, and deleted after it.

An erased surgeon's jobs are deleted in steps, after the surgeon.

On SQLite a foreign key is removed by editing the text of the table, as its documentation describes for constraints
(section 7 of lang_altertable.html), because copying all chunks would take as much disk again as the database has.
"""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
MOMENT = sa.DateTime(timezone=True)
ENDED = sa.text("ended_at IS NOT NULL")
WITHDRAWN = sa.text("withdrawn_at IS NOT NULL")
# name: table, columns, condition
INDEXES = {
    "ix_jobs_kind_row": ("jobs", ["kind", "row"], None),
    "ix_jobs_kind_state": ("jobs", ["kind", "state", "row"], None),
    "ix_jobs_plan": ("jobs", ["plan", "kind", "row"], None),
    "ix_jobs_ended": ("jobs", ["ended_at"], ENDED),
    "ix_demonstrations_withdrawn": ("demonstrations", ["row"], WITHDRAWN),
    "ix_demonstration_outcomes_outcome": ("demonstration_outcomes", ["outcome", "demonstration_row"], None),
    "ix_playback_pictures_created_at": ("playback_pictures", ["created_at"], None),
}
# table, name of the foreign key, column, the table that it refers to, and what stands before it
LOOSENED = (
    ("recording_chunks", "fk_recording_chunks_recording", "recording", "recordings", "PRIMARY KEY (recording, number)"),
    ("jobs", "fk_jobs_surgeon_row", "surgeon_row", "surgeons", "CHECK (progress >= 0 AND progress <= 1)"),
)


def upgrade() -> None:
    op.create_table(
        "loose_chunks",
        sa.Column("recording_row", ROW, autoincrement=False, nullable=False),
        sa.Column("due_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("recording_row", name="pk_loose_chunks"),
    )
    op.create_table(
        "erased_surgeons",
        sa.Column("surgeon_row", ROW, autoincrement=False, nullable=False),
        sa.PrimaryKeyConstraint("surgeon_row", name="pk_erased_surgeons"),
    )
    op.add_column("jobs", sa.Column("plan", sa.String(length=64), nullable=True))
    connection = op.get_bind()
    asked = "json_extract(request, '$.plan')" if connection.dialect.name == "sqlite" else "request ->> 'plan'"
    connection.execute(sa.text(f"UPDATE jobs SET plan = {asked} WHERE kind IN ('playback', 'pictures')"))  # noqa: S608
    active = "kind = 'retraining' AND state IN ('queued', 'running')"  # all their styles have rows
    connection.execute(sa.text(f"UPDATE jobs SET told_at = created_at WHERE {active}"))  # noqa: S608
    op.drop_index("ix_jobs_kind", "jobs")
    for name, (table, columns, where) in INDEXES.items():
        op.create_index(name, table, columns, sqlite_where=where, postgresql_where=where)
    for table, name, column, parent, _ in LOOSENED:
        key = f'CONSTRAINT {name} FOREIGN KEY({column}) REFERENCES {parent} ("row")'
        if connection.dialect.name == "sqlite":
            _edit(connection, table, f", \n\t{key}", "")
        else:
            op.drop_constraint(name, table, type_="foreignkey")


def downgrade() -> None:
    connection = op.get_bind()
    # An older version knows neither: what is loose is deleted now, in one transaction.
    op.execute("DELETE FROM recording_chunks WHERE recording NOT IN (SELECT row FROM recordings)")
    op.execute("DELETE FROM jobs WHERE surgeon_row IS NOT NULL AND surgeon_row NOT IN (SELECT row FROM surgeons)")
    for table, name, column, parent, before in LOOSENED:
        key = f'CONSTRAINT {name} FOREIGN KEY({column}) REFERENCES {parent} ("row")'
        if connection.dialect.name == "sqlite":
            _edit(connection, table, before, f"{before}, \n\t{key}")
        else:
            op.create_foreign_key(name, table, parent, [column], ["row"])
    for name, (table, _, _) in INDEXES.items():
        op.drop_index(name, table)
    op.create_index("ix_jobs_kind", "jobs", ["kind", "state"])
    op.drop_column("jobs", "plan")
    op.drop_table("erased_surgeons")
    op.drop_table("loose_chunks")


def _edit(connection: sa.Connection, table: str, text: str, by: str) -> None:
    """Replace a part of the statement by which SQLite knows a table, and let all connections read it again."""
    found = connection.scalar(sa.text("SELECT sql FROM sqlite_master WHERE name = :table"), {"table": table})
    assert found is not None and found.count(text) == 1, found
    version = connection.scalar(sa.text("PRAGMA schema_version"))
    connection.exec_driver_sql("PRAGMA writable_schema = ON")
    edited = {"table": table, "sql": found.replace(text, by)}
    connection.execute(sa.text("UPDATE sqlite_master SET sql = :sql WHERE type = 'table' AND name = :table"), edited)
    connection.exec_driver_sql(f"PRAGMA schema_version = {version + 1}")
    connection.exec_driver_sql("PRAGMA writable_schema = RESET")
