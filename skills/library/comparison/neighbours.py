"""Nearest neighbours of a demonstration among all of its suture type, from an index in memory.

    Database --nearest_to--> Nearest

The index has the shape of each demonstration that may be compared (`skills.comparison.nearest`); it is filled at the
first request after a start. Every request first reads which demonstrations are active, and which surgeons' consent
covers an atlas, and adds and removes what has changed; and at its end it reads those that it returns once more. So a
withdrawal, an erasure or an ended consent acts at once. `forget_gone` removes them from memory between requests too.

One process holds at most `skills.comparison.nearest.MOST` shapes; the suture types that were not asked for longest make
room. What a key may not see stays in the index, and is not searched for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from sqlalchemy import ColumnElement, Engine, Row, Text, cast, func, select
from sqlalchemy.orm import Session

from skills.arrays import Floats, Ints
from skills.comparison import nearest as places
from skills.comparison.distances import STATES, in_lengths
from skills.comparison.nearest import ShapeIndex
from skills.db import in_parts
from skills.db.models import Demonstration, Surgeon
from skills.db.row_visibility import ALL_ROWS, ONLY
from skills.db.session import Database
from skills.errors import BadPath, Conflict
from skills.library.comparison.atlas import DISTANCE, NO_DIRECTION, UNITS
from skills.library.comparison.measuring import one_at_a_time, shapes_of, store_shapes, stored_shapes
from skills.library.comparison.members import Member, comparable_demo, members_among, without_overlaps
from skills.library.people.consent import may
from skills.schemas.comparison import Nearest, Neighbour

ROWS_AT_ONCE = 500  # shapes read from the database
DIGITS = 4
CALLERS = 8  # keys with different rows whose rows are remembered
MORE = 8  # neighbours beyond the requested ones, for those that turn out to be cuts of one motion


@dataclass(eq=False)
class _SutureIndex:
    """The index of one suture type, and the rows without a direction, which it cannot have."""

    index: ShapeIndex = field(default_factory=ShapeIndex)
    without: set[int] = field(default_factory=set)
    listed: "_Listed | None" = None  # the rows as the database last listed them
    visible: dict["_Listed", Ints] = field(default_factory=dict)  # what callers may see; the index has all of it

    def known(self) -> Ints:
        return np.concatenate([self.index.rows, np.array(sorted(self.without), np.int64)])


_indices: WeakKeyDictionary[Engine, dict[str, _SutureIndex]] = WeakKeyDictionary()
_using = Lock()


def nearest_to(database: Database, demo: str, count: int, *, scaled: bool = False) -> Nearest:
    """Return the demonstrations of the same suture type whose shapes are nearest to one's, exactly.

    Of overlapping cuts of one motion the newest counts; cuts of the requested one's own motion do not.

    Args:
        database: The database, restricted to the rows that the caller may see.
        demo: Digest of the demonstration.
        count: Number of neighbours.
        scaled: Scale all shapes so that start and goal coincide; sizes are then ignored.

    Raises:
        NotFound: There is no such demonstration.
        Conflict: It was withdrawn, or consent does not cover it; or there are more than an index holds.
        BadPath: It has no direction.
        Busy: Another thread has been filling the index for more than `measuring.PATIENCE_S`.
    """
    with one_at_a_time(_using, "The shapes of the demonstrations are being read; request it again in a moment."):
        with database.reading() as session:
            asked = comparable_demo(session, demo)
            every_row = _listed(session, asked.suture, ALL_ROWS)
            visible = _listed(session, asked.suture, {}) if ONLY in session.info else every_row
            held = _touch(database, asked.suture)
            _remove(session, held, every_row)
            rows = held.visible[visible] if visible in held.visible else visible.rows(session)
        if visible not in held.visible:
            _add_missing(database, asked.suture, held, rows)
            if len(held.visible) == CALLERS:
                held.visible.clear()
            held.visible[visible] = rows
        if asked.row not in held.index:
            raise BadPath(f"{NO_DIRECTION} Cut the hand-off from its start to the point where the needle is taken.")
        among = None if visible == every_row else np.isin(held.index.rows, rows, kind="table")
        shape = held.index.shape_of(asked.row)
        shape, wanted = in_lengths(shape) if scaled else shape, count + MORE
        while True:
            found = held.index.nearest(shape, wanted, scaled=scaled, among=among)
            neighbours = _counted(database, asked, *found)
            if len(neighbours) >= count or len(found[0]) < wanted:
                break
            wanted = 2 * (wanted - MORE) + MORE
        searched = (len(held.index) if among is None else int(among.sum())) - 1
    return Nearest(
        demo=asked.sha256,
        suture=asked.suture,
        scaled=scaled,
        unit=UNITS[scaled],
        searched=searched,
        nearest=neighbours[:count],
        notes=[DISTANCE],
    )


def forget_gone(database: Database) -> None:
    """Remove from the indices in memory what may not be compared any more; a request in progress does it itself."""
    if not _indices.get(database.engine) or not _using.acquire(blocking=False):
        return
    try:
        for suture, held in _indices.get(database.engine, {}).items():
            with database.reading() as session:
                _remove(session, held, _listed(session, suture, ALL_ROWS))
    finally:
        _using.release()


@dataclass(frozen=True)
class _Listed:
    """The rows of a suture type that may be compared, in short: cheap to read, and to compare with the last one.

    Rows are never used twice and never change, so as long as these agree the rows are the same ones: of the same
    surgeons, without the same withdrawn ones, as many with the same sum up to the same last one.
    """

    suture: str
    surgeons: tuple[int, ...]
    withdrawn: tuple[int, ...]
    count: int
    total: int
    last: int
    options: Mapping[str, bool] = field(compare=False)  # of the queries: with or without the rows that are hidden

    def rows(self, session: Session) -> Ints:
        """Return the rows, increasing, shape (N,)."""
        rows = func.aggregate_strings(cast(Demonstration.row, Text), ",")  # one text: of many rows the fastest way
        texts = _of_each(session, [rows], self.suture, self.surgeons, self.options)
        numbers = [np.array(text.split(","), np.int64) for (text,) in texts if text]
        return np.setdiff1d(np.concatenate(numbers) if numbers else np.empty(0, np.int64), np.array(self.withdrawn))


def _listed(session: Session, suture: str, options: Mapping[str, bool]) -> _Listed:
    of = Demonstration.row
    surgeons = [one.row for one in session.scalars(select(Surgeon), execution_options=options) if may(one, "atlas")]
    figures = [func.count(), func.coalesce(func.sum(of), 0), func.coalesce(func.max(of), 0)]
    found = _of_each(session, figures, suture, surgeons, options)
    counts, totals, lasts = zip(*found, strict=True) if found else ((), (), ())
    withdrawn = select(of).where(Demonstration.withdrawn_at.is_not(None))
    gone = tuple(sorted(session.scalars(withdrawn, execution_options=options)))
    return _Listed(suture, tuple(surgeons), gone, sum(counts), int(sum(totals)), max(lasts, default=0), options)


def _of_each(
    session: Session,
    columns: Sequence[ColumnElement[Any]],
    suture: str,
    surgeons: Sequence[int],
    options: Mapping[str, bool],
) -> list[Row[Any]]:
    """Aggregate the rows of surgeons' demonstrations; an index alone has them, where a row has the whole motion."""
    query = select(*columns).where(Demonstration.suture == suture)
    some = (query.where(Demonstration.surgeon_row.in_(part)) for part in in_parts(surgeons))
    return [session.execute(one, execution_options=options).one() for one in some]


def _touch(database: Database, suture: str) -> _SutureIndex:
    """Return the index of a suture type, now the last that makes room for others."""
    indices = _indices.setdefault(database.engine, {})
    indices[suture] = indices.pop(suture) if suture in indices else _SutureIndex()
    return indices[suture]


def _remove(session: Session, held: _SutureIndex, every_row: _Listed) -> None:
    """Remove the rows that may not be compared any more."""
    if every_row == held.listed:
        return
    gone = np.setdiff1d(held.known(), every_row.rows(session)).tolist()
    held.index.remove(gone)
    held.without -= {*gone}
    held.listed = every_row
    held.visible.clear()


def _add_missing(database: Database, suture: str, held: _SutureIndex, visible: Ints) -> None:
    """Add the rows that a caller may see and that the index does not have."""
    indices, missing = _indices[database.engine], np.setdiff1d(visible, held.known()).tolist()
    demos = len(held.index) + len(missing)
    if demos > places.MOST:
        raise Conflict(
            f"There are {demos} demonstrations of '{suture}', and an index holds {places.MOST}; withdraw those that "
            "are not used for learning.",
            demos=demos,
        )
    while sum(len(one.index) for one in indices.values()) + len(missing) > places.MOST:
        del indices[next(one for one in indices if one != suture)]
    for some in in_parts(missing, ROWS_AT_ONCE):
        _add(database, held, some)


def _add(database: Database, held: _SutureIndex, rows: Sequence[int]) -> None:
    known = stored_shapes(database, rows)
    new = shapes_of(database, [row for row in rows if row not in known])
    store_shapes(database, new)
    for row, measured in (known | new).items():
        if measured.shape_mm is None:
            held.without.add(row)
        else:
            held.index.add(row, measured.shape_mm)


def _counted(database: Database, asked: Demonstration, rows: Ints, totals: Floats) -> list[Neighbour]:
    """Return the neighbours that are visible, active and agreed now, and not another cut of the same motion."""
    with database.reading() as session:
        comparable_demo(session, asked.sha256)  # consent may have ended since
        beside = members_among(session, asked.suture, rows.tolist())
    counted, _ = without_overlaps(beside)
    own = next((one for one in beside if one.row == asked.row), None)
    there: dict[int, Member] = {one.row: one for one in counted}
    neighbours = []
    for row, total in zip(rows.tolist(), totals.tolist(), strict=True):
        one = there.get(row)
        if one is None or row == asked.row or (own is not None and one.same_motion(own)):
            continue
        apart = round(total / STATES, DIGITS)
        found = Neighbour(demo=one.sha256, surgeon=one.surgeon, session=one.session, arm=one.arm, distance=apart)
        neighbours.append(found)
    return neighbours
