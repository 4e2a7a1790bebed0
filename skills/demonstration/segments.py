"""Segments: the hand-offs of a recording, labelled or detected.

    Recording --propose_segments--> Segments: the start of A1, the transition to A2, the end of A2, and the reasons

**Labels.** Stages of a recorder's tags and gestures of JIGSAWS name hand-offs:

    stages    "hand-off", "handover", "A1 A2": both tasks at once; "A1" and then "A2": one after the other
    gestures  G6 (pull the suture with the left hand), then G8 (orient the needle), then G4 (pass it to the right)

The paper says that its tasks generalise the gestures of JIGSAWS; that A1 is G6 and A2 the G8 and G4 that follow is our
reading (Fig. 3). A G8 after the G4 is made by the other hand and belongs to the next stitch.

**Proposals.** A segment's times are a proposal: the surgeon decides, and `cut_demo` takes any other times. All of it is
ours; the paper cut by hand. Of four methods the first that applies is used:

* *named*: stages of a recorder's tags, or gestures of JIGSAWS, if they name a hand-off;
* *transfer*: the last movement in which the jaw holds a needle before it gives it to another arm's (`transfers`). Used
  if such a transfer between any two arms was found;
* *jaw*: an interval in which the jaw holds something, from the first movement in it to the last. Within one hold the
  hand may rest for `HELD_PAUSE_S`. Used if the jaw was recorded and opened and closed, even if it finds nothing;
* *motion*: an interval of movement between rests. If the jaw was not recorded but the wrist was, a hand-off ends with a
  turn in place: the paper found that the orientation does not change in A1, and A2 is a turn. If there is no such turn
  either, every movement that is long enough is proposed.

Of more than `PROPOSALS_LIMIT` hand-offs of an arm the first are proposed. Labelled hand-offs that overlap are taken
until together they last `OVERLAP_LIMIT` times as long as the motion. So the work is proportional to the length of the
motion, whatever the labels are.

Pauses in which the arm was not driven belong to the movement around them. A candidate that is small compared with the
recording's other candidates is hand-work (M1, M2): steadying tissue, reaching.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from typing import Literal

import numpy as np

from skills.arrays import Flags, Floats
from skills.demonstration.movement import (
    TURNING_RAD_S,
    Movement,
    Span,
    bridged,
    inside,
    movement_of,
    offset,
    onset,
    spans_of,
    undriven,
)
from skills.demonstration.partner import REGRIP_S, NeedleTransfer, closed_jaw, find_transfers, partner_at
from skills.demonstration.recording import BaseFrame, Label, Motion, Recording, base_frames
from skills.fields import Fraction, computed_field, schema

FOLLOWS_NS = 5_000_000_000  # an A2 that begins later than 5 s after the end of A1 belongs to another hand-off
MOST = 200  # per recording; more are a mistake, and for each the motion has to be analysed
NAMES = ("handoff", "handover")
PULL, ORIENT, PASS_ON = "G6", "G8", "G4"


@dataclass(frozen=True)
class Named:
    """A labelled hand-off, in the recording's own nanoseconds; `handover_ns` is None unless A1's end is labelled."""

    kind: Literal["stage", "gesture"]
    start_ns: int
    end_ns: int
    handover_ns: int | None
    words: str


def named_hand_offs(labels: Sequence[Label]) -> tuple[Named, ...]:
    """Find the hand-offs among the labels of a recording: those of stages, or those of gestures if no stage names one.

    Args:
        labels: The labels, in order of time.

    Returns:
        The first `MOST` hand-offs, in order of time.
    """
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
        last, shared = pull, [PULL]
        for one in gestures[number + 1 : number + 3]:
            if one.name not in (ORIENT, PASS_ON) or last.name == PASS_ON or one.start_ns - last.end_ns > FOLLOWS_NS:
                break
            last, shared = one, [*shared, one.name]
        if len(shared) > 1:
            words = f"the gestures {', '.join(shared)} were transcribed"
            yield Named("gesture", pull.start_ns, last.end_ns, pull.end_ns, words)


PAUSE_S = 1.5  # a shorter rest is hesitation, not the end of a pass
HELD_PAUSE_S = 3.0  # the same while the jaw holds something: the pass does not end before the release
STROKE_PAUSE_S = 0.6  # the same if hand-offs are found by a turn in place: gripping the needle takes longer
PAUSED_SHARE = 0.5  # a rest in which the arm was not driven for this share does not end a pass, however long it is
SHORTEST_S = 0.5
SHORTEST_MM = 3.0
SMALL_SHARE = 0.35  # of the upper quartile of the candidates' extents: smaller ones are hand-work
SMALLEST_TURN_RAD = 0.15  # 9 degrees: a last turn by less is an unsteady wrist
A2_RAD = 0.35  # 20 degrees in place: far more than an unsteady wrist, less than any necessary realignment
A1_SHARE = 1 / 3  # of the turn in place: a hand that reaches for the needle also turns, but on the way
PROPOSALS_LIMIT = 1000  # of one arm
OVERLAP_LIMIT = 3
RELEASE_S = 3.0  # longest time from the last movement to the release, and to the other arm's grip

FoundBy = Literal["stage", "gesture", "transfer", "jaw", "motion"]
Spans = Floats  # of shape (K, 2): start and end of each


@schema
@dataclass(frozen=True)
class Segment:
    """A proposed hand-off, in seconds since the recording's `origin_ns`.

    Attributes:
        arm: Name of the arm.
        start_s: Start of A1: the tip moves off with the needle.
        end_s: End of A2: the end of the arm's last movement before it releases the needle.
        handover_s: Transition from A1 to A2: the tip comes to rest.
        found_by: The source of the proposal: stage, gesture, transfer, jaw or motion.
        reasons: The reasons in words, the most important first.
        confidence: Probability that the needle was given to another arm at its end; null unless found by a transfer.
    """

    arm: str
    start_s: float
    end_s: float
    handover_s: float
    found_by: str
    reasons: tuple[str, ...]
    confidence: Fraction | None = None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def reason(self) -> str:
        """All reasons in one sentence."""
        return "; ".join(self.reasons)


@dataclass(frozen=True, eq=False)
class _Analysed:
    """The motion of one arm in a recording, analysed. Spans are in seconds since `origin_ns`, disjoint and in order."""

    recording: Recording
    motion: Motion
    movement: Movement
    strokes: Spans  # the tip moves, and the arm is driven
    moving: Spans  # the tip moves or turns, and the arm is driven
    holding: Spans | None  # the jaw is closed; None if that cannot be determined
    closes: dict[str, Spans]  # the same of the other arms, by name
    paused_s: Floats  # cumulated time in which the arm was not driven, for each sample of the movement
    bases: Sequence[BaseFrame]


def propose_segments(recording: Recording, arm: str | None = None) -> tuple[Segment, ...]:
    """Propose the hand-offs of one arm.

    Args:
        recording: The recording.
        arm: Name of the arm; may be omitted if the recording has one arm.

    Returns:
        The proposals, in order of time.

    Raises:
        NoUsableTopic: There is no such arm, or there are several and none is named.
    """
    return _proposed(_shared(recording), recording.motion_of(arm=arm))


def propose_by_arm(recording: Recording) -> tuple[Segment, ...]:
    """Propose the hand-offs of every arm.

    Args:
        recording: The recording.

    Returns:
        The proposals arm by arm, those of each in order of time.
    """
    shared = _shared(recording)
    return tuple(segment for arm in recording.arms for segment in _proposed(shared, recording.motion_of(arm=arm)))


def movements_by_arm(recording: Recording) -> tuple[Segment, ...]:
    """Find the movements of every arm that resemble a hand-off, whatever they were for; labels are not regarded.

    They are those made with a closed jaw, or, where no jaw tells, those between rests. If needles are transferred, only
    the last ones before a transfer are proposals.

    Args:
        recording: The recording.

    Returns:
        The movements arm by arm, those of each in order of time.
    """
    shared = _shared(replace(recording, labels=()))
    return tuple(one for arm in recording.arms for one in _moved(_analyse(shared, recording.motion_of(arm=arm))))


def _proposed(shared: "_Shared", motion: Motion) -> tuple[Segment, ...]:
    seen = _analyse(shared, motion)
    named = _named_passes(seen, shared.named[motion.arm])
    if named:
        return tuple(_propose_named(seen, one) for one in named[:PROPOSALS_LIMIT])
    if shared.transfers and seen.holding is not None:
        given = {one.released_s: one for one in shared.transfers if one.giver == motion.arm}
        return tuple(
            _propose_before_transfer(seen, span, one) for span, one in _last_held(seen, given)[:PROPOSALS_LIMIT]
        )
    return _moved(seen)


def _moved(seen: "_Analysed") -> tuple[Segment, ...]:
    if seen.holding is not None:
        held = _without_hand_work(seen, _movements_in_hold(seen, seen.holding))
        return tuple(_propose(seen, span, "jaw") for span in held[:PROPOSALS_LIMIT])
    turned = [span for span in _strokes(seen) if _ends_with_a2(seen, span)]
    drawn = bridged(_listed(seen.moving), PAUSE_S, partial(_mostly_paused, seen))
    spans = turned or [span for span in drawn if _is_a_pass(seen, span)]
    return tuple(_propose(seen, span, "motion") for span in _without_hand_work(seen, spans)[:PROPOSALS_LIMIT])


def arrival(movement: Movement, start_s: float, end_s: float) -> float:
    """Find the transition from A1 to A2: the time at which the tip comes to rest where it is at the end.

    Args:
        movement: The motion of the arm.
        start_s: Start of the interval, in the times of `movement.seconds`.
        end_s: End of the interval.

    Returns:
        The time in s, within the interval; `end_s` if the tip stays within `SHORTEST_MM` of its last position or does
        not come to rest.
    """
    first, last = movement.index(start_s), movement.index(end_s)
    apart_mm = np.linalg.norm(movement.tip_mm[first : last + 1] - movement.tip_mm[last], axis=1)
    far = np.flatnonzero(apart_mm > SHORTEST_MM)
    if len(far) == 0:
        return end_s
    near, least = first + int(far[-1]), movement.moving_mm_s
    slow = np.flatnonzero(movement.speed_mm_s[near : last + 1] < least)
    if len(slow) == 0:
        return end_s
    last_fast = near + max(0, int(slow[0]) - 1)
    return max(start_s, min(end_s, offset(movement.seconds, movement.speed_mm_s, last_fast, least)))


@dataclass(frozen=True, eq=False)
class _Shared:
    """Data of a recording that is computed once and shared by all its arms."""

    recording: Recording
    named: dict[str, list[Named]]  # by arm
    holding: dict[str, Spans | None]
    transfers: tuple[NeedleTransfer, ...]


def _shared(recording: Recording) -> _Shared:
    named: dict[str, list[Named]] = {arm: [] for arm in recording.arms}
    for one in named_hand_offs(recording.labels):
        named[_arm_handing_off(recording, one)].append(one)
    closed = {arm: closed_jaw(recording, arm) for arm in recording.arms}
    holding = {arm: None if spans is None else _spans(spans) for arm, spans in closed.items()}
    return _Shared(recording, named, holding, find_transfers(recording, closed, base_frames(recording)))


def _analyse(shared: _Shared, motion: Motion) -> _Analysed:
    recording = shared.recording
    movement = movement_of(recording.seconds(motion.stamps_ns), motion.tip_mm, motion.rotation_xyzw)
    paused = [
        ((start - recording.origin_ns) / 1e9, (end - recording.origin_ns) / 1e9)
        for start, end, _ in undriven(recording, motion.arm)
    ]
    halted = inside(movement.seconds, paused)
    strokes = _movements(movement, movement.speed_mm_s, movement.moving_mm_s, ~halted)
    turns = _movements(movement, movement.turning_rad_s, TURNING_RAD_S, ~halted)
    return _Analysed(
        recording=recording,
        motion=motion,
        movement=movement,
        strokes=_spans(strokes),
        moving=_spans(bridged(sorted(strokes + turns), 0.0)),
        holding=shared.holding[motion.arm],
        closes={arm: spans for arm, spans in shared.holding.items() if spans is not None and arm != motion.arm},
        paused_s=np.append(0.0, np.cumsum(np.diff(movement.seconds) * (halted[1:] & halted[:-1]))),
        bases=base_frames(recording),
    )


def _movements(movement: Movement, speed: Floats, least: float, driven: Flags) -> list[Span]:
    """Find the movements of a driven arm, from the onset to the offset of each."""
    seconds, whole = movement.seconds, (float(movement.seconds[0]), float(movement.seconds[-1]))
    spans = [
        (onset(seconds, speed, movement.index(start), least), offset(seconds, speed, movement.index(end), least))
        for start, end in spans_of(seconds, (speed > least) & driven)
    ]
    # Onset and offset extend the movements, so that neighbours may overlap.
    apart = bridged(sorted(span for span in spans if span[0] < span[1]), 0.0)  # a movement of one sample is left out
    return _within(_spans(apart), whole)


# ---- by jaw and motion ------------------------------------------------------------------------------------------


def _movements_in_hold(seen: _Analysed, holding: Spans) -> list[Span]:
    """Find the movements made while the jaw holds something, none longer than its hold."""
    spans = [
        _exact(seen, group)
        for hold in _listed(holding)
        for group in bridged(_within(seen.moving, hold), HELD_PAUSE_S, partial(_mostly_paused, seen))
    ]
    return [span for span in spans if _is_a_pass(seen, span)]


def _last_held(seen: _Analysed, given: Mapping[float, NeedleTransfer]) -> list[tuple[Span, NeedleTransfer]]:
    """Find the last movement before each transfer that the arm makes with the needle, by the time of its release."""
    assert seen.holding is not None
    found = []
    for hold in _listed(seen.holding):
        if (transfer := given.get(hold[1])) is not None:
            groups = bridged(_within(seen.moving, hold), HELD_PAUSE_S, partial(_mostly_paused, seen))
            passes = [span for span in (_exact(seen, group) for group in groups) if _is_a_pass(seen, span)]
            found += [(span, transfer) for span in passes[-1:]]
    return found


def _strokes(seen: _Analysed) -> list[Span]:
    """Find the movements between rests; a turn in place ends a movement."""
    whole = (float(seen.movement.seconds[0]), float(seen.movement.seconds[-1]))
    bounds = [whole[0], *(end for _, end in _turns_in_place(seen)), whole[1]]
    parts = [_within(seen.moving, part) for part in pairwise(bounds) if part[0] < part[1]]
    groups = [group for part in parts for group in bridged(part, STROKE_PAUSE_S, partial(_mostly_paused, seen))]
    spans = [_exact(seen, group) for group in groups]
    return [span for span in spans if _is_a_pass(seen, span)]


def _turns_in_place(seen: _Analysed) -> list[Span]:
    m = seen.movement
    spans = spans_of(m.seconds, (m.turning_rad_s > TURNING_RAD_S) & (m.speed_mm_s < 2.0 * m.moving_mm_s))
    return [span for span in bridged(spans, REGRIP_S) if m.turn_rad(*span) >= A2_RAD]


def _exact(seen: _Analysed, group: Span) -> Span:
    """Cut a group of movements to where the tip moves off for good and where its last movement or turn ends."""
    parts = _within(seen.moving, group)
    first, last = 0, len(parts) - 1
    while first < last and seen.movement.extent_mm(*parts[first]) < SHORTEST_MM:
        first += 1
    while first < last and _is_nothing(seen, parts[last]):
        last -= 1
    off = min((start for start, _ in _within(seen.strokes, parts[first])), default=parts[first][0])
    return off, parts[last][1]


def _is_nothing(seen: _Analysed, burst: Span) -> bool:
    return seen.movement.extent_mm(*burst) < SHORTEST_MM and seen.movement.turn_rad(*burst) < SMALLEST_TURN_RAD


def _is_a_pass(seen: _Analysed, span: Span) -> bool:
    return span[1] - span[0] >= SHORTEST_S and seen.movement.extent_mm(*span) >= SHORTEST_MM


def _without_hand_work(seen: _Analysed, spans: list[Span]) -> list[Span]:
    if not spans:
        return []
    widths = [seen.movement.extent_mm(*span) for span in spans]
    # A quartile and not the maximum, so that one exceptionally wide movement does not reject the others.
    least = SMALL_SHARE * float(np.quantile(widths, 0.75))
    return [span for span, mm in zip(spans, widths, strict=True) if mm >= least]


def _ends_with_a2(seen: _Analysed, span: Span) -> bool:
    """Return whether the instrument hardly turns until the tip has come to rest, and turns after it."""
    rest = arrival(seen.movement, *span)
    before, after = seen.movement.turn_rad(span[0], rest), seen.movement.turn_rad(rest, span[1])
    return after >= A2_RAD and before <= A1_SHARE * after


def _mostly_paused(seen: _Analysed, start: float, end: float) -> bool:
    """Return whether the arm was not driven for most of a gap, which then ends no pass."""
    paused_s = seen.paused_s[seen.movement.index(end)] - seen.paused_s[seen.movement.index(start)]
    return bool(paused_s >= PAUSED_SHARE * (end - start))


def _within(spans: Spans, limits: Span) -> list[Span]:
    """Clip spans to limits; spans outside the limits are left out."""
    first, last = bisect_right(spans[:, 1], limits[0]), bisect_left(spans[:, 0], limits[1])
    if first >= last:
        return []
    return _listed(spans[first:last].clip(*limits))


def _spans(spans: list[Span]) -> Spans:
    return np.array(spans, dtype=np.float64).reshape(-1, 2)


def _listed(spans: Spans) -> list[Span]:
    return [(start, end) for start, end in spans.tolist()]


# ---- proposals and their reasons --------------------------------------------------------------------------------


def _propose(seen: _Analysed, span: Span, found_by: FoundBy) -> Segment:
    """Return a span as a proposal, with its reasons."""
    handover = arrival(seen.movement, *span)
    what = "the tip moves with the jaw closed" if found_by == "jaw" else "the tip moves"
    reasons = [what, *_pauses(seen, span), *_grip(seen, span), *_a2(seen, span, handover), *_taken(seen, span)]
    return _segment(seen, span, handover, found_by, reasons)


def _propose_before_transfer(seen: _Analysed, span: Span, transfer: NeedleTransfer) -> Segment:
    """Return the movement before a transfer as a proposal, with its reasons."""
    proposed = _propose(seen, span, "jaw")
    both_s = max(0.0, transfer.released_s - transfer.taken_s)
    words = f"{transfer.taker} takes the needle: both jaws are closed for {both_s:.1f} s, and the tips keep together"
    reasons = (*proposed.reasons, words)
    return replace(proposed, found_by="transfer", reasons=reasons, confidence=round(transfer.confidence, 4))


def _propose_named(seen: _Analysed, one: Named) -> Segment:
    """Return a labelled hand-off as a proposal; if the end of A1 is not labelled, it is the time of `arrival`."""
    span, last = _seconds_of(seen, one), float(seen.movement.seconds[-1])
    if one.handover_ns is None:
        handover = arrival(seen.movement, *span)
    else:
        handover = max(span[0], min(last, (one.handover_ns - seen.recording.origin_ns) / 1e9))
    reasons = [one.words, *_pauses(seen, span), *_grip(seen, span), *_a2(seen, span, handover), *_taken(seen, span)]
    return _segment(seen, span, handover, one.kind, reasons)


def _segment(seen: _Analysed, span: Span, handover: float, found_by: FoundBy, reasons: Sequence[str]) -> Segment:
    start, end, handover = (round(second, 6) for second in (*span, handover))
    return Segment(seen.motion.arm, start, end, handover, found_by, tuple(reasons))


def _seconds_of(seen: _Analysed, one: Named) -> Span:
    """Return the span of a labelled hand-off in seconds, clipped to the motion."""
    first, last = float(seen.movement.seconds[0]), float(seen.movement.seconds[-1])
    origin_ns = seen.recording.origin_ns
    return max(first, (one.start_ns - origin_ns) / 1e9), min(last, (one.end_ns - origin_ns) / 1e9)


def _arm_handing_off(recording: Recording, one: Named) -> str:
    """Return the arm that hands off: of several, the one that moves furthest before the handover (labels name none)."""
    until_ns = one.end_ns if one.handover_ns is None else one.handover_ns
    ways = {arm: _way_mm(recording.motion_of(arm=arm), one.start_ns, until_ns) for arm in recording.arms}
    return max(ways, key=lambda arm: ways[arm])


def _named_passes(seen: _Analysed, named: Sequence[Named]) -> list[Named]:
    """Select the labelled hand-offs that are a pass, up to a total length of `OVERLAP_LIMIT` times the motion's."""
    left_s, taken = OVERLAP_LIMIT * float(seen.movement.seconds[-1] - seen.movement.seconds[0]), []
    for one in named:
        start, end = _seconds_of(seen, one)
        if start >= end:
            continue
        left_s -= end - start  # also for those that turn out not to be a pass: testing them takes the time
        if left_s < 0:
            break
        if _is_a_pass(seen, (start, end)):
            taken.append(one)
    return taken


def _way_mm(motion: Motion, start_ns: int, end_ns: int) -> float:
    first, last = np.searchsorted(motion.stamps_ns, start_ns), np.searchsorted(motion.stamps_ns, end_ns, side="right")
    tip_mm = motion.tip_mm[first:last]
    return float(np.ptp(tip_mm, axis=0).max()) if len(tip_mm) else 0.0


def _pauses(seen: _Analysed, span: Span) -> list[str]:
    count = len(_within(seen.moving, span)) - 1
    if count < 1:
        return []
    return [f"{count} short or clutched pause{'s belong' if count > 1 else ' belongs'} to it"]


def _grip(seen: _Analysed, span: Span) -> list[str]:
    """Return the times of the jaw's grip and release around the movement, in words, if the recording covers them."""
    whole = seen.recording.seconds(seen.motion.stamps_ns[[0, -1]])
    hold = None if seen.holding is None else seen.holding[bisect_left(seen.holding[:, 1], span[1]) :][:1]
    if hold is None or len(hold) == 0 or hold[0, 0] > span[0]:
        return []
    (closes, opens), said = hold[0].tolist(), []
    if closes > whole[0] and span[0] - closes <= RELEASE_S:
        said.append(f"the jaw closed {span[0] - closes:.1f} s before the tip moves off")
    if opens < whole[1] and opens - span[1] <= RELEASE_S:
        said.append(f"the jaw opens {opens - span[1]:.1f} s after the arm's last movement")
    return said


def _a2(seen: _Analysed, span: Span, handover: float) -> list[str]:
    """Return the transition from A1 to A2, in words."""
    rest = f"the tip comes to rest at {handover:.1f} s"
    turned = seen.movement.turn_rad(handover, span[1])
    return [f"{rest}, then the jaw turns by {np.degrees(turned):.0f} degrees in place" if turned >= A2_RAD else rest]


def _taken(seen: _Analysed, span: Span) -> list[str]:
    """Return the other arms that close their jaws at the end, in words, with the distance if it can be determined."""
    said = []
    for arm, closed in seen.closes.items():
        at = closed[bisect_left(closed[:, 0], span[1] - SHORTEST_S) :, 0][:1]
        if len(at) and at[0] <= span[1] + RELEASE_S:
            said.append(f"{arm}'s jaw closes at {at[0]:.1f} s" + _nearness(seen, arm, float(at[0])))
    return said


def _nearness(seen: _Analysed, arm: str, second: float) -> str:
    partner = partner_at(seen.recording, seen.motion, second, seen.bases, arm)
    if partner is None:
        return ""
    tip_mm = seen.movement.tip_mm[seen.movement.index(second)]
    return f", {np.linalg.norm(tip_mm - np.array(partner.position_mm), axis=-1):.0f} mm from this tip"
