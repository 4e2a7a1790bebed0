"""Join the parts of a recording that was split while it was recorded: topic by topic, in order of time."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from skills.errors import MixedFrames
from skills.style.recording import Integrity, Joints, Label, Motion, Recording, Signal, TopicInfo, recorded_motion

Pairs = Iterable[tuple[str, Signal]]


def join(parts: Sequence[Recording]) -> Recording:
    """Join the parts of one recording, in order of time.

    Raises:
        MixedFrames: A topic is in another frame in another part.
        BackwardStamps, RepeatedStamps: As for one recording.
    """
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    pedals, clutches = _signals(part.pedals for part in parts), [part.clutch for part in parts if part.clutch]
    return Recording(
        format=first.format,
        integrity=_weakest([part.integrity for part in parts]),
        motions=_motions(part.motions for part in parts),
        jaws=_signals(part.jaws for part in parts),
        clutch=_clutch(pedals, clutches),
        topics=_topics(part.topics for part in parts),
        joints=_joints(part.joints for part in parts),
        masters=_motions(part.masters for part in parts),
        grippers=_signals(part.grippers for part in parts),
        pedals=pedals,
        following=_signals(part.following for part in parts),
        scales=_signals(part.scales for part in parts),
        tools=tuple({arm: tool for part in parts for arm, tool in part.tools}.items()),
        labels=in_time(label for part in parts for label in part.labels),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        left_out=tuple(dict(pair for part in parts for pair in part.left_out).items()),
    )


def in_time(labels: Iterable[Label]) -> tuple[Label, ...]:
    """Return labels in order of time, each once."""
    return tuple(sorted(set(labels), key=lambda label: (label.start_ns, label.end_ns, label.name)))


def _weakest(all_of: list[Integrity]) -> Integrity:
    kinds = set(all_of)
    return all_of[0] if len(kinds) == 1 else "partial"


def _motions(parts: Iterable[Iterable[Motion]]) -> tuple[Motion, ...]:
    by_topic: dict[str, list[Motion]] = {}
    for motions in parts:
        for motion in motions:
            by_topic.setdefault(motion.topic, []).append(motion)
    return tuple(_joined_motion(pieces) for _, pieces in sorted(by_topic.items()))


def _joined_motion(pieces: list[Motion]) -> Motion:
    first, frames = pieces[0], sorted({piece.frame for piece in pieces})
    if len(frames) > 1:
        raise MixedFrames(f"{first.topic} is in the frames {' and '.join(map(repr, frames))}; record them apart.")
    turns = [piece.rotation_xyzw for piece in pieces if piece.rotation_xyzw is not None]
    whole = recorded_motion(
        arm=first.arm,
        topic=first.topic,
        frame=first.frame,
        stamps_ns=np.concatenate([piece.stamps_ns for piece in pieces]),
        tip_mm=np.concatenate([piece.tip_mm for piece in pieces]),
        rotation_xyzw=np.concatenate(turns) if len(turns) == len(pieces) else None,
    )
    dropped = sum(piece.duplicate_stamps for piece in pieces)
    return replace(whole, duplicate_stamps=whole.duplicate_stamps + dropped)


def _joints(parts: Iterable[Iterable[Joints]]) -> tuple[Joints, ...]:
    by_topic: dict[str, list[Joints]] = {}
    for joints in parts:
        for one in joints:
            by_topic.setdefault(one.topic, []).append(one)
    return tuple(
        Joints(
            pieces[0].arm,
            topic,
            np.concatenate([piece.stamps_ns for piece in pieces]),
            np.concatenate([piece.positions for piece in pieces]),
        )
        for topic, pieces in sorted(by_topic.items())
    )


def _signals(parts: Iterable[Pairs]) -> tuple[tuple[str, Signal], ...]:
    by_name: dict[str, list[Signal]] = {}
    for pairs in parts:
        for name, signal in pairs:
            by_name.setdefault(name, []).append(signal)
    return tuple((name, _joined_signal(pieces)) for name, pieces in sorted(by_name.items()))


def _joined_signal(pieces: list[Signal]) -> Signal:
    stamps_ns = np.concatenate([piece.stamps_ns for piece in pieces])
    return Signal(stamps_ns, np.concatenate([piece.values for piece in pieces]), pieces[0].topic)


def _clutch(pedals: tuple[tuple[str, Signal], ...], clutches: list[Signal]) -> Signal | None:
    """Return the clutch as one of the joined pedals, or joined from what there is of it in the parts."""
    if not clutches:
        return None
    same = [clutch for clutch in clutches if clutch.topic == clutches[0].topic]
    return dict(pedals).get(clutches[0].topic) or _joined_signal(same)


def _topics(parts: Iterable[Iterable[TopicInfo]]) -> tuple[TopicInfo, ...]:
    counts: Counter[tuple[str, str]] = Counter()
    for topics in parts:
        for topic in topics:
            counts[topic.name, topic.type] += topic.messages
    return tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items()))
