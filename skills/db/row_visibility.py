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

from skills.db import Base, models
from skills.db.service_tables import DatasetChunk, DatasetDemonstration, Job, StoredDataset, StyleToRetrain

ONLY = "only"
ALL_ROWS = {"all_rows": True}  # the execution option of a query that must see all rows
# Tables without a rule; a test checks that every other table has one.
UNRESTRICTED_TABLES = (
    *("erasures", "suture_types", "calibrations", "executors", "events", "keys", "key_surgeons", "sign_ins"),
    *("recording_uploads", "loose_chunks", "erased_surgeons", "history", "history_checkpoints", "history_tiles"),
)
# The tables whose rows are visible together with the row that one of their columns names, by this column.
VISIBLE_WITH: dict[str, tuple[type[Base], ...]] = {
    "surgeon_row": (
        models.RecordingSurgeon,
        models.Demonstration,
        models.PolicyVersion,
        models.LastUsed,
        models.Release,
    ),
    "recording_row": (models.ErasedInterval, models.ParsedRecording, models.ParsedChunk, models.ProposalMark),
    "demonstration_row": (
        models.DemonstrationOutcome,
        models.MeasuredShape,
        models.StoredRewardMap,
        DatasetDemonstration,
        StyleToRetrain,
    ),
    "policy_row": (models.PolicyDemonstration, models.StoredPoses, models.Plan),
    "plan_row": (models.StoredPlayback,),
    "playback_row": (models.StoredPictures,),
    "dataset_row": (DatasetChunk,),
}


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
        demo, policy = _columns(models.Demonstration), _columns(models.PolicyVersion)
        plan, played, sent = map(_columns, (models.Plan, models.StoredPlayback, models.RecordingUpload))
        style, exported, dataset = map(_columns, (StyleToRetrain, DatasetDemonstration, StoredDataset))
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
        visible: dict[str, object] = {"surgeon_row": mine, "recording_row": recordings, "demonstration_row": demos}
        visible |= {"policy_row": policies, "plan_row": plans, "playback_row": playbacks, "dataset_row": datasets}
        rules = {of: getattr(of, name).in_(visible[name]) for name, tables in VISIBLE_WITH.items() for of in tables}
        return rules | {
            models.Surgeon: models.Surgeon.row.in_(mine),
            models.StoredRecording: models.StoredRecording.row.in_(recordings),
            models.RecordingChunk: models.RecordingChunk.recording.in_(recordings),
            StoredDataset: StoredDataset.row.in_(datasets),
            # Batches, their parts and exports belong to no single surgeon; one with data of a hidden surgeon is hidden.
            Job: or_(Job.surgeon_row.in_(mine), and_(Job.surgeon_row.is_(None), ~others, ~exports)),
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
