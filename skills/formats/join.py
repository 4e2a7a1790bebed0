"""Joining the parts of a split bag into one recording, topic by topic, in order of time."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import TypeVar

import numpy as np

from skills.demonstration.recording import Joints, Label, Motion, Recording, Signal, recorded_motion
from skills.errors import MixedFrames, SkillsError
from skills.formats.topics import counted

Named = tuple[str, Signal]
Part = TypeVar("Part", Motion, Joints, Named)


def join(parts: Sequence[Recording]) -> Recording:
    """Join the parts of one recording.

    Args:
        parts: In order of time, at least one.

    Raises:
        MixedFrames: A topic has different frames in different parts.
        BackwardStamps, RepeatedStamps: As for one recording.
    """
    if len(parts) == 1:
        return parts[0]
    faults = {topic: why for part in parts for topic, why in part.left_out}  # also if only one part has it
    pedals, clutches = _signals(part.pedals for part in parts), [part.clutch for part in parts if part.clutch]
    tips = _sound(_grouped((part.setpoints for part in parts), lambda one: one.topic), _joined_motion, faults)
    jaws = _sound(_grouped((part.jaw_setpoints for part in parts), lambda one: one[1].topic), _joined_signal, faults)
    first, integrities = parts[0], {part.integrity for part in parts}
    counts: Counter[tuple[str, str]] = Counter()
    for topic in chain.from_iterable(part.topics for part in parts):
        counts[topic.name, topic.type] += topic.messages
    return Recording(
        format=first.format,
        integrity=first.integrity if len(integrities) == 1 else "partial",
        motions=_motions(part.motions for part in parts),
        jaws=_signals(part.jaws for part in parts),
        clutch=_clutch(pedals, clutches),
        topics=counted(counts),
        joints=tuple(
            _joined_joints(some) for _, some in _grouped((part.joints for part in parts), lambda one: one.topic)
        ),
        masters=_motions(part.masters for part in parts),
        grippers=_signals(part.grippers for part in parts),
        pedals=pedals,
        following=_signals(part.following for part in parts),
        scales=_signals(part.scales for part in parts),
        tools=tuple({arm: tool for part in parts for arm, tool in part.tools}.items()),
        labels=in_time(label for part in parts for label in part.labels),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        left_out=tuple(faults.items()),
        setpoints=tips,
        jaw_setpoints=jaws,
    )


def in_time(labels: Iterable[Label]) -> tuple[Label, ...]:
    """Return labels in order of time, without duplicates."""
    return tuple(sorted(set(labels), key=lambda label: (label.start_ns, label.end_ns, label.name)))


def _grouped(parts: Iterable[Iterable[Part]], key: Callable[[Part], str]) -> list[tuple[str, list[Part]]]:
    """Return the pieces of each topic in order of time, sorted by topic."""
    pieces: dict[str, list[Part]] = {}
    for piece in chain.from_iterable(parts):
        pieces.setdefault(key(piece), []).append(piece)
    return sorted(pieces.items())


def _sound(
    grouped: Iterable[tuple[str, list[Part]]], joined: Callable[[list[Part]], Part], faults: dict[str, str]
) -> tuple[Part, ...]:
    """Return the joined setpoints of each topic without a fault; the faults of others are added."""
    sound = []
    for topic, pieces in grouped:
        try:
            if topic not in faults:
                sound.append(joined(pieces))
        except SkillsError as error:
            faults[topic] = str(error)
    return tuple(sound)


def _motions(parts: Iterable[Iterable[Motion]]) -> tuple[Motion, ...]:
    return tuple(_joined_motion(pieces) for _, pieces in _grouped(parts, lambda motion: motion.topic))


def _joined_motion(pieces: list[Motion]) -> Motion:
    first, frames = pieces[0], sorted({piece.frame for piece in pieces})
    if len(frames) > 1:
        raise MixedFrames(
            f"{first.topic} is in the frames {' and '.join(map(repr, frames))}; record each frame on a separate topic."
        )
    turns = [piece.rotation_xyzw for piece in pieces if piece.rotation_xyzw is not None]
    whole = recorded_motion(
        arm=first.arm,
        topic=first.topic,
        frame=first.frame,
        stamps_ns=np.concatenate([piece.stamps_ns for piece in pieces]),
        tip_mm=np.concatenate([piece.tip_mm for piece in pieces]),
        rotation_xyzw=np.concatenate(turns) if len(turns) == len(pieces) else None,
    )
    # `recorded_motion` counts only what it drops between the pieces; each piece has counted its own before.
    return replace(
        whole,
        duplicate_stamps=whole.duplicate_stamps + sum(piece.duplicate_stamps for piece in pieces),
        backward_stamps=whole.backward_stamps + sum(piece.backward_stamps for piece in pieces),
    )


def _joined_joints(pieces: list[Joints]) -> Joints:
    stamps_ns = np.concatenate([piece.stamps_ns for piece in pieces])
    positions = np.concatenate([piece.positions for piece in pieces])
    dropped = sum(piece.backward_stamps for piece in pieces)
    return Joints(pieces[0].arm, pieces[0].topic, stamps_ns, positions, dropped)


def _signals(parts: Iterable[Iterable[Named]]) -> tuple[Named, ...]:
    return tuple(_joined_signal(pieces) for _, pieces in _grouped(parts, lambda pair: pair[0]))


def _joined_signal(pieces: list[Named]) -> Named:
    (name, first), signals = pieces[0], [signal for _, signal in pieces]
    stamps_ns = np.concatenate([signal.stamps_ns for signal in signals])
    dropped = sum(signal.backward_stamps for signal in signals)
    return name, Signal(stamps_ns, np.concatenate([signal.values for signal in signals]), first.topic, dropped)


def _clutch(pedals: tuple[Named, ...], clutches: list[Signal]) -> Signal | None:
    """Return the clutch: the joined pedal of its topic, or else its signals in the parts, joined."""
    if not clutches:
        return None
    topic = clutches[0].topic
    return dict(pedals).get(topic) or _joined_signal([(topic, one) for one in clutches if one.topic == topic])[1]
