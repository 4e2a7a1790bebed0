"""Recordings with results that are slow to compute: hand-offs, identifications, and the description for clients.

    bytes --parse_recording--> ParsedContent

The computation takes time in proportion to the recording's motions, and more for a hostile one. So the service makes it
in the process that reads the recording (`skills.formats.reader_process`), and never within a transaction.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from skills import packing
from skills.demonstration.identification import ArmIdentification
from skills.demonstration.movement import press_times
from skills.demonstration.plausible import check_steps
from skills.demonstration.recording import (
    BaseFrame,
    Joints,
    Label,
    Motion,
    Recording,
    Signal,
    base_frames,
    equal_samples,
)
from skills.demonstration.segments import Segment, propose_by_arm
from skills.errors import ImplausibleMotion
from skills.fields import as_json
from skills.formats import read_recording
from skills.schemas import recordings as described

MOST = 200  # entries of each list of unlimited length; `counts` has the full numbers of segments and labels


@dataclass(frozen=True, eq=False)
class ParsedContent:
    """A recording with results that are slow to compute.

    Attributes:
        recording: The recording.
        proposed: The proposed hand-offs, ordered by arm and time.
        identifications: Those of the recording, each of which takes a tenth of a second to compute.
        bases: Those of the recording, which are computed with them.
        about_json: The result of `describe` as JSON, so that it passes between processes unchanged.
    """

    recording: Recording
    proposed: tuple[Segment, ...]
    identifications: tuple[ArmIdentification, ...]
    bases: tuple[BaseFrame, ...]
    about_json: str

    def __post_init__(self) -> None:
        packing.canonical([as_json(one) for one in (*self.identifications, *self.bases)])  # raises for NaN
        # The recording's own properties have them now, so that a cut in another process does not compute them again.
        vars(self.recording).update(identifications=self.identifications, bases=self.bases)

    @property
    def about(self) -> described.RecordingContent:
        """The description of the recording for clients."""
        return described.RecordingContent.model_validate_json(self.about_json)


def parse_recording(file: BinaryIO, **options: Any) -> ParsedContent:
    """Read and parse a recording; arguments and errors are those of `read_recording`."""
    return parse(read_recording(file, **options))


def parse(recording: Recording) -> ParsedContent:
    """Compute the proposed hand-offs and the description of a recording."""
    proposed = propose_by_arm(recording)
    about_json = json.dumps(describe(recording, proposed).model_dump(mode="json"), allow_nan=False)
    return ParsedContent(recording, proposed, recording.identifications, recording.bases, about_json)


def describe(recording: Recording, proposed: Sequence[Segment]) -> described.RecordingContent:
    """Return the description of a recording for clients: its contents, its quality and the proposed hand-offs.

    Each list that the recording could make arbitrarily long is limited to `MOST` entries.
    """
    return described.RecordingContent(
        duration_s=recording.duration_s,
        notes=dict(recording.notes) | _jumps(recording),
        topics=list(recording.topics),
        motions=[
            described.Motion(m.arm, m.topic, m.frame, len(m.stamps_ns), m.duplicate_stamps) for m in recording.motions
        ],
        quality=[_quality(motion) for motion in recording.motions],
        segments=list(proposed[:MOST]),
        counts=described.RecordingCounts(len(proposed), len(recording.labels)),
        labels=[_label(recording, label) for label in recording.labels[:MOST]],
        tools=dict(recording.tools),
        joints=[described.JointStates(j.arm, j.topic, j.positions.shape[1]) for j in recording.joints[:MOST]],
        masters=[described.Master(one.arm, one.topic) for one in recording.masters[:MOST]],
        pedals=[_pedal(recording, name, pedal) for name, pedal in recording.pedals[:MOST]],
        following=[_following(recording, name, signal) for name, signal in recording.following[:MOST]],
        scales=[
            described.Scale(name, float(signal.values.min()), float(signal.values.max()))
            for name, signal in recording.scales[:MOST]
            if len(signal.values)
        ],
        left_out=[described.LeftOut(topic, why) for topic, why in recording.left_out[:MOST]],
        dropped=_dropped(recording)[:MOST],
        setpoints=_setpoints(recording)[:MOST],
        base_frames=list(base_frames(recording)),
        identifications=list(recording.identifications),
    )


def _setpoints(recording: Recording) -> list[described.Setpoints]:
    tips = [described.Setpoints(one.arm, one.topic, one.frame, len(one.stamps_ns)) for one in recording.setpoints]
    jaws = recording.jaw_setpoints
    return tips + [described.Setpoints(arm, one.topic, None, len(one.stamps_ns)) for arm, one in jaws]


def _dropped(recording: Recording) -> list[described.Dropped]:
    signals = [
        signal for _, signal in (*recording.jaws, *recording.grippers, *recording.jaw_setpoints, *recording.pedals)
    ]
    streams: list[Motion | Joints | Signal]
    streams = [*recording.motions, *recording.joints, *recording.masters, *recording.setpoints, *signals]
    return [described.Dropped(one.topic, one.backward_stamps) for one in streams if one.backward_stamps]


def _quality(motion: Motion) -> described.Quality:
    steps_ns = np.diff(motion.stamps_ns)
    x, y, z = np.ptp(motion.tip_mm, axis=0).tolist()
    return described.Quality(
        arm=motion.arm,
        topic=motion.topic,
        duration_s=float(np.ptp(motion.stamps_ns)) / 1e9,
        rate_hz=1e9 / float(np.median(steps_ns)) if len(steps_ns) else None,
        longest_gap_s=float(steps_ns.max(initial=0)) / 1e9,
        extent_mm=(x, y, z),
        equal_samples=equal_samples(motion.tip_mm, motion.rotation_xyzw),
    )


def _jumps(recording: Recording) -> dict[str, str]:
    """Return the motions that can only be cut in parts, with the refusal of the whole."""
    found = {}
    for one in recording.motions:
        try:
            check_steps(one.topic, recording.seconds(one.stamps_ns), one.tip_mm)
        except ImplausibleMotion as error:
            found[f"jump of {one.topic}"] = str(error)
    return found


def _label(recording: Recording, label: Label) -> described.Label:
    start_s, end_s = ((stamp_ns - recording.origin_ns) / 1e9 for stamp_ns in (label.start_ns, label.end_ns))
    return described.Label(label.name, label.kind, start_s, end_s)


def _pedal(recording: Recording, topic: str, pedal: Signal) -> described.Pedal:
    """Return the number of presses of a pedal and their total duration.

    A press without release lasts to the end of the recording.
    """
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    presses = press_times(pedal)
    pressed_ns = sum(max(0, (last_ns if up is None else up) - down) for down, up in presses)
    return described.Pedal(topic, len(presses), pressed_ns / 1e9)


def _following(recording: Recording, name: str, signal: Signal) -> described.Following:
    """Return for how long a teleoperation drove its arm.

    The last value is valid to the end of the recording.
    """
    last_ns = recording.origin_ns + round(recording.duration_s * 1e9)
    held_ns = np.diff(np.append(signal.stamps_ns, max(last_ns, int(signal.stamps_ns[-1])))) if len(signal.values) else 0
    return described.Following(name, float((held_ns * (signal.values == 1)).sum()) / 1e9)
