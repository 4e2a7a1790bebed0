"""Find the hand-offs of a recording: by what was named in it, else by what the tip, the jaw and the other arm do.

    Recording --propose_segments--> Segments: where A1 starts, where it gives way to A2, where A2 ends, and why

The surgeon decides: a segment's times are a proposal, and `cut_demo` takes any others. All of it is ours; the paper cut
by hand. Three ways, the first that finds anything is taken:

* *named*: stages of a recorder's tags, gestures of JIGSAWS (`skills.style.labels`);
* *jaw*: a stretch in which the jaw holds something, from the first movement in it to the last. In one hold the hand
  may rest for `HELD_PAUSE_S`;
* *motion*: a stretch of movement between rests. Where the jaw was not recorded but the wrist was, a hand-off ends with
  a turn in place: the paper found the orientation not to change in A1, and A2 is a turn. Where there is no such turn
  either, every long enough movement is proposed.

Pauses in which the arm was not driven, by clutch or because teleoperation did not follow, belong to the movement around
them. What is small beside the recording's other candidates is hand-work (M1, M2): steadying tissue, reaching.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from skills.style._arrays import Floats
from skills.style.labels import Named, named_hand_offs
from skills.style.movement import TURNING_RAD_S, Flags, Movement, Span, inside, movement_of, offset, onset, spans_of
from skills.style.partner import partner_at
from skills.style.pauses import undriven
from skills.style.recording import BaseFrame, Motion, Recording, base_frames

PAUSE_S = 1.5  # a shorter rest is hesitation, not the end of a pass
HELD_PAUSE_S = 3.0  # the same with something held in the jaw: the pass is not over before it is let go
STROKE_PAUSE_S = 0.6  # the same where a turn in place says what a hand-off is: gripping the needle takes longer
PAUSED_SHARE = 0.5  # of a rest, not driven: then it is a pause of any length
REGRIP_S = 0.3  # a shorter opening of the jaw is a new grip, not a release
SHORTEST_S = 0.5
SHORTEST_MM = 3.0
SMALL_SHARE = 0.35  # of the upper quartile of the candidates' widths: less is hand-work
JAW_RANGE_RAD = 0.2  # a jaw that moves less never let go
A2_RAD = 0.35  # 20 degrees in place: far beyond an unsteady wrist, less than any realignment that is needed
A1_SHARE = 1 / 3  # of the turn in place: a hand that reaches for the needle turns on the way as well
RELEASE_S = 3.0  # how long after the last movement the needle is let go and taken

FoundBy = Literal["stage", "gesture", "jaw", "motion"]
Spans = Floats  # of shape (K, 2): start and end of each


@dataclass(frozen=True)
class Segment:
    """A hand-off that is proposed, in seconds since the recording's `origin_ns`.

    Attributes:
        start_s: A1 starts: the tip moves off with the needle.
        end_s: A2 ends: the arm's last movement before it lets go.
        handover_s: A1 gives way to A2: the tip comes to rest.
        found_by: What it was found by.
        reasons: Why, in words, the most telling first.
    """

    start_s: float
    end_s: float
    handover_s: float
    found_by: FoundBy
    reasons: tuple[str, ...]

    @property
    def reason(self) -> str:
        """All reasons in one sentence."""
        return "; ".join(self.reasons)


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is known of one arm in a recording; spans in its seconds, in order and apart from each other."""

    recording: Recording
    motion: Motion
    movement: Movement
    strokes: Spans  # the tip moves, and is driven
    moving: Spans  # it moves or turns
    holding: Spans | None  # the jaw is closed; None where that cannot be told
    closes: dict[str, Spans]  # the other arms' jaws are closed
    paused_s: Floats  # how long the arm was not driven from the start of the movement to each of its samples
    bases: Sequence[BaseFrame]


def propose_segments(recording: Recording, arm: str | None = None) -> tuple[Segment, ...]:
    """Propose the hand-offs of one arm, in order of time.

    Raises:
        NoUsableTopic: There is no such arm, or several and none named.
    """
    seen = _look(recording, recording.motion_of(arm=arm))
    named = [one for one in named_hand_offs(recording.labels) if _is_whose(recording, seen, one)]
    if named:
        return tuple(_named(seen, one) for one in named)
    if seen.holding is not None:
        return tuple(_told(seen, span, "jaw") for span in _without_hand_work(seen, _held(seen, seen.holding)))
    turned = [span for span in _strokes(seen) if _ends_with_a2(seen, span)]
    spans = turned or [span for span in _bridged(_listed(seen.moving), PAUSE_S, seen) if _is_a_pass(seen, span)]
    return tuple(_told(seen, span, "motion") for span in _without_hand_work(seen, spans))


def arrival(movement: Movement, start_s: float, end_s: float) -> float:
    """Find when the tip comes to rest at the place where it is at the end: there A1 gives way to A2."""
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


def _look(recording: Recording, motion: Motion) -> _Seen:
    movement = movement_of(recording.seconds(motion.stamps_ns), motion.tip_mm, motion.rotation_xyzw)
    paused = [
        ((start - recording.origin_ns) / 1e9, (end - recording.origin_ns) / 1e9)
        for start, end, _ in undriven(recording, motion.arm)
    ]
    halted = inside(movement.seconds, paused)
    strokes = _movements(movement, movement.speed_mm_s, movement.moving_mm_s, ~halted)
    turns = _movements(movement, movement.turning_rad_s, TURNING_RAD_S, ~halted)
    others = {arm: _holding(recording, arm) for arm in recording.arms if arm != motion.arm}
    return _Seen(
        recording=recording,
        motion=motion,
        movement=movement,
        strokes=_spans(strokes),
        moving=_spans(_bridged(sorted(strokes + turns), 0.0)),
        holding=_holding(recording, motion.arm),
        closes={arm: spans for arm, spans in others.items() if spans is not None},
        paused_s=np.append(0.0, np.cumsum(np.diff(movement.seconds) * (halted[1:] & halted[:-1]))),
        bases=base_frames(recording),
    )


def _movements(movement: Movement, speed: Floats, least: float, driven: Flags) -> list[Span]:
    """Find the movements of an arm that is driven, from where each really begins to where it ends."""
    seconds, whole = movement.seconds, (float(movement.seconds[0]), float(movement.seconds[-1]))
    spans = [
        (onset(seconds, speed, movement.index(start), least), offset(seconds, speed, movement.index(end), least))
        for start, end in spans_of(seconds, (speed > least) & driven)
    ]
    apart = _bridged(sorted(span for span in spans if span[0] < span[1]), 0.0)  # one sample is no movement
    return _within(_spans(apart), whole)


# ---- by jaw and motion ------------------------------------------------------------------------------------------


def _held(seen: _Seen, holding: Spans) -> list[Span]:
    """Find the movements while the jaw holds something, none longer than its hold."""
    spans = [
        _exact(seen, group)
        for hold in _listed(holding)
        for group in _bridged(_within(seen.moving, hold), HELD_PAUSE_S, seen)
    ]
    return [span for span in spans if _is_a_pass(seen, span)]


def _strokes(seen: _Seen) -> list[Span]:
    """Find the movements between rests; a turn in place ends one."""
    whole = (float(seen.movement.seconds[0]), float(seen.movement.seconds[-1]))
    bounds = [whole[0], *(end for _, end in _turns_in_place(seen)), whole[1]]
    parts = [_within(seen.moving, part) for part in pairwise(bounds) if part[0] < part[1]]
    groups = [group for part in parts for group in _bridged(part, STROKE_PAUSE_S, seen)]
    spans = [_exact(seen, group) for group in groups]
    return [span for span in spans if _is_a_pass(seen, span)]


def _turns_in_place(seen: _Seen) -> list[Span]:
    m = seen.movement
    spans = spans_of(m.seconds, (m.turning_rad_s > TURNING_RAD_S) & (m.speed_mm_s < 2.0 * m.moving_mm_s))
    return [span for span in _bridged(spans, REGRIP_S) if m.turn_rad(*span) >= A2_RAD]


def _exact(seen: _Seen, group: Span) -> Span:
    """Cut a group of movements to where the tip moves off for good and where it or the jaw's turn ends."""
    parts = _within(seen.moving, group)
    while len(parts) > 1 and seen.movement.extent_mm(*parts[0]) < SHORTEST_MM:
        parts = parts[1:]
    while len(parts) > 1 and _is_nothing(seen, parts[-1]):
        parts = parts[:-1]
    off = min((start for start, _ in _within(seen.strokes, parts[0])), default=parts[0][0])
    return off, parts[-1][1]


def _is_nothing(seen: _Seen, burst: Span) -> bool:
    return seen.movement.extent_mm(*burst) < SHORTEST_MM and seen.movement.turn_rad(*burst) < TURNING_RAD_S


def _is_a_pass(seen: _Seen, span: Span) -> bool:
    return span[1] - span[0] >= SHORTEST_S and seen.movement.extent_mm(*span) >= SHORTEST_MM


def _without_hand_work(seen: _Seen, spans: list[Span]) -> list[Span]:
    if not spans:
        return []
    widths = [seen.movement.extent_mm(*span) for span in spans]
    least = SMALL_SHARE * float(np.quantile(widths, 0.75))
    return [span for span, mm in zip(spans, widths, strict=True) if mm >= least]


def _ends_with_a2(seen: _Seen, span: Span) -> bool:
    """Say whether the jaw hardly turns before the tip has come to rest, and does after."""
    rest = arrival(seen.movement, *span)
    before, after = seen.movement.turn_rad(span[0], rest), seen.movement.turn_rad(rest, span[1])
    return after >= A2_RAD and before <= A1_SHARE * after


def _holding(recording: Recording, arm: str) -> Spans | None:
    """Return when the jaw is closed: below the middle of its range; None where that cannot be told."""
    jaw = recording.jaw_of(arm)
    if jaw is None or len(jaw.values) == 0 or np.ptp(jaw.values) < JAW_RANGE_RAD:
        return None
    middle = (float(jaw.values.min()) + float(jaw.values.max())) / 2.0
    return _spans(_bridged(spans_of(recording.seconds(jaw.stamps_ns), jaw.values < middle), REGRIP_S))


def _bridged(spans: list[Span], pause_s: float, seen: _Seen | None = None) -> list[Span]:
    """Join neighbours whose gap is shorter than `pause_s`, or in which the arm that was seen was mostly not driven."""
    joined: list[Span] = []
    for start, end in spans:
        if joined and (start - joined[-1][1] < pause_s or (seen and _mostly_paused(seen, joined[-1][1], start))):
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined


def _mostly_paused(seen: _Seen, start: float, end: float) -> bool:
    paused_s = seen.paused_s[seen.movement.index(end)] - seen.paused_s[seen.movement.index(start)]
    return bool(paused_s >= PAUSED_SHARE * (end - start))


def _within(spans: Spans, limits: Span) -> list[Span]:
    """Cut spans to limits; what lies outside of them is left out."""
    first, last = np.searchsorted(spans[:, 1], limits[0], side="right"), np.searchsorted(spans[:, 0], limits[1])
    return _listed(spans[first:last].clip(*limits))


def _spans(spans: list[Span]) -> Spans:
    return np.array(spans, dtype=np.float64).reshape(-1, 2)


def _listed(spans: Spans) -> list[Span]:
    return [(start, end) for start, end in spans.tolist()]


# ---- what is said of it -----------------------------------------------------------------------------------------


def _told(seen: _Seen, span: Span, found_by: FoundBy) -> Segment:
    """Write a span as a proposal, with its reasons."""
    handover = arrival(seen.movement, *span)
    what = "the tip moves with the jaw closed" if found_by == "jaw" else "the tip moves"
    reasons = [what, *_pauses(seen, span), *_grip(seen, span), *_a2(seen, span, handover), *_taken(seen, span)]
    return Segment(round(span[0], 6), round(span[1], 6), round(handover, 6), found_by, tuple(reasons))


def _named(seen: _Seen, one: Named) -> Segment:
    """Write a named hand-off as a proposal; where the end of A1 was not named, it is where the tip comes to rest."""
    span, last = _seconds_of(seen, one), float(seen.movement.seconds[-1])
    if one.handover_ns is None:
        handover = arrival(seen.movement, *span)
    else:
        handover = max(span[0], min(last, (one.handover_ns - seen.recording.origin_ns) / 1e9))
    reasons = [one.words, *_pauses(seen, span), *_grip(seen, span), *_a2(seen, span, handover), *_taken(seen, span)]
    return Segment(round(span[0], 6), round(span[1], 6), round(handover, 6), one.kind, tuple(reasons))


def _seconds_of(seen: _Seen, one: Named) -> Span:
    """Tell the time of a named hand-off in seconds, within the motion."""
    first, last = float(seen.movement.seconds[0]), float(seen.movement.seconds[-1])
    origin_ns = seen.recording.origin_ns
    return max(first, (one.start_ns - origin_ns) / 1e9), min(last, (one.end_ns - origin_ns) / 1e9)


def _is_whose(recording: Recording, seen: _Seen, one: Named) -> bool:
    """Say whether this arm is the one that hands off: of several, the one that moves furthest before the handover.

    A label names no arm.
    """
    span = _seconds_of(seen, one)
    if span[0] >= span[1] or not _is_a_pass(seen, span):
        return False
    until_ns = one.end_ns if one.handover_ns is None else one.handover_ns
    ways = {arm: _way_mm(recording.motion_of(arm=arm), one.start_ns, until_ns) for arm in recording.arms}
    return max(ways, key=lambda arm: ways[arm]) == seen.motion.arm


def _way_mm(motion: Motion, start_ns: int, end_ns: int) -> float:
    first, last = np.searchsorted(motion.stamps_ns, start_ns), np.searchsorted(motion.stamps_ns, end_ns, side="right")
    tip_mm = motion.tip_mm[first:last]
    return float(np.ptp(tip_mm, axis=0).max()) if len(tip_mm) else 0.0


def _pauses(seen: _Seen, span: Span) -> list[str]:
    count = len(_within(seen.moving, span)) - 1
    if count < 1:
        return []
    return [f"{count} short or clutched pause{'s belong' if count > 1 else ' belongs'} to it"]


def _grip(seen: _Seen, span: Span) -> list[str]:
    """Say when the jaw closed before and opened after, where the recording has seen it."""
    whole = seen.recording.seconds(seen.motion.stamps_ns[[0, -1]])
    hold = None if seen.holding is None else seen.holding[np.searchsorted(seen.holding[:, 1], span[1]) :][:1]
    if hold is None or len(hold) == 0 or hold[0, 0] > span[0]:
        return []
    (closes, opens), said = hold[0].tolist(), []
    if closes > whole[0] and span[0] - closes <= RELEASE_S:
        said.append(f"the jaw closed {span[0] - closes:.1f} s before the tip moves off")
    if opens < whole[1] and opens - span[1] <= RELEASE_S:
        said.append(f"the jaw opens {opens - span[1]:.1f} s after the arm's last movement")
    return said


def _a2(seen: _Seen, span: Span, handover: float) -> list[str]:
    """Say where A1 gives way to A2."""
    rest = f"the tip comes to rest at {handover:.1f} s"
    turned = seen.movement.turn_rad(handover, span[1])
    return [f"{rest}, then the jaw turns by {np.degrees(turned):.0f} degrees in place" if turned >= A2_RAD else rest]


def _taken(seen: _Seen, span: Span) -> list[str]:
    """Say which other arm closes its jaw at the end, and how near it is where that can be told."""
    said = []
    for arm, closed in seen.closes.items():
        at = closed[np.searchsorted(closed[:, 0], span[1] - SHORTEST_S) :, 0][:1]
        if len(at) and at[0] <= span[1] + RELEASE_S:
            said.append(f"{arm}'s jaw closes at {at[0]:.1f} s" + _nearness(seen, arm, float(at[0])))
    return said


def _nearness(seen: _Seen, arm: str, second: float) -> str:
    partner = partner_at(seen.recording, seen.motion, second, seen.bases, arm)
    if partner is None:
        return ""
    tip_mm = seen.movement.tip_mm[seen.movement.index(second)]
    return f", {np.linalg.norm(tip_mm - np.array(partner.position_mm)):.0f} mm from this tip"
