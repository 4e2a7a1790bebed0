"""Timelines of what is stored: recordings, demonstrations, policy versions and plans, and which of them to compare.

A timeline is computed at each request and stored nowhere; what takes long, the decoding of a recording, is cached with
the recording (`skills.library.recordings.recordings`). What may be seen is what a reader may see of the same resource
in another form: the path of a demonstration, the trajectory of a plan. A file of a recorded motion is an export.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db import newest
from skills.db.models import Demonstration, Plan, PolicyVersion, StoredPlayback, StoredRecording
from skills.db.session import Database
from skills.errors import NotFound
from skills.library.operation.integrity import planned
from skills.library.people.recorded import recording_for, shown_recording
from skills.library.plans.headline import OF_A_PASS, counted_as, describe_errors
from skills.library.plans.plans import find_plan, followed_plan, trajectory_of
from skills.library.policies import versions
from skills.library.policies.pose_styles import poses_of
from skills.library.recordings.demos import demo_for, find_demo
from skills.library.recordings.recordings import Parser, find_recording, stored_recording
from skills.verification.timeline import (
    Timeline,
    timeline_of_demo,
    timeline_of_path,
    timeline_of_plan,
    timeline_of_recording,
)

Source = Literal["recordings", "demos", "policy-versions", "plans"]
MOST_CHOICES = 50


def timeline_of(database: Database, source: Source, sha256: str, parse: Parser) -> Timeline:
    """Return the timeline of a resource; no transaction is open while it is computed.

    Raises:
        NotFound: There is no such resource, or the policy version has no pose style.
        Conflict: The surgeon's consent does not cover training, for a policy version or a plan, or somebody in these
            seconds of a recording allows no use.
        Corrupt: What is stored does not match its digest.
    """
    if source == "recordings":
        return timeline_of_recording(shown_recording(database, sha256, parse).recording)
    if source == "demos":
        with database.reading() as session:
            recording = find_demo(session, sha256).recording.sha256
        parsed = stored_recording(database, recording, parse)
        with database.reading() as session:
            demo = demo_for(session, sha256, "any").demo
        return timeline_of_demo(parsed.recording, demo)
    if source == "policy-versions":
        with database.reading() as session:
            poses = poses_of(versions.followable(versions.find_by_digest(session, sha256)))
        return timeline_of_path(poses.path, arm=poses.arm, frame=poses.frame)
    with database.reading() as session:
        plan = followed_plan(session, sha256)
        motion = planned(plan)
        played = session.scalar(newest(StoredPlayback, StoredPlayback.plan_row == plan.row))
        measured, odds, event = None if played is None else played.measured, {}, ""
        executed = None if played is None else played.report.executed
        if played is not None and played.feasible:
            under = played.report.estimate.under[0]
            odds = {number: one.succeeds.probability for number, one in enumerate(under.passes)}
            event = f"The pass {OF_A_PASS[counted_as(under)]}, {describe_errors(under.errors.name)}"
    return timeline_of_plan(
        trajectory_of(motion),
        arm=motion.arm,
        frame=motion.frame,
        played=measured,
        odds=odds,
        event=event,
        servo=None if executed is None else executed.servo,
    )


def check_export(session: Session, source: Source, sha256: str) -> None:
    """Refuse a file of a recorded motion that a surgeon's consent does not cover; others are checked as they are read.

    Raises:
        Conflict: Somebody in these seconds of the recording does not allow an export.
    """
    if source == "demos":
        demo_for(session, sha256, "export")
    if source == "recordings":
        recording_for(session, sha256, "export")


class TimelineLink(NamedTuple):
    """A resource with a timeline, and its name on a page."""

    source: Source
    sha256: str
    name: str


Row = StoredRecording | Demonstration | PolicyVersion | Plan
FIND: dict[str, Callable[[Session, str], Row]] = {
    "recordings": find_recording,
    "demos": find_demo,
    "policy-versions": versions.find_by_digest,
    "plans": find_plan,
}


def motion_named(session: Session, name: str) -> TimelineLink:
    """Return the resource of a name such as `plans/DIGEST`.

    Raises:
        NotFound: There is no such resource.
    """
    source, _, sha256 = name.partition("/")
    if source not in FIND:
        raise NotFound("There is no such motion to play beside this one; choose one of the list.")
    return _link(FIND[source](session, sha256))


def chosen(session: Session, source: Source, sha256: str) -> tuple[TimelineLink, Sequence[TimelineLink]]:
    """Return a resource under its name, and some to play beside it: of the same suture type, its own surgeon's first.

    Raises:
        NotFound: There is no such resource.
    """
    row = FIND[source](session, sha256)
    others: list[Row] = []
    if isinstance(row, StoredRecording):
        cut = select(Demonstration).where(Demonstration.recording_row == row.row)
        others += session.scalars(cut.order_by(Demonstration.start_s).limit(MOST_CHOICES))
    else:
        of = row.policy if isinstance(row, Plan) else row
        others += _newest(session, Demonstration, of.suture, of.surgeon_row)
        others += [one for one in _newest(session, PolicyVersion, of.suture, of.surgeon_row) if one.poses is not None]
        plans = newest(Plan, PolicyVersion.suture == of.suture, limit=MOST_CHOICES).join(PolicyVersion)
        others += session.scalars(plans)
    return _link(row), [_link(one) for one in others if one is not row]


def _newest(
    session: Session, of: type[Demonstration] | type[PolicyVersion], suture: str, surgeon_row: int
) -> Sequence[Any]:
    query = select(of).where(of.suture == suture).order_by(of.surgeon_row != surgeon_row, of.row.desc())
    if of is Demonstration:
        query = query.where(Demonstration.withdrawn_at.is_(None))
    return session.scalars(query.limit(MOST_CHOICES)).all()


def _link(row: Row) -> TimelineLink:
    if isinstance(row, StoredRecording):
        return TimelineLink("recordings", row.sha256, f"Recording {row.sha256[:12]}")
    if isinstance(row, Demonstration):
        return TimelineLink("demos", row.sha256, f"{row.surgeon.slug}, demonstration {row.sha256[:8]}")
    if isinstance(row, PolicyVersion):
        return TimelineLink("policy-versions", row.sha256, f"{row.surgeon.slug}, learnt path of version {row.version}")
    return TimelineLink("plans", row.sha256, f"{row.policy.surgeon.slug}, plan {row.sha256[:8]}")
