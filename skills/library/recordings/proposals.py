"""The hand-offs proposed in recordings as one list: open, accepted or rejected.

    StoredRecording.about --list_proposals--> Proposal, with its demonstration or its newest mark
    Proposal --decide--> ProposalMark

A proposal is a segment of its recording's row, counted from 1 among the segments of all arms. It is accepted if a
demonstration, active or withdrawn, was cut there: by the same arm, and so that the two share at least half of the
longer one. That is not stored, so it holds for demonstrations that were cut in any other way. A rejection is a mark
(`ProposalMark`) and holds until somebody opens the proposal again.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from sqlalchemy import Row, Select, or_, select
from sqlalchemy.orm import Session

from skills.db.models import Demonstration, ErasedInterval, ProposalMark, RecordingSurgeon, StoredRecording, Surgeon
from skills.db.service_tables import record_event
from skills.db.session import Database
from skills.demonstration.segments import Segment
from skills.errors import Conflict, NotFound
from skills.formats.parsed import MOST
from skills.library.people.recorded import shown_recording
from skills.library.people.surgeons import find_surgeon
from skills.library.people.suture_types import find_suture_type
from skills.library.recordings.recordings import Parser, find_recording
from skills.remedies import Action, Remedy
from skills.schemas import ProposalDecision, ProposalState
from skills.schemas import demos as described

SHARED = 0.5  # of the longer of proposal and cut: a corrected proposal is still the same, a cut of all hand-offs is not
AT_ONCE, LOOKED_AT = 50, 500  # recordings: read by one query, and read for one page at most
POINTS = 48  # of a small picture of a path
_PAGE = 1000  # numbers of a recording in a cursor
assert MOST < _PAGE


@dataclass(frozen=True)
class Proposal:
    """A proposed hand-off of a recording.

    Attributes:
        recording: The row of its recording, or columns of it.
        number: Its number in the recording, from 1.
        segment: The segment as it was stored.
        surgeon: The surgeon of its demonstration, else the only one that the recording was uploaded for.
        demo: The demonstration that was cut there, as columns of its row; None if none was.
        mark: The newest decision on it; None if there is none.
    """

    recording: Any
    number: int
    segment: Segment
    surgeon: str | None
    demo: Any
    mark: ProposalMark | None

    @property
    def state(self) -> ProposalState:
        """Its state."""
        if self.demo is not None:
            return "accepted"
        return "open" if self.mark is None or self.mark.state == "open" else "rejected"

    @property
    def cursor(self) -> int:
        """The cursor of a page that ends with it."""
        return int(self.recording.row) * _PAGE + self.number


def list_proposals(
    session: Session,
    limit: int,
    after: int | None,
    *,
    state: ProposalState | None = None,
    recording: str | None = None,
    surgeon: str | None = None,
    suture: str | None = None,
) -> tuple[list[Proposal], int | None]:
    """List proposals, those of the newest recording first, in the order of their numbers.

    A page may be shorter than `limit`, or empty, though others follow: it ends after `LOOKED_AT` recordings.

    Args:
        session: The caller's transaction.
        limit: The most proposals.
        after: The cursor of the page before.
        state: List only those in this state.
        recording: List only those of this recording, by its digest.
        surgeon: List only those of this surgeon.
        suture: List only accepted ones with a demonstration of this suture type.

    Returns:
        The proposals, and the cursor of the next page; None if there is none.
    """
    of, cut = StoredRecording, Demonstration
    query: Select[*tuple[Any, ...]] = select(of.row, of.sha256, of.about, of.created_at)
    if recording is not None:
        query = query.where(of.row == find_recording(session, recording).row)
    if surgeon is not None:
        who = find_surgeon(session, surgeon)
        cuts = select(cut.recording_row).where(cut.surgeon_row == who.row)
        named = select(RecordingSurgeon.recording_row).where(RecordingSurgeon.surgeon_row == who.row)
        query = query.where(or_(of.row.in_(cuts), of.row.in_(named)))
    if suture is not None:
        what = find_suture_type(session, suture).slug
        query = query.where(of.row.in_(select(cut.recording_row).where(cut.suture == what)))
    found: list[Proposal] = []
    last = None
    for some in _recordings(session, query, after):
        for one in _proposals_in(session, some):
            known = after is not None and one.recording.row == after // _PAGE and one.number <= after % _PAGE
            of_suture = suture is None or (one.demo is not None and one.demo.suture == suture)
            if known or not of_suture or state not in (None, one.state) or surgeon not in (None, one.surgeon):
                continue
            found.append(one)
            if len(found) == limit:
                return found, one.cursor
        last = int(some[-1].row) * _PAGE if len(some) == AT_ONCE else None
    return found, last


def _recordings(session: Session, query: Select[Any], after: int | None) -> Iterator[Sequence[Row[Any]]]:
    """Yield the rows of recordings, the newest first, some at a time, at most `LOOKED_AT` and at least one page."""
    before = None if after is None else -(-after // _PAGE)  # number 0: it was listed to its end
    for _ in range(LOOKED_AT // AT_ONCE):
        page = query if before is None else query.where(StoredRecording.row < before)
        some = session.execute(page.order_by(StoredRecording.row.desc()).limit(AT_ONCE)).all()
        if not some:
            return
        yield some
        before = some[-1].row


def find_proposal(session: Session, recording: str, number: int) -> Proposal:
    """Return a proposal of a recording.

    Raises:
        NotFound: There is no such recording, or no such proposal in it.
    """
    stored = find_recording(session, recording)
    one = next((one for one in _proposals_in(session, [stored]) if one.number == number), None)
    if one is None:
        count = len(stored.about.segments)
        raise NotFound(
            f"There is no proposal {number} in this recording; it has {count}.", Remedy(Action.LIST_PROPOSALS)
        )
    return one


def _proposals_in(session: Session, recordings: Sequence[Any]) -> Iterator[Proposal]:
    rows = [one.row for one in recordings]
    of, named, gone, marked = Demonstration, RecordingSurgeon, ErasedInterval, ProposalMark
    columns = (of.row, of.recording_row, of.surgeon_row, of.arm, of.start_s, of.end_s, of.sha256, of.suture)
    cut = select(*columns, of.withdrawn_at, of.outcome, of.outcome_reason).where(of.recording_row.in_(rows))
    demos: defaultdict[int, list[Any]] = defaultdict(list)
    for demo in sorted(session.execute(cut), key=lambda one: one.row):
        demos[demo.recording_row].append(demo)
    owners: defaultdict[int, set[int | None]] = defaultdict(set)
    sent_as = select(named.recording_row, named.surgeon_row).where(named.recording_row.in_(rows))
    erased = select(gone.recording_row, gone.surgeon_row).where(gone.recording_row.in_(rows), gone.start_s.is_(None))
    for row, owner in (*session.execute(sent_as), *session.execute(erased)):
        owners[row].add(owner)  # null: somebody who was erased
    known = {*chain.from_iterable(owners.values()), *(demo.surgeon_row for some in demos.values() for demo in some)}
    called = select(Surgeon.row, Surgeon.slug).where(Surgeon.row.in_(known - {None}))
    slugs: dict[int | None, str] = {one.row: one.slug for one in session.execute(called)}
    all_marks = session.scalars(select(marked).where(marked.recording_row.in_(rows)).order_by(marked.row))
    marks = {(one.recording_row, one.number): one for one in all_marks}  # the newest of each
    for one in recordings:
        for number, segment in enumerate(one.about.segments, 1):
            demo = _cut_there(segment, demos[one.row])
            theirs = owners[one.row] if demo is None else {demo.surgeon_row}
            surgeon = slugs.get(next(iter(theirs))) if len(theirs) == 1 else None
            yield Proposal(one, number, segment, surgeon, demo, marks.get((one.row, number)))


def _cut_there(segment: Segment, demos: Sequence[Any]) -> Any:
    """Return the demonstration that was cut at a proposal, an active one first and of those the newest."""
    there = [one for one in demos if one.arm == segment.arm and _same(segment, one)]
    active = [one for one in there if one.withdrawn_at is None]
    return next(reversed(active or there), None)


def _same(segment: Segment, cut: Any) -> bool:
    shared_s = min(segment.end_s, cut.end_s) - max(segment.start_s, cut.start_s)
    return bool(shared_s >= SHARED * max(segment.end_s - segment.start_s, cut.end_s - cut.start_s))


def decide(
    session: Session, recording: str, number: int, state: ProposalDecision, note: str | None, actor: str
) -> Proposal:
    """Reject a proposal, or open a rejected one again; an equal decision is not stored twice.

    Args:
        session: The caller's transaction.
        recording: The recording's digest.
        number: The number of the proposal in it.
        state: The decision.
        note: Why, in the words of the caller.
        actor: The owner of the caller's key.

    Raises:
        NotFound: There is no such proposal.
        Conflict: A demonstration was cut there.
    """
    one = find_proposal(session, recording, number)
    if one.demo is not None:
        why = f"This proposal was accepted: the demonstration {one.demo.sha256} was cut there."
        raise Conflict(why, Remedy(Action.WITHDRAW_DEMO, demo=one.demo.sha256))
    if state == one.state and (one.mark is None or one.mark.note == note):
        return one
    mark = {"state": state, "note": note, "actor": actor}
    session.add(ProposalMark(recording_row=one.recording.row, number=number, **mark))
    action = "reject-proposal" if state == "rejected" else "open-proposal"
    record_event(session, actor, action, "recording", one.recording.sha256)
    session.flush()
    return find_proposal(session, recording, number)


def describe_proposal(one: Proposal) -> described.Proposal:
    """Return a proposal as it is sent to clients."""
    demo, note = one.demo, None
    if demo is not None:
        note = demo.outcome_reason
    elif one.mark is not None and one.state == "rejected":
        note = one.mark.note
    return described.Proposal(
        recording=one.recording.sha256,
        number=one.number,
        state=one.state,
        surgeon=one.surgeon,
        suture=None if demo is None else demo.suture,
        demo=None if demo is None else demo.sha256,
        outcome=None if demo is None else demo.outcome,
        note=note,
        created_at=one.recording.created_at,
        **vars(one.segment),
    )


def paths_of(database: Database, recording: str, parse: Parser) -> list[list[list[float]]]:
    """Return the path of the tip in each proposal of a recording, at most `POINTS` points of it in mm, for pictures."""
    with database.reading() as session:
        segments = find_recording(session, recording).about.segments
    shown = shown_recording(database, recording, parse).recording
    motions = {arm: shown.motion_of(arm=arm) for arm in {one.arm for one in segments}}
    paths = []
    for one in segments:
        motion = motions[one.arm]
        first, last = np.searchsorted(shown.seconds(motion.stamps_ns), [one.start_s, one.end_s])
        inside = motion.tip_mm[first : max(last, first + 2)]
        at = np.linspace(0, len(inside) - 1, min(POINTS, len(inside))).round().astype(int)
        paths.append(np.round(inside[at], 2).tolist())
    return paths
