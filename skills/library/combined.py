"""Policies that were learnt from several demonstrations: which way they follow, and what is told of it.

A way that is none of them is stored nowhere but as the policy's path. Whoever needs more of it combines the
demonstrations again, which gives the same; `skills verify` compares the path that comes out with the policy's.
"""

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from skills.db.models import Demonstration, PolicyVersion, Surgeon
from skills.errors import BadInput, Conflict
from skills.library.demos import find_demo, newest_demo
from skills.style.combining import COMBININGS, Combined, Combining, Corridor, Followed, followed
from skills.style.demo import Demo
from skills.style.grid import GridPath

MOST_DEMOS = 50  # ours: all pairs are compared, and the way with each some ten times, in a third of a second
BEST = Corridor()  # nearest to demonstrations left out, with an outlier and without: docs/results.md


def choose_demos(session: Session, who: Surgeon, suture: str, demos: list[str] | None) -> list[Demonstration]:
    """Find the demonstrations that are asked for, the oldest first, or else the newest active one of the style.

    Raises:
        NotFound: One is unknown.
        Conflict: One was withdrawn, or the style has none.
        BadInput: One is of another style or named twice, or they cannot be combined.
    """
    found = [find_demo(session, one) for one in demos] if demos else [newest_demo(session, who.row, suture)]
    chosen = sorted((demo for demo in found if demo is not None), key=lambda demo: demo.row)
    if not chosen:
        raise Conflict(f"'{who.slug}' has no active demonstration of '{suture}'; POST /demos adds one.")
    if len(chosen) > MOST_DEMOS:
        raise BadInput(f"At most {MOST_DEMOS} demonstrations are combined.", demos=len(chosen))
    if len({demo.row for demo in chosen}) < len(chosen):
        raise BadInput("A demonstration is named twice; name each once.")
    if any((demo.surgeon_row, demo.suture) != (who.row, suture) for demo in chosen):
        raise BadInput("The demonstration belongs to another style.")
    if any(demo.withdrawn_at is not None for demo in chosen):
        raise Conflict("The demonstration was withdrawn.")
    _refuse_unlike(chosen)
    return chosen


def _refuse_unlike(demonstrations: Sequence[Demonstration]) -> None:
    """Refuse demonstrations that `combine` refuses, before anything is read of them.

    Raises:
        BadInput: They are not of one arm, frame and instrument.
    """
    for name in ("arm", "frame", "instrument"):
        if len(found := sorted({getattr(one, name) for one in demonstrations})) > 1:
            raise BadInput(
                f"They are of the {name}s {', '.join(found)}; demonstrations are combined if they are of one arm, in "
                "one frame, with one instrument."
            )


def combining_of(described: dict[str, Any]) -> Combining:
    """Read from JSON how demonstrations are combined."""
    return COMBININGS[described["kind"]]()


def describe_combined(found: Followed, how: Combining, demos: Sequence[str]) -> dict[str, Any]:
    """Write how demonstrations, their digests the oldest first, were combined, and how wide their way is.

    `width_mm` is within what the majority of them pass each waypoint; `apart_mm` how far the way is from each of them,
    at a state on average; `hysteresis` and `bridged_cells` are the path's.
    """
    combined = found.combined
    return {
        "kind": how.kind,
        "medoid": demos[combined.medoid],
        "at": demos[combined.at],
        "moved": combined.moved,
        "apart_mm": combined.apart_mm.round(6).tolist(),
        "width_mm": found.width_mm.round(6).tolist(),
        "hysteresis": found.path.hysteresis,
        "bridged_cells": found.path.bridged,
    }


def learnt_from(version: PolicyVersion) -> Demo:
    """Find the demonstration that a policy's path was made of, or what its demonstrations make together."""
    return version.demonstration.demo if "combined" not in version.manifest else _followed(version).demo


def path_of(version: PolicyVersion) -> GridPath:
    """Find the path of what a policy was learnt from, not from the policy but from its demonstrations."""
    return version.demonstration.path if "combined" not in version.manifest else _followed(version).path


def combined_of(version: PolicyVersion) -> Combined | None:
    """Find the way that a policy's demonstrations make together; None of one alone."""
    return None if "combined" not in version.manifest else _followed(version).combined


def _followed(version: PolicyVersion) -> Followed:
    rows = version.demonstrations
    return followed([one.demo for one in rows], [one.path for one in rows], combining_of(version.manifest["combined"]))
