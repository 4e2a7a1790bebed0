"""Policies learnt from several demonstrations: the choice of demonstrations, and the combined path that they follow.

A combined path that is none of the demonstrations is stored only as the policy's path. To get more of it, combine the
demonstrations again, which gives the same result; `skills verify` compares the resulting path with the policy's.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import exists, func, select
from sqlalchemy.orm import Session

from skills.comparison.combining import COMBININGS, Combined, Combining, Corridor, Followed, followed
from skills.db.models import Demonstration, PolicyDemonstration, PolicyVersion, Release, Surgeon
from skills.demonstration.demonstration import Demo
from skills.errors import BadInput, Conflict
from skills.fields import as_json
from skills.gridworld.grid import GridPath
from skills.library.demos import find_demo, newest_demo
from skills.library.releases import is_served
from skills.remedies import Action, Remedy
from skills.schemas import policies as described

MOST_DEMOS = 50  # ours: all pairs are compared, and the combined path with each some ten times, in a third of a second
BEST = Corridor()  # nearest to left-out demonstrations, with an outlier and without: docs/results.md


def choose_demos(session: Session, who: Surgeon, suture: str, demos: list[str] | None) -> list[Demonstration]:
    """Return the requested demonstrations, the oldest first, or the newest active one of the style if none are named.

    Raises:
        NotFound: One is unknown.
        Conflict: One was withdrawn, or the style has none.
        BadInput: One is of another style or named twice, there are too many, or they cannot be combined.
    """
    found = [find_demo(session, one) for one in demos] if demos else [newest_demo(session, who.row, suture)]
    chosen = sorted((demo for demo in found if demo is not None), key=lambda demo: demo.row)
    if not chosen:
        add = Remedy(Action.ADD_DEMO, surgeon=who.slug, suture=suture)
        raise Conflict(f"'{who.slug}' has no active demonstration of '{suture}'.", add)
    if len(chosen) > MOST_DEMOS:
        raise BadInput(f"At most {MOST_DEMOS} demonstrations can be combined.", demos=len(chosen))
    if len({demo.row for demo in chosen}) < len(chosen):
        raise BadInput("A demonstration is named twice; name each once.")
    if any((demo.surgeon_row, demo.suture) != (who.row, suture) for demo in chosen):
        raise BadInput("The demonstration belongs to another style.")
    if any(demo.withdrawn_at is not None for demo in chosen):
        raise Conflict("The demonstration was withdrawn.")
    refuse_unlike(chosen)
    return chosen


@dataclass(frozen=True)
class Recipe:
    """The number of demonstrations of a style's served policy, and the way they were combined."""

    demos: int
    how: Combining


def recipes_of(session: Session, surgeons: Collection[int] | None = None) -> dict[tuple[int, str], Recipe]:
    """Return, with one statement, the recipes of the styles that serve a policy of several demonstrations.

    Args:
        session: The caller's transaction.
        surgeons: The rows of surgeons; None: all.

    Returns:
        By style: a surgeon's row and a suture type.
    """
    if surgeons is not None and not surgeons:
        return {}
    by, other = PolicyVersion, PolicyDemonstration
    kind = by.manifest["combined"]["kind"].as_string()
    mine = other.policy_row == by.row
    others = select(func.count()).select_from(other).where(mine).correlate(by).scalar_subquery()
    several = exists().where(mine).correlate(by)
    query = select(Release.surgeon_row, Release.suture, kind, others).join(by, by.row == Release.policy_row)
    query = query.where(is_served(), several)
    if surgeons is not None:
        query = query.where(Release.surgeon_row.in_(surgeons))
    found = session.execute(query)
    return {(who, suture): Recipe(more + 1, combining_of({"kind": how})) for who, suture, how, more in found}


def newest_demos(session: Session, surgeon_row: int, suture: str, most: int) -> list[Demonstration]:
    """Return the newest active demonstrations of a style, at most `most`, the oldest of them first."""
    of = Demonstration
    active = select(of).where(of.surgeon_row == surgeon_row, of.suture == suture, of.withdrawn_at.is_(None))
    # Selected from the newest back, returned from the oldest on.
    return list(session.scalars(active.order_by(of.row.desc()).limit(most)))[::-1]


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


def combining_of(described: dict[str, Any]) -> Combining:
    """Return the combination that a JSON object describes."""
    return COMBININGS[described["kind"]]()


def describe_combined(found: Followed, how: Combining, demos: Sequence[str]) -> dict[str, Any]:
    """Return the JSON of a combination: its kind, its medoid, and the widths and distances of the combined path.

    Args:
        found: The combined path.
        how: The way of combining.
        demos: The digests of the demonstrations, the oldest first.
    """
    combined = found.combined
    written: dict[str, Any] = as_json(
        described.Combined(
            kind=how.kind,
            medoid=demos[combined.medoid],
            at=demos[combined.at],
            moved=combined.moved,
            apart_mm=tuple(combined.apart_mm.round(6).tolist()),
            width_mm=tuple(found.width_mm.round(6).tolist()),
            hysteresis=found.path.hysteresis,
            bridged_cells=found.path.bridged,
        )
    )
    return written


def learnt_from(version: PolicyVersion) -> Demo:
    """Return the demonstration that a policy was learnt from, or the one that its demonstrations were combined into."""
    return version.demonstration.demo if "combined" not in version.manifest else _followed(version).demo


def path_of(version: PolicyVersion) -> GridPath:
    """Return the path that a policy was learnt from, computed from its demonstrations and not read from the policy."""
    return version.demonstration.path if "combined" not in version.manifest else _followed(version).path


def combined_of(version: PolicyVersion) -> Combined | None:
    """Return the combination of a policy's demonstrations; None for a single one."""
    return None if "combined" not in version.manifest else _followed(version).combined


def _followed(version: PolicyVersion) -> Followed:
    rows = version.demonstrations
    return followed([one.demo for one in rows], [one.path for one in rows], combining_of(version.manifest["combined"]))
