"""The part of a recording that a demonstration is cut from, chosen by the request or among the proposed hand-offs."""

from collections.abc import Sequence
from typing import NamedTuple

from skills.demonstration.segments import Segment
from skills.errors import BadSegment, SegmentNotNamed
from skills.formats.parsed import MOST, ParsedContent
from skills.remedies import Action, Remedy
from skills.schemas.demos import DemoIn


class ChosenPart(NamedTuple):
    """A request with the arm and the times of the part to cut, the name of that part, and the reason for the choice."""

    cut: DemoIn
    name: str
    because: str


def choose_part(parsed: ParsedContent, cut: DemoIn) -> ChosenPart:
    """Return the part of a recording that a request names, or else the only proposed hand-off, or the whole.

    Raises:
        SegmentNotNamed: Several hand-offs are proposed, and the request names none.
        BadSegment: The part is named in two ways, or there is no such proposal.
    """
    timed = cut.start_s is not None or cut.end_s is not None
    if timed and cut.segment is not None:
        raise BadSegment("Choose the part by segment, or by start_s and end_s, but not by both.")
    if timed:
        return ChosenPart(cut, "the given times", "start_s or end_s was given")
    if cut.segment == "whole":
        return ChosenPart(cut, "the whole recording", "segment=whole was given")
    fitting = {m.arm for m in parsed.recording.motions if cut.arm in (None, m.arm) and cut.topic in (None, m.topic)}
    proposed = [one for one in parsed.proposed if one.arm in fitting]
    if isinstance(cut.segment, int):
        if not 1 <= cut.segment <= len(proposed):
            raise BadSegment(f"There is no proposal {cut.segment}. {_list(proposed)}", segments=_numbered(proposed))
        return _proposal(cut, proposed, cut.segment)
    if not proposed:
        return ChosenPart(cut, "the whole recording", "no hand-off is proposed in it; check that it holds exactly one")
    if len(proposed) > 1:
        raise SegmentNotNamed(_list(proposed), Remedy(Action.NAME_SEGMENT), segments=_numbered(proposed))
    return _proposal(cut, proposed, 1)


def _proposal(cut: DemoIn, proposed: Sequence[Segment], number: int) -> ChosenPart:
    one = proposed[number - 1]
    part = cut.model_copy(update={"arm": one.arm, "start_s": one.start_s, "end_s": one.end_s})
    why = "it is the only one" if cut.segment is None else f"segment={number} was given"
    return ChosenPart(part, f"proposal {number} of {len(proposed)}", f"{why}: {one.reason}")


def _numbered(proposed: Sequence[Segment]) -> list[dict[str, object]]:  # JSON, in the numbers of a refusal
    """Return proposals with their numbers, the first `MOST`."""
    return [
        {"segment": number, "arm": one.arm, "start_s": one.start_s, "end_s": one.end_s, "reason": one.reason}
        for number, one in enumerate(proposed[:MOST], 1)
    ]


def _list(proposed: Sequence[Segment]) -> str:
    """Return a sentence that lists the proposals, the first ten with their times."""
    if not proposed:
        return "No hand-off is proposed in this recording."
    shown = [f"{n}: {one.arm}, {one.start_s:.2f} to {one.end_s:.2f} s" for n, one in enumerate(proposed[:10], 1)]
    rest = "; ..." if len(proposed) > len(shown) else ""
    are = "1 hand-off is" if len(proposed) == 1 else f"{len(proposed)} hand-offs are"
    return f"{are} proposed in this recording ({'; '.join(shown)}{rest})."
