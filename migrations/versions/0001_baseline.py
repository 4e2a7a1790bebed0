"""The tables, and the triggers that keep them append-only and note each change for the history.

Until 0.3.0 is released this one migration is edited in place, and a database of other sources is refused
(`skills.db.revisions`). Row numbers are never used twice (on SQLite by AUTOINCREMENT): jobs are known to the engine by
theirs.

The notes of changed rows are read before the commit. PostgreSQL keeps them in settings of the transaction, of some
16 kB each, on the connections of the service, which have the setting "skills.noting"; on others, as of `psql`, nothing
is noted.
"""

import sqlalchemy as sa
from alembic import op

from skills.db.revisions import baseline
from skills.migrations.noting import note_changes

revision = baseline()
down_revision = None
branch_labels = None
depends_on = None

ROW = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
MOMENT = sa.DateTime(timezone=True)

FROZEN = (  # no row changes
    "calibrations",
    "dataset_chunks",
    "dataset_demonstrations",
    "datasets",
    "demonstration_outcomes",
    "erased_intervals",
    "erasures",
    "events",
    "history_checkpoints",
    "history_tiles",
    "plans",
    "playback_pictures",
    "playbacks",
    "policy_demonstrations",
    "policy_versions",
    "pose_styles",
    "proposal_marks",
    "recording_chunks",
    "recordings",
    "reward_maps",
    "used_numbers",
)
WITHDRAWABLE = ("demonstrations", "releases")  # no row changes, save that it is withdrawn, once
NEVER_DELETED = ("history", "history_checkpoints", "history_tiles")
NOTED = {  # by logged table, its key, and the columns that may change: a note names those that a change has changed
    "calibrations": (("row",), ""),
    "erasures": (("row",), ""),
    "events": (("row",), ""),
    "keys": (("row",), "row id digest owner role restricted created_by expires_at revoked_at created_at"),
    "recordings": (("row",), ""),
    "surgeons": (("row",), "row slug subject skill_level handedness protocol consent created_at"),
    "suture_types": (("slug",), "slug name also_called family description"),
    "demonstrations": (("row",), "withdrawn_at"),
    "erased_intervals": (("row",), ""),
    "jobs": (
        ("row",),
        "row id kind identity state request result error surgeon_row plan requested_by ended_at created_at",
    ),
    "key_surgeons": (("key_row", "surgeon_row"), "key_row surgeon_row"),
    "parsed_recordings": (("recording_row",), "recording_row version reading sha256"),
    "proposal_marks": (("row",), ""),
    "recording_surgeons": (("recording_row", "surgeon_row"), "recording_row surgeon_row"),
    "recording_uploads": (("recording_row", "actor"), "recording_row actor"),
    "sign_ins": (("digest",), "digest key_row created_at"),
    "used_numbers": (("row",), ""),
    "dataset_demonstrations": (("job_row", "demonstration_row"), ""),
    "datasets": (("row",), ""),
    "demonstration_outcomes": (("row",), ""),
    "measured_shapes": (("demonstration_row",), "demonstration_row version measured"),
    "policy_versions": (("row",), ""),
    "reward_maps": (("row",), ""),
    "plans": (("row",), ""),
    "policy_demonstrations": (("policy_row", "demonstration_row"), ""),
    "pose_styles": (("row",), ""),
    "releases": (("row",), "withdrawn_at"),
    "playbacks": (("row",), ""),
    "playback_pictures": (("row",), ""),
}
PARTLY_LOGGED = ("jobs", "sign_ins")  # a change of their other columns is not noted
SEALED = ("row", "table_name", "entry", "seal")  # columns of the history that never change


def upgrade() -> None:
    op.create_table(
        "calibrations",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("about", sa.JSON(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_calibrations"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "erased_surgeons",
        sa.Column("surgeon_row", ROW, autoincrement=False, nullable=False),
        sa.PrimaryKeyConstraint("surgeon_row", name="pk_erased_surgeons"),
    )
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
    op.create_index("ix_events_subject", "events", ["subject"])
    op.create_table(
        "executors",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("beat_at", MOMENT, nullable=False),
        sa.Column("verified_at", MOMENT, nullable=True),
        sa.Column("faults_found", sa.Integer(), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_executors"),
    )
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
    op.create_index("ix_history_key", "history", ["table_name", "key", "row"])
    op.create_index(
        "ix_history_unsigned",
        "history",
        ["row"],
        sqlite_where=sa.text("number IS NULL"),
        postgresql_where=sa.text("number IS NULL"),
    )
    op.create_table(
        "history_checkpoints",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("note", sa.String(length=1000), nullable=False),
        sa.Column("subtrees", sa.LargeBinary(), nullable=False),
        sa.Column("signed_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("row", name="pk_history_checkpoints"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_history_checkpoints_size", "history_checkpoints", ["size"])
    op.create_table(
        "history_tiles",
        sa.Column("level", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("root", sa.LargeBinary(), nullable=False),
        sa.Column("hashes", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("level", "number", name="pk_history_tiles"),
    )
    op.create_table(
        "keys",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("owner", sa.String(length=64), nullable=False),
        sa.Column("role", sa.String(length=10), nullable=False),
        sa.Column("restricted", sa.Boolean(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("created_by", sa.String(length=200), nullable=False),
        sa.Column("expires_at", MOMENT, nullable=True),
        sa.Column("revoked_at", MOMENT, nullable=True),
        sa.CheckConstraint("role IN ('reader', 'uploader', 'trainer', 'releaser', 'admin')", name=op.f("ck_keys_role")),
        sa.PrimaryKeyConstraint("row", name="pk_keys"),
        sa.UniqueConstraint("id", name="uq_keys_id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "loose_chunks",
        sa.Column("recording_row", ROW, autoincrement=False, nullable=False),
        sa.Column("due_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("recording_row", name="pk_loose_chunks"),
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
        sa.Column("hysteresis", sa.Double(), nullable=False),
        sa.Column("demo", sa.LargeBinary(), nullable=False),
        sa.Column("path", sa.LargeBinary(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("segment", sa.JSON(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("withdrawn_at", MOMENT, nullable=True),
        sa.ForeignKeyConstraint(["recording_row"], ["recordings.row"], name="fk_demonstrations_recording_row"),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_demonstrations_surgeon_row"),
        sa.ForeignKeyConstraint(["suture"], ["suture_types.slug"], name="fk_demonstrations_suture"),
        sa.PrimaryKeyConstraint("row", name="pk_demonstrations"),
        sa.UniqueConstraint("sha256", name="uq_demonstrations_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_demonstrations_recording_row", "demonstrations", ["recording_row"])
    op.create_index("ix_demonstrations_style", "demonstrations", ["surgeon_row", "suture", "row"])
    op.create_index("ix_demonstrations_surgeon", "demonstrations", ["surgeon_row", "row"])
    op.create_index("ix_demonstrations_suture", "demonstrations", ["suture", "row"])
    op.create_index(
        "ix_demonstrations_withdrawn",
        "demonstrations",
        ["row"],
        sqlite_where=sa.text("withdrawn_at IS NOT NULL"),
        postgresql_where=sa.text("withdrawn_at IS NOT NULL"),
    )
    op.create_table(
        "erased_intervals",
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
    op.create_index("ix_erased_intervals_recording_row", "erased_intervals", ["recording_row"])
    op.create_index("ix_erased_intervals_surgeon_row", "erased_intervals", ["surgeon_row"])
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
        sa.Column("plan", sa.String(length=64), nullable=True),
        sa.Column("requested_by", sa.String(length=200), nullable=False),
        sa.Column("submitted_at", MOMENT, nullable=True),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("started_at", MOMENT, nullable=True),
        sa.Column("ended_at", MOMENT, nullable=True),
        sa.CheckConstraint(
            "state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name=op.f("ck_jobs_state")
        ),
        sa.CheckConstraint("progress >= 0 AND progress <= 1", name=op.f("ck_jobs_progress")),
        sa.PrimaryKeyConstraint("row", name="pk_jobs"),
        sa.UniqueConstraint("id", name="uq_jobs_id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_jobs_ended",
        "jobs",
        ["ended_at"],
        sqlite_where=sa.text("ended_at IS NOT NULL"),
        postgresql_where=sa.text("ended_at IS NOT NULL"),
    )
    op.create_index("ix_jobs_identity", "jobs", ["identity", "row"])
    op.create_index("ix_jobs_kind_row", "jobs", ["kind", "row"])
    op.create_index("ix_jobs_kind_state", "jobs", ["kind", "state", "row"])
    op.create_index("ix_jobs_plan", "jobs", ["plan", "kind", "row"])
    op.create_index("ix_jobs_state", "jobs", ["state", "row"])
    op.create_index("ix_jobs_surgeon_row", "jobs", ["surgeon_row"])
    op.create_index(
        "uq_jobs_identity_live",
        "jobs",
        ["identity"],
        unique=True,
        sqlite_where=sa.text("state IN ('queued', 'running', 'succeeded')"),
        postgresql_where=sa.text("state IN ('queued', 'running', 'succeeded')"),
    )
    op.create_table(
        "key_surgeons",
        sa.Column("key_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(["key_row"], ["keys.row"], name="fk_key_surgeons_key_row"),
        sa.ForeignKeyConstraint(
            ["surgeon_row"], ["surgeons.row"], name="fk_key_surgeons_surgeon_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("key_row", "surgeon_row", name="pk_key_surgeons"),
    )
    op.create_table(
        "parsed_recordings",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("reading", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_parsed_recordings_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("recording_row", name="pk_parsed_recordings"),
    )
    op.create_table(
        "proposal_marks",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=200), nullable=False),
        sa.Column("note", sa.String(length=200), nullable=True),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.CheckConstraint("state IN ('open', 'rejected')", name=op.f("ck_proposal_marks_state")),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_proposal_marks_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_proposal_marks"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_proposal_marks_newest", "proposal_marks", ["recording_row", "number", "row"])
    op.create_table(
        "recording_chunks",
        sa.Column("recording", ROW, autoincrement=False, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("recording", "number", name="pk_recording_chunks"),
    )
    op.create_table(
        "recording_surgeons",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("surgeon_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_recording_surgeons_recording_row", ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["surgeon_row"], ["surgeons.row"], name="fk_recording_surgeons_surgeon_row"),
        sa.PrimaryKeyConstraint("recording_row", "surgeon_row", name="pk_recording_surgeons"),
    )
    op.create_index("ix_recording_surgeons_surgeon_row", "recording_surgeons", ["surgeon_row"])
    op.create_table(
        "recording_uploads",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"], ["recordings.row"], name="fk_recording_uploads_recording_row", ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("recording_row", "actor", name="pk_recording_uploads"),
    )
    op.create_table(
        "sign_ins",
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("key_row", ROW, nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("used_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["key_row"], ["keys.row"], name="fk_sign_ins_key_row"),
        sa.PrimaryKeyConstraint("digest", name="pk_sign_ins"),
    )
    op.create_table(
        "used_numbers",
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
    op.create_index("ix_used_numbers_surgeon_row", "used_numbers", ["surgeon_row"])
    op.create_table(
        "dataset_demonstrations",
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("split", sa.String(length=10), nullable=False),
        sa.Column("whole", sa.Boolean(), nullable=False),
        sa.CheckConstraint(
            "split IN ('train', 'val', 'test', 'recovery', 'failure')", name=op.f("ck_dataset_demonstrations_split")
        ),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_dataset_demonstrations_demonstration_row"
        ),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_dataset_demonstrations_job_row"),
        sa.PrimaryKeyConstraint("job_row", "demonstration_row", name="pk_dataset_demonstrations"),
    )
    op.create_index("ix_dataset_demonstrations_demonstration_row", "dataset_demonstrations", ["demonstration_row"])
    op.create_table(
        "datasets",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_datasets_job_row"),
        sa.PrimaryKeyConstraint("row", name="pk_datasets"),
        sa.UniqueConstraint("job_row", name="uq_datasets_job_row"),
        sa.UniqueConstraint("sha256", name="uq_datasets_sha256"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "demonstration_outcomes",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("outcome", sa.String(length=200), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=True),
        sa.Column("actor", sa.String(length=200), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.CheckConstraint(
            "outcome IN ('success', 'recovery', 'failure')", name=op.f("ck_demonstration_outcomes_outcome")
        ),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_demonstration_outcomes_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("row", name="pk_demonstration_outcomes"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_demonstration_outcomes_newest", "demonstration_outcomes", ["demonstration_row", "row"])
    op.create_index("ix_demonstration_outcomes_outcome", "demonstration_outcomes", ["outcome", "demonstration_row"])
    op.create_table(
        "measured_shapes",
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("measured", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_measured_shapes_demonstration_row"
        ),
        sa.PrimaryKeyConstraint("demonstration_row", name="pk_measured_shapes"),
    )
    op.create_table(
        "parsed_chunks",
        sa.Column("recording_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["recording_row"],
            ["parsed_recordings.recording_row"],
            name="fk_parsed_chunks_recording_row",
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("recording_row", "number", name="pk_parsed_chunks"),
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
    op.create_index("ix_policy_versions_demonstration_row", "policy_versions", ["demonstration_row"])
    op.create_index("ix_policy_versions_training", "policy_versions", ["training"])
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
        "dataset_chunks",
        sa.Column("dataset_row", ROW, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["dataset_row"], ["datasets.row"], name="fk_dataset_chunks_dataset_row"),
        sa.PrimaryKeyConstraint("dataset_row", "number", name="pk_dataset_chunks"),
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
    op.create_index("ix_plans_policy_row", "plans", ["policy_row"])
    op.create_table(
        "policy_demonstrations",
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_policy_demonstrations_demonstration_row"
        ),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_policy_demonstrations_policy_row"),
        sa.PrimaryKeyConstraint("policy_row", "demonstration_row", name="pk_policy_demonstrations"),
    )
    op.create_index("ix_policy_demonstrations_demonstration_row", "policy_demonstrations", ["demonstration_row"])
    op.create_table(
        "pose_styles",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("policy_row", ROW, nullable=False),
        sa.Column("poses", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_pose_styles_policy_row"),
        sa.PrimaryKeyConstraint("row", name="pk_pose_styles"),
        sa.UniqueConstraint("policy_row", name="uq_pose_styles_policy_row"),
        sqlite_autoincrement=True,
    )
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
    op.create_index("ix_releases_policy_row", "releases", ["policy_row"])
    op.create_index("ix_releases_style", "releases", ["surgeon_row", "suture", "row"])
    op.create_table(
        "retraining_styles",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("job_row", ROW, nullable=False),
        sa.Column("part_row", ROW, nullable=False),
        sa.Column("demonstration_row", ROW, nullable=False),
        sa.Column("stale", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("tries", sa.Integer(), nullable=False),
        sa.Column("policy_row", ROW, nullable=True),
        sa.Column("reason", sa.String(length=2000), nullable=True),
        sa.Column("comparison", sa.JSON(), nullable=True),
        sa.Column("ended_at", MOMENT, nullable=True),
        sa.CheckConstraint(
            "state IN ('queued', 'done', 'failed', 'cancelled')", name=op.f("ck_retraining_styles_state")
        ),
        sa.ForeignKeyConstraint(
            ["demonstration_row"], ["demonstrations.row"], name="fk_retraining_styles_demonstration_row"
        ),
        sa.ForeignKeyConstraint(["job_row"], ["jobs.row"], name="fk_retraining_styles_job_row"),
        sa.ForeignKeyConstraint(["part_row"], ["jobs.row"], name="fk_retraining_styles_part_row"),
        sa.ForeignKeyConstraint(["policy_row"], ["policy_versions.row"], name="fk_retraining_styles_policy_row"),
        sa.PrimaryKeyConstraint("row", name="pk_retraining_styles"),
        sa.UniqueConstraint("job_row", "demonstration_row", name="uq_retraining_styles_demonstration"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_retraining_styles_demonstration_row", "retraining_styles", ["demonstration_row"])
    op.create_index("ix_retraining_styles_job", "retraining_styles", ["job_row", "row"])
    op.create_index("ix_retraining_styles_part", "retraining_styles", ["part_row", "state"])
    op.create_index("ix_retraining_styles_policy_row", "retraining_styles", ["policy_row"])
    op.create_index("ix_retraining_styles_state", "retraining_styles", ["job_row", "state", "row"])
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
    op.create_index("ix_playbacks_plan_row", "playbacks", ["plan_row"])
    op.create_table(
        "playback_pictures",
        sa.Column("row", ROW, autoincrement=True, nullable=False),
        sa.Column("playback_row", ROW, nullable=False),
        sa.Column("drawn", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.ForeignKeyConstraint(["playback_row"], ["playbacks.row"], name="fk_playback_pictures_playback_row"),
        sa.PrimaryKeyConstraint("row", name="pk_playback_pictures"),
        sa.UniqueConstraint("playback_row", name="uq_playback_pictures_playback_row"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_playback_pictures_created_at", "playback_pictures", ["created_at"])

    if op.get_bind().dialect.name == "sqlite":
        op.execute("CREATE TABLE history_notes (table_name TEXT, change TEXT, key TEXT, changed TEXT)")
        _guard_on_sqlite()
    else:
        _make_functions()
        _guard_on_postgresql()
    for table, (keys, changing) in NOTED.items():
        note_changes(table, keys, changing, changing if table in PARTLY_LOGGED else "")


def _guard_on_sqlite() -> None:
    columns = {table: [str(c["name"]) for c in sa.inspect(op.get_bind()).get_columns(table)] for table in WITHDRAWABLE}
    guarded = {table: [name for name in names if name != "withdrawn_at"] for table, names in columns.items()}
    for table in FROZEN:
        _refuse_on_sqlite(f"{table}_append_only", "UPDATE", table)
    for table, names in (guarded | {"history": SEALED}).items():
        _refuse_on_sqlite(f"{table}_append_only", f"UPDATE OF {', '.join(names)}", table)
    for table in WITHDRAWABLE:
        once = "WHEN OLD.withdrawn_at IS NOT NULL"
        _refuse_on_sqlite(f"{table}_withdrawn_once", "UPDATE OF withdrawn_at", table, once)
    for table in NEVER_DELETED:
        _refuse_on_sqlite(f"{table}_kept", "DELETE", table)


def _refuse_on_sqlite(trigger: str, statement: str, table: str, when: str = "") -> None:
    op.execute(
        f"CREATE TRIGGER {trigger} BEFORE {statement} ON {table} {when} "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
    )


def _guard_on_postgresql() -> None:
    for table in FROZEN:
        _refuse_on_postgresql(f"{table}_append_only", "UPDATE", table)
    for table in WITHDRAWABLE:
        _refuse_on_postgresql(f"{table}_append_only", "UPDATE", table, "skills_withdraw_only")
    _refuse_on_postgresql("history_append_only", f"UPDATE OF {', '.join(SEALED)}", "history")
    for table in NEVER_DELETED:
        _refuse_on_postgresql(f"{table}_kept", "DELETE", table)


def _refuse_on_postgresql(trigger: str, statement: str, table: str, function: str = "skills_append_only") -> None:
    op.execute(f"CREATE TRIGGER {trigger} BEFORE {statement} ON {table} FOR EACH ROW EXECUTE FUNCTION {function}()")


def _make_functions() -> None:
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
    op.execute(
        "CREATE FUNCTION skills_note(noted json) RETURNS void LANGUAGE plpgsql AS $$ "
        "DECLARE part text := current_setting('skills.noting'); "
        "so_far text := current_setting('skills.notes' || part, true); BEGIN "
        "IF octet_length(so_far) > 16000 THEN "
        "part := part::int + 1; so_far := ''; PERFORM set_config('skills.noting', part, true); "
        "END IF; "
        "PERFORM set_config('skills.notes' || part, concat(so_far, noted, chr(10)), true); END $$"
    )
