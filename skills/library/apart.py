"""How far demonstrations are apart: measured once and kept, and measured again where it was dropped.

A pair is measured when somebody first asks about both, so a new demonstration costs one row of distances. What was
measured is kept as a row for each demonstration (`MeasuredShape`), in short transactions between the measuring, so that
whoever is interrupted has not worked for nothing. Both kinds of distance are kept: one atlas or the other asks for it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import delete, func, insert, select

from skills.db.models import Demonstration, MeasuredShape
from skills.db.packed import pack
from skills.db.session import Database
from skills.errors import BadPath, Busy
from skills.style._arrays import Floats, Ints
from skills.style.comparing.distances import distances_of
from skills.style.comparing.measured import VERSION, Measured
from skills.style.comparing.shapes import in_lengths, shape_of
from skills.style.demo import Demo

DEMOS_AT_ONCE = 100  # recorded motions in memory; each has some thousand samples
PAIRS_AT_ONCE = 20_000  # measured between two transactions: about a second
PATIENCE_S = 30.0  # with somebody else's measuring; of 1000 demonstrations it takes about as long

_measuring = Lock()  # what one request measures, another would measure too

Kept = dict[int, Measured]  # by the row of the demonstration


@dataclass(frozen=True, eq=False)
class Apart:
    """Shapes, and the distances between all of them.

    Attributes:
        rows: Of the demonstrations that have a shape, increasing, shape (N,).
        shapes_mm: Shape (N, STATES, 3).
        apart_mm: Totals of dynamic time warping, shape (N, N); NaN where nobody has measured yet.
        apart_scaled: The same in lengths of start to goal, of scaled shapes.
    """

    rows: Ints
    shapes_mm: Floats
    apart_mm: Floats
    apart_scaled: Floats


def far_apart(database: Database, rows: Sequence[int]) -> Apart:
    """Tell how far demonstrations, given by their rows, are apart; those without a direction are left out.

    What is not known yet is measured and kept.

    Raises:
        Busy: Somebody else has been measuring for long.
    """
    wanted = sorted({*rows})
    kept = _kept(database, wanted)
    apart = _laid_out(kept)
    if len(kept) == len(wanted) and not np.isnan(apart.apart_mm).any():
        return apart
    with _one_at_a_time():
        known = apart.rows[~np.isnan(apart.apart_mm).any(axis=1)]
        kept |= _kept(database, sorted({*wanted} - {*known.tolist()}))  # somebody may have measured it meanwhile
        new = _shapes(database, [row for row in wanted if row not in kept])
        _keep(database, wanted, new)
        kept |= new
        for measured in _measure(kept):
            _keep(database, wanted, measured)
            kept |= measured
    return _laid_out(kept)


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    if not _measuring.acquire(timeout=PATIENCE_S):
        raise Busy("The distances between demonstrations are being measured; ask again in a moment.")
    try:
        yield
    finally:
        _measuring.release()


# ---- what is measured --------------------------------------------------------------------------------------------


def _shapes(database: Database, rows: Sequence[int]) -> Kept:
    """Lay recorded demonstrations out, a few at a time."""
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
    except BadPath:  # it has no direction; whoever asks about it is told so
        return None


_NOTHING = np.empty(0, np.int64), np.empty(0), np.empty(0)


def _measure(kept: Mapping[int, Measured]) -> Iterator[Kept]:
    """Measure what is missing, and give out every now and then the rows that have grown."""
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
    """Share the missing pairs, (N, N), out among rows: whoever misses most takes all of his, so a new one takes all."""
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
    """Put what is known into whole matrices."""
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


# ---- what is kept ------------------------------------------------------------------------------------------------


def _kept(database: Database, rows: Sequence[int]) -> Kept:
    query = select(MeasuredShape.demonstration_row, MeasuredShape.measured)
    mine = MeasuredShape.version == VERSION, MeasuredShape.demonstration_row.in_(rows)
    with database.reading() as session:
        return {row: measured for row, measured in session.execute(query.where(*mine)).all()}  # noqa: C416 - mypy


def _keep(database: Database, wanted: Sequence[int], measured: Mapping[int, Measured]) -> None:
    """Keep what was measured of some, in place of what was kept of them.

    Nothing is kept where one of those that are compared was erased meanwhile: a distance from it would stay.
    """
    packed = [
        {"demonstration_row": row, "version": VERSION, "measured": pack(one)} for row, one in measured.items()
    ]  # before the transaction, which others wait for
    if not packed:
        return
    there = select(func.count()).select_from(Demonstration).where(Demonstration.row.in_(wanted))
    with database.writing() as session:
        if session.scalar(there) != len(wanted):
            return
        session.execute(delete(MeasuredShape).where(MeasuredShape.demonstration_row.in_(measured)))
        session.execute(insert(MeasuredShape), packed)
