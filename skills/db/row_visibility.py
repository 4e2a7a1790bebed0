"""Row-level visibility: sessions of restricted callers find only the rows of their surgeons, as if no others existed.

There is one rule for each table with data about surgeons. A session with `ONLY` in its `info` adds the rules to every
SELECT that it sends, including lists, counts and joins, so no route and no library function has to apply them.
Statements on bare tables (`Table`, `text`) are not restricted; only workers and the installation itself use those.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sqlalchemy import ColumnElement, and_, event, exists, or_, select
from sqlalchemy.orm import ORMExecuteState, Session, with_loader_criteria

from skills.db import Base
from skills.db.models import (
    Demonstration,
    DemonstrationOutcome,
    ErasedInterval,
    LastUsed,
    MeasuredShape,
    ParsedChunk,
    ParsedRecording,
    Plan,
    PolicyDemonstration,
    PolicyVersion,
    ProposalMark,
    RecordingChunk,
    RecordingSurgeon,
    RecordingUpload,
    Release,
    StoredPictures,
    StoredPlayback,
    StoredPoses,
    StoredRecording,
    StoredRewardMap,
    Surgeon,
)
from skills.db.service_tables import DatasetChunk, DatasetDemonstration, Job, StoredDataset, StyleToRetrain

ONLY = "only"
ALL_ROWS = {"all_rows": True}  # the execution option of a query that must see all rows
# Tables without a rule; a test checks that every other table has one.
UNRESTRICTED_TABLES = (
    *("erasures", "suture_types", "calibrations", "executors", "events", "keys", "key_surgeons", "sign_ins"),
    *("recording_uploads", "loose_chunks", "erased_surgeons", "history", "history_checkpoints", "history_tiles"),
)
INSIDE = (
    *(Demonstration, PolicyVersion, Plan, StoredPlayback, RecordingUpload, StyleToRetrain),
    *(DatasetDemonstration, StoredDataset),
)


@dataclass(frozen=True)
class Only:
    """The surgeons that a caller may see, by row number, and the caller's name.

    A caller also sees the recordings that it uploaded.
    """

    actor: str
    surgeons: frozenset[int]

    @cached_property
    def rules(self) -> dict[type[Base], ColumnElement[bool]]:
        """The condition for visible rows, by table.

        The subqueries use bare tables, to which no rule is applied again.
        """
        mine = tuple(sorted(self.surgeons))
        demo, policy, plan, played, sent, style, exported, dataset = map(_columns, INSIDE)
        demos = select(demo.row).where(demo.surgeon_row.in_(mine))
        policies = select(policy.row).where(policy.surgeon_row.in_(mine))
        plans = select(plan.row).where(plan.policy_row.in_(policies))
        playbacks = select(played.row).where(played.plan_row.in_(plans))
        shown = select(demo.recording_row).where(demo.surgeon_row.in_(mine))
        recordings = shown.union(select(sent.recording_row).where(sent.actor == self.actor))
        of_batch = or_(style.job_row == Job.row, style.part_row == Job.row)
        others = exists(select(style.row).where(of_batch, style.demonstration_row.not_in(demos)).correlate(Job))
        # A dataset, like a batch, is hidden where one of its demonstrations is.
        hidden = select(exported.job_row).where(exported.demonstration_row.not_in(demos))
        exports = exists(hidden.where(exported.job_row == Job.row).correlate(Job))
        datasets = select(dataset.row).where(dataset.job_row.not_in(hidden))
        return {
            Surgeon: Surgeon.row.in_(mine),
            StoredRecording: StoredRecording.row.in_(recordings),
            RecordingSurgeon: RecordingSurgeon.surgeon_row.in_(mine),
            ErasedInterval: ErasedInterval.recording_row.in_(recordings),
            RecordingChunk: RecordingChunk.recording.in_(recordings),
            ParsedRecording: ParsedRecording.recording_row.in_(recordings),
            ParsedChunk: ParsedChunk.recording_row.in_(recordings),
            ProposalMark: ProposalMark.recording_row.in_(recordings),
            Demonstration: Demonstration.surgeon_row.in_(mine),
            DemonstrationOutcome: DemonstrationOutcome.demonstration_row.in_(demos),
            MeasuredShape: MeasuredShape.demonstration_row.in_(demos),
            StoredRewardMap: StoredRewardMap.demonstration_row.in_(demos),
            PolicyVersion: PolicyVersion.surgeon_row.in_(mine),
            PolicyDemonstration: PolicyDemonstration.policy_row.in_(policies),
            StoredPoses: StoredPoses.policy_row.in_(policies),
            LastUsed: LastUsed.surgeon_row.in_(mine),
            Release: Release.surgeon_row.in_(mine),
            Plan: Plan.policy_row.in_(policies),
            StoredPlayback: StoredPlayback.plan_row.in_(plans),
            StoredPictures: StoredPictures.playback_row.in_(playbacks),
            # Batches, their parts and exports belong to no single surgeon; one with data of a hidden surgeon is hidden.
            Job: or_(Job.surgeon_row.in_(mine), and_(Job.surgeon_row.is_(None), ~others, ~exports)),
            DatasetDemonstration: DatasetDemonstration.demonstration_row.in_(demos),
            StoredDataset: StoredDataset.row.in_(datasets),
            DatasetChunk: DatasetChunk.dataset_row.in_(datasets),
            StyleToRetrain: StyleToRetrain.demonstration_row.in_(demos),
        }

    @cached_property
    def criteria(self) -> Sequence[Any]:
        """The rules as options of a query."""
        return [with_loader_criteria(table, rule, include_aliases=True) for table, rule in self.rules.items()]


def _columns(table: type[Base]) -> Any:
    return table.__table__.c


@event.listens_for(Session, "do_orm_execute")
def _narrow(asked: ORMExecuteState) -> None:
    """Add the rules to a query; SQLAlchemy applies them to the relationships that its rows load."""
    only: Only | None = asked.session.info.get(ONLY)
    if only is None or not asked.is_select or asked.is_column_load or asked.is_relationship_load:
        return
    if not asked.execution_options.get("all_rows"):
        asked.statement = asked.statement.options(*only.criteria)
