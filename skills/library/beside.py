"""Beside whom a motion is scored: the stored demonstrations of its suture type, measured against the same reference.

Percentiles are by the skill level that surgeons say of themselves, and a surgeon's own demonstrations make a course
over time. Whoever did not agree to be compared is not among them.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from skills.db.base import rfc3339
from skills.db.models import Demonstration, MeasuredShape, Surgeon
from skills.errors import BadPath, Conflict
from skills.library.catalogue import check_consent
from skills.style._arrays import Floats
from skills.style.comparing.distances import distances
from skills.style.comparing.measured import VERSION
from skills.style.comparing.shapes import shape_of
from skills.style.scoring.deviation import laid
from skills.style.scoring.figures import KINDS, Numbers
from skills.style.scoring.model import LEVELS

USE = "atlas"  # the use that a surgeon's consent must cover, for somebody's motion is compared with others'
LEAST_DEMOS, LEAST_SURGEONS = 5, 2  # of a level: with fewer, a percentile says nothing, or says it of one person
MOST_OTHERS = 1000  # the newest of a suture type; percentiles of more are not told apart on a page


@dataclass(frozen=True, eq=False)
class Other:
    """One stored demonstration, measured as the scored one is."""

    row: Demonstration
    numbers: Numbers


@dataclass
class _Level:
    """The demonstrations of the surgeons of one skill level."""

    name: str
    numbers: list[Numbers] = field(default_factory=list)
    surgeons: set[int] = field(default_factory=set)


def others_of(session: Session, suture: str, onto_mm: Floats) -> Iterator[Other]:
    """Measure the newest demonstrations of a suture type, whose surgeons agreed, against a reference's shape."""
    query = (
        select(Demonstration)
        .where(Demonstration.suture == suture, Demonstration.withdrawn_at.is_(None))
        .order_by(Demonstration.row.desc())
        .limit(MOST_OTHERS)
    )
    agreed = {row.row: row for row in session.scalars(query) if agrees(row.surgeon)}
    shapes = _shapes(session, list(agreed))
    if not shapes:
        return
    totals = distances(np.stack([laid(shape, onto_mm) for shape in shapes.values()]), onto_mm[None])[:, 0]
    for (row, shape), total in zip(shapes.items(), totals.tolist(), strict=True):
        reported = {kind.name: agreed[row].report.get(kind.name) for kind in KINDS}
        measured = {"size_mm": float(shape[-1, 0]), "distance_mm": total / len(onto_mm)}
        yield Other(agreed[row], reported | measured)


def agrees(surgeon: Surgeon) -> bool:
    """Tell whether a surgeon's consent covers being compared."""
    try:
        check_consent(surgeon, USE)
    except Conflict:
        return False
    return True


def _shapes(session: Session, rows: Sequence[int]) -> dict[int, Floats]:
    """Take the shapes of demonstrations, by row: what the atlas has measured, and otherwise measured here."""
    of_these = MeasuredShape.demonstration_row.in_(rows)
    kept = session.scalars(select(MeasuredShape).where(of_these, MeasuredShape.version == VERSION))
    shapes = {one.demonstration_row: one.measured.shape_mm for one in kept}
    recorded = select(Demonstration.row, Demonstration.demo).where(Demonstration.row.in_({*rows} - {*shapes}))
    for row, demo in session.execute(recorded):
        try:
            shapes[row] = shape_of(demo)
        except BadPath:  # it ends where it began: there is nothing that it could be compared in
            continue
    return {row: shape for row, shape in shapes.items() if shape is not None}


def percentiles(
    others: Sequence[Other], mine: Numbers, scored: Demonstration | None, reference: Demonstration
) -> list[dict[str, Any]]:
    """Place the figures of a motion among the demonstrations of each skill level."""
    return [_percentile(level, mine) for level in _by_level(others, scored, reference)]


def _by_level(others: Sequence[Other], scored: Demonstration | None, reference: Demonstration) -> list[_Level]:
    """Sort demonstrations by the skill level of their surgeons; the two that are compared are not among them."""
    levels: dict[str | None, _Level] = {name: _Level(name) for name in LEVELS}
    out = {reference.row, *([scored.row] if scored else [])}
    for other in others:
        level = levels.get(other.row.surgeon.skill_level)
        if level is not None and other.row.row not in out:
            level.numbers.append(other.numbers)
            level.surgeons.add(other.row.surgeon_row)
    return list(levels.values())


def _percentile(level: _Level, mine: Numbers) -> dict[str, Any]:
    """Say which share of a level's demonstrations has a smaller value than the scored one; equal ones count half."""
    told: dict[str, Any] = {"level": level.name, "demos": len(level.numbers), "surgeons": len(level.surgeons)}
    if len(level.numbers) < LEAST_DEMOS or len(level.surgeons) < LEAST_SURGEONS:
        reason = f"at least {LEAST_DEMOS} demonstrations of {LEAST_SURGEONS} surgeons are needed"
        return told | {"reason": reason, "below": None}
    below = {name: _share_below(mine[name], [one[name] for one in level.numbers]) for name in mine}
    return told | {"reason": None, "below": below}


def _share_below(value: float | None, among: Sequence[float | None]) -> float | None:
    """Place a value; None where it, or that of too many others, was not recorded."""
    known = [one for one in among if one is not None]
    if value is None or len(known) < LEAST_DEMOS:
        return None
    return sum(0.5 if math.isclose(one, value) else float(one < value) for one in known) / len(known)


def course(others: Sequence[Other], scored: Demonstration | None) -> list[dict[str, Any]]:
    """List the scored surgeon's demonstrations of the suture type up to the scored one, in the order of recording."""
    if scored is None:
        return []

    def when(row: Demonstration) -> tuple[int, float]:
        return row.recording_row, row.start_s

    mine = [one for one in others if one.row.surgeon_row == scored.surgeon_row and when(one.row) <= when(scored)]
    return [
        {
            "demo": one.row.sha256,
            "session": one.row.session,
            "stored_at": rfc3339(one.row.recording.created_at),
            "distance_mm": one.numbers["distance_mm"],
            "duration_s": one.numbers["duration_s"],
            "log_dimensionless_jerk": one.numbers["log_dimensionless_jerk"],
        }
        for one in sorted(mine, key=lambda one: when(one.row))
    ]
