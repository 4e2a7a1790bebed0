"""The tables of the library.

A row labels a value: it has the value's owner, time and origin, and the value itself serialised in one column.

Append-only (triggers of the migrations refuse changes): recordings with their chunks and the decisions on their
proposals, demonstrations and their outcomes, reward maps, policy versions with their further demonstrations and pose
styles, releases, plans, playbacks and their pictures, calibrations; a demonstration and a release can be withdrawn,
once. Only erasure deletes. The tables of the service's own state are in `skills.db.service_tables`.
"""

from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.ext.hybrid import hybrid_property
from sqlalchemy.orm import Mapped, column_property, mapped_column, relationship

from skills.comparison.distances import Measured
from skills.db import AsJson, Base, Dated, Identified, Number, Numbered, RowId, Sha256, Slug, now, partial_index
from skills.db.packed import Packed, stored
from skills.demonstration.demonstration import Demo
from skills.demonstration.movement import Pause
from skills.demonstration.partner import Partner, PartnerMotion
from skills.gridworld.grid import GridPath
from skills.gridworld.reward import RewardMap
from skills.learning.certificate import Coverage
from skills.learning.policy import Policy
from skills.learning.pose_style import PosePath
from skills.learning.tube import CertifiedPoses
from skills.learning.tube_certificate import TubeCertificate, TubeLimits
from skills.packing import store_as_palette
from skills.planning.handoff import OtherArm, PsmM
from skills.planning.motion_laws import Pose, Poses
from skills.planning.path_fit import Hand
from skills.planning.plan import Departure, Pass, SuturePlan, SuturePoint
from skills.planning.trajectory import Trajectory
from skills.schemas import DemoOutcome
from skills.schemas.calibrations import Calibration
from skills.schemas.demos import ChosenSegment, DemoReport
from skills.schemas.people import Consent
from skills.schemas.plans import PlanDescription
from skills.schemas.playbacks import Verdict
from skills.schemas.policies import GateRefusal, PolicyManifest
from skills.schemas.policy_document import POLICY_CLASSES
from skills.schemas.recordings import RecordingContent, TableIn
from skills.verification.playback import Pictures, Playback

stored(*POLICY_CLASSES.values())
stored(SuturePoint, Pass, Pause, Partner, PsmM, Hand, Pose, Departure)
stored(PosePath, PartnerMotion, TubeLimits, TubeCertificate)
stored(Trajectory, OtherArm, Poses)
# A field that is added to one of these after 0.3.0 is released is registered here, with `skills.packing.added_later`.
store_as_palette(Coverage, "share")  # one for each waypoint


class Surgeon(Dated):
    """A surgeon, identified by a pseudonym; `subject` is the random name in events, which erasure deletes."""

    __tablename__ = "surgeons"

    slug: Mapped[str] = mapped_column(Slug, unique=True)
    subject: Mapped[str] = mapped_column(sa.String(32), unique=True)
    skill_level: Mapped[str | None]
    handedness: Mapped[str | None]
    protocol: Mapped[str | None]
    consent: Mapped[Consent | None] = mapped_column(AsJson(Consent))


class LastUsed(Numbered):
    """The last number of a style's versions that were erased, or lost with a restoration: no version has it again."""

    __tablename__ = "used_numbers"

    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row", ondelete="CASCADE"), index=True)
    suture: Mapped[str] = mapped_column(Slug)  # not of the catalogue alone: a restored one may be older
    last: Mapped[int]


class Erasure(Numbered):
    """A record that a surgeon was erased, with a salted digest of the pseudonym instead of the pseudonym."""

    __tablename__ = "erasures"

    salt: Mapped[str] = mapped_column(sa.String(64))
    digest: Mapped[str] = mapped_column(Sha256)
    erased_at: Mapped[datetime] = mapped_column(default=now)


class SutureType(Base):
    """One suture type of the catalogue."""

    __tablename__ = "suture_types"

    slug: Mapped[str] = mapped_column(Slug, primary_key=True)
    name: Mapped[str]
    also_called: Mapped[list[str]] = mapped_column(AsJson(list[str]))
    family: Mapped[str]
    description: Mapped[str] = mapped_column(sa.String(2000))


class StoredRecording(Identified):
    """An uploaded file, identified by the SHA-256 of its bytes."""

    __tablename__ = "recordings"

    size_bytes: Mapped[int] = mapped_column(sa.BigInteger)
    media_type: Mapped[str]
    format: Mapped[str]
    integrity: Mapped[str]
    reading: Mapped[TableIn] = mapped_column(AsJson(TableIn))
    about: Mapped[RecordingContent] = mapped_column(AsJson(RecordingContent))


class RecordingUpload(Base):
    """An upload of a recording by a caller, which may see the recording for that reason."""

    __tablename__ = "recording_uploads"

    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row", ondelete="CASCADE"), primary_key=True)
    actor: Mapped[str] = mapped_column(primary_key=True)


class RecordingSurgeon(Base):
    """A surgeon that a recording was uploaded for, one of possibly several; used to find recordings at erasure."""

    __tablename__ = "recording_surgeons"

    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row", ondelete="CASCADE"), primary_key=True)
    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row"), primary_key=True, index=True)


class ErasedInterval(Numbered):
    """An interval of a recording in which somebody is seen whose demonstration was erased; without times all of it.

    The surgeon is null once that surgeon is erased: then nobody can allow a use of it any more.
    """

    __tablename__ = "erased_intervals"

    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row", ondelete="CASCADE"), index=True)
    surgeon_row: Mapped[int | None] = mapped_column(sa.ForeignKey("surgeons.row"), index=True)
    start_s: Mapped[float | None]
    end_s: Mapped[float | None]


CHUNK_BYTES = 1 << 20  # of a recording, of its parsed content, and of a dataset
# Ours: that many bytes are stored in one transaction, for which others wait: on SQLite some 40 ms.
AT_ONCE_BYTES = 4 * CHUNK_BYTES


class RecordingChunk(Base):
    """A chunk of 1 MiB of a recording; it is stored before the row of the recording, and deleted after it."""

    __tablename__ = "recording_chunks"

    recording: Mapped[Number] = mapped_column(primary_key=True, autoincrement=False)
    number: Mapped[int] = mapped_column(primary_key=True)
    data: Mapped[bytes] = mapped_column(sa.LargeBinary)


class LooseChunks(Base):
    """Chunks without a recording, to be deleted when due: of an upload under way, or of a deleted recording."""

    __tablename__ = "loose_chunks"

    recording_row: Mapped[Number] = mapped_column(primary_key=True, autoincrement=False)
    due_at: Mapped[datetime]


class ParsedRecording(Base):
    """A cache of a recording's content as it was read from its bytes (`skills.library.recordings.content_cache`).

    A row may be deleted at any time; the bytes are then decoded again. `version` is the `READER_VERSION` that read it;
    rows of another version are not used.
    """

    __tablename__ = "parsed_recordings"

    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row", ondelete="CASCADE"), primary_key=True)
    version: Mapped[int]
    reading: Mapped[str] = mapped_column(Sha256)  # digest of the reading parameters
    sha256: Mapped[str] = mapped_column(Sha256)  # of the recording's digest, the two above and the chunks


class ParsedChunk(Base):
    """A chunk of 1 MiB of a recording's serialised content."""

    __tablename__ = "parsed_chunks"

    recording_row: Mapped[int] = mapped_column(
        sa.ForeignKey("parsed_recordings.recording_row", ondelete="CASCADE"), primary_key=True
    )
    number: Mapped[int] = mapped_column(primary_key=True)
    data: Mapped[bytes] = mapped_column(sa.LargeBinary)


class ProposalMark(Dated):
    """A decision on a proposed hand-off of a recording, with a note: rejected, or open again. The newest one counts.

    `number` is that of the proposal in `StoredRecording.about`, counted from 1. An accepted proposal has no mark: its
    demonstration says so.
    """

    __tablename__ = "proposal_marks"

    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row", ondelete="CASCADE"))
    number: Mapped[int]
    state: Mapped[str]
    note: Mapped[str | None]
    actor: Mapped[str]

    __table_args__ = (
        sa.CheckConstraint("state IN ('open', 'rejected')", name="state"),
        sa.Index("ix_proposal_marks_newest", "recording_row", "number", "row"),
    )


SUCCESS = "success"


class DemonstrationOutcome(Dated):
    """A mark of a demonstration: success, recovery or failure, with the reason. The newest mark counts."""

    __tablename__ = "demonstration_outcomes"

    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"))
    outcome: Mapped[str]
    reason: Mapped[str | None]
    actor: Mapped[str]

    __table_args__ = (
        sa.CheckConstraint("outcome IN ('success', 'recovery', 'failure')", name="outcome"),
        sa.Index("ix_demonstration_outcomes_newest", "demonstration_row", "row"),
        sa.Index("ix_demonstration_outcomes_outcome", "outcome", "demonstration_row"),
    )


def newest_mark(column: str, demonstration_row: Any) -> sa.ScalarSelect[str | None]:
    """Return a subquery of a column of a demonstration's newest mark; null if it was never marked.

    It is of the bare table, to which no rule of `skills.db.row_visibility` is added: a mark is visible with its
    demonstration.
    """
    marks = DemonstrationOutcome.__table__
    newest = sa.select(marks.c[column]).where(marks.c.demonstration_row == demonstration_row)
    return newest.order_by(marks.c.row.desc()).limit(1).correlate_except(marks).scalar_subquery()


class Demonstration(Identified):
    """One hand-off segment cut from a recording, with its path in a grid world; `outcome` is None if not known."""

    __tablename__ = "demonstrations"

    row: Mapped[RowId] = mapped_column(sort_order=-2)
    recording_row: Mapped[int] = mapped_column(sa.ForeignKey("recordings.row"), index=True)
    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row"))
    suture: Mapped[str] = mapped_column(sa.ForeignKey("suture_types.slug"))
    arm: Mapped[str]
    topic: Mapped[str]
    frame: Mapped[str]
    instrument: Mapped[str]
    start_s: Mapped[float]
    end_s: Mapped[float]
    session: Mapped[str | None]
    hysteresis: Mapped[float]  # cells
    demo: Mapped[Demo] = mapped_column(Packed(Demo), deferred=True)
    path: Mapped[GridPath] = mapped_column(Packed(GridPath), deferred=True)
    report: Mapped[DemoReport] = mapped_column(AsJson(DemoReport))
    segment: Mapped[ChosenSegment] = mapped_column(AsJson(ChosenSegment))
    withdrawn_at: Mapped[datetime | None]
    outcome: Mapped[DemoOutcome | None] = column_property(newest_mark("outcome", row))
    outcome_reason: Mapped[str | None] = column_property(newest_mark("reason", row))

    recording: Mapped[StoredRecording] = relationship(lazy="joined", innerjoin=True)
    surgeon: Mapped[Surgeon] = relationship(lazy="joined", innerjoin=True)
    __table_args__ = (
        sa.Index("ix_demonstrations_style", "surgeon_row", "suture", "row"),
        sa.Index("ix_demonstrations_surgeon", "surgeon_row", "row"),
        sa.Index("ix_demonstrations_suture", "suture", "row"),
        partial_index("ix_demonstrations_withdrawn", "row", where="withdrawn_at IS NOT NULL"),
    )

    @property
    def state(self) -> str:
        """Whether it is active or withdrawn."""
        return "active" if self.withdrawn_at is None else "withdrawn"

    @property
    def failed(self) -> bool:
        """True if it is marked recovery or failure."""
        return self.outcome not in (None, SUCCESS)

    @hybrid_property
    def learnable(self) -> bool:
        """True if a training takes it without outcomes "any": it is active, and not `failed`."""
        return self.withdrawn_at is None and not self.failed

    @learnable.inplace.expression
    @classmethod
    def _learnable(cls) -> sa.ColumnElement[bool]:
        return sa.and_(cls.withdrawn_at.is_(None), sa.func.coalesce(cls.outcome, SUCCESS) == SUCCESS)


class MeasuredShape(Base):
    """A cache of the atlas's measurements of a demonstration.

    A row may be deleted at any time and is then computed again. `version` is that of `skills.comparison.distances`,
    negative for a row without distances, which no other demonstration's erasure deletes; rows of another version are
    not used.
    """

    __tablename__ = "measured_shapes"

    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), primary_key=True)
    version: Mapped[int]
    measured: Mapped[Measured] = mapped_column(Packed(Measured))


class StoredRewardMap(Numbered):
    """The reward map that Algorithm 1 computed for a demonstration."""

    __tablename__ = "reward_maps"

    sha256: Mapped[str] = mapped_column(Sha256)
    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), unique=True)
    map: Mapped[RewardMap] = mapped_column(Packed(RewardMap), deferred=True)


class PolicyVersion(Identified):
    """One learnt policy of a style; `manifest` is its description for clients, without the release."""

    __tablename__ = "policy_versions"

    training: Mapped[str] = mapped_column(Sha256, index=True)  # identity of the training that produced it
    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row"))
    suture: Mapped[str] = mapped_column(sa.ForeignKey("suture_types.slug"))
    version: Mapped[int]
    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), index=True)
    manifest: Mapped[PolicyManifest] = mapped_column(AsJson(PolicyManifest))
    releasable: Mapped[bool]
    learnt: Mapped[Policy] = mapped_column(Packed(Policy), deferred=True)
    covered: Mapped[Coverage] = mapped_column(Packed(Coverage), deferred=True)

    surgeon: Mapped[Surgeon] = relationship(lazy="joined", innerjoin=True)
    demonstration: Mapped[Demonstration] = relationship(lazy="select")
    others: Mapped[list[Demonstration]] = relationship(secondary="policy_demonstrations", lazy="select", viewonly=True)
    poses: Mapped["StoredPoses | None"] = relationship(lazy="select", back_populates="policy", viewonly=True)
    __table_args__ = (sa.UniqueConstraint("surgeon_row", "suture", "version", name="uq_policy_versions_version"),)

    @property
    def demonstrations(self) -> list[Demonstration]:
        """All demonstrations that it was learnt from, oldest first."""
        return sorted([self.demonstration, *self.others], key=lambda one: one.row)

    @property
    def of_any_outcome(self) -> bool:
        """True if it was trained from demonstrations of any outcome; its manifest then names the outcomes."""
        return self.manifest.outcomes is not None

    @property
    def objections(self) -> list[GateRefusal]:
        """The change of a demonstration that forbids a release: it "was withdrawn" or "was marked failure"."""
        demos = self.demonstrations
        withdrawn = any(one.withdrawn_at is not None for one in demos)
        marked = set() if self.of_any_outcome else {f"was marked {one.outcome}" for one in demos if one.failed}
        changed = [GateRefusal("withdrawn", "was withdrawn")] if withdrawn else []
        return changed + [GateRefusal("marked", text) for text in sorted(marked)]


class StoredPoses(Dated):
    """The pose style of a policy version: the poses of its demonstrations' hands, and the certificate of their tube.

    A version whose demonstrations have no orientation has none.
    """

    __tablename__ = "pose_styles"

    sha256: Mapped[str] = mapped_column(Sha256)
    policy_row: Mapped[int] = mapped_column(sa.ForeignKey("policy_versions.row"), unique=True)
    poses: Mapped[CertifiedPoses] = mapped_column(Packed(CertifiedPoses), deferred=True)

    policy: Mapped[PolicyVersion] = relationship(lazy="joined", innerjoin=True, back_populates="poses")


class PolicyDemonstration(Base):
    """A further demonstration of a policy, in addition to the one named in the policy's row."""

    __tablename__ = "policy_demonstrations"

    policy_row: Mapped[int] = mapped_column(sa.ForeignKey("policy_versions.row"), primary_key=True)
    demonstration_row: Mapped[int] = mapped_column(sa.ForeignKey("demonstrations.row"), primary_key=True, index=True)


class Release(Numbered):
    """A release of a policy version; the newest release of a style that is not withdrawn is served."""

    __tablename__ = "releases"

    policy_row: Mapped[int] = mapped_column(sa.ForeignKey("policy_versions.row"), index=True)
    surgeon_row: Mapped[int] = mapped_column(sa.ForeignKey("surgeons.row"))
    suture: Mapped[str] = mapped_column(sa.ForeignKey("suture_types.slug"))
    released_at: Mapped[datetime] = mapped_column(default=now)
    released_by: Mapped[str]
    withdrawn_at: Mapped[datetime | None]

    policy: Mapped[PolicyVersion] = relationship(lazy="select")
    __table_args__ = (sa.Index("ix_releases_style", "surgeon_row", "suture", "row"),)


class Plan(Identified):
    """A plan: grid worlds stacked at suture points."""

    __tablename__ = "plans"

    policy_row: Mapped[int] = mapped_column(sa.ForeignKey("policy_versions.row"), index=True)
    about: Mapped[PlanDescription] = mapped_column(AsJson(PlanDescription))
    plan: Mapped[SuturePlan] = mapped_column(Packed(SuturePlan), deferred=True)

    policy: Mapped[PolicyVersion] = relationship(lazy="joined", innerjoin=True)


class StoredPlayback(Identified):
    """The simulator's measurements of a plan, and the verdict."""

    __tablename__ = "playbacks"

    plan_row: Mapped[int] = mapped_column(sa.ForeignKey("plans.row"), index=True)
    feasible: Mapped[bool]
    report: Mapped[Verdict] = mapped_column(AsJson(Verdict))
    measured: Mapped[Playback] = mapped_column(Packed(Playback), deferred=True)

    plan: Mapped[Plan] = relationship(lazy="joined", innerjoin=True)


class StoredPictures(Numbered):
    """The pictures of a playback, drawn after its verdict."""

    __tablename__ = "playback_pictures"

    playback_row: Mapped[int] = mapped_column(sa.ForeignKey("playbacks.row"), unique=True)
    drawn: Mapped[Pictures] = mapped_column(Packed(Pictures), deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)


class StoredCalibration(Dated):
    """A calibrated model of skill as plain numbers, with its data set and its accuracy; the newest one is used.

    It is calibrated on rated trials of a laboratory, not on the surgeons here; it contains no trial and no pseudonym.
    """

    __tablename__ = "calibrations"

    sha256: Mapped[str] = mapped_column(Sha256)
    about: Mapped[Calibration] = mapped_column(AsJson(Calibration))
