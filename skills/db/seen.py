"""Who may see only some surgeons finds in every query only what is theirs, as if there were nothing else.

One rule stands here for each table that holds something of a surgeon; a session with `ONLY` in its `info` puts them
into every SELECT that it sends, lists, counts and joins included. So no route and no library function has to remember
it. Statements on bare tables (`Table`, `text`) are not narrowed; those are the workers' and the installation's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sqlalchemy import ColumnElement, and_, event, exists, or_, select
from sqlalchemy.orm import ORMExecuteState, Session, with_loader_criteria

from skills.db.base import Base
from skills.db.books import Job, StyleToRetrain
from skills.db.models import (
    Demonstration,
    MeasuredShape,
    Plan,
    PolicyDemonstration,
    PolicyVersion,
    RecordingChunk,
    RecordingUpload,
    Release,
    StoredPictures,
    StoredPlayback,
    StoredRecording,
    StoredRewardMap,
    Surgeon,
)

ONLY = "only"
EVERYBODYS = {"everybodys": True}  # the execution option of a query that must see all there is
OF_NOBODY = (
    *("erasures", "suture_types", "calibrations", "executors", "events", "keys", "key_surgeons", "sign_ins"),
    "recording_uploads",
)
INSIDE = (Demonstration, PolicyVersion, Plan, StoredPlayback, RecordingUpload, StyleToRetrain)


@dataclass(frozen=True)
class Only:
    """The surgeons that somebody may see, by their rows; and who it is: they also see what they brought."""

    actor: str
    surgeons: frozenset[int]

    @cached_property
    def rules(self) -> dict[type[Base], ColumnElement[bool]]:
        """Say of each table which rows may be seen; inside, bare tables, for which no rule holds."""
        mine = tuple(sorted(self.surgeons))
        demo, policy, plan, played, sent, style = map(_columns, INSIDE)
        demos = select(demo.row).where(demo.surgeon_row.in_(mine))
        policies = select(policy.row).where(policy.surgeon_row.in_(mine))
        plans = select(plan.row).where(plan.policy_row.in_(policies))
        playbacks = select(played.row).where(played.plan_row.in_(plans))
        shown = select(demo.recording_row).where(demo.surgeon_row.in_(mine))
        recordings = shown.union(select(sent.recording_row).where(sent.actor == self.actor))
        of_batch = or_(style.job_row == Job.row, style.part_row == Job.row)
        others = exists(select(style.row).where(of_batch, style.demonstration_row.not_in(demos)).correlate(Job))
        return {
            Surgeon: Surgeon.row.in_(mine),
            StoredRecording: StoredRecording.row.in_(recordings),
            RecordingChunk: RecordingChunk.recording.in_(recordings),
            Demonstration: Demonstration.surgeon_row.in_(mine),
            MeasuredShape: MeasuredShape.demonstration_row.in_(demos),
            StoredRewardMap: StoredRewardMap.demonstration_row.in_(demos),
            PolicyVersion: PolicyVersion.surgeon_row.in_(mine),
            PolicyDemonstration: PolicyDemonstration.policy_row.in_(policies),
            Release: Release.surgeon_row.in_(mine),
            Plan: Plan.policy_row.in_(policies),
            StoredPlayback: StoredPlayback.plan_row.in_(plans),
            StoredPictures: StoredPictures.playback_row.in_(playbacks),
            # Of no single surgeon are batches and their parts; one that holds another's style is another's.
            Job: or_(Job.surgeon_row.in_(mine), and_(Job.surgeon_row.is_(None), ~others)),
            StyleToRetrain: StyleToRetrain.demonstration_row.in_(demos),
        }

    @cached_property
    def criteria(self) -> Sequence[Any]:
        """Write the rules as what is put into a query."""
        return [with_loader_criteria(table, rule, include_aliases=True) for table, rule in self.rules.items()]


def _columns(table: type[Base]) -> Any:
    return table.__table__.c


@event.listens_for(Session, "do_orm_execute")
def _narrow(asked: ORMExecuteState) -> None:
    """Put the rules into a query; what is then loaded for its rows carries them on by itself."""
    only: Only | None = asked.session.info.get(ONLY)
    if only is None or not asked.is_select or asked.is_column_load or asked.is_relationship_load:
        return
    if not asked.execution_options.get("everybodys"):
        asked.statement = asked.statement.options(*only.criteria)
