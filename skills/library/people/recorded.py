"""Surgeons who are recorded in some seconds of recordings, and the refusal of a use that not all of them allow.

    demonstrations, or a recording --episodes_of, whole--> queries of episodes --recorded_in--> SurgeonsRecorded

In an episode is recorded whoever has a demonstration at the same time, whoever had one there that was erased, and
everybody for whom the recording was uploaded, because nobody knows when they are to be seen. Somebody who was erased is
still in the bytes of a recording that others are in too: without a name (`ErasedInterval`), and for no use.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, cast

from sqlalchemy import ColumnElement, Select, Table, and_, exists, literal, or_, select
from sqlalchemy.orm import Session

from skills.db import in_parts
from skills.db.models import Demonstration, ErasedInterval, RecordingSurgeon, StoredRecording, Surgeon
from skills.db.row_visibility import ALL_ROWS
from skills.db.session import Database
from skills.errors import Conflict
from skills.formats.parsed import ParsedContent
from skills.library.people import consent
from skills.library.recordings.recordings import Parser, find_recording, stored_recording

# Bare tables, because a surgeon whom the caller may not see has to consent too.
_DEMOS, _NAMED, _ERASED = (
    cast(Table, one.__table__).alias() for one in (Demonstration, RecordingSurgeon, ErasedInterval)
)
RECORDED = cast(Table, Demonstration.__table__).alias("recorded")
Episodes = Iterable[Select[Any]]  # of recording_row, surgeon_row, start_s, end_s, and whether the whole is shown


class SurgeonsRecorded(NamedTuple):
    """The surgeons who are recorded in some episodes, and whether somebody who was erased is."""

    surgeons: list[Surgeon]
    erased: bool

    @property
    def single(self) -> bool:
        """True if exactly one surgeon is recorded."""
        return len(self.surgeons) == 1 and not self.erased

    def may(self, use: consent.Use) -> bool:
        """Return whether all of them allow a use today."""
        return not self.erased and all(consent.may(one, use) for one in self.surgeons)

    def require(self, use: consent.Use, known: Collection[int] = ()) -> None:
        """Refuse a use that not all of them allow today.

        Args:
            use: The use.
            known: The rows of the surgeons whom the caller may see, and the message may name.

        Raises:
            Conflict: A consent does not cover it, or somebody was erased.
        """
        for surgeon in self.surgeons:
            if surgeon.row in known:
                consent.require(surgeon, use)
        if not self.may(use):
            covers = f"whose consent does not cover {consent.CALLED[use]}, or who was erased"
            raise Conflict(f"The recording shows {'another' if known else 'a'} surgeon {covers}.")


def episodes_of(demonstrations: Sequence[int], *, whole: bool) -> Iterator[Select[Any]]:
    """Yield queries of the episodes of some demonstrations: their intervals, or their whole recordings."""
    columns = (_DEMOS.c.recording_row, _DEMOS.c.surgeon_row, _DEMOS.c.start_s, _DEMOS.c.end_s)
    for some in in_parts(demonstrations):
        yield select(*columns, literal(whole).label("whole")).where(_DEMOS.c.row.in_(some))


def in_recording(session: Session, recording: StoredRecording) -> SurgeonsRecorded:
    """Return who is recorded in a whole recording."""
    values = {"recording_row": recording.row, "surgeon_row": 0, "start_s": 0.0, "end_s": 0.0, "whole": True}
    columns: list[Any] = [literal(value).label(name) for name, value in values.items()]
    return recorded_in(session, [select(*columns)])


def recording_for(session: Session, recording_sha256: str, use: consent.Use) -> StoredRecording:
    """Return a recording whose motion is used.

    Raises:
        Conflict: Somebody in it does not allow the use.
    """
    recording = find_recording(session, recording_sha256)
    in_recording(session, recording).require(use)
    return recording


def shown_recording(database: Database, recording_sha256: str, parse: Parser) -> ParsedContent:
    """Return the content of a stored recording, to be shown; the consents of all in it are checked after it was read.

    It raises the errors of `recording_for`, and of `skills.library.recordings.recordings.stored_recording`.
    """
    parsed = stored_recording(database, recording_sha256, parse)
    with database.reading() as session:
        recording_for(session, recording_sha256, "any")
    return parsed


def recorded_in(session: Session, episodes: Episodes) -> SurgeonsRecorded:
    """Return who is recorded in some episodes."""
    found = {row for one in episodes for query in _recorded(one) for row in session.scalars(query.distinct())}
    rows = sorted(found - {None})
    of = (select(Surgeon).where(Surgeon.row.in_(some)).order_by(Surgeon.row) for some in in_parts(rows))
    surgeons = [one for query in of for one in session.scalars(query, execution_options=ALL_ROWS)]
    return SurgeonsRecorded(surgeons, None in found)


def overlap(of: Any, shown: Any = RECORDED.c) -> ColumnElement[bool]:
    """Return the condition that an interval `shown` of a recording is seen in an episode with the columns `of`."""
    at_once = and_(shown.start_s <= of.end_s, shown.end_s >= of.start_s)
    return and_(shown.recording_row == of.recording_row, or_(of.whole, at_once))


def _recorded(episodes: Select[Any]) -> Iterator[Select[Any]]:
    """Yield queries of the surgeons who are recorded in some episodes; null is somebody who was erased.

    Only demonstrations of other surgeons are compared with the episodes, so the time does not grow with the square of
    those in one recording.
    """
    of = episodes.cte("episodes").c
    recordings = select(of.recording_row)
    yield select(of.surgeon_row)
    others = RECORDED.c.recording_row.in_(recordings), RECORDED.c.surgeon_row.not_in(select(of.surgeon_row))
    yield select(RECORDED.c.surgeon_row).where(*others, exists().where(overlap(of)))
    yield select(_NAMED.c.surgeon_row).where(_NAMED.c.recording_row.in_(recordings))
    shown = or_(_ERASED.c.start_s.is_(None), exists().where(overlap(of, _ERASED.c)))
    yield select(_ERASED.c.surgeon_row).where(_ERASED.c.recording_row.in_(recordings), shown)
