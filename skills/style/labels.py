"""The hand-offs that somebody named: stages of a recorder's tags, gestures of JIGSAWS.

    stages    "hand-off", "handover", "A1 A2": both at once; "A1" and then "A2": one after the other
    gestures  G6 (pull the suture with the left hand), then G8 (orient the needle), then G4 (pass it to the right)

The paper says that its tasks generalise the gestures of JIGSAWS; that A1 is G6 and A2 what follows of G8 and G4 is our
reading (Fig. 3). A G8 after the G4 is of the other hand, and belongs to the next stitch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Literal

from skills.style.recording import Label

FOLLOWS_NS = 5_000_000_000  # A2 begins within 5 s of the end of A1, or belongs to another hand-off
MOST = 200  # of one recording; more are a mistake, and each costs a look at its motion
NAMES = ("handoff", "handover")
PULL, ORIENT, PASS_ON = "G6", "G8", "G4"


@dataclass(frozen=True)
class Named:
    """A hand-off that somebody named, in the recording's own nanoseconds; `handover_ns` where A1's end is named too."""

    kind: Literal["stage", "gesture"]
    start_ns: int
    end_ns: int
    handover_ns: int | None
    words: str


def named_hand_offs(labels: Sequence[Label]) -> tuple[Named, ...]:
    """Find the hand-offs among labels, in order of time: those of stages, where no stage is one those of gestures."""
    return tuple(islice(_of_stages(labels), MOST)) or tuple(islice(_of_gestures(labels), MOST))


def _of_stages(labels: Sequence[Label]) -> Iterator[Named]:
    tasks = [(task, one) for one in labels if one.kind == "stage" and (task := _task_of(one.name)) is not None]
    for number, (task, one) in enumerate(tasks):
        if task == "both":
            yield Named("stage", one.start_ns, one.end_ns, None, f"the stage {one.name!r} was tagged")
        elif task == "A1":
            after = [other for kind, other in tasks[number + 1 : number + 2] if kind == "A2"]
            if after and after[0].start_ns - one.end_ns <= FOLLOWS_NS:
                words = f"the stages {one.name!r} and {after[0].name!r} were tagged"
                yield Named("stage", one.start_ns, after[0].end_ns, one.end_ns, words)
            else:
                yield Named("stage", one.start_ns, one.end_ns, one.end_ns, f"the stage {one.name!r} was tagged")


def _task_of(name: str) -> Literal["A1", "A2", "both"] | None:
    words = "".join(letter if letter.isalnum() else " " for letter in name.lower()).split()
    one, other, joined = "a1" in words, "a2" in words, "".join(words)
    if one != other:
        return "A1" if one else "A2"
    return "both" if one or joined == "a1a2" or any(part in joined for part in NAMES) else None


def _of_gestures(labels: Sequence[Label]) -> Iterator[Named]:
    gestures = [one for one in labels if one.kind == "gesture"]
    for number, pull in enumerate(gestures):
        if pull.name != PULL:
            continue
        last, heard = pull, [PULL]
        for one in gestures[number + 1 : number + 3]:
            if one.name not in (ORIENT, PASS_ON) or last.name == PASS_ON or one.start_ns - last.end_ns > FOLLOWS_NS:
                break
            last, heard = one, [*heard, one.name]
        if len(heard) > 1:
            words = f"the gestures {', '.join(heard)} were transcribed"
            yield Named("gesture", pull.start_ns, last.end_ns, pull.end_ns, words)
