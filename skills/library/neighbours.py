"""Nearest neighbours of a demonstration among all of its suture type, from an index in memory.

    Database --nearest_to--> Nearest

The index has the shape of each demonstration that may be compared (`skills.comparison.nearest`); it is filled at the
first request after a start. Every request first reads which demonstrations are active, and which surgeons' consent
covers an atlas, and adds and removes what has changed; and at its end it reads those that it returns once more. So a
withdrawal, an erasure or an ended consent acts at once. `forget_gone` removes them from memory between requests too.

One process holds at most `skills.comparison.nearest.MOST` shapes; the suture types that were not asked for longest make
room. What a key may not see stays in the index, and is not searched for it.
"""

from dataclasses import dataclass, field
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np
from sqlalchemy import Engine, Text, cast, func, select
from sqlalchemy.orm import Session

from skills.arrays import Floats, Ints
from skills.comparison import nearest as places
from skills.comparison.distances import STATES, in_lengths
from skills.comparison.nearest import ShapeIndex
from skills.db import in_parts
from skills.db.models import Demonstration, Surgeon
from skills.db.row_visibility import EVERYBODYS, ONLY
from skills.db.session import Database
from skills.errors import BadPath, Busy, Conflict
from skills.library.atlas import DISTANCE, NO_DIRECTION, UNITS, keep_shapes, kept_shapes, shapes_of
from skills.library.consent import may, require
from skills.library.demos import find_demo
from skills.library.members import Member, members_among, without_overlaps
from skills.schemas.comparison import Nearest, Neighbour

ROWS_AT_ONCE = 500  # shapes read from the database
PATIENCE_S = 30.0  # timeout of the wait for another thread that fills the index
DIGITS = 4
MORE = 8  # neighbours beyond the requested ones, for those that turn out to be cuts of one motion


@dataclass(eq=False)
class _Held:
    """The index of one suture type, and the rows without a direction, which it cannot have."""

    index: ShapeIndex = field(default_factory=ShapeIndex)
    without: set[int] = field(default_factory=set)
    said: str | None = None  # the rows as the database last listed them

    def known(self) -> Ints:
        return np.concatenate([self.index.rows, np.array(sorted(self.without), np.int64)])


_held: WeakKeyDictionary[Engine, dict[str, _Held]] = WeakKeyDictionary()
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
        Busy: Another thread has been filling the index for more than `PATIENCE_S`.
    """
    if not _using.acquire(timeout=PATIENCE_S):
        raise Busy("The shapes of the demonstrations are being read; request it again in a moment.")
    try:
        with database.reading() as session:
            asked = _asked(session, demo)
            everybodys = _Listed(session, asked.suture, everybodys=True)
            visible = _Listed(session, asked.suture) if ONLY in session.info else everybodys
        held = _follow(database, asked.suture, everybodys, visible.rows())
        if asked.row not in held.index:
            raise BadPath(f"{NO_DIRECTION} Cut the hand-off from its start to the point where the needle is taken.")
        among = np.isin(held.index.rows, visible.rows(), kind="table")
        shape = held.index.shape_of(asked.row)
        wanted = count
        while True:
            found = held.index.nearest(
                in_lengths(shape) if scaled else shape, wanted + MORE, scaled=scaled, among=among
            )
            neighbours = _counted(database, asked, *found)
            if len(neighbours) >= count or len(found[0]) < wanted + MORE:
                break
            wanted *= 2
        searched = int(among.sum()) - 1
    finally:
        _using.release()
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
    if not _held.get(database.engine) or not _using.acquire(blocking=False):
        return
    try:
        for suture, held in _held.get(database.engine, {}).items():
            with database.reading() as session:
                _remove(held, _Listed(session, suture, everybodys=True))
    finally:
        _using.release()


def _asked(session: Session, demo: str) -> Demonstration:
    found = find_demo(session, demo)
    if found.withdrawn_at is not None:
        raise Conflict("This demonstration was withdrawn; it is no longer compared.")
    require(found.surgeon, "atlas")
    return found


class _Listed:
    """The rows of a suture type that may be compared, as one text: cheap to read, and to compare with the last one."""

    def __init__(self, session: Session, suture: str, *, everybodys: bool = False) -> None:
        options = EVERYBODYS if everybodys else {}
        of = Demonstration
        surgeons = [one.row for one in session.scalars(select(Surgeon), execution_options=options) if may(one, "atlas")]
        # Both queries are answered by an index alone: a row has the whole motion in it.
        listed = select(func.aggregate_strings(cast(of.row, Text), ",")).where(of.suture == suture)
        withdrawn = select(of.row).where(of.withdrawn_at.is_not(None))
        self._texts = [
            session.scalar(listed.where(of.surgeon_row.in_(some)), execution_options=options) or ""
            for some in in_parts(surgeons)
        ]
        self._withdrawn = sorted(session.scalars(withdrawn, execution_options=options))

    @property
    def said(self) -> str:
        return f"{';'.join(self._texts)} {self._withdrawn}"

    def rows(self) -> Ints:
        """Return the rows, increasing, shape (N,)."""
        numbers = [np.array(text.split(","), np.int64) for text in self._texts if text]
        listed = np.concatenate(numbers) if numbers else np.empty(0, np.int64)
        return np.setdiff1d(listed, np.array(self._withdrawn, np.int64))


def _follow(database: Database, suture: str, everybodys: "_Listed", visible: Ints) -> _Held:
    """Bring the index of a suture type up to date, with what the caller may see, and make it the last to be dropped."""
    indices = _held.setdefault(database.engine, {})
    held = indices.pop(suture, None) or _Held()
    indices[suture] = held
    _remove(held, everybodys)
    missing = np.setdiff1d(visible, held.known()).tolist()
    if len(held.index) + len(missing) > places.MOST:
        raise Conflict(
            f"There are {len(held.index) + len(missing)} demonstrations of '{suture}', and an index holds "
            f"{places.MOST}; withdraw those that are not used for learning.",
            demos=len(held.index) + len(missing),
        )
    while sum(len(one.index) for one in indices.values()) + len(missing) > places.MOST:
        del indices[next(one for one in indices if one != suture)]
    for at in range(0, len(missing), ROWS_AT_ONCE):
        _add(database, held, missing[at : at + ROWS_AT_ONCE])
    return held


def _remove(held: _Held, everybodys: "_Listed") -> None:
    """Remove the rows that may not be compared any more."""
    if everybodys.said == held.said:
        return
    held.said = everybodys.said
    gone = np.setdiff1d(held.known(), everybodys.rows()).tolist()
    held.index.remove(gone)
    held.without -= {*gone}


def _add(database: Database, held: _Held, rows: list[int]) -> None:
    kept = kept_shapes(database, rows)
    new = shapes_of(database, [row for row in rows if row not in kept])
    keep_shapes(database, new)
    for row, measured in (kept | new).items():
        if measured.shape_mm is None:
            held.without.add(row)
        else:
            held.index.add(row, measured.shape_mm)


def _counted(database: Database, asked: Demonstration, rows: Ints, totals: Floats) -> list[Neighbour]:
    """Return the neighbours that are visible, active and agreed now, and not another cut of the same motion."""
    with database.reading() as session:
        require(_asked(session, asked.sha256).surgeon, "atlas")  # consent may have ended since
        beside = members_among(session, asked.suture, rows.tolist())
    counted, _ = without_overlaps(beside)
    own = next((one for one in beside if one.row == asked.row), None)
    there: dict[int, Member] = {one.row: one for one in counted}
    neighbours = []
    for row, total in zip(rows.tolist(), totals.tolist(), strict=True):
        one = there.get(row)
        if one is None or row == asked.row or (own is not None and one.same_motion(own)):
            continue
        neighbours.append(
            Neighbour(
                demo=one.sha256,
                surgeon=one.surgeon,
                session=one.session,
                arm=one.arm,
                distance=round(total / STATES, DIGITS),
            )
        )
    return neighbours
