"""Shapes of demonstrations and the distances between them, measured once and stored.

    rows --far_apart--> Distances

A pair is measured at the first request that contains both demonstrations, so a new demonstration costs one row of
distances. The results are stored in one row for each demonstration (`MeasuredShape`), in short transactions during the
measuring, so that an interruption loses little work. Both kinds of distances are stored, in mm and scaled.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, delete, func, insert, select

from skills.arrays import Floats, Ints
from skills.comparison.distances import VERSION, Measured, distances_of, in_lengths, shape_of
from skills.comparison.recognition import NUMBERS, signature_of
from skills.db import in_parts
from skills.db.models import Demonstration, MeasuredShape
from skills.db.packed import pack
from skills.db.row_visibility import ALL_ROWS
from skills.db.session import Database
from skills.demonstration.demonstration import Demo
from skills.errors import BadPath, Busy
from skills.library.operation import locks

DEMOS_AT_ONCE = 100  # recorded motions in memory; each has some thousand samples
PAIRS_AT_ONCE = 20_000  # measured between two transactions: about a second
MEASURED = "The distances between demonstrations are being measured; request them again in a moment."
PATIENCE_S = 30.0  # timeout of the wait for another thread's measuring; 1000 demonstrations take about as long

_measuring = Lock()  # two requests at once would measure the same pairs twice

ByRow = dict[int, Measured]  # by the demonstration's row


@dataclass(frozen=True, eq=False)
class Distances:
    """Shapes, and the distances between all of them.

    Attributes:
        rows: Rows of the demonstrations that have a shape, increasing, shape (N,).
        shapes_mm: Shape (N, STATES, 3).
        apart_mm: DTW totals in mm, shape (N, N); NaN for pairs that were not measured yet.
        apart_scaled: The same for scaled shapes, in lengths of start to goal.
        signatures: Shape (N, NUMBERS).
    """

    rows: Ints
    shapes_mm: Floats
    apart_mm: Floats
    apart_scaled: Floats
    signatures: Floats


def far_apart(database: Database, rows: Sequence[int]) -> Distances:
    """Return the distances between demonstrations, given by their rows; those without a direction are left out.

    Missing distances are measured and stored.

    Raises:
        Busy: Another thread has been measuring for more than `PATIENCE_S`.
    """
    wanted = sorted({*rows})
    known = stored_shapes(database, wanted)
    apart = _laid_out(known)
    if len(known) == len(wanted) and not np.isnan(apart.apart_mm).any():
        return apart
    with one_at_a_time(_measuring, MEASURED):
        complete = apart.rows[~np.isnan(apart.apart_mm).any(axis=1)]
        known |= stored_shapes(database, sorted({*wanted} - {*complete.tolist()}))  # measured by another thread
        new = shapes_of(database, [row for row in wanted if row not in known])
        store_shapes(database, new)
        known |= new
        for measured in _measure(known):
            store_shapes(database, measured)
            known |= measured
    return _laid_out(known)


@contextmanager
def one_at_a_time(lock: Lock, busy: str) -> Iterator[None]:
    """Hold a lock.

    Raises:
        Busy: Another thread has held it for more than `PATIENCE_S`; the message is `busy`.
    """
    if not lock.acquire(timeout=PATIENCE_S):
        raise Busy(busy)
    try:
        yield
    finally:
        lock.release()


def shapes_of(database: Database, rows: Sequence[int]) -> ByRow:
    """Compute the shapes of recorded demonstrations, `DEMOS_AT_ONCE` at a time."""
    made: ByRow = {}
    of, nothing = Demonstration, (np.empty(0, np.int64), np.empty(0), np.empty(0))
    for some in in_parts(rows, DEMOS_AT_ONCE):
        with database.reading() as session:
            recorded = session.execute(select(of.row, of.demo).where(of.row.in_(some))).all()
        made |= {row: Measured(shape_or_none(demo), *nothing, signature_of(demo)) for row, demo in recorded}
    return made


def shape_or_none(demo: Demo) -> Floats | None:
    """Return the shape of a motion; None if it ends where it began, so that it has no direction to be compared."""
    try:
        return shape_of(demo)
    except BadPath:
        return None


def _measure(known: Mapping[int, Measured]) -> Iterator[ByRow]:
    """Measure the missing distances; yield the rows that have grown after every block of pairs."""
    apart = _laid_out(known)
    scaled = np.array([in_lengths(shape) for shape in apart.shapes_mm]).reshape(apart.shapes_mm.shape)
    for block in _blocks(np.isnan(apart.apart_mm)):
        pairs = np.array([(one, other) for one, others in block for other in others.tolist()])
        totals = np.stack([distances_of(apart.shapes_mm, pairs), distances_of(scaled, pairs)])
        parts = np.split(totals, np.cumsum([len(others) for _, others in block])[:-1], axis=1)
        grown: ByRow = {}
        for (one, others), (mm, lengths) in zip(block, parts, strict=True):
            row = int(apart.rows[one])
            before = known[row]
            grown[row] = replace(
                before,
                others=np.append(before.others, apart.rows[others]),
                apart_mm=np.append(before.apart_mm, mm),
                apart_scaled=np.append(before.apart_scaled, lengths),
            )
        yield grown


def _blocks(missing: NDArray[np.bool_]) -> Iterator[list[tuple[int, Ints]]]:
    """Divide the missing pairs, (N, N), among rows, the row with most missing pairs first.

    Each pair is measured in one row only. So a new demonstration takes all its pairs into its own row, and the stored
    rows of the others need not be written again.
    """
    missing = missing.copy()
    counts = missing.sum(axis=1)
    block: list[tuple[int, Ints]] = []
    pairs = 0
    while counts.any():
        one = int(counts.argmax())
        others = np.flatnonzero(missing[one])
        missing[one], missing[:, one] = False, False
        counts[others] -= 1
        counts[one] = 0
        block.append((one, others))
        pairs += len(others)
        if pairs >= PAIRS_AT_ONCE:
            yield block
            block, pairs = [], 0
    if block:
        yield block


def _laid_out(known: Mapping[int, Measured]) -> Distances:
    """Return the known distances as full matrices."""
    shapes = {row: shape for row in sorted(known) if (shape := known[row].shape_mm) is not None}
    rows = np.array(list(shapes), np.int64)
    apart_mm, apart_scaled = (np.full((len(rows), len(rows)), np.nan) for _ in range(2))
    for at, row in enumerate(rows.tolist()):
        one = known[row]
        places = np.searchsorted(rows, one.others).clip(max=len(rows) - 1)
        there = rows[places] == one.others
        for matrix, totals in ((apart_mm, one.apart_mm), (apart_scaled, one.apart_scaled)):
            matrix[at, at] = 0.0
            matrix[at, places[there]] = matrix[places[there], at] = totals[there]
    signatures = np.array([known[row].signature for row in shapes]).reshape(-1, NUMBERS)
    return Distances(rows, np.array(list(shapes.values())), apart_mm, apart_scaled, signatures)


def is_current() -> ColumnElement[bool]:
    """Return the condition of the stored rows of this version: of shapes alone, and of shapes with distances."""
    return MeasuredShape.version.in_((VERSION, -VERSION))


def stored_shapes(database: Database, rows: Sequence[int]) -> ByRow:
    """Return the stored measurements of demonstrations, given by their rows, of those that have any."""
    query = select(MeasuredShape.demonstration_row, MeasuredShape.measured)
    mine = is_current(), MeasuredShape.demonstration_row.in_(rows)
    with database.reading() as session:
        return {row: measured for row, measured in session.execute(query.where(*mine)).all()}  # noqa: C416 - mypy


def store_shapes(database: Database, measured: Mapping[int, Measured]) -> None:
    """Replace the stored rows of some demonstrations by new measurements.

    Nothing is stored if a demonstration in a row, on either side of a distance, was erased since: its distance would
    remain.
    """
    packed = [
        {"demonstration_row": row, "version": VERSION if len(one.others) else -VERSION, "measured": pack(one)}
        for row, one in measured.items()
    ]  # packed before the transaction, which others wait for
    if not packed:
        return
    named = sorted({*measured}.union(*(one.others.tolist() for one in measured.values())))
    with database.writing([locks.DISTANCES]) as session:
        for some in in_parts(named):  # also of surgeons that this caller may not see
            there = select(func.count()).select_from(Demonstration).where(Demonstration.row.in_(some))
            if session.scalar(there, execution_options=ALL_ROWS) != len(some):
                return
        session.execute(delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(measured)))
        session.execute(insert(MeasuredShape), packed)
