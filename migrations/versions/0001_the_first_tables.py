"""The first tables.

Row numbers are never used twice (on SQLite by AUTOINCREMENT): jobs are known to the engine by theirs. What is
append-only is so by triggers: nothing in it can be changed, save that a demonstration or a release is withdrawn, once.
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
MOMENT = sa.DateTime(timezone=True)

FROZEN = (
    "recordings",
    "recording_chunks",
    "reward_maps",
    "policy_versions",
    "plans",
    "playbacks",
    "events",
    "erasures",
)
WITHDRAWABLE = ("demonstrations", "releases")


def upgrade() -> None:
    op.create_table(
        "erasures",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("salt", sa.String(length=64), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("erased_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_erasures"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "events",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("at", MOMENT, nullable=False),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("action", sa.String(length=200), nullable=False),
        sa.Column("object_kind", sa.String(length=200), nullable=False),
        sa.Column("object_id", sa.String(length=200), nullable=False),
        sa.Column("subject", sa.String(length=32), nullable=True),
        sa.PrimaryKeyConstraint("row", name="pk_events"),
        sa.UniqueConstraint("sha256", name="uq_events_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_subject", "events", ["subject"], unique=False)

    op.create_table(
        "executors",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("beat_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_executors"),
    )
    op.create_table(
        "recordings",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("media_type", sa.String(length=200), nullable=False),
        sa.Column("format", sa.String(length=200), nullable=False),
        sa.Column("integrity", sa.String(length=200), nullable=False),
        sa.Column("reading", sa.JSON(), nullable=False),
        sa.Column("about", sa.JSON(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_recordings"),
        sa.UniqueConstraint("sha256", name="uq_recordings_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "surgeons",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("slug", sa.String(length=64), nullable=False),
        sa.Column("subject", sa.String(length=32), nullable=False),
        sa.Column("skill_level", sa.String(length=200), nullable=True),
        sa.Column("handedness", sa.String(length=200), nullable=True),
        sa.Column("protocol", sa.String(length=200), nullable=True),
        sa.Column("consent", sa.JSON(), nullable=True),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_surgeons"),
        sa.UniqueConstraint("slug", name="uq_surgeons_slug"),
        sa.UniqueConstraint("subject", name="uq_surgeons_subject"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "suture_types",
        sa.Column("slug", sa.String(length=64), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("also_called", sa.JSON(), nullable=False),
        sa.Column("family", sa.String(length=200), nullable=False),
        sa.Column("description", sa.String(length=2000), nullable=False),
        sa.PrimaryKeyConstraint("slug", name="pk_suture_types"),
    )
    op.create_table(
        "demonstrations",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.Column("suture", sa.String(length=64), nullable=False),
        sa.Column("arm", sa.String(length=200), nullable=False),
        sa.Column("topic", sa.String(length=200), nullable=False),
        sa.Column("frame", sa.String(length=200), nullable=False),
        sa.Column("instrument", sa.String(length=200), nullable=False),
        sa.Column("start_s", sa.Double(), nullable=False),
        sa.Column("end_s", sa.Double(), nullable=False),
        sa.Column("session", sa.String(length=200), nullable=True),
        sa.Column("demo", sa.LargeBinary(), nullable=False),
        sa.Column("path", sa.LargeBinary(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("withdrawn_at", MOMENT, nullable=True),
        sa.ForeignKeyConstraint(["recording_row"], ["recordings.row"], name="fk_demonstrations_recording_row"),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_demonstrations_surgeon_row"),
        sa.ForeignKeyConstraint(["suture"], ["suture_types.slug"], name="fk_demonstrations_suture"),
        sa.PrimaryKeyConstraint("row", name="pk_demonstrations"),
        sa.UniqueConstraint("sha256", name="uq_demonstrations_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_demonstrations_recording_row", "demonstrations", ["recording_row"], unique=False)
    op.create_index("ix_demonstrations_style", "demonstrations", ["surgeon_row", "suture", "row"], unique=False)
    op.create_index("ix_demonstrations_suture", "demonstrations", ["suture"], unique=False)

    op.create_table(
        "jobs",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("identity", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.String(length=2000), nullable=True),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("surgeon_row", ROW, nullable=True),
        sa.Column("asked_by", sa.String(length=200), nullable=False),
        sa.Column("told_at", MOMENT, nullable=True),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("started_at", MOMENT, nullable=True),
        sa.Column("ended_at", MOMENT, nullable=True),
        sa.CheckConstraint("state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name="ck_jobs_state"),
        sa.CheckConstraint("progress >= 0 AND progress <= 1", name="ck_jobs_progress"),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_jobs_surgeon_row"),
        sa.PrimaryKeyConstraint("row", name="pk_jobs"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_jobs_state", "jobs", ["state"], unique=False)
    op.create_index("ix_jobs_surgeon_row", "jobs", ["surgeon_row"], unique=False)
    op.create_index(
        "uq_jobs_identity_live",
        "jobs",
        ["identity"],
        unique=True,
        sqlite_where=sa.text("state IN ('queued', 'running', 'succeeded')"),
        postgresql_where=sa.text("state IN ('queued', 'running', 'succeeded')"),
    )

    op.create_table(
        "recording_chunks",
        sa.Column("recording", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["recording"], ["recordings.row"], name="fk_recording_chunks_recording"),
        sa.PrimaryKeyConstraint("recording", "number", name="pk_recording_chunks"),
    )
    op.create_table(
        "policy_versions",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("training", sa.String(length=64), nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.Column("suture", sa.String(length=64), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("manifest", sa.JSON(), nullable=False),
        sa.Column("releasable", sa.Boolean(), nullable=False),
        sa.Column("learnt", sa.LargeBinary(), nullable=False),
        sa.Column("covered", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_policy_versions_demonstration_row"
        ),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_policy_versions_surgeon_row"),
        sa.ForeignKeyConstraint(["suture"], ["suture_types.slug"], name="fk_policy_versions_suture"),
        sa.PrimaryKeyConstraint("row", name="pk_policy_versions"),
        sa.UniqueConstraint("sha256", name="uq_policy_versions_sha256"),
        sa.UniqueConstraint("surgeon_row", "suture", "version", name="uq_policy_versions_version"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_policy_versions_demonstration_row", "policy_versions", ["demonstration_row"], unique=False)
    op.create_index("ix_policy_versions_training", "policy_versions", ["training"], unique=False)

    op.create_table(
        "reward_maps",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("map", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["demonstration_row"], ["demonstrations.row"], name="fk_reward_maps_demonstration_row"),
        sa.PrimaryKeyConstraint("row", name="pk_reward_maps"),
        sa.UniqueConstraint("demonstration_row", name="uq_reward_maps_demonstration_row"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "plans",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("about", sa.JSON(), nullable=False),
        sa.Column("plan", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_plans_policy_row"),
        sa.PrimaryKeyConstraint("row", name="pk_plans"),
        sa.UniqueConstraint("sha256", name="uq_plans_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_plans_policy_row", "plans", ["policy_row"], unique=False)

    op.create_table(
        "releases",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.Column("suture", sa.String(length=64), nullable=False),
        sa.Column("released_at", MOMENT, nullable=False),
        sa.Column("released_by", sa.String(length=200), nullable=False),
        sa.Column("withdrawn_at", MOMENT, nullable=True),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_releases_policy_row"),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_releases_surgeon_row"),
        sa.ForeignKeyConstraint(["suture"], ["suture_types.slug"], name="fk_releases_suture"),
        sa.PrimaryKeyConstraint("row", name="pk_releases"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_releases_policy_row", "releases", ["policy_row"], unique=False)
    op.create_index("ix_releases_style", "releases", ["surgeon_row", "suture", "row"], unique=False)

    op.create_table(
        "playbacks",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("plan_row", ROW, nullable=False),
        sa.Column("feasible", sa.Boolean(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("measured", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["plan_row"], ["plans.row"], name="fk_playbacks_plan_row"),
        sa.PrimaryKeyConstraint("row", name="pk_playbacks"),
        sa.UniqueConstraint("sha256", name="uq_playbacks_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_playbacks_plan_row", "playbacks", ["plan_row"], unique=False)

    if op.get_bind().dialect.name == "sqlite":
        freeze_on_sqlite()
    else:
        freeze_on_postgresql()


def freeze_on_sqlite() -> None:
    for table in FROZEN:
        refuse_on_sqlite(table, "append_only", "UPDATE")
    for table in WITHDRAWABLE:
        columns = [c["name"] for c in sa.inspect(op.get_bind()).get_columns(table) if c["name"] != "withdrawn_at"]
        refuse_on_sqlite(table, "append_only", f"UPDATE OF {', '.join(columns)}")
        refuse_on_sqlite(table, "withdrawn_once", "UPDATE OF withdrawn_at", "WHEN OLD.withdrawn_at IS NOT NULL")


def refuse_on_sqlite(table: str, name: str, what: str, when: str = "") -> None:
    op.execute(
        f"CREATE TRIGGER {table}_{name} BEFORE {what} ON {table} {when} "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
    )


def freeze_on_postgresql() -> None:
    op.execute(
        "CREATE FUNCTION skills_append_only() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION '% is append-only', TG_TABLE_NAME USING ERRCODE = 'integrity_constraint_violation'; "
        "END $$"
    )
    op.execute(
        "CREATE FUNCTION skills_withdraw_only() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
        "IF OLD.withdrawn_at IS NOT NULL OR (to_jsonb(NEW) - 'withdrawn_at') <> (to_jsonb(OLD) - 'withdrawn_at') THEN "
        "RAISE EXCEPTION '% is append-only', TG_TABLE_NAME USING ERRCODE = 'integrity_constraint_violation'; "
        "END IF; RETURN NEW; END $$"
    )
    for tables, function in ((FROZEN, "skills_append_only"), (WITHDRAWABLE, "skills_withdraw_only")):
        for table in tables:
            op.execute(
                f"CREATE TRIGGER {table}_append_only BEFORE UPDATE ON {table} "
                f"FOR EACH ROW EXECUTE FUNCTION {function}()"
            )


def downgrade() -> None:
    for table in (
        "playbacks",
        "releases",
        "plans",
        "reward_maps",
        "policy_versions",
        "recording_chunks",
        "jobs",
        "demonstrations",
        "suture_types",
        "surgeons",
        "recordings",
        "executors",
        "events",
        "erasures",
    ):
        op.drop_table(table)
    if op.get_bind().dialect.name != "sqlite":
        op.execute("DROP FUNCTION skills_append_only()")
        op.execute("DROP FUNCTION skills_withdraw_only()")
