"""The tables of the service's own state: jobs with their datasets, workers, keys and sign-ins, and the audit log.

An event of the audit log has an actor, an action, an object and a time; surgeons appear only by the random subject of
their row. Events are append-only. Revoked keys are not deleted; a sign-in is deleted when it ends.
"""

import secrets
from collections.abc import Sequence
from datetime import datetime
from typing import Any, cast

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, mapped_column, relationship

from skills.db import AsJson, Base, Dated, Identified, Number, Numbered, Sha256, now, partial_index
from skills.db.models import Demonstration, PolicyVersion, RecordingChunk, StoredRecording, Surgeon
from skills.packing import canonical, sha256
from skills.schemas.operation import JobState
from skills.schemas.training import StoredComparison
from skills.settings import Role

LONGEST_REASON = 2000  # characters


class Job(Dated):
    """A request for work.

    `identity` is the digest of its resolved inputs: there is at most one active or succeeded job of an identity.
    `plan` is the digest of the plan that a playback or pictures belong to. `attempt` is the number of the current
    attempt; its workflow is named "<row>-<attempt>". `submitted_at` is the time at which the attempt was enqueued in
    the engine; of a batch, the time since which all its styles have rows. The surgeon is no foreign key: an erased
    surgeon's jobs are deleted in steps, after the surgeon.
    """

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(sa.String(32), unique=True)
    kind: Mapped[str] = mapped_column(sa.String(20))
    identity: Mapped[str] = mapped_column(Sha256)
    state: Mapped[JobState] = mapped_column(sa.String(10), default="queued")
    progress: Mapped[float] = mapped_column(default=0.0)
    request: Mapped[dict[str, Any]]
    result: Mapped[dict[str, Any] | None]
    error: Mapped[str | None] = mapped_column(sa.String(LONGEST_REASON))
    attempt: Mapped[int] = mapped_column(default=1)
    surgeon_row: Mapped[Number | None] = mapped_column(index=True)
    plan: Mapped[str | None] = mapped_column(Sha256)
    requested_by: Mapped[str] = mapped_column(default="local")
    submitted_at: Mapped[datetime | None]
    started_at: Mapped[datetime | None]
    ended_at: Mapped[datetime | None]

    __table_args__ = (
        sa.CheckConstraint("state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name="state"),
        sa.CheckConstraint("progress >= 0 AND progress <= 1", name="progress"),
        sa.Index("ix_jobs_identity", "identity", "row"),
        sa.Index("ix_jobs_state", "state", "row"),
        sa.Index("ix_jobs_kind_row", "kind", "row"),
        sa.Index("ix_jobs_kind_state", "kind", "state", "row"),  # also for the counts at every metrics scrape
        sa.Index("ix_jobs_plan", "plan", "kind", "row"),
        # for the retention: the others have not ended
        partial_index("ix_jobs_ended", "ended_at", where="ended_at IS NOT NULL"),
        # so that failed and cancelled jobs can be requested again
        partial_index(
            "uq_jobs_identity_live", "identity", where="state IN ('queued', 'running', 'succeeded')", unique=True
        ),
    )


class ErasedSurgeon(Base):
    """A surgeon who was erased, and whose ended jobs are not deleted yet: until then they are hidden."""

    __tablename__ = "erased_surgeons"

    surgeon_row: Mapped[Number] = mapped_column(primary_key=True, autoincrement=False)


class StyleToRetrain(Numbered):
    """One style of a batch: its demonstration, its part of the batch, and its outcome.

    `tries` counts how often a worker has started it, `stale` holds the reasons why it needed training, and `comparison`
    compares the new policy version with the released one.
    """

    __tablename__ = "retraining_styles"

    job_row: Mapped[int] = mapped_column(sa.ForeignKey("jobs.row"))
    part_row: Mapped[int] = mapped_column(sa.ForeignKey("jobs.row"))
    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), index=True)
    stale: Mapped[list[Any]]
    state: Mapped[str] = mapped_column(sa.String(10), default="queued")
    tries: Mapped[int] = mapped_column(default=0)
    policy_row: Mapped[int | None] = mapped_column(sa.ForeignKey("policy_versions.row"), index=True)
    reason: Mapped[str | None] = mapped_column(sa.String(LONGEST_REASON))
    comparison: Mapped[StoredComparison | None] = mapped_column(AsJson(StoredComparison))
    ended_at: Mapped[datetime | None]

    demonstration: Mapped[Demonstration] = relationship(lazy="joined", innerjoin=True)
    policy: Mapped[PolicyVersion | None] = relationship(lazy="selectin")  # with a join SQLite would read all rows
    __table_args__ = (
        sa.CheckConstraint("state IN ('queued', 'done', 'failed', 'cancelled')", name="state"),
        sa.UniqueConstraint("job_row", "demonstration_row", name="uq_retraining_styles_demonstration"),
        sa.Index("ix_retraining_styles_job", "job_row", "row"),
        sa.Index("ix_retraining_styles_state", "job_row", "state", "row"),
        sa.Index("ix_retraining_styles_part", "part_row", "state"),
    )


class DatasetDemonstration(Base):
    """One demonstration of an export, from its request on: it belongs to the job, and to the dataset that this makes.

    `whole`: its entire recording is exported, and not its interval alone.
    """

    __tablename__ = "dataset_demonstrations"

    job_row: Mapped[int] = mapped_column(sa.ForeignKey("jobs.row"), primary_key=True)
    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), primary_key=True, index=True)
    split: Mapped[str] = mapped_column(sa.String(10))
    whole: Mapped[bool]

    __table_args__ = (sa.CheckConstraint("split IN ('train', 'val', 'test', 'recovery', 'failure')", name="split"),)


class StoredDataset(Identified):
    """An exported dataset, identified by the SHA-256 of its zip file."""

    __tablename__ = "datasets"
    media_type = "application/zip"

    job_row: Mapped[int] = mapped_column(sa.ForeignKey("jobs.row"), unique=True)
    size_bytes: Mapped[int] = mapped_column(sa.BigInteger)


class DatasetChunk(Base):
    """A chunk of 1 MiB of a dataset."""

    __tablename__ = "dataset_chunks"

    dataset_row: Mapped[int] = mapped_column(sa.ForeignKey("datasets.row"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    data: Mapped[bytes] = mapped_column(sa.LargeBinary)


class Executor(Base):
    """A worker process and its last heartbeat; an `id` is never reused.

    `faults_found` are those of its last verification of the history, which ended at `verified_at`.
    """

    __tablename__ = "executors"

    id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    beat_at: Mapped[datetime] = mapped_column(default=now)
    verified_at: Mapped[datetime | None]
    faults_found: Mapped[int | None]


class Key(Dated):
    """An API key of a person or a program: the digest of its secret, which is not stored itself, and its permissions.

    `id` is the public part of the key. `restricted` limits a key to its surgeons even when all of them are erased.
    """

    __tablename__ = "keys"

    id: Mapped[str] = mapped_column(sa.String(16), unique=True)
    digest: Mapped[str] = mapped_column(Sha256)
    owner: Mapped[str] = mapped_column(sa.String(64))
    role: Mapped[Role] = mapped_column(sa.String(10))
    restricted: Mapped[bool]
    created_by: Mapped[str]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]

    surgeons: Mapped[list[Surgeon]] = relationship(secondary="key_surgeons", lazy="selectin", order_by=Surgeon.slug)
    __table_args__ = (
        sa.CheckConstraint("role IN ('reader', 'uploader', 'trainer', 'releaser', 'admin')", name="role"),
    )


class KeySurgeon(Base):
    """A surgeon that a restricted key may see, one of possibly several; deleted with the surgeon."""

    __tablename__ = "key_surgeons"

    key_row: Mapped[int] = mapped_column(sa.ForeignKey("keys.row"), primary_key=True)
    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row", ondelete="CASCADE"), primary_key=True)


class SignIn(Base):
    """A browser session of a key: the digest of the cookie, and the time of its last use."""

    __tablename__ = "sign_ins"

    digest: Mapped[str] = mapped_column(Sha256, primary_key=True)
    key_row: Mapped[int] = mapped_column(sa.ForeignKey("keys.row"))
    created_at: Mapped[datetime] = mapped_column(default=now)
    used_at: Mapped[datetime] = mapped_column(default=now)

    key: Mapped[Key] = relationship(lazy="joined", innerjoin=True)


class Event(Numbered):
    """An audit event: actor, action, object and time; people appear only by their random subject."""

    __tablename__ = "events"

    sha256: Mapped[str] = mapped_column(Sha256, unique=True)
    at: Mapped[datetime] = mapped_column(default=now)
    actor: Mapped[str]
    action: Mapped[str]
    object_kind: Mapped[str]
    object_id: Mapped[str]
    subject: Mapped[str | None] = mapped_column(sa.String(32), index=True)


# Without a foreign key, but in the order in which they are backed up and restored: older schemas have the keys.
for _late, _first in ((Job, Surgeon), (RecordingChunk, StoredRecording)):
    cast(sa.Table, _late.__table__).add_is_dependent_on(cast(sa.Table, _first.__table__))


# ---- the audit log -------------------------------------------------------------------------------------------------


def record_event(
    session: Session, actor: str, action: str, object_kind: str, object_id: str, surgeon: Surgeon | None = None
) -> None:
    """Add an event to the caller's transaction."""
    record_events(session, actor, action, object_kind, [(object_id, surgeon)])


def record_events(
    session: Session, actor: str, action: str, object_kind: str, objects: Sequence[tuple[str, Surgeon | None]]
) -> None:
    """Add one event for each of several objects of one kind, each with its surgeon, to the caller's transaction."""
    at = now()
    events = []
    for object_id, surgeon in objects:
        subject = surgeon.subject if surgeon else None
        # The random part makes the digests of two equal events at one moment different.
        identity = [at.isoformat(), actor, action, object_kind, object_id, subject, secrets.token_hex(8)]
        event = {"at": at, "actor": actor, "action": action, "object_kind": object_kind}
        events.append(event | {"sha256": sha256(canonical(identity)), "object_id": object_id, "subject": subject})
    if events:  # one statement on the bare table for all of them: a batch adds many events at once
        session.execute(sa.insert(cast(sa.Table, Event.__table__)), events)
