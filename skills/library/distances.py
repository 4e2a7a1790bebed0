"""Distances between demonstrations: measured once and stored, and measured again after a deletion.

A pair is measured at the first request that contains both demonstrations, so a new demonstration costs one row of
distances. The results are stored in one row for each demonstration (`MeasuredShape`), in short transactions during the
measuring, so that an interruption loses little work. Both kinds of distances are stored, in mm and scaled: an atlas
uses one or the other.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import delete, func, insert, select

from skills.arrays import Floats, Ints
from skills.comparison.distances import VERSION, Measured, distances_of, in_lengths, shape_of
from skills.db.base import in_parts
from skills.db.models import Demonstration, MeasuredShape
from skills.db.packed import pack
from skills.db.row_visibility import EVERYBODYS
from skills.db.session import Database
from skills.demonstration.demonstration import Demo
from skills.errors import BadPath, Busy

DEMOS_AT_ONCE = 100  # recorded motions in memory; each has some thousand samples
PAIRS_AT_ONCE = 20_000  # measured between two transactions: about a second
PATIENCE_S = 30.0  # timeout of the wait for another thread's measuring; 1000 demonstrations take about as long

_measuring = Lock()  # two requests at once would measure the same pairs twice

Kept = dict[int, Measured]  # by the demonstration's row


@dataclass(frozen=True, eq=False)
class Apart:
    """Shapes, and the distances between all of them.

    Attributes:
        rows: Rows of the demonstrations that have a shape, increasing, shape (N,).
        shapes_mm: Shape (N, STATES, 3).
        apart_mm: DTW totals in mm, shape (N, N); NaN for pairs that were not measured yet.
        apart_scaled: The same for scaled shapes, in lengths of start to goal.
    """

    rows: Ints
    shapes_mm: Floats
    apart_mm: Floats
    apart_scaled: Floats


def far_apart(database: Database, rows: Sequence[int]) -> Apart:
    """Return the distances between demonstrations, given by their rows; those without a direction are left out.

    Missing distances are measured and stored.

    Raises:
        Busy: Another thread has been measuring for more than `PATIENCE_S`.
    """
    wanted = sorted({*rows})
    kept = _kept(database, wanted)
    apart = _laid_out(kept)
    if len(kept) == len(wanted) and not np.isnan(apart.apart_mm).any():
        return apart
    with _one_at_a_time():
        known = apart.rows[~np.isnan(apart.apart_mm).any(axis=1)]
        kept |= _kept(database, sorted({*wanted} - {*known.tolist()}))  # measured by another thread
        new = _shapes(database, [row for row in wanted if row not in kept])
        _keep(database, new)
        kept |= new
        for measured in _measure(kept):
            _keep(database, measured)
            kept |= measured
    return _laid_out(kept)


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    if not _measuring.acquire(timeout=PATIENCE_S):
        raise Busy("The distances between demonstrations are being measured; request them again in a moment.")
    try:
        yield
    finally:
        _measuring.release()


# ---- measuring ---------------------------------------------------------------------------------------------------


def _shapes(database: Database, rows: Sequence[int]) -> Kept:
    """Compute the shapes of recorded demonstrations, `DEMOS_AT_ONCE` at a time."""
    made: Kept = {}
    for at in range(0, len(rows), DEMOS_AT_ONCE):
        some = Demonstration.row.in_(rows[at : at + DEMOS_AT_ONCE])
        with database.reading() as session:
            recorded = session.execute(select(Demonstration.row, Demonstration.demo).where(some)).all()
        made |= {row: Measured(_shape(demo), *_NOTHING) for row, demo in recorded}
    return made


def _shape(demo: Demo) -> Floats | None:
    try:
        return shape_of(demo)
    except BadPath:  # it has no direction; the atlas lists it as left out
        return None


_NOTHING = np.empty(0, np.int64), np.empty(0), np.empty(0)


def _measure(kept: Mapping[int, Measured]) -> Iterator[Kept]:
    """Measure the missing distances; yield the rows that have grown after every block of pairs."""
    apart = _laid_out(kept)
    scaled = np.array([in_lengths(shape) for shape in apart.shapes_mm]).reshape(apart.shapes_mm.shape)
    for block in _blocks(np.isnan(apart.apart_mm)):
        pairs = np.array([(one, other) for one, others in block for other in others.tolist()])
        totals = np.stack([distances_of(apart.shapes_mm, pairs), distances_of(scaled, pairs)])
        parts = np.split(totals, np.cumsum([len(others) for _, others in block])[:-1], axis=1)
        grown: Kept = {}
        for (one, others), (mm, lengths) in zip(block, parts, strict=True):
            row = int(apart.rows[one])
            known = kept[row]
            grown[row] = Measured(
                known.shape_mm,
                np.append(known.others, apart.rows[others]),
                np.append(known.apart_mm, mm),
                np.append(known.apart_scaled, lengths),
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


def _laid_out(kept: Mapping[int, Measured]) -> Apart:
    """Return the known distances as full matrices."""
    shapes = {row: kept[row].shape_mm for row in sorted(kept)}
    rows = np.array([row for row, shape in shapes.items() if shape is not None], np.int64)
    apart_mm, apart_scaled = (np.full((len(rows), len(rows)), np.nan) for _ in range(2))
    for at, row in enumerate(rows.tolist()):
        known = kept[row]
        places = np.searchsorted(rows, known.others).clip(max=len(rows) - 1)
        there = rows[places] == known.others
        for matrix, totals in ((apart_mm, known.apart_mm), (apart_scaled, known.apart_scaled)):
            matrix[at, at] = 0.0
            matrix[at, places[there]] = matrix[places[there], at] = totals[there]
    whole = np.array([shape for shape in shapes.values() if shape is not None])
    return Apart(rows, whole, apart_mm, apart_scaled)


# ---- storage -----------------------------------------------------------------------------------------------------


def _kept(database: Database, rows: Sequence[int]) -> Kept:
    query = select(MeasuredShape.demonstration_row, MeasuredShape.measured)
    mine = MeasuredShape.version == VERSION, MeasuredShape.demonstration_row.in_(rows)
    with database.reading() as session:
        return {row: measured for row, measured in session.execute(query.where(*mine)).all()}  # noqa: C416 - mypy


def _keep(database: Database, measured: Mapping[int, Measured]) -> None:
    """Replace the stored rows of some demonstrations by new measurements.

    Nothing is stored if a demonstration in a row, on either side of a distance, was erased since: its distance would
    remain.
    """
    packed = [
        {"demonstration_row": row, "version": VERSION, "measured": pack(one)} for row, one in measured.items()
    ]  # packed before the transaction, which others wait for
    if not packed:
        return
    named = sorted({*measured}.union(*(one.others.tolist() for one in measured.values())))
    with database.writing() as session:
        for some in in_parts(named):  # also of surgeons that this caller may not see
            there = select(func.count()).select_from(Demonstration).where(Demonstration.row.in_(some))
            if session.scalar(there, execution_options=EVERYBODYS) != len(some):
                return
        session.execute(delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(measured)))
        session.execute(insert(MeasuredShape), packed)
