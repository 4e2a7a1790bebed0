"""Members of an atlas: the demonstrations of a suture type that may be compared, each motion once.

Cuts of one arm's motion that overlap show the same motion: if a demonstration shares at least half of the shorter
one's time with a newer one of the same recording and arm, only the newer one counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import ColumnElement, and_, func, select
from sqlalchemy.orm import Session

from skills.arrays import Ints
from skills.db.models import Demonstration, Surgeon
from skills.errors import Conflict
from skills.library.people.consent import may, require
from skills.library.recordings.demos import find_demo

OVERLAP = 0.5  # of the shorter cut; hand-offs that follow each other share a moment at most


@dataclass(frozen=True)
class Member:
    """A demonstration of an atlas, without its motion."""

    row: int
    sha256: str
    surgeon: str
    session: str | None
    recording_row: int
    arm: str
    frame: str
    start_s: float
    end_s: float

    def same_motion(self, other: "Member") -> bool:
        """Return whether two are overlapping cuts of one arm's motion in one recording."""
        if (self.recording_row, self.arm) != (other.recording_row, other.arm):
            return False
        shared_s = min(self.end_s, other.end_s) - max(self.start_s, other.start_s)
        return shared_s >= OVERLAP * min(self.end_s - self.start_s, other.end_s - other.start_s)


def comparable_demo(session: Session, demo_sha256: str) -> Demonstration:
    """Return a demonstration that may be compared.

    Raises:
        NotFound: There is no such demonstration.
        Conflict: It was withdrawn, or its surgeon's consent does not cover a comparison.
    """
    found = find_demo(session, demo_sha256)
    if found.withdrawn_at is not None:
        raise Conflict("This demonstration was withdrawn; it is no longer compared.")
    require(found.surgeon, "atlas")
    return found


def members_of(session: Session, suture: str) -> tuple[list[Member], int]:
    """List the active demonstrations whose surgeon's consent covers an atlas, the oldest first, and count the others.

    Args:
        session: The caller's transaction.
        suture: The suture type.
    """
    return _listed(session, Demonstration.suture == suture)


def members_among(session: Session, suture: str, rows: Sequence[int]) -> list[Member]:
    """List the members cut from the same recordings as some demonstrations, given by their rows, the oldest first."""
    recordings = select(Demonstration.recording_row).where(Demonstration.row.in_(rows))
    # The function hides the suture type from the planner, which would read all of its demonstrations by that index.
    of_suture = func.coalesce(Demonstration.suture, "") == suture
    return _listed(session, and_(of_suture, Demonstration.recording_row.in_(recordings)))[0]


def member_of(row: Demonstration) -> Member:
    """Return a stored demonstration as a member."""
    of = row.row, row.sha256, row.surgeon.slug, row.session, row.recording_row, row.arm, row.frame
    return Member(*of, row.start_s, row.end_s)


def _listed(session: Session, which: ColumnElement[bool]) -> tuple[list[Member], int]:
    of = Demonstration
    surgeons = {row.row: (row.slug, may(row, "atlas")) for row in session.scalars(select(Surgeon))}
    query = select(
        of.row, of.sha256, of.surgeon_row, of.session, of.recording_row, of.arm, of.frame, of.start_s, of.end_s
    )
    rows = session.execute(query.where(which, of.withdrawn_at.is_(None)).order_by(of.row)).all()
    members = [
        Member(one.row, one.sha256, surgeons[one.surgeon_row][0], one.session, *one[4:])
        for one in rows
        if surgeons[one.surgeon_row][1]
    ]
    return members, len(rows) - len(members)


def without_overlaps(members: Sequence[Member]) -> tuple[list[Member], list[Member]]:
    """Divide members, the oldest first, into those that count and the cuts that a newer one overlaps."""
    counted: dict[tuple[int, str], list[Member]] = {}
    overlapped = []
    for one in reversed(members):
        newer = counted.setdefault((one.recording_row, one.arm), [])
        if any(one.same_motion(other) for other in newer):
            overlapped.append(one)
        else:
            newer.append(one)
    out = {one.row for one in overlapped}
    return [one for one in members if one.row not in out], overlapped[::-1]


def sessions_of(members: Sequence[Member]) -> Ints:
    """Number the sessions: demonstrations of one session name, or of one recording, were recorded together.

    Cuts of one recording belong to one session even if their session names differ, or only some have one.
    """
    together: dict[object, set[int]] = {}
    session = np.arange(len(members))
    for number, one in enumerate(members):
        for key in {one.recording_row, one.session or one.recording_row}:
            together.setdefault(key, set()).add(number)
    for numbers in together.values():
        joined = np.unique(session[sorted(numbers)])
        session[np.isin(session, joined)] = joined[0]
    return np.unique(session, return_inverse=True)[1]
