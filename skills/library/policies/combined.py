"""Demonstrations that a policy is learnt from: one, or several combined into one path.

A combined path that is none of the demonstrations is stored only as the policy's path. To get more of it, combine the
demonstrations again, which gives the same result; `skills verify` compares the resulting path with the policy's.
"""

from collections.abc import Sequence
from typing import NamedTuple

from sqlalchemy.orm import Session

from skills.comparison.combining import Combined, Combining, Followed, followed
from skills.db.models import Demonstration, PolicyVersion, Surgeon
from skills.demonstration.demonstration import Demo
from skills.errors import BadInput, Conflict
from skills.gridworld.grid import GridPath
from skills.library.recordings.demos import find_demo, newest_demos
from skills.remedies import Action, Remedy
from skills.schemas.policies import Combined as CombinedFigures
from skills.schemas.training import CombineIn

MOST_DEMOS = 50  # ours: all pairs are compared, and the combined path with each some ten times, in a third of a second

BEST = CombineIn(kind="corridor")  # nearest to left-out demonstrations, with an outlier and without: docs/results.md


def choose_demos(
    session: Session, who: Surgeon, suture: str, demos: list[str] | None, *, any_outcome: bool = False
) -> list[Demonstration]:
    """Return the requested demonstrations, the oldest first, or the newest one of the style if none are named.

    Args:
        session: The caller's transaction.
        who: The surgeon.
        suture: The suture type.
        demos: Their digests, or None.
        any_outcome: Accept demonstrations that are marked recovery or failure.

    Raises:
        NotFound: One is unknown.
        Conflict: One was withdrawn, or marked recovery or failure; or the style has none.
        BadInput: One is of another style or named twice, there are too many, or they cannot be combined.
    """
    if demos:
        chosen = sorted((find_demo(session, one) for one in demos), key=lambda demo: demo.row)
    else:
        chosen = newest_demos(session, who.row, suture, 1, any_outcome=any_outcome)
    if not chosen:
        raise _none(session, who, suture)
    if len(chosen) > MOST_DEMOS:
        raise BadInput(f"At most {MOST_DEMOS} demonstrations can be combined.", demos=len(chosen))
    if len({demo.row for demo in chosen}) < len(chosen):
        raise BadInput("A demonstration is named twice; name each once.")
    if any((demo.surgeon_row, demo.suture) != (who.row, suture) for demo in chosen):
        raise BadInput("The demonstration belongs to another style.")
    if any(demo.withdrawn_at is not None for demo in chosen):
        raise Conflict("The demonstration was withdrawn.")
    if not any_outcome and (failed := [demo for demo in chosen if demo.failed]):
        one, reason = failed[0], (failed[0].outcome_reason or "no reason is given").rstrip(".")
        why = f"The demonstration {one.sha256[:12]} is marked {one.outcome}: {reason}."
        raise Conflict(why, Remedy(Action.TRAIN_ANY), demos=[demo.sha256 for demo in failed])
    refuse_unlike(chosen)
    return chosen


def _none(session: Session, who: Surgeon, suture: str) -> Conflict:
    """Return the error that a style has no demonstration to learn from."""
    if newest_demos(session, who.row, suture, 1, any_outcome=True):
        why = f"Every active demonstration of '{suture}' by '{who.slug}' is marked recovery or failure."
        return Conflict(why, Remedy(Action.TRAIN_ANY))
    add = Remedy(Action.ADD_DEMO, surgeon=who.slug, suture=suture)
    return Conflict(f"'{who.slug}' has no active demonstration of '{suture}'.", add)


def refuse_unlike(demonstrations: Sequence[Demonstration]) -> None:
    """Refuse demonstrations that cannot be combined, before their values are read.

    Raises:
        BadInput: They differ in arm, frame or instrument.
    """
    for name in ("arm", "frame", "instrument"):
        if len(found := sorted({getattr(one, name) for one in demonstrations})) > 1:
            raise BadInput(
                f"The demonstrations have the {name}s {', '.join(found)}; only demonstrations of one arm, in one "
                "frame and with one instrument can be combined."
            )


def describe_combined(found: Followed, how: Combining, demos: Sequence[str]) -> CombinedFigures:
    """Return the description of a combination: its kind, its medoid, and the widths and distances of the combined path.

    Args:
        found: The combined path.
        how: The way of combining.
        demos: The digests of the demonstrations, the oldest first.
    """
    combined = found.combined
    return CombinedFigures(
        kind=how,
        medoid=demos[combined.medoid],
        at=demos[combined.at],
        moved=combined.moved,
        apart_mm=tuple(combined.apart_mm.round(6).tolist()),
        width_mm=tuple(found.width_mm.round(6).tolist()),
        hysteresis=found.path.hysteresis,
        bridged_cells=found.path.bridged,
    )


class LearntFrom(NamedTuple):
    """What a policy was learnt from: a demonstration with its path, or those into which several were combined."""

    demo: Demo
    path: GridPath
    combined: Combined | None


def learnt_from(version: PolicyVersion) -> LearntFrom:
    """Return what a policy was learnt from, computed from its demonstrations and not read from the policy.

    Several are combined again, which gives the same result.
    """
    rows, combined = version.demonstrations, version.manifest.combined
    if combined is None:
        return LearntFrom(rows[0].demo, rows[0].path, None)
    found = followed([one.demo for one in rows], [one.path for one in rows], combined.kind)
    return LearntFrom(found.demo, found.path, found.combined)
