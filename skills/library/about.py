"""What a client is told of a recording: what is in it, how good it is, and which hand-offs it seems to hold."""

from dataclasses import asdict
from typing import Any

import numpy as np

from skills.style.demo import Motion, Recording, Segment, Signal, propose_segments
from skills.style.pauses import press_times
from skills.style.recording import base_frames

MOST = 200  # of each list that a recording may make as long as it likes; the counts say what is left out


def about_recording(recording: Recording) -> dict[str, Any]:
    """Say what is in a recording and how good it is, and which hand-offs it seems to hold, by arm."""
    proposed = [(arm, segment) for arm in recording.arms for segment in propose_segments(recording, arm)]
    return {
        "duration_s": recording.duration_s,
        "notes": dict(recording.notes),
        "topics": [asdict(topic) for topic in recording.topics],
        "motions": [
            {
                "arm": m.arm,
                "topic": m.topic,
                "frame": m.frame,
                "samples": len(m.stamps_ns),
                "duplicate_stamps": m.duplicate_stamps,
            }
            for m in recording.motions
        ],
        "quality": [_quality(motion) for motion in recording.motions],
        "segments": [_segment(arm, segment) for arm, segment in proposed[:MOST]],
        "counts": {"segments": len(proposed), "labels": len(recording.labels)},
        "labels": [
            {
                "name": label.name,
                "kind": label.kind,
                "start_s": (label.start_ns - recording.origin_ns) / 1e9,
                "end_s": (label.end_ns - recording.origin_ns) / 1e9,
            }
            for label in recording.labels[:MOST]
        ],
        "tools": dict(recording.tools),
        "joints": [{"arm": j.arm, "topic": j.topic, "joints": j.positions.shape[1]} for j in recording.joints[:MOST]],
        "masters": [{"arm": m.arm, "topic": m.topic} for m in recording.masters[:MOST]],
        "pedals": [_pedal(recording, name, pedal) for name, pedal in recording.pedals[:MOST]],
        "following": [_following(recording, name, signal) for name, signal in recording.following[:MOST]],
        "scales": [
            {"teleoperation": name, "least": float(signal.values.min()), "greatest": float(signal.values.max())}
            for name, signal in recording.scales[:MOST]
            if len(signal.values)
        ],
        "left_out": [{"topic": topic, "because": why} for topic, why in recording.left_out[:MOST]],
        "base_frames": [asdict(base) for base in base_frames(recording)],
    }


def _quality(motion: Motion) -> dict[str, Any]:
    steps_ns = np.diff(motion.stamps_ns)
    return {
        "arm": motion.arm,
        "topic": motion.topic,
        "duration_s": float(np.ptp(motion.stamps_ns)) / 1e9,
        "rate_hz": 1e9 / float(np.median(steps_ns)) if len(steps_ns) else None,
        "longest_gap_s": float(steps_ns.max(initial=0)) / 1e9,
        "extent_mm": np.ptp(motion.tip_mm, axis=0).tolist(),
    }


def _segment(arm: str, segment: Segment) -> dict[str, Any]:
    """Write a proposal in the form in which a demonstration is asked for, and why it is made."""
    return {"arm": arm, **asdict(segment), "reasons": list(segment.reasons), "reason": segment.reason}


def _pedal(recording: Recording, topic: str, pedal: Signal) -> dict[str, Any]:
    """Say how often a pedal went down, and for how long, to the end of the recording where it never went up."""
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    presses = press_times(pedal)
    pressed_ns = sum(max(0, (last_ns if up is None else up) - down) for down, up in presses)
    return {"topic": topic, "presses": len(presses), "pressed_s": pressed_ns / 1e9}


def _following(recording: Recording, name: str, signal: Signal) -> dict[str, Any]:
    """Say for how long a teleoperation drove its arm; what it last said holds to the end of the recording."""
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    held_ns = np.diff(np.append(signal.stamps_ns, max(last_ns, int(signal.stamps_ns[-1])))) if len(signal.values) else 0
    return {"teleoperation": name, "following_s": float((held_ns * (signal.values == 1)).sum()) / 1e9}
